"""Import of a pass archive (folder or ZIP): manifest, reference, catalogue, images and downlink become a pass."""

import contextlib
import hashlib
import os
import shutil
import stat
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput, NotFound, storage_error
from ground_service.ground import Ground
from ground_service.ingest.service import ingest_stored
from ground_service.missions import store as missions
from ground_service.missions.ephemerides.service import attitude_file, check_attitudes, insert_ephemeris, load_attitudes
from ground_service.missions.frames import mission_of_manifest
from ground_service.missions.model import Mission
from ground_service.missions.service import enter, read_mission
from ground_service.missions.timekeeping.core import utc_ns_of_ticks
from ground_service.missions.timekeeping.recorrelation import enter_receptions, read_receptions
from ground_service.passes import sample_store, store
from ground_service.passes.model import Image
from ground_service.passes.span import PassSpan, pass_span, vehicle_span
from ground_service.store.event_kinds import ArchiveImported, publish_once
from ground_service.store.files import UNPACKING, StoredFile, register_file, unfinished_prefix
from ground_service.store.vehicles import ARCHIVE_ACTOR, SPACECRAFT_ID_MAX, find_vehicle, hold, vehicle_id
from ground_service.toml import read_json, require_line
from lunar.arrays import FloatArray
from lunar.catalogue import load_catalogue
from lunar.constants import DAY_NS
from lunar.ephemeris import Ephemeris
from lunar.errors import LunarError
from lunar.messages.ephemeris_files import load_orbit
from lunar.timescales import TICKS_PER_SECOND, parse_utc
from tmtc.dictionary.payload import APID_LARGE_DATA, DICTIONARY
from tmtc.errors import ValueRefused
from tmtc.packets.large_data import LargeDataReceiver, Thumbnail, unpack_thumbnail
from tmtc.packets.stream import cut_packets

SCHEMA_VERSION = 1
RECEPTIONS_FILE = "receptions.csv"
MISSION_FILE = "mission.toml"
MANIFEST_FILE = "manifest.json"
Content = TypeVar("Content")

FRAMES_KEPT = 200
"""Images kept with a pass, spread evenly: galleries need a few, and a day of them would fill the archive."""

_REQUIRED: dict[str, type | tuple[type, ...]] = {
    "schema_version": int,
    "pass_name": str,
    "spacecraft_id": int,
    "start_utc": str,
    "stop_utc": str,
    "files": dict,
}
_NUMBERS = {
    "cadence_s": (0.0, 86_400.0),
    "frames_expected": (0, 10_000_000),
    "camera.width_px": (1, 16_384),
    "camera.height_px": (1, 16_384),
    "camera.fov_deg": (0.0, 180.0),
}
"""Least and greatest value of what a manifest may state; NaN is neither."""


def import_archive(ground: Ground, folder: Path) -> int:
    """Import a pass archive; the id of its pass. Importing the same archive again changes nothing.

    Every file is checked against the hash that the manifest gives before anything is stored. The telemetry goes
    into an instance of the spacecraft that belongs to this archive alone, so that runs of an emulator do not mix.

    Raises
    ------
    InvalidInput
        If the archive is not complete or not what its manifest says.
    """
    folder = Path(folder)
    manifest, digest = read_manifest(folder)
    names = checked_files(folder, manifest)
    start_utc_ns, stop_utc_ns = _interval(folder, manifest)
    mission, text = _mission(folder, manifest)
    reference = _readable(load_orbit, folder / "reference.oem", names)
    _readable(load_catalogue, folder / "catalogue.csv", names)
    receptions = read_receptions(folder / RECEPTIONS_FILE, 0) if RECEPTIONS_FILE in names else []
    attitudes = attitude_file(names, str(folder))
    if attitudes is not None:
        table = load_attitudes(folder / attitudes, str(folder / attitudes))
        if reference is not None:
            try:
                check_attitudes(table, reference, start_utc_ns, stop_utc_ns)
            except LunarError as error:
                raise InvalidInput(str(folder / attitudes), "", "attitudes of the pass", str(error)) from None
    stored = {name: ground.files.put_file(folder / name) for name in names if not name.startswith("frames/")}
    # The regression archive of the pass is made of the stored files, which the manifest names.
    stored[MANIFEST_FILE] = ground.files.put_file(folder / MANIFEST_FILE)
    images = {number: ground.files.put_file(folder / name) for number, name in _chosen_frames(names)}
    pass_id = _register(
        ground, folder, manifest, digest, start_utc_ns, stop_utc_ns, stored, images, (mission, text), reference
    )
    if receptions:  # a flight in the range of no station has none
        enter_receptions(
            ground, int(manifest["spacecraft_id"]), instance_of(manifest, digest), receptions, actor="archive"
        )
    if "downlink.cadu" in stored:
        ingest_stored(
            ground,
            stored["downlink.cadu"],
            spacecraft_id=manifest["spacecraft_id"],
            instance=instance_of(manifest, digest),
            name="downlink.cadu",
        )
    with ground.database.writing() as connection:
        hold(connection, f"archive {digest}")
        vehicle = store.get_pass(connection, pass_id).vehicle_id
        publish_once(connection, ArchiveImported(pass_id=pass_id, vehicle_id=vehicle))
    return pass_id


