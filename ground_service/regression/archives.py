"""Pass archives to fly again: folders and zips of them, checked, kept by content, pinned and removed.

Whatever an archive says, nothing outside the folder it is unpacked into is written, nothing unreasonably large is
unpacked, and no file is used whose hash is not the one in the manifest.
"""

import hashlib
import json
import logging
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput, NotFound, StoreError, storage_error
from ground_service.evaluation.inputs import read_image
from ground_service.ground import Ground
from ground_service.http.model import UtcTime
from ground_service.passes.archive_import import checked_files, read_manifest, unpacked
from ground_service.regression import store
from ground_service.regression.model import COMPLETE, TELEMETRY_ONLY, TO_RENDER, ArchiveRecord, KeptArchive
from ground_service.store.files import FileArchive, StoredFile, remove_leftovers, replace_durably, unfinished_prefix
from ground_service.store.vehicles import hold
from ground_service.toml import read_json, read_table

_log = logging.getLogger(__name__)

MANIFEST = "manifest.json"
_FILES_LOCK = "files of regression archives"
"""Lock held while files of archives are in use, so that no file is removed that another process has just stored."""

_WORKING = ".working-"
"""Prefix of folders with temporary copies; host and process follow, to identify leftovers."""

INPUTS = "payload/inputs.jsonl"
DETECTIONS = "payload/detections.jsonl"
"""Received detections by frame, from which an archive without frames is replayed."""

NOISE_DN = 1.0
"""Standard deviation of the noise of a placebo."""

