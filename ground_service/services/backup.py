"""Backup and restore: the whole service as a folder, readable on any machine and by either kind of database.

A backup holds a SQLite database of the same schema (whatever the service itself runs on), every file of the archive,
and a manifest with their hashes. The database is read in one snapshot; files are immutable and written before the
rows that name them, so a backup of a running service is consistent.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Table, insert, select, text

from ground_service.errors import Conflict, FileDamaged, InvalidInput, storage_error
from ground_service.services.ground import Ground
from ground_service.store.database import Database, prepare_database, schema_revisions
from ground_service.store.files import FileArchive
from ground_service.store.models import Base
from lunar.timescales import format_utc

SCHEMA_VERSION = 1
DATABASE = "linna.db"
FILES = "files"
MANIFEST = "backup.json"
BLOCK_ROWS = 5_000


def backup(ground: Ground, out: Path, *, now_utc_ns: int) -> dict[str, Any]:
    """Write a backup into the new folder `out`; its manifest.

    Raises
    ------
    Conflict
        If there is something at `out` already.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise Conflict(f"{out}: expected a folder that is new or empty, found something in it")
    partial = out.with_name(f".{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True)
        copy = prepare_database(f"sqlite:///{partial / DATABASE}")
        try:
            rows = _copy_rows(ground.database, copy)
            with copy.writing() as connection:
                names = sorted(connection.execute(select(Base.metadata.tables["files"].c.sha256)).scalars())
        finally:
            copy.engine.dispose()
        octets = 0
        for sha256 in names:
            octets += _copy_file(ground.files.path(sha256), FileArchive(partial / FILES).path(sha256), sha256)
        manifest = {
            "schema_version": SCHEMA_VERSION,
            "made_utc": format_utc(now_utc_ns),
            "revision": schema_revisions(ground.database)[0],
            "rows": rows,
            "files": len(names),
            "octets": octets,
        }
        (partial / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
        if out.exists():
            out.rmdir()
        os.replace(partial, out)
    except OSError as error:
        raise storage_error(error, out) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return manifest


def restore(folder: Path, ground: Ground) -> dict[str, Any]:
    """Fill an empty service from a backup; its manifest.

    Raises
    ------
    InvalidInput
        If the folder is no backup.
    Conflict
        If the service holds anything.
    """
    manifest = _manifest(folder)
    with ground.database.reading() as connection:
        for table in _tables():
            if connection.execute(select(*table.primary_key.columns).limit(1)).first() is not None:
                raise Conflict(
                    f"{ground.database.label}: expected an empty service, found {table.name} in it"
                )
    source = prepare_database(f"sqlite:///{folder / DATABASE}", upgrade=False)
    try:
        with source.reading() as connection:
            names = sorted(connection.execute(select(Base.metadata.tables["files"].c.sha256)).scalars())
        for sha256 in names:
            _copy_file(FileArchive(folder / FILES).path(sha256), ground.files.path(sha256), sha256)
        rows = _copy_rows(source, ground.database)
    except OSError as error:
        raise storage_error(error, ground.home) from None
    finally:
        source.engine.dispose()
    if rows != manifest["rows"]:
        raise InvalidInput(str(folder), "rows", str(manifest["rows"]), str(rows))
    return manifest


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
    return manifest


def _tables() -> list[Table]:
    """All tables, those that others point to first."""
    return list(Base.metadata.sorted_tables)


def _copy_rows(source: Database, target: Database) -> dict[str, int]:
    """Every row of one database into another empty one, read in one snapshot, written in one transaction."""
    counts = {}
    with source.engine.connect() as reading, target.writing() as writing:
        if source.dialect == "postgresql":
            reading = reading.execution_options(isolation_level="REPEATABLE READ")
        with reading.begin():
            for table in _tables():
                counts[table.name] = 0
                later = []
                for block in _blocks(reading, table):
                    if table.name == "windows":
                        # A window may name one with a greater key: they are linked when all are there.
                        later += [row for row in block if row["predecessor_id"] is not None]
                        block = [{**row, "predecessor_id": None} for row in block]
                    writing.execute(insert(table), block)
                    counts[table.name] += len(block)
                for row in later:
                    writing.execute(
                        table.update()
                        .where(table.c.id == row["id"])
                        .values(predecessor_id=row["predecessor_id"])
                    )
        if target.dialect == "postgresql":
            _advance_sequences(writing)
    return counts


def _blocks(connection: Connection, table: Table) -> Iterator[list[dict[str, Any]]]:
    rows = connection.execution_options(yield_per=BLOCK_ROWS).execute(
        select(table).order_by(*table.primary_key.columns)
    )
    for part in rows.mappings().partitions(BLOCK_ROWS):
        yield [dict(row) for row in part]


def _advance_sequences(connection: Connection) -> None:
    """Let new keys begin behind those that were copied."""
    for table in _tables():
        keys = list(table.primary_key.columns)
        if len(keys) != 1 or not isinstance(keys[0].type.python_type(), int):
            continue
        name = connection.execute(
            text("SELECT pg_get_serial_sequence(:table, :column)"),
            {"table": f'"{table.name}"', "column": keys[0].name},
        ).scalar()
        if name is not None:
            connection.execute(
                text(
                    f'SELECT setval(:name, (SELECT COALESCE(MAX({keys[0].name}), 0) + 1 FROM "{table.name}"), false)'
                ),
                {"name": name},
            )


def _copy_file(source: Path, target: Path, sha256: str) -> int:
    """Copy a file, checked while it is read; its octets."""
    digest = hashlib.sha256()
    octets = 0
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.copying")
    with source.open("rb") as reading, temporary.open("wb") as writing:
        while block := reading.read(1 << 20):
            digest.update(block)
            octets += len(block)
            writing.write(block)
    if digest.hexdigest() != sha256:
        temporary.unlink()
        raise FileDamaged(source, sha256, digest.hexdigest())
    temporary.chmod(0o444)
    os.replace(temporary, target)
    return octets