def _readable(load: Callable[[Path], Content], path: Path, names: Collection[str]) -> Content | None:
    """Return the content of a file of an archive, None if the archive has no such file."""
    try:
        return load(path) if path.name in names else None
    except LunarError as error:
        raise InvalidInput(str(path), "", "a readable file", str(error)) from None


def read_manifest(folder: Path) -> tuple[dict[str, Any], str]:
    """The manifest of a pass archive, checked for what must be in it, and the SHA-256 that names the archive."""
    path = folder / "manifest.json"
    if not folder.is_dir():
        raise InvalidInput(str(folder), "", "a pass archive folder", "a file" if folder.exists() else "nothing there")
    try:
        octets = path.read_bytes()
    except FileNotFoundError:
        raise InvalidInput(str(folder), "", "a pass archive with manifest.json", "no manifest.json") from None
    except OSError as error:
        raise storage_error(error, path) from None
    manifest = read_json(octets, str(path))
    if not isinstance(manifest, dict):
        raise InvalidInput(str(path), "", "a JSON object", type(manifest).__name__)
    for key, kind in _REQUIRED.items():
        if not isinstance(manifest.get(key), kind) or isinstance(manifest.get(key), bool):
            expected = kind.__name__ if isinstance(kind, type) else "a value"
            raise InvalidInput(str(path), key, expected, repr(manifest.get(key))[:80])
    if manifest["schema_version"] > SCHEMA_VERSION:
        raise InvalidInput(
            str(path), "schema_version", f"{SCHEMA_VERSION} or less", f"{manifest['schema_version']} of a newer version"
        )
    for place, (least, most) in _NUMBERS.items():
        section, _, key = place.rpartition(".")
        table = manifest.get(section) if section else manifest
        value = table.get(key) if isinstance(table, dict) else None
        if value is not None and not (isinstance(value, int | float) and least <= value <= most):
            raise InvalidInput(str(path), place, f"a number from {least} to {most}", repr(value)[:40])
    require_line(manifest["pass_name"], str(path), "pass_name")
    if not 0 <= manifest["spacecraft_id"] <= SPACECRAFT_ID_MAX:
        found = str(manifest["spacecraft_id"])[:40]
        raise InvalidInput(str(path), "spacecraft_id", f"0 to {SPACECRAFT_ID_MAX}", found)
    return manifest, hashlib.sha256(octets).hexdigest()


def instance_of(manifest: Mapping[str, Any], digest: str) -> str:
    """The instance of the spacecraft that the telemetry of an archive belongs to."""
    name = "".join(c if c.isalnum() or c in "-_." else "-" for c in str(manifest["pass_name"]))[:60]
    return f"{name}@{digest[:16]}"