_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
_PNG_HEADER = struct.Struct(">8s4x4sII")
_FLIGHT_FOLDERS = ("payload/", "frames/")
_FLIGHT_KEYS = (
    "schema_version", "pass_name", "spacecraft_id", "cadence_s", "frames_expected", "camera", "estimators",
    "dictionary",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class PassArchive:
    """An archive whose files have the hashes of its manifest.

    Attributes
    ----------
    digest
        SHA-256 of the manifest that the archive was kept with, which has the hash of every file: its identity.
    frames, frames_stored
        Frames that the payload was given, and those with a stored image.
    state, reason
        See `KeptArchive`.
    manifest_sha256
        SHA-256 of the manifest of a kept archive, which changes with its files; empty if the archive is not kept.
    """

    folder: Path
    digest: str
    manifest: dict[str, Any]
    frames: int
    frames_stored: int
    state: str = COMPLETE
    reason: str = ""
    manifest_sha256: str = ""

    @property
    def name(self) -> str:
        return str(self.manifest["pass_name"])

    @property
    def has_inputs(self) -> bool:
        """Return whether the archive contains the inputs of the payload."""
        return INPUTS in self.manifest["files"]


@contextmanager
def opened_archive(path: Path) -> Iterator[Path]:
    """The folder of an archive; a zip is unpacked for as long as the context lasts.

    Raises
    ------
    InvalidInput
        It is neither, or the zip names a place outside itself, holds links, or would grow beyond reason.
    """
    if path.is_dir():
        yield path
        return
    if not path.exists():
        raise InvalidInput(str(path), "", "a pass archive (folder or zip)", "nothing there")
    with unpacked(path, Path(tempfile.gettempdir()), str(path)) as folder:
        yield folder


def check_archive(folder: Path) -> PassArchive:
    """Check the hash of every file and the size of every stored frame, and return the archive.

    Frames that are not stored are rendered from the scenario of the archive at its first use; without a scenario the
    archive is telemetry only.

    Raises
    ------
    InvalidInput
        The archive is damaged, lacks an input of the payload, or has detections in addition to all its frames.
    """
    manifest, digest = read_manifest(folder)
    names = set(checked_files(folder, manifest))
    for name in (INPUTS, "payload/parameters.toml", "payload/dictionary.json", "reference.oem", "catalogue.csv"):
        if name not in names:
            raise InvalidInput(str(folder), name, "a file of an archive that can be flown again", "nothing there")
    rows = frame_inputs(folder)
    lacking = _lacking(rows, names)
    if DETECTIONS in names and not lacking:
        raise InvalidInput(str(folder), DETECTIONS, "received detections only where frames are missing", "all frames")
    _check_images(folder, manifest, [row for row in rows if row["image"] in names])
    state, reason = COMPLETE, ""
    if lacking:
        state = TO_RENDER
        if not manifest.get("scenario_toml"):
            state = TELEMETRY_ONLY
            reason = (
                f"{len(lacking)} of {len(rows)} frames are not stored, the first {lacking[0]}, and the archive "
                "declares no scenario to render them from"
            )
    return PassArchive(folder, digest, manifest, len(rows), len(rows) - len(lacking), state, reason)


def _lacking(rows: Sequence[Mapping[str, Any]], names: Collection[str]) -> list[int]:
    """Return the frames that had an image which is not among the files of the archive."""
    return [row["frame"] for row in rows if row["image"] and row["image"] not in names]


def _check_images(folder: Path, manifest: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:
    """Check that the stored frames have the recorded size and that of the camera."""
    camera = manifest.get("camera") or {}
    size = (camera.get("width_px"), camera.get("height_px"))
    for row in rows:
        place = str(folder / row["image"])
        found = _png_size(folder / row["image"])
        if tuple(row["shape"][:2]) != found[::-1]:
            recorded = f"{row['shape'][1]} x {row['shape'][0]} px as recorded"
            raise InvalidInput(place, "", recorded, _by(found))
        if found != size:
            raise InvalidInput(place, "", f"an image of the camera of {_by(size)} px", f"{_by(found)} px")


def pack_archive(folder: Path, target: Path) -> None:
    """Write a zip of an archive: the same archive gives the same octets."""
    manifest, _ = read_manifest(folder)
    names = [MANIFEST, *checked_files(folder, manifest)]
    partial = target.with_name(f".{target.name}.partial")
    try:
        with zipfile.ZipFile(partial, "w") as packed:
            for name in names:
                entry = zipfile.ZipInfo(name, _ZIP_EPOCH)
                entry.external_attr = 0o644 << 16
                entry.compress_type = zipfile.ZIP_STORED if name.endswith(".png") else zipfile.ZIP_DEFLATED
                packed.writestr(entry, (folder / name).read_bytes())
        replace_durably(partial, target)
    except OSError as error:
        raise storage_error(error, target) from None
    finally:
        partial.unlink(missing_ok=True)


def write_flight_view(archive: Path, folder: Path, *, noise: int = 0) -> None:
    """Copy what the payload was given into a folder: manifest without truth, inputs, tables, parameters, images.

    An archive without all its frames is replayed from its received detections, without images. `noise` is the seed of
    noise that is added to the images; 0: none.
    """
    manifest, _ = read_manifest(archive)
    folder.mkdir(parents=True)
    names = manifest["files"]
    partial = DETECTIONS in names and bool(_lacking(frame_inputs(archive), names))
    folders = ("payload/",) if partial else _FLIGHT_FOLDERS
    for name in names:
        if name.startswith(folders) and (partial or name != DETECTIONS):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(archive / name, folder / name)
    seen = {key: manifest[key] for key in _FLIGHT_KEYS if key in manifest}
    (folder / MANIFEST).write_text(json.dumps({**seen, "coding": coding_of(manifest)}, indent=1) + "\n")
    if noise and not partial:
        _add_noise(folder, noise)


def _add_noise(folder: Path, seed: int) -> None:
    """Add noise to the images of a flight view, and give its inputs their hashes."""
    from PIL import Image

    rng, rows = np.random.default_rng(seed), frame_inputs(folder, steps=True)
    for row in rows:
        if row["image"]:
            place = folder / row["image"]
            image = read_image(place.read_bytes(), place.name)
            noisy = np.rint(image + NOISE_DN * rng.standard_normal(image.shape))
            image = np.clip(noisy, 0, 255).astype(np.uint8)
            Image.fromarray(image).save(place, compress_level=1)
            row["pixels_sha256"] = hashlib.sha256(image.tobytes()).hexdigest()
    (folder / INPUTS).write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


def coding_of(manifest: dict[str, Any]) -> str:
    """Coding of the downlink of a pass, as its scenario says."""
    try:
        return str(read_table(str(manifest.get("scenario_toml") or ""), "scenario", "TOML")["link"]["coding"])
    except (InvalidInput, KeyError, TypeError):
        return "rs"


# The store


def keep_archive(ground: Ground, path: Path, *, pinned: bool = False) -> PassArchive:
    """Check an archive and keep it by content; keeping it again changes nothing but the pin."""
    with opened_archive(path) as folder:
        archive = check_archive(folder)
        store_archive(ground, archive, pinned=pinned)
    return archive


def store_archive(ground: Ground, archive: PassArchive, *, pinned: bool = False, pass_id: int | None = None) -> None:
    """Keep a checked archive; with `pass_id` it replaces the archives that were made of this pass before."""
    files = store_of(ground)
    stored = _stored(files, archive)
    with ground.database.writing() as connection:
        hold(connection, _FILES_LOCK)
        _restore(files, archive.folder, stored)
        record = ArchiveRecord(
            digest=archive.digest,
            name=archive.name,
            **_columns(archive, stored),
            pinned=pinned,
            kept_since=UtcTime(utc_now_ns()),
            pass_id=pass_id,
        )
        store.keep_archive(connection, record)
        replaced = [] if pass_id is None else store.remove_replaced(connection, pass_id, archive.digest)
    _remove_files(ground, replaced)


def restock_archive(ground: Ground, record: ArchiveRecord, archive: PassArchive) -> None:
    """Replace the files and the state of a kept archive, unless nothing or another process has changed it."""
    files = store_of(ground)
    stored = _stored(files, archive)
    found = (stored[MANIFEST].sha256, archive.state, archive.reason)
    if found == (record.manifest_sha256, record.state, record.reason):
        return
    with ground.database.writing() as connection:
        hold(connection, _FILES_LOCK)
        _restore(files, archive.folder, stored)
        store.restock_archive(connection, record, **_columns(archive, stored))


def _columns(archive: PassArchive, stored: Mapping[str, StoredFile]) -> dict[str, Any]:
    """Return the columns of the contents of an archive."""
    octets = sum(file.octets for file in stored.values())
    same = {name: getattr(archive, name) for name in ("frames", "frames_stored", "state", "reason")}
    return {"manifest_sha256": stored[MANIFEST].sha256, "octets": octets, **same}


def _stored(files: FileArchive, archive: PassArchive) -> dict[str, StoredFile]:
    return {name: files.put_file(archive.folder / name) for name in (*archive.manifest["files"], MANIFEST)}


def _restore(files: FileArchive, folder: Path, stored: Mapping[str, StoredFile]) -> None:
    """Store files again that were removed with another archive meanwhile."""
    for name, file in stored.items():
        if files.octets(file.sha256) is None:
            files.put_file(folder / name)


def kept_archives(ground: Ground) -> list[KeptArchive]:
    """Return the kept archives, oldest first."""
    with ground.database.reading() as connection:
        return [_shown(record) for record in store.list_archives(connection)]


def kept_archive(ground: Ground, digest: str) -> KeptArchive:
    with ground.database.reading() as connection:
        return _shown(store.get_archive(connection, digest))


def check_out(ground: Ground, digest: str, folder: Path, *, images: bool = True) -> PassArchive:
    """Write a kept archive into a folder, checked again, and note its use.

    Without its images: what the ground reads of a pass, which is no use.
    """
    with ground.database.writing() as connection:
        if images:
            store.use_archive(connection, digest, utc_now_ns())
        record = store.get_archive(connection, digest)
    files = store_of(ground)
    archive = archive_of(ground, record, folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / MANIFEST).write_bytes(files.get(record.manifest_sha256))
        names = {
            name: entry for name, entry in archive.manifest["files"].items() if images or not name.startswith("frames/")
        }
        for name, entry in names.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(files.path(entry["sha256"]), folder / name)
    except FileNotFoundError:
        raise NotFound("file of archive", digest) from None
    except OSError as error:
        raise storage_error(error, folder) from None
    if archive.has_inputs and images:
        check_archive(folder)
    else:
        checked_files(folder, {**archive.manifest, "files": names})
    return archive


def archive_of(ground: Ground, record: ArchiveRecord, folder: Path) -> PassArchive:
    """Return a kept archive with its manifest; `folder` is where its files are."""
    manifest = json.loads(store_of(ground).get(record.manifest_sha256))
    return PassArchive(
        folder,
        record.digest,
        manifest,
        record.frames,
        record.frames_stored,
        record.state,
        record.reason,
        record.manifest_sha256,
    )


def pin_archive(ground: Ground, digest: str, pinned: bool) -> None:
    """Exclude an archive from retention, or include it again."""
    ground.write(store.pin_archive, digest, pinned)


def let_go(
    ground: Ground,
    *,
    unused_for_ns: int | None,
    limit_octets: int | None = None,
    actor: str = "service",
    condition: Callable[[str], str] = str,
) -> list[str]:
    """Remove archives that are not pinned; return their identities. Each removal is recorded in the audit log.

    Files that another archive holds too stay.

    Parameters
    ----------
    unused_for_ns
        Remove those that were not used for so long; None: none for their age.
    limit_octets
        Remove those of the condition that most have, the longest unused first, until the others have this size; None:
        any size.
    condition
        Returns the condition of a kept archive with frames.
    """
    conditions = {}
    if limit_octets is not None and sum(one.octets for one in kept_archives(ground)) > limit_octets:
        whole = [one.digest for one in kept_archives(ground) if one.state == COMPLETE]
        conditions = {digest: condition(digest) for digest in whole}
    with ground.database.writing() as connection:
        hold(connection, _FILES_LOCK)
        now = utc_now_ns()
        removed = [] if unused_for_ns is None else store.remove_unused(connection, now - unused_for_ns)
        if limit_octets is not None:
            removed += store.remove_above(connection, limit_octets, conditions)
        for record in removed:
            detail = {"pass": record.pass_id, "octets": record.octets, "kept_since": str(record.kept_since)}
            audit(connection, actor, "remove regression archive", record.digest, detail)
    _remove_files(ground, removed)
    return sorted(record.digest for record in removed)


def _remove_files(ground: Ground, removed: Sequence[ArchiveRecord]) -> None:
    """Remove the files of archives that were removed, after the commit."""
    files = store_of(ground)
    unused: set[str] = set()
    for record in removed:
        try:
            unused |= _held(files, record)
        except (NotFound, StoreError) as error:
            _log.warning("files of removed archive %s are not removed: %s", record.digest, error)
    remove_unheld(ground, unused)


def remove_unheld(ground: Ground, unused: set[str]) -> None:
    """Remove files by their hashes, unless a kept archive has them.

    Nothing is removed while the manifest of a kept archive cannot be read, because its files are not known.
    """
    if not unused:
        return
    files = store_of(ground)
    with ground.database.writing() as connection:
        hold(connection, _FILES_LOCK)
        try:
            for record in store.list_archives(connection):
                unused = unused - _held(files, record)
        except (NotFound, StoreError) as error:
            _log.warning("no files of archives are removed: kept archive %s: %s", record.digest, error)
            return
        for sha256 in unused:
            files.remove(sha256)


@contextmanager
def working_folder(ground: Ground) -> Iterator[Path]:
    """Yield a folder for temporary copies of archives, which only the service can read."""
    scratch = _scratch_of(ground)
    scratch.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=unfinished_prefix(_WORKING), dir=scratch) as name:
        yield Path(name)


def remove_unfinished(ground: Ground) -> int:
    """Remove the temporary copies and unfinished files of ended processes; return their number."""
    return remove_leftovers(_scratch_of(ground), _WORKING) + store_of(ground).remove_leftovers()


def _scratch_of(ground: Ground) -> Path:
    return ground.home / "regression" / "scratch"


def store_of(ground: Ground) -> FileArchive:
    """The files of archives and replays, apart from those of the ground's own archive."""
    objects = None if ground.objects is None else ground.objects.under("regression")
    return FileArchive(ground.home / "regression" / "files", objects)


def _held(files: FileArchive, record: ArchiveRecord) -> set[str]:
    """Return the hashes of the files of an archive, its manifest included."""
    manifest = json.loads(files.get(record.manifest_sha256))
    return {record.manifest_sha256, *(entry["sha256"] for entry in manifest["files"].values())}


def _shown(record: ArchiveRecord) -> KeptArchive:
    return KeptArchive.of(dict(record))


def frame_inputs(folder: Path, *, steps: bool = False) -> list[dict[str, Any]]:
    """Return the inputs of the payload, a row per frame; steps without one only with `steps`."""
    path = folder / INPUTS
    rows = []
    try:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines()):
            row = read_json(line, INPUTS)
            if not isinstance(row["frame"], int) or not isinstance(row["shape"], list):
                raise ValueError(f"line {number + 1}")
            if row["frame"] >= 0 or steps:
                rows.append({"image": None, **row})
    except (InvalidInput, ValueError, KeyError, TypeError) as error:
        raise InvalidInput(str(path), "", "a line of inputs for each step", str(error)) from None
    return rows


def _png_size(path: Path) -> tuple[int, int]:
    """Width and height of a PNG by its header."""
    with path.open("rb") as stream:
        head = stream.read(_PNG_HEADER.size)
    if len(head) == _PNG_HEADER.size:
        signature, kind, width, height = _PNG_HEADER.unpack(head)
        if signature == b"\x89PNG\r\n\x1a\n" and kind == b"IHDR":
            return width, height
    raise InvalidInput(str(path), "", "a PNG image", "something else")


def _by(size: tuple[Any, ...]) -> str:
    return f"{size[0]} x {size[1]}"
