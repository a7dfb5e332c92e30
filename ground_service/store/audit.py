"""Append-only audit log in which each entry contains the hash of the previous one.

Entry n contains the SHA-256 of entry n - 1, and the SHA-256 of its own content including that hash. Changing, inserting
or removing an entry breaks the chain. One row, the head, contains number and hash of the newest entry; a copy of the
head that is stored elsewhere shows whether the log was truncated.

Entries are collected during a transaction and appended by its last statements, so the row of the head is locked only
during their insertion and the commit. Because of this lock, the order of the chain is the order of commits.
"""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, func, insert, select, text, update

from ground_service.errors import AuditBroken
from ground_service.store.models import AUDIT, AUDIT_HEAD, METADATA

GENESIS = "0" * 64
"""Previous hash of the first entry."""

PENDING = "linna_audit"
"""Execution option of a write transaction: the list of entries to append at its end."""

BLOCK_ROWS = 1000
HEAD_ID = 1

_ENTRIES = METADATA.tables[AUDIT.name]
_HEAD = METADATA.tables[AUDIT_HEAD.name]


@dataclass(frozen=True, slots=True)
class Head:
    """Number and hash of the newest entry; number 0 without entries."""

    number: int
    sha256: str


@dataclass(frozen=True, slots=True)
class Note:
    """Audit entry before it is appended to the chain."""

    utc_ns: int
    actor: str
    action: str
    target: str
    detail: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class BrokenEntry:
    """Entry that is inconsistent with the previous one or with its hash."""

    number: int
    reason: str


def entry_sha256(previous_sha256: str, number: int, note: Note) -> str:
    """Return the hash (hex) of an entry: SHA-256 of its canonical JSON with the hash of the previous entry."""
    content = [previous_sha256, number, note.utc_ns, note.actor, note.action, note.target, plain_detail(note.detail)]
    return hashlib.sha256(
        json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    ).hexdigest()


def plain_detail(detail: Mapping[str, Any]) -> dict[str, Any]:
    """Return a detail with JSON types: keys as text, non-finite numbers as text."""
    plain: dict[str, Any] = json.loads(json.dumps(_finite(detail)))
    return plain


def add_note(connection: Connection, note: Note) -> None:
    """Append an entry at the end of the write transaction of this connection (`Database.writing`).

    Raises
    ------
    RuntimeError
        If the connection is not in such a transaction, because the entry would be lost.
    """
    pending = connection.get_execution_options().get(PENDING)
    if pending is None:
        raise RuntimeError("audit entries are written inside Database.writing()")
    pending.append(note)


def append_pending(connection: Connection) -> None:
    """Append the entries of a transaction to the chain, by its last statements.

    Raises
    ------
    AuditBroken
        If the row of the head is missing; an entry without a predecessor would hide that.
    """
    pending: list[Note] = connection.get_execution_options().get(PENDING, [])
    if not pending:
        return
    found = connection.execute(
        select(_HEAD.c.number, _HEAD.c.sha256).where(_HEAD.c.id == HEAD_ID).with_for_update()
    ).first()
    if found is None:
        raise AuditBroken("the head of the audit chain is missing; nothing was stored, run 'linna verify'")
    number, previous = int(found[0]), str(found[1])
    rows = []
    for note in pending:
        number += 1
        sha256 = entry_sha256(previous, number, note)
        rows.append(
            {
                "id": number,
                "utc_ns": note.utc_ns,
                "actor": note.actor,
                "action": note.action,
                "target": note.target,
                "detail": plain_detail(note.detail),
                "previous_sha256": previous,
                "sha256": sha256,
            }
        )
        previous = sha256
    connection.execute(insert(_ENTRIES), rows)
    connection.execute(update(_HEAD).where(_HEAD.c.id == HEAD_ID).values(number=number, sha256=previous))
    pending.clear()


def read_head(connection: Connection) -> Head | None:
    """Return the head of the chain; None if its row is missing."""
    row = connection.execute(select(_HEAD.c.number, _HEAD.c.sha256).where(_HEAD.c.id == HEAD_ID)).first()
    return Head(int(row[0]), str(row[1])) if row is not None else None