def checked_files(folder: Path, manifest: Mapping[str, Any]) -> list[str]:
    """Names of the files of the archive, each found to have the size and hash that the manifest gives."""
    root = folder.resolve()
    names = []
    for name, entry in sorted(manifest["files"].items()):
        path = folder / name
        if not isinstance(entry, dict) or not isinstance(entry.get("sha256"), str):
            raise InvalidInput(
                str(folder / "manifest.json"), f"files.{name}", "an object with sha256", repr(entry)[:80]
            )
        if Path(name).is_absolute() or not path.resolve().is_relative_to(root):
            raise InvalidInput(str(folder / "manifest.json"), f"files.{name}", "a path inside the archive", name)
        if not path.is_file():
            raise InvalidInput(str(folder), name, "a file of the archive", "nothing there")
        found = _sha256(path)
        if found != entry["sha256"]:
            raise InvalidInput(
                str(path),
                "",
                f"SHA-256 {entry['sha256'][:16]}… of the manifest",
                f"{found[:16]}… (damaged or cut short)",
            )
        size = path.stat().st_size
        if entry.get("bytes", size) != size:
            raise InvalidInput(str(path), "", f"{str(entry['bytes'])[:20]} octets as in the manifest", str(size))
        names.append(name)
    return names


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise storage_error(error, path) from None


def _interval(folder: Path, manifest: Mapping[str, Any]) -> tuple[int, int]:
    path = str(folder / "manifest.json")
    try:
        start, stop = parse_utc(manifest["start_utc"]), parse_utc(manifest["stop_utc"])
    except LunarError as error:
        raise InvalidInput(path, "start_utc, stop_utc", "UTC epochs", str(error)) from None
    if stop < start:
        raise InvalidInput(path, "stop_utc", f"an epoch after {manifest['start_utc']}", manifest["stop_utc"])
    return start, stop


def archived_mission(folder: Path, manifest: Mapping[str, Any]) -> Mission:
    """Return the mission description of an archive, otherwise that of its manifest."""
    return _mission(folder, manifest)[0]


def _mission(folder: Path, manifest: Mapping[str, Any]) -> tuple[Mission, str | None]:
    if MISSION_FILE not in manifest["files"]:
        return mission_of_manifest(manifest), None
    path = folder / MISSION_FILE
    mission, text = read_mission(path.read_bytes(), str(path))
    stated = mission.spacecraft.id
    if stated is not None and stated != manifest["spacecraft_id"]:
        expected = f"{manifest['spacecraft_id']} as in manifest.json"
        raise InvalidInput(str(path), "spacecraft.id", expected, str(stated))
    return mission, text


def _chosen_frames(names: list[str]) -> list[tuple[int, str]]:
    """Frame numbers and names of the images to keep."""
    frames = []
    for name in names:
        stem = Path(name).stem
        if name.startswith("frames/") and stem.isdigit():
            frames.append((int(stem), name))
    frames.sort()
    if len(frames) <= FRAMES_KEPT:
        return frames
    step = (len(frames) - 1) / (FRAMES_KEPT - 1)
    return [frames[round(k * step)] for k in range(FRAMES_KEPT)]


def _register(
    ground: Ground,
    folder: Path,
    manifest: dict[str, Any],
    digest: str,
    start_utc_ns: int,
    stop_utc_ns: int,
    stored: Mapping[str, StoredFile],
    images: Mapping[int, StoredFile],
    mission: tuple[Mission, str | None],
    reference: Ephemeris | None,
) -> int:
    now = utc_now_ns()
    attitudes = attitude_file(stored, str(folder))
    with ground.database.writing() as connection:
        hold(connection, f"archive {digest}")
        existing = store.archived_pass(connection, digest)
        if existing is not None:
            return existing
        for name, file in stored.items():
            register_file(connection, file, Path(name).stem, name, now)
        for number, file in images.items():
            register_file(connection, file, "frame", f"frame {number}", now)
        ephemeris_id = None
        if reference is not None:
            ephemeris_id = insert_ephemeris(
                connection,
                stored["reference.oem"],
                reference,
                name=f"reference of {manifest['pass_name']}",
                precedence=0,
                now_utc_ns=now,
            ).id
        pass_id = store.add_pass(
            connection,
            vehicle_id=vehicle_id(connection, manifest["spacecraft_id"], instance_of(manifest, digest)),
            name=manifest["pass_name"],
            start_utc_ns=start_utc_ns,
            stop_utc_ns=stop_utc_ns,
            archive_digest=digest,
            manifest={key: value for key, value in manifest.items() if key != "files"},
            ephemeris_id=ephemeris_id,
            catalogue_sha256=stored["catalogue.csv"].sha256 if "catalogue.csv" in stored else None,
            attitude_sha256=None if attitudes is None else stored[attitudes].sha256,
            mission_id=enter(connection, *mission, actor=ARCHIVE_ACTOR),
            now_utc_ns=now,
        )
        store.add_frames(connection, pass_id, {number: file.sha256 for number, file in images.items()})
        return pass_id


