"""Backup and restore of the service as a folder, during operation, with SQLite and PostgreSQL.

The folder contains a SQLite database of the same schema, the files of the archive, and a manifest with the SHA-256 of
every table and of the list of files and the head of the audit chain. A restore verifies everything before it writes,
and requires an empty service.
"""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sqlalchemy import Connection

from ground_service.errors import Conflict, FileDamaged, InvalidInput, NotFound, storage_error
from ground_service.ground import Ground
from ground_service.store import audit, rows
from ground_service.store.database import Database, open_database, prepare_database, schema_revisions
from ground_service.store.files import (
    FileArchive,
    StoredFile,
    file_names,
    make_durable_folder,
    read_blocks,
    replace_durably,
)
from lunar.timescales import format_utc

SCHEMA_VERSION = 2
MANIFEST = "backup.json"
DATABASE = "linna.db"
FILES = "files"


def backup(ground: Ground, out: Path, *, now_utc_ns: int) -> dict[str, Any]:
    """Write a backup into a new folder; return its manifest.

    Raises
    ------
    Conflict
        If the folder exists already.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise Conflict(f"{out}: expected a folder that is new or empty, found something in it")
    partial = out.with_name(f".{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        make_durable_folder(out.parent)
        partial.mkdir()
        copy = prepare_database(f"sqlite:///{partial / DATABASE}")
        try:
            with ground.database.snapshot() as connection:
                _copy_rows(connection, copy)
            with copy.reading() as connection:
                tables = rows.table_digests(connection)
                head = audit.read_head(connection)
                names = file_names(connection)
        finally:
            copy.engine.dispose()
        octets = 0
        for sha256 in names:
            octets += _copy_file(ground.files, FileArchive(partial / FILES), sha256)
        manifest = {
            "schema_version": SCHEMA_VERSION,
            "made_utc": format_utc(now_utc_ns),
            "revision": schema_revisions(ground.database)[0],
            "rows": {name: table.rows for name, table in tables.items()},
            "tables": {name: table.sha256 for name, table in tables.items()},
            "files": len(names),
            "files_sha256": _list_sha256(names),
            "octets": octets,
            "audit_head": asdict(head) if head is not None else None,
        }
        (partial / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
        if out.exists():
            out.rmdir()
        replace_durably(partial, out)
    except OSError as error:
        raise storage_error(error, out) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return manifest


def restore(folder: Path, ground: Ground) -> dict[str, Any]:
    """Restore a verified backup, also of an earlier revision, into an empty service; return its manifest.

    Raises
    ------
    InvalidInput
        If the folder is not a backup, or a row in it was changed.
    FileDamaged, NotFound
        If a file in it was changed or is missing.
    Conflict
        If the service is not empty.
    """
    manifest = _manifest(folder)
    filled = ground.read(rows.first_filled_table)
    if filled is not None:
        raise Conflict(f"{ground.database.label}: expected an empty service, found rows in {filled}")
    try:
        with checked(folder) as (connection, names):
            for sha256 in names:
                _copy_file(FileArchive(folder / FILES), ground.files, sha256)
            _copy_rows(connection, ground.database)
    except OSError as error:
        raise storage_error(error, ground.home) from None
    return manifest


@contextmanager
def checked(folder: Path) -> Iterator[tuple[Connection, list[str]]]:
    """Yield the database of a backup and the names of its files, all of them checked; raises as `restore`."""
    with _upgraded(folder, _manifest(folder)) as source, source.snapshot() as connection:
        names = file_names(connection)
        for sha256 in names:
            _check_file(FileArchive(folder / FILES), sha256)
        yield connection, names


@contextmanager
def _upgraded(folder: Path, manifest: dict[str, Any]) -> Iterator[Database]:
    """Yield the verified database of a backup; one of an earlier revision is upgraded in a copy."""
    url = f"sqlite:///{folder / DATABASE}"
    with tempfile.TemporaryDirectory(prefix="linna-restore-") as scratch:
        stored = open_database(url)
        try:
            found, head, _ = schema_revisions(stored)
            with stored.snapshot() as connection:
                _check_rows(folder, connection, manifest)
        finally:
            stored.engine.dispose()
        if found != head:
            url = f"sqlite:///{shutil.copyfile(folder / DATABASE, Path(scratch) / DATABASE)}"
        source = prepare_database(url)
        try:
            yield source
        finally:
            source.engine.dispose()


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InvalidInput(str(folder), "", f"a backup with {MANIFEST}", "none") from None
    except (OSError, ValueError) as error:
        raise InvalidInput(str(path), "", "a JSON object", str(error)[:80]) from None
    if not isinstance(manifest, dict) or manifest.get("schema_version") != SCHEMA_VERSION:
        raise InvalidInput(str(path), "schema_version", str(SCHEMA_VERSION), "another")
    for key in ("rows", "tables", "files_sha256", "audit_head"):
        if key not in manifest:
            raise InvalidInput(str(path), key, "an entry", "none")
    return manifest


def _check_rows(folder: Path, connection: Connection, manifest: dict[str, Any]) -> None:
    """Compare every table, the list of files and the audit chain of a backup with its manifest."""
    digests = rows.table_digests(connection)
    for name in sorted(manifest["tables"].keys() - digests):
        raise InvalidInput(str(folder / DATABASE), name, "the rows that were saved", "no such table")
    for name, table in digests.items():
        if manifest["rows"].get(name) != table.rows:
            raise InvalidInput(str(folder / DATABASE), name, f"{manifest['rows'].get(name)} rows", str(table.rows))
        if manifest["tables"].get(name) != table.sha256:
            raise InvalidInput(str(folder / DATABASE), name, "the rows that were saved", "changed rows")
    if _list_sha256(file_names(connection)) != manifest["files_sha256"]:
        raise InvalidInput(str(folder / DATABASE), "files", "the files that were saved", "a changed list")
    head = audit.read_head(connection)
    if head is None or asdict(head) != manifest["audit_head"]:
        raise InvalidInput(str(folder / MANIFEST), "audit_head", "the head of the audit chain", "another")
    broken = next(audit.broken_entries(connection), None)
    if broken is not None:
        raise InvalidInput(str(folder / DATABASE), f"audit {broken.number}", "a complete chain", broken.reason)


def _list_sha256(names: list[str]) -> str:
    return hashlib.sha256("\n".join(names).encode()).hexdigest()


def _copy_rows(connection: Connection, target: Database) -> None:
    """Copy every row that a connection sees into another, empty database, in one transaction."""
    with target.writing() as writing:
        for table in rows.copied_tables():
            rows.insert_rows(writing, table, rows.row_blocks(connection, table))
        rows.advance_sequences(writing)


def _check_file(files: FileArchive, sha256: str) -> None:
    path = files.path(sha256)
    if not path.is_file():
        raise NotFound("file", f"{sha256} in {files.root}")
    digest = hashlib.sha256()
    for block in read_blocks(path):
        digest.update(block)
    if digest.hexdigest() != sha256:
        raise FileDamaged(path, sha256, digest.hexdigest())


def _copy_file(source: FileArchive, files: FileArchive, sha256: str) -> int:
    """Copy a file from one archive into another and verify its hash; return its number of octets."""
    if source.octets(sha256) is None:
        raise NotFound("file", f"{sha256} in {source.root}")
    stored: StoredFile = files.put(source.blocks(sha256))
    if stored.sha256 != sha256:
        files.remove(stored.sha256)
        raise FileDamaged(source.place(sha256), sha256, stored.sha256)
    return stored.octets