def read_entry_sha256(connection: Connection, number: int) -> str | None:
    """Return the stored hash of one entry; None if it does not exist."""
    found = connection.execute(select(_ENTRIES.c.sha256).where(_ENTRIES.c.id == number)).scalar()
    return str(found) if found is not None else None


def count_entries(connection: Connection) -> int:
    """Return the number of stored entries."""
    return int(connection.execute(select(func.count()).select_from(_ENTRIES)).scalar_one())


def broken_entries(connection: Connection) -> Iterator[BrokenEntry]:
    """Yield the faults of the chain, from its first entry to its head."""
    number, previous = 0, GENESIS
    rows = connection.execution_options(yield_per=BLOCK_ROWS).execute(select(_ENTRIES).order_by(_ENTRIES.c.id))
    for row in rows.mappings():
        found = int(row["id"])
        if found != number + 1:
            missing = f"entry {number + 1}" if found == number + 2 else f"entries {number + 1} to {found - 1}"
            yield BrokenEntry(found, f"expected entry {number + 1}, found {found}: {missing} missing")
        elif row["previous_sha256"] != previous:
            yield BrokenEntry(found, "expected the hash of the previous entry, found another")
        note = Note(row["utc_ns"], row["actor"], row["action"], row["target"], row["detail"] or {})
        if entry_sha256(str(row["previous_sha256"]), found, note) != row["sha256"]:
            yield BrokenEntry(found, "expected content that matches its hash, found changed content")
        number, previous = found, str(row["sha256"])
    head = read_head(connection)
    others = connection.execute(select(func.count()).select_from(_HEAD).where(_HEAD.c.id != HEAD_ID)).scalar_one()
    if others:
        yield BrokenEntry(0, f"expected one head of the chain, found {others} more")
    if head is None:
        yield BrokenEntry(0, "the head of the chain is missing")
    elif (head.number, head.sha256) != (number, previous):
        yield BrokenEntry(
            head.number,
            f"expected the head at the newest entry ({number}, {previous[:12]}…), "
            f"found ({head.number}, {head.sha256[:12]}…)",
        )


GUARD_NAMES = ("audit_no_update", "audit_no_delete")


def install_guards(connection: Connection) -> None:
    """Install triggers that refuse to change or remove entries; a repeated call changes nothing."""
    if connection.dialect.name == "sqlite":
        for name, change in zip(GUARD_NAMES, ("UPDATE", "DELETE"), strict=True):
            connection.execute(
                text(
                    f"CREATE TRIGGER IF NOT EXISTS {name} BEFORE {change} ON audit "
                    "BEGIN SELECT RAISE(ABORT, 'audit entries cannot be changed or removed'); END"
                )
            )
        return
    connection.execute(
        text(
            "CREATE OR REPLACE FUNCTION linna_refuse_audit_change() RETURNS trigger LANGUAGE plpgsql AS "
            "$$BEGIN RAISE EXCEPTION 'audit entries cannot be changed or removed'; END$$"
        )
    )
    for name, change in zip(GUARD_NAMES, ("UPDATE", "DELETE OR TRUNCATE"), strict=True):
        connection.execute(text(f"DROP TRIGGER IF EXISTS {name} ON audit"))
        connection.execute(
            text(
                f"CREATE TRIGGER {name} BEFORE {change} ON audit FOR EACH STATEMENT "
                "EXECUTE FUNCTION linna_refuse_audit_change()"
            )
        )


def missing_guards(connection: Connection) -> list[str]:
    """Return the names of missing triggers of the audit table."""
    query = (
        "SELECT name FROM sqlite_master WHERE type = 'trigger'"
        if connection.dialect.name == "sqlite"
        else "SELECT tgname FROM pg_trigger WHERE tgrelid = 'audit'::regclass AND tgenabled <> 'D'"
    )
    found = {str(row[0]) for row in connection.execute(text(query))}
    return [name for name in GUARD_NAMES if name not in found]


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