ENTRIES_LIMIT = 20_000
DIRECTORY_LIMIT_OCTETS = 8 << 20
"""Largest size of the central directory in octets, 400 for each entry; the directory is read at once."""

OCTETS_LIMIT = 16 << 30
RATIO_LIMIT = 200
"""Images and telemetry shrink by ten at most; what grows a hundredfold and more is made to fill the disk."""

RATIO_FREE_OCTETS = 1 << 20
BLOCK_OCTETS = 1 << 20


def import_zip(ground: Ground, path: Path, name: str = "archive.zip") -> int:
    """Import a zipped pass archive; the id of its pass.

    Raises
    ------
    InvalidInput
        If it is no zip file, would write outside its folder or fill the disk, or is no pass archive.
    """
    with unpacked(path, ground.home, name) as folder:
        return import_archive(ground, folder)


@contextmanager
def unpacked(path: Path, work: Path, name: str) -> Iterator[Path]:
    """The files of a zip in a folder under `work`, which is removed in the end."""
    try:
        folder = Path(tempfile.mkdtemp(prefix=unfinished_prefix(UNPACKING), dir=work))
    except OSError as error:
        raise storage_error(error, work) from None
    try:
        with _opened(path, name) as archive:
            _unpack(archive, folder, path.stat().st_size, name)
        yield _root(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _opened(path: Path, name: str) -> Iterator[zipfile.ZipFile]:
    try:
        _check_directory(path, name)
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError, ValueError, EOFError):
        raise InvalidInput(name, "", "a complete zip file", "something else, or a part of one") from None
    with archive:
        yield archive


_END = struct.Struct("<4s4H2LH")
_END_64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR_64 = struct.Struct("<4sLQL")
_ENTRY_OCTETS = 46


def _check_directory(path: Path, name: str) -> None:
    """Refuse a zip with a too large central directory before reading it into memory."""
    with path.open("rb") as stream:
        tail_start = max(stream.seek(0, os.SEEK_END) - (1 << 16) - _END.size, 0)
        stream.seek(tail_start)
        tail = stream.read()
        at = len(tail) - _END.size
        if at < 0 or tail[at : at + 4] != b"PK\5\6" or tail[-2:] != b"\0\0":
            at = tail.rfind(b"PK\5\6")
        if at < 0 or at + _END.size > len(tail):
            raise zipfile.BadZipFile
        entries, octets = _END.unpack_from(tail, at)[4:6]
        end = tail_start + at
        stream.seek(max(end - _LOCATOR_64.size - _END_64.size, 0))
        record = stream.read(_END_64.size + _LOCATOR_64.size)
        if len(record) == _END_64.size + _LOCATOR_64.size and record[_END_64.size :][:4] == b"PK\6\7":
            entries, octets = _END_64.unpack_from(record)[7:9]
            end -= len(record)
        _refuse_over(name, "files", ENTRIES_LIMIT, entries)
        _refuse_over(name, "octets of its directory", DIRECTORY_LIMIT_OCTETS, octets)
        if octets > end:
            raise zipfile.BadZipFile
        stream.seek(end - octets)
        directory = stream.read(octets)
    position = found = 0
    while position + _ENTRY_OCTETS <= len(directory):
        found += 1
        position += _ENTRY_OCTETS + sum(struct.unpack_from("<3H", directory, position + 28))
    _refuse_over(name, "files", ENTRIES_LIMIT, found)


