"""Pass archives that come as zip files: unpacked only where nothing in them can do harm."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from ground_service.errors import InvalidInput, storage_error
from ground_service.ground import Ground
from ground_service.passes.archive_import import import_archive
from ground_service.store.files import UNPACKING, unfinished_prefix

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
    """Refuse a zip with a too large central directory before reading it into memory.

    Raises
    ------
    InvalidInput
        If the directory has too many octets or entries, also if the end record states fewer.
    """
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
                        raise InvalidInput(
                            name, entry.filename[:80], f"at most {limit} octets when unpacked", "more"
                        )
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
    """Where the manifest lies: in the folder, or in the only one within it."""
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
