"""Export and import of all rows and files as one portable file, with SQLite and PostgreSQL.

The file is a zip archive: `manifest.json` with its SHA-256 in `manifest.sha256`, one file of JSON lines for each table
(see `store.rows`), and the files of the archive under their SHA-256. The manifest has the number and SHA-256 of the
lines of each table, so an import verifies everything before it writes. All data are streamed: memory use does not
depend on the size of the archive.

A database of the last revision before version 1.0 can also be exported. Its import leaves out derived rows, decodes the
packets again, and adds the old audit entries to a hash chain.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from sqlalchemy import Connection

from ground_service.errors import (
    Conflict,
    DatabaseTooNew,
    DatabaseTooOld,
    FileDamaged,
    InvalidInput,
    storage_error,
)
from ground_service.ground import Ground
from ground_service.ingest.service import decode_all_again
from ground_service.store import audit, rows
from ground_service.store.database import Database, schema_revisions
from ground_service.store.files import FileArchive, replace_durably
from ground_service.worker import exchange_store as store
from lunar.timescales import format_utc

FORMAT, VERSION = "linna-export", 1
MANIFEST = "manifest.json"
MANIFEST_DIGEST = "manifest.sha256"
MANIFEST_LIMIT_OCTETS = 16 << 20
BLOCK_OCTETS = 1 << 20
EARLIER_REVISION = "0011"
"""Last schema revision before version 1.0; its tables can be exported."""

"""Columns missing in an earlier revision, and the column of the same row with their value."""

Say = Callable[[str], None]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ExportedTable(_Strict):
    """Table of an export."""

    columns: tuple[str, ...]
    rows: int = Field(ge=0)
    sha256: str = Field(description="SHA-256 of its lines")


class ExportedFiles(_Strict):
    """Files of an export."""

    count: int = Field(ge=0)
    octets: int = Field(ge=0)
    included: bool


class ExportManifest(_Strict):
    """Manifest of an export."""

    format: str
    version: int
    revision: str = Field(description="Schema revision of the exported database")
    made_utc: str
    tables: dict[str, ExportedTable]
    files: ExportedFiles
    audit_head: str | None = Field(description="NUMBER:SHA256 of the newest audit entry; null: no chain yet")


class ImportResult(_Strict):
    """Result of an import."""

    revision: str
    rows: dict[str, int]
    files: int
    left_out: dict[str, int] = Field(description="Rows of an earlier revision that were derived or not used")
    decoded: int = Field(description="Rows decoded again from packets of an earlier revision")


# Export


def export_database(
    database: Database,
    files: FileArchive,
    out: Path,
    *,
    now_utc_ns: int,
    with_files: bool = True,
    say: Say | None = None,
) -> ExportManifest:
    """Write a consistent snapshot of all rows (and files) of a database into a new zip file.

    Raises
    ------
    Conflict
        If the file exists already.
    DatabaseTooOld, DatabaseTooNew
        If this program cannot read the schema.
    """
    if out.exists():
        raise Conflict(f"{out}: expected a file that does not exist yet, found one")
    found, head, _ = schema_revisions(database)
    if found is None or found not in (head, EARLIER_REVISION):
        known = found is not None and found.isdigit() and found < EARLIER_REVISION
        raise (DatabaseTooOld if known else DatabaseTooNew)(database.label, head, found or "none")
    tell = say or (lambda _text: None)
    partial = out.with_name(f".{out.name}.partial")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with (
            database.snapshot() as connection,
            zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        ):
            tables = {}
            for table in store.exported_tables(connection, earlier=found != head):
                tell(table.name)
                tables[table.name] = _write_table(archive, connection, table)
            tell("files")
            written = _write_files(archive, connection, files, with_files=with_files)
            chain = audit.read_head(connection) if found == head else None
            manifest = ExportManifest(
                format=FORMAT,
                version=VERSION,
                revision=found,
                made_utc=format_utc(now_utc_ns),
                tables=tables,
                files=written,
                audit_head=f"{chain.number}:{chain.sha256}" if chain is not None else None,
            )
            listed = manifest.model_dump_json(indent=2).encode()
            archive.writestr(MANIFEST, listed)
            archive.writestr(MANIFEST_DIGEST, hashlib.sha256(listed).hexdigest())
        replace_durably(partial, out)
    except OSError as error:
        raise storage_error(error, out) from None
    finally:
        partial.unlink(missing_ok=True)
    return manifest


def _write_table(archive: zipfile.ZipFile, connection: Connection, table: rows.Table) -> ExportedTable:
    with archive.open(_entry(f"tables/{table.name}.jsonl"), "w", force_zip64=True) as stream:
        digest = rows.lines_digest(_written(stream, rows.table_lines(connection, table)))
    return ExportedTable(
        columns=tuple(column.name for column in table.columns), rows=digest.rows, sha256=digest.sha256
    )


def _written(stream: Any, lines: Iterable[bytes]) -> Iterator[bytes]:
    for line in lines:
        stream.write(line)
        yield line


def _write_files(
    archive: zipfile.ZipFile, connection: Connection, files: FileArchive, *, with_files: bool
) -> ExportedFiles:
    count = octets = 0
    for sha256, size in store.file_sizes(connection):
        count, octets = count + 1, octets + int(size)
        if not with_files:
            continue
        path = files.place(str(sha256))
        if files.octets(str(sha256)) is None:
            raise FileDamaged(path, str(sha256), "no file")
        digest = hashlib.sha256()
        with archive.open(_entry(f"files/{sha256}"), "w", force_zip64=True) as stream:
            for block in files.blocks(str(sha256)):
                digest.update(block)
                stream.write(block)
        if digest.hexdigest() != sha256:
            raise FileDamaged(path, str(sha256), digest.hexdigest())
    return ExportedFiles(count=count, octets=octets, included=with_files)


def _entry(name: str) -> zipfile.ZipInfo:
    """Return a zip entry with a fixed time."""
    entry = zipfile.ZipInfo(name)
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


# Import


def import_database(ground: Ground, path: Path, *, say: Say | None = None) -> ImportResult:
    """Import a verified export into an empty service.

    Raises
    ------
    InvalidInput
        If the file is not an export, or was changed.
    FileDamaged
        If a file of the archive in the export was changed.
    Conflict
        If the service is not empty.
    """
    tell = say or (lambda _text: None)
    try:
        archive = zipfile.ZipFile(path)
    except FileNotFoundError:
        raise InvalidInput(str(path), "", "a file that 'linna db export' wrote", "nothing there") from None
    except (zipfile.BadZipFile, OSError):
        raise InvalidInput(str(path), "", "a file that 'linna db export' wrote", "another file") from None
    with archive:
        manifest = _read_manifest(path, archive)
        with ground.database.reading() as connection:
            filled = rows.first_filled_table(connection)
        if filled is not None:
            raise Conflict(f"{ground.database.label}: expected an empty service, found rows in {filled}")
        tell("checking the export")
        _check_tables(path, archive, manifest)
        names = _file_names(path, archive, manifest)
        for name in names:
            if manifest.files.included:
                _check_file(path, archive, name)
            elif ground.files.octets(name) is None:
                raise InvalidInput(
                    str(path),
                    f"file {name[:16]}…",
                    f"the file in {ground.files.root}",
                    "none there or in the export",
                )
        if manifest.files.included:
            tell("files")
            for name in names:
                ground.files.put(_blocks(archive, f"files/{name}"))
        tell("rows")
        earlier = manifest.revision != schema_revisions(ground.database)[1]
        stored, left_out = _store_rows(ground, path, archive, manifest, earlier=earlier)
    decoded = 0
    if earlier:
        tell("packets decoded again")
        decoded = decode_all_again(ground)
    return ImportResult(
        revision=manifest.revision, rows=stored, files=len(names), left_out=left_out, decoded=decoded
    )


def _read_manifest(path: Path, archive: zipfile.ZipFile) -> ExportManifest:
    try:
        entry = archive.getinfo(MANIFEST)
        if entry.file_size > MANIFEST_LIMIT_OCTETS:
            raise ValueError("too long")
        listed = archive.read(entry)
        document = json.loads(listed)
        if (document["format"], document["version"]) != (FORMAT, VERSION):
            raise InvalidInput(
                str(path), MANIFEST, f"{FORMAT} version {VERSION}", f"version {str(document['version'])[:20]}"
            )
        if archive.read(MANIFEST_DIGEST) != hashlib.sha256(listed).hexdigest().encode():
            raise InvalidInput(
                str(path), MANIFEST, f"the manifest whose hash is in {MANIFEST_DIGEST}", "another"
            )
        return ExportManifest.model_validate(document)
    except (KeyError, TypeError, ValueError, ValidationError, zipfile.BadZipFile):
        raise InvalidInput(str(path), MANIFEST, "the manifest of an export", "none or another") from None


def _check_tables(path: Path, archive: zipfile.ZipFile, manifest: ExportManifest) -> None:
    for name, table in manifest.tables.items():
        found = rows.lines_digest(_lines(path, archive, name))
        if (found.rows, found.sha256) != (table.rows, table.sha256):
            raise InvalidInput(
                str(path),
                f"table {name}",
                f"{table.rows} rows as they were exported",
                f"{found.rows} changed rows",
            )


def _file_names(path: Path, archive: zipfile.ZipFile, manifest: ExportManifest) -> list[str]:
    table = manifest.tables.get("files")
    if table is None or "sha256" not in table.columns:
        raise InvalidInput(str(path), MANIFEST, "a table of files", "none")
    index = table.columns.index("sha256")
    names = [str(json.loads(line)[index]) for line in _lines(path, archive, "files")]
    for name in names:
        if len(name) != 64 or set(name) - set("0123456789abcdef"):
            raise InvalidInput(str(path), "table files", "SHA-256 of files", repr(name)[:80])
    return names


def _check_file(path: Path, archive: zipfile.ZipFile, name: str) -> None:
    digest = hashlib.sha256()
    try:
        for block in _blocks(archive, f"files/{name}"):
            digest.update(block)
    except (KeyError, zipfile.BadZipFile):
        raise InvalidInput(
            str(path), f"file {name[:16]}…", "the file as it was exported", "none or another"
        ) from None
    if digest.hexdigest() != name:
        raise FileDamaged(path / "files" / name, name, digest.hexdigest())


def _lines(path: Path, archive: zipfile.ZipFile, name: str) -> Iterator[bytes]:
    try:
        with archive.open(f"tables/{name}.jsonl") as stream:
            yield from stream
    except (KeyError, zipfile.BadZipFile):
        raise InvalidInput(
            str(path), f"table {name}", "rows as they were exported", "none or others"
        ) from None


def _blocks(archive: zipfile.ZipFile, name: str) -> Iterator[bytes]:
    with archive.open(name) as opened:
        stream: Any = opened
        while block := stream.read(BLOCK_OCTETS):
            yield block


def _store_rows(
    ground: Ground, path: Path, archive: zipfile.ZipFile, manifest: ExportManifest, *, earlier: bool
) -> tuple[dict[str, int], dict[str, int]]:
    """Insert the rows of every table in one transaction; return the numbers of inserted and omitted rows."""
    columns = {name: exported.columns for name, exported in manifest.tables.items()}
    with ground.database.writing() as connection:
        stored = store.insert_tables(
            connection, str(path), columns, lambda name: _lines(path, archive, name), earlier=earlier
        )
    taken = store.imported_tables(earlier=earlier)
    left_out = {
        name: exported.rows
        for name, exported in manifest.tables.items()
        if name not in taken and exported.rows
    }
    return stored, left_out