def _refuse_over(name: str, what: str, limit: int, found: int) -> None:
    if found > limit:
        raise InvalidInput(name, "", f"at most {limit} {what}", str(found))


def _unpack(archive: zipfile.ZipFile, folder: Path, packed_octets: int, name: str) -> None:
    entries = archive.infolist()
    seen: set[str] = set()
    limit = min(OCTETS_LIMIT, max(packed_octets * RATIO_LIMIT, RATIO_FREE_OCTETS))
    _refuse_over(name, "octets when unpacked", limit, sum(entry.file_size for entry in entries))
    taken = 0
    for entry in entries:
        target = folder / _checked_name(entry, seen, name)
        if entry.is_dir():
            target.mkdir(parents=True, exist_ok=True)
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            with archive.open(entry) as source, target.open("xb") as sink:
                while block := source.read(BLOCK_OCTETS):
                    taken += len(block)
                    if taken > limit:
                        raise InvalidInput(name, entry.filename[:80], f"at most {limit} octets when unpacked", "more")
                    sink.write(block)
        except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
            raise InvalidInput(name, entry.filename[:80], "a whole file", str(error)[:120]) from None
        except OSError as error:
            raise storage_error(error, folder) from None


def _checked_name(entry: zipfile.ZipInfo, seen: set[str], name: str) -> str:
    """The path of an entry inside the archive; anything that could lead elsewhere is refused."""
    path = PurePosixPath(entry.filename)
    mode = entry.external_attr >> 16
    harmless = (
        entry.filename
        and "\\" not in entry.filename
        and "\0" not in entry.filename
        and ":" not in entry.filename
        and not path.is_absolute()
        and ".." not in path.parts
        and len(entry.filename) < 1000
        and not stat.S_ISLNK(mode)
        and not entry.flag_bits & 1
    )
    if not harmless:
        raise InvalidInput(name, repr(entry.filename[:80]), "a plain file inside the archive", "another path")
    if str(path) in seen:
        raise InvalidInput(name, entry.filename[:80], "each file once", "it twice")
    seen.add(str(path))
    return str(path)


def _root(folder: Path) -> Path:
    """Return the folder of the manifest: the folder itself, or the only one within it."""
    inside = list(folder.iterdir())
    if len(inside) == 1 and inside[0].is_dir() and not (folder / "manifest.json").exists():
        return inside[0]
    return folder


def zip_folder(folder: Path) -> Path:
    """Return an uncompressed zip file of the files of a folder; the caller removes it."""
    descriptor, name = tempfile.mkstemp(suffix=".zip")
    os.close(descriptor)
    try:
        with zipfile.ZipFile(name, "w", zipfile.ZIP_STORED) as archive:
            for path in sorted(folder.rglob("*")):
                if path.is_file():
                    archive.write(path, str(path.relative_to(folder)))
    except BaseException:
        with contextlib.suppress(OSError):
            Path(name).unlink()
        raise
    return Path(name)


IMAGES_LIMIT = 2000
"""Largest number of images in a list; the newest of an interval are listed."""

ORANGE_BGR = (0, 159, 230)

DRAWN_PX = 512
"""Least width of a thumbnail with detections: circles of a few pixels show nothing."""

FRAME_MARGIN_S = 1
"""A frame and the report of its detections have times that differ by less."""

DAYS_LIMIT = 31
DELAY_NS = DAY_NS
"""Thumbnails are looked for in packets up to a day later than their frame."""

THUMBNAIL = {name: code for code, name in DICTIONARY.labels("large_data_last", "table").items()}["thumbnail"]


