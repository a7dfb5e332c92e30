"""Pass archives to fly again: folders and zips of them, checked, kept by content, pinned and let go.

Whatever an archive says, nothing outside the folder it is unpacked into is written, nothing unreasonably large is
unpacked, and no file is used whose hash is not the one in the manifest.
"""

from __future__ import annotations

import json
import shutil
import struct
import tempfile
import tomllib
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput, NotFound, storage_error
from ground_service.ground import Ground
from ground_service.http.times import UtcTime
from ground_service.passes.archive_import import checked_files, read_manifest
from ground_service.passes.archive_zip import unpacked
from ground_service.regression import store
from ground_service.regression.model import ArchiveRecord, KeptArchive
from ground_service.store.counters import hold
from ground_service.store.files import FileArchive, replace_durably

MANIFEST = "manifest.json"
_FILES_LOCK = "files of regression archives"
"""Lock held while files of archives are in use, so that no file is removed that another process has just stored."""

INPUTS = "payload/inputs.jsonl"
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
        SHA-256 of the manifest, which holds the hash of every other file: the identity of the archive.
    frames
        Frames that the payload was given.
    """

    folder: Path
    digest: str
    manifest: dict[str, Any]
    frames: int

    @property
    def name(self) -> str:
        return str(self.manifest["pass_name"])


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
    """An archive that can be flown again: every hash as in the manifest, every frame there, of the camera it names.

    Raises
    ------
    InvalidInput
        What is wrong with it, and where.
    """
    manifest, digest = read_manifest(folder)
    names = set(checked_files(folder, manifest))
    for name in (
        INPUTS,
        "payload/parameters.toml",
        "payload/dictionary.json",
        "reference.oem",
        "catalogue.csv",
    ):
        if name not in names:
            raise InvalidInput(
                str(folder), name, "a file of an archive that can be flown again", "nothing there"
            )
    rows = frame_inputs(folder)
    lacking = [row["frame"] for row in rows if row["image"] and row["image"] not in names]
    if lacking:
        raise InvalidInput(
            str(folder),
            "frames",
            f"{len(rows)} frames",
            f"{len(lacking)} missing, the first {lacking[0]} (linna replay --complete renders them)",
        )
    camera = manifest.get("camera") or {}
    size = (camera.get("width_px"), camera.get("height_px"))
    for row in rows:
        if row["image"]:
            found = _png_size(folder / row["image"])
            if tuple(row["shape"][:2]) != found[::-1]:
                raise InvalidInput(
                    str(folder / row["image"]),
                    "",
                    f"{row['shape'][1]} x {row['shape'][0]} px as recorded",
                    _by(found),
                )
            if found != size:
                raise InvalidInput(
                    str(folder / row["image"]),
                    "",
                    f"an image of the camera of {_by(size)} px",
                    f"{_by(found)} px",
                )
    return PassArchive(folder, digest, manifest, len(rows))


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


def write_flight_view(archive: Path, folder: Path) -> None:
    """Copy what the payload was given into a folder: manifest without truth, inputs, tables, parameters, images."""
    manifest, _ = read_manifest(archive)
    folder.mkdir(parents=True)
    for name in manifest["files"]:
        if name.startswith(_FLIGHT_FOLDERS):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(archive / name, folder / name)
    seen = {key: manifest[key] for key in _FLIGHT_KEYS if key in manifest}
    (folder / MANIFEST).write_text(json.dumps({**seen, "coding": coding_of(manifest)}, indent=1) + "\n")


def coding_of(manifest: dict[str, Any]) -> str:
    """Coding of the downlink of a pass, as its scenario says."""
    try:
        return str(tomllib.loads(str(manifest.get("scenario_toml") or ""))["link"]["coding"])
    except (tomllib.TOMLDecodeError, KeyError, TypeError):
        return "rs"


# The store


def keep_archive(ground: Ground, path: Path, *, pinned: bool = False) -> PassArchive:
    """Check an archive and keep it by content; keeping it again changes nothing but the pin."""
    with opened_archive(path) as folder:
        archive = check_archive(folder)
        files = store_of(ground)
        stored = {name: files.put_file(folder / name) for name in (*archive.manifest["files"], MANIFEST)}
        now = utc_now_ns()
        with ground.database.writing() as connection:
            hold(connection, _FILES_LOCK)
            for name, file in stored.items():
                if not file.path.exists():  # the file was removed with another archive meanwhile
                    files.put_file(folder / name)
            record = ArchiveRecord(
                digest=archive.digest,
                name=archive.name,
                manifest_sha256=stored[MANIFEST].sha256,
                frames=archive.frames,
                octets=sum(file.octets for file in stored.values()),
                pinned=pinned,
                kept_since=UtcTime(now),
            )
            store.keep_archive(connection, record)
    return archive


def kept_archives(ground: Ground) -> list[KeptArchive]:
    """Return the kept archives, oldest first."""
    with ground.database.reading() as connection:
        return [_shown(record) for record in store.list_archives(connection)]


def kept_archive(ground: Ground, digest: str) -> KeptArchive:
    """Return a kept archive.

    Raises
    ------
    NotFound
        There is no such archive.
    """
    with ground.database.reading() as connection:
        return _shown(store.get_archive(connection, digest))


def check_out(ground: Ground, digest: str, folder: Path) -> PassArchive:
    """Write a kept archive into a folder, checked again.

    Raises
    ------
    NotFound
        No archive of this identity is kept.
    """
    with ground.database.writing() as connection:
        manifest_sha256 = store.use_archive(connection, digest, utc_now_ns()).manifest_sha256
    files = store_of(ground)
    manifest = json.loads(files.get(manifest_sha256))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / MANIFEST).write_bytes(files.get(manifest_sha256))
        for name, entry in manifest["files"].items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(files.path(entry["sha256"]), folder / name)
    except FileNotFoundError:
        raise NotFound("file of archive", digest) from None
    except OSError as error:
        raise storage_error(error, folder) from None
    return check_archive(folder)


def pin_archive(ground: Ground, digest: str, pinned: bool) -> None:
    """Exclude an archive from retention, or include it again."""
    with ground.database.writing() as connection:
        store.pin_archive(connection, digest, pinned)


def let_go(ground: Ground, *, unused_for_ns: int) -> list[str]:
    """Remove archives that are not pinned and were not used for so long; the identities of those removed.

    Files that another archive holds too stay.
    """
    files = store_of(ground)
    with ground.database.writing() as connection:
        hold(connection, _FILES_LOCK)
        old = store.remove_unused(connection, utc_now_ns() - unused_for_ns)
        needed = _held(files, store.list_archives(connection))
        for sha256 in _held(files, old) - needed:
            files.path(sha256).unlink(missing_ok=True)
    return sorted(record.digest for record in old)


def store_of(ground: Ground) -> FileArchive:
    """The files of archives and replays, apart from those of the ground's own archive."""
    return FileArchive(ground.home / "regression" / "files")


def _held(files: FileArchive, records: Sequence[ArchiveRecord]) -> set[str]:
    """Return the hashes of the files of archives, their manifests included."""
    held = {record.manifest_sha256 for record in records}
    for record in records:
        manifest = json.loads(files.get(record.manifest_sha256))
        held |= {entry["sha256"] for entry in manifest["files"].values()}
    return held


def _shown(record: ArchiveRecord) -> KeptArchive:
    return KeptArchive.of(dict(record))


def frame_inputs(folder: Path) -> list[dict[str, Any]]:
    """What the payload was given with each frame, a row per frame; steps without one are left out."""
    path = folder / INPUTS
    rows = []
    try:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines()):
            row = json.loads(line)
            if not isinstance(row["frame"], int) or not isinstance(row["shape"], list):
                raise ValueError(f"line {number + 1}")
            if row["frame"] >= 0:
                rows.append({"image": None, **row})
    except (ValueError, KeyError, TypeError) as error:
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