def list_images(ground: Ground, spacecraft_id: int, instance: str, start_utc_ns: int, stop_utc_ns: int) -> list[Image]:
    """Return the images of a spacecraft in an interval, in time order; of more than `IMAGES_LIMIT` the newest.

    Raises
    ------
    NotFound
        There is no such spacecraft.
    InvalidInput
        The interval is longer than `DAYS_LIMIT`.
    """
    if stop_utc_ns - start_utc_ns > DAYS_LIMIT * DAY_NS:
        found_days = f"{(stop_utc_ns - start_utc_ns) / DAY_NS:.0f} days"
        raise InvalidInput("images", "stop", f"at most {DAYS_LIMIT} days after start", found_days)
    with ground.database.reading() as connection:
        vehicle = find_vehicle(connection, spacecraft_id, instance).id
        found = [
            *_archived(connection, vehicle, start_utc_ns, stop_utc_ns),
            *_downlinked(connection, vehicle, spacecraft_id, instance, start_utc_ns, stop_utc_ns),
        ]
    inside = [one for one in found if start_utc_ns <= one.time.utc_ns <= stop_utc_ns]
    return sorted(inside, key=lambda one: (one.time.utc_ns, one.source, one.frame_number))[-IMAGES_LIMIT:]


def archived_image(ground: Ground, pass_id: int, frame_number: int, *, detections: bool = False) -> bytes:
    """Return a full frame of a pass archive as PNG, with circles around the detections of the payload if required.

    Raises
    ------
    NotFound
        There is no such pass, or its archive has no such frame.
    InvalidInput
        Detections cannot be drawn because the archived file is no image.
    """
    with ground.database.reading() as connection:
        record = store.get_pass(connection, pass_id)
        sha256 = store.frame_files(connection, pass_id).get(frame_number)
        found = _circles(connection, pass_span(connection, record), frame_number) if detections else None
    if sha256 is None:
        raise NotFound(f"pass {pass_id}: image of frame", frame_number)
    octets = ground.files.get(sha256)
    if found is None:
        return octets
    import cv2

    picture = cv2.imdecode(np.frombuffer(octets, dtype=np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise InvalidInput("archived image", "", "a PNG image", "another file")
    return _drawn(picture, found)


def _circles(connection: Connection, span: PassSpan, frame_number: int) -> FloatArray:
    """Return the detections of a frame (n, 3): u, v and diameter in pixels."""
    samples = sample_store.detection_samples(connection, span)
    rows = [
        np.arange(samples.offsets[k], samples.offsets[k + 1])
        for k in np.flatnonzero(samples.frame_number == frame_number)
    ]
    chosen = np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)
    circles: FloatArray = np.column_stack([samples.u_px, samples.v_px, samples.diameter_px])[chosen]
    return circles


def _drawn(picture: NDArray[np.uint8], circles: FloatArray) -> bytes:
    import cv2

    for u_px, v_px, diameter_px in circles.tolist():
        cv2.circle(picture, (round(u_px), round(v_px)), max(round(diameter_px / 2.0), 1), ORANGE_BGR, 1)
    _, drawn = cv2.imencode(".png", picture)
    return drawn.tobytes()


def thumbnail_image(
    ground: Ground, spacecraft_id: int, instance: str, ticks: int, *, detections: bool = False
) -> bytes:
    """Return the thumbnail of the frame with an on-board time as PNG.

    With `detections` it is enlarged to at least `DRAWN_PX`, with circles around the detections of the payload.

    Raises
    ------
    NotFound
        There is no such spacecraft, or no such thumbnail was received completely.
    InvalidInput
        Detections cannot be drawn because the mission description does not state the width of the camera.
    """
    import cv2

    with ground.database.reading() as connection:
        vehicle = find_vehicle(connection, spacecraft_id, instance).id
        time_ns = int(vehicle_span(connection, vehicle, None, None).utc_ns([ticks])[0])
        span = vehicle_span(connection, vehicle, time_ns, time_ns + DELAY_NS)
        found = next((one for one in _thumbnails(connection, span) if one.ticks == ticks), None)
        if found is None:
            raise NotFound("thumbnail", ticks)
        if detections:
            width_px = _camera_width_px(connection, vehicle)
            if width_px is None:
                raise InvalidInput("detections", "camera.width_px", "a stated value", "not stated")
            margin_ns = FRAME_MARGIN_S * 1_000_000_000
            span = vehicle_span(connection, vehicle, time_ns - margin_ns, time_ns + margin_ns)
            return _enlarged(found, _circles(connection, span, found.frame_number), width_px)
    _, octets = cv2.imencode(".png", found.levels)
    return octets.tobytes()


def _enlarged(thumbnail: Thumbnail, circles: FloatArray, width_px: int) -> bytes:
    """Return a thumbnail with squares as pixels, and circles given in pixels of the whole image."""
    import cv2

    columns = thumbnail.levels.shape[1]
    factor = max(-(-DRAWN_PX // columns), 1)
    picture = cv2.cvtColor(np.kron(thumbnail.levels, np.ones((factor, factor), np.uint8)), cv2.COLOR_GRAY2BGR)
    # Pixels of the thumbnail are means of whole squares; what is left over at the edge is missing.
    scale = factor / max(width_px // columns, 1)
    drawn = np.column_stack([(circles[:, :2] + 0.5) * scale - 0.5, circles[:, 2] * scale])
    return _drawn(picture, drawn)


def _camera_width_px(connection: Connection, vehicle: int) -> int | None:
    mission = missions.mission_of_vehicle(connection, vehicle)
    return None if mission is None else mission.camera.width_px


def _archived(connection: Connection, vehicle: int, start_utc_ns: int, stop_utc_ns: int) -> Iterator[Image]:
    for record in store.passes_with_images(connection, vehicle, start_utc_ns, stop_utc_ns):
        span = pass_span(connection, record)
        rows = sample_store.samples(connection, span, "detections", ("frame_number", "ticks"))
        ticks = dict(zip(rows["frame_number"], rows["ticks"], strict=True))
        numbers = [number for number in store.frame_files(connection, record.id) if number in ticks]
        for number, time_ns in zip(numbers, span.utc_ns([ticks[number] for number in numbers]).tolist(), strict=True):
            address = f"/api/v1/passes/{record.id}/images/{number}"
            yield Image.of(
                {},
                frame_number=number,
                time=time_ns,
                source="archive",
                pass_id=record.id,
                address=address,
                overlay=f"{address}?detections=true",
            )


def _downlinked(
    connection: Connection, vehicle: int, spacecraft_id: int, instance: str, start_utc_ns: int, stop_utc_ns: int
) -> Iterator[Image]:
    span = vehicle_span(connection, vehicle, start_utc_ns, stop_utc_ns + DELAY_NS)
    rows = sample_store.samples(connection, span, "detections", ("frame_number", "ticks"))
    reported = np.array([rows["frame_number"], rows["ticks"]], dtype=np.int64)
    drawable = _camera_width_px(connection, vehicle) is not None
    for one in {found.ticks: found for found in _thumbnails(connection, span)}.values():
        time_ns = int(utc_ns_of_ticks(np.array([one.ticks]), span.correlations)[0][0])
        address = f"/api/v1/spacecraft/{spacecraft_id}/thumbnails/{one.ticks}?instance={instance}"
        of_frame = reported[1, reported[0] == one.frame_number]
        known = drawable and bool((np.abs(of_frame - one.ticks) <= FRAME_MARGIN_S * TICKS_PER_SECOND).any())
        yield Image.of(
            {},
            frame_number=one.frame_number,
            time=time_ns,
            source="thumbnail",
            pass_id=None,
            address=address,
            overlay=f"{address}&detections=true" if known else None,
        )


def _thumbnails(connection: Connection, span: PassSpan) -> Iterator[Thumbnail]:
    """Yield the thumbnails that were received completely in a span."""
    receiver = LargeDataReceiver()
    octets = sample_store.packet_octets(connection, span, APID_LARGE_DATA)
    cut = cut_packets(octets)
    for start, length in zip(cut.offsets.tolist(), cut.lengths.tolist(), strict=True):
        name, values = DICTIONARY.unpack(octets[start : start + length])
        whole = receiver.accept(name, values) if name.startswith("large_data_") else None
        if whole is not None and whole.table == THUMBNAIL:
            try:
                found = unpack_thumbnail(whole.octets)
            except ValueRefused:
                continue  # the parts of two transfers with one number
            if found.levels.size:
                yield found
