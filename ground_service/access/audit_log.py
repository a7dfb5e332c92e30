"""Queries of the audit log."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import and_, func, select

from ground_service.errors import AuditBroken, InvalidInput
from ground_service.ground import Ground
from ground_service.http.views import time_text
from ground_service.store import audit as chain
from ground_service.store import repository


class AuditEntry(BaseModel):
    """Entry of the audit log with its hash chain values."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    number: int = Field(examples=[1], description="1 for the first entry, without gaps")
    time: str = Field(examples=["2029-08-07T06:00:00.000000000Z"])
    actor: str = Field(examples=["ann"])
    action: str = Field(examples=["release telecommand"])
    target: str = Field(examples=["7"])
    detail: dict[str, Any]
    previous_sha256: str = Field(description="Hash of the previous entry")
    sha256: str = Field(description="Hash of this entry")


class AuditHead(BaseModel):
    """Newest entry of the chain; a copy stored elsewhere shows whether the log was truncated later."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    number: int = Field(examples=[1], description="0: no entry yet")
    sha256: str


def list_entries(
    ground: Ground,
    *,
    actor: str | None = None,
    action: str | None = None,
    target: str | None = None,
    since_utc_ns: int | None = None,
    until_utc_ns: int | None = None,
    limit: int = 100,
    offset: int = 0,
) -> tuple[list[AuditEntry], int]:
    """Return a page of entries, newest first, and the total number.

    `actor` and `target` must be equal; `action` may be a part of the name: "telecommand" finds "release telecommand".
    The interval does not include `until_utc_ns`.
    """
    table = repository.AUDIT
    conditions: list[Any] = []
    if actor is not None:
        conditions.append(table.c.actor == actor)
    if action is not None:
        conditions.append(table.c.action.contains(action, autoescape=True))
    if target is not None:
        conditions.append(table.c.target == target)
    if since_utc_ns is not None:
        conditions.append(table.c.utc_ns >= since_utc_ns)
    if until_utc_ns is not None:
        conditions.append(table.c.utc_ns < until_utc_ns)
    chosen = and_(True, *conditions)
    with ground.database.reading() as connection:
        total = connection.execute(select(func.count()).select_from(table).where(chosen)).scalar_one()
        rows = connection.execute(
            select(table).where(chosen).order_by(table.c.id.desc()).limit(limit).offset(offset)
        ).mappings()
        return [_entry(dict(row)) for row in rows], int(total)


def audit_head(ground: Ground) -> AuditHead:
    """Return the head of the chain.

    Raises
    ------
    AuditBroken
        If its row is missing.
    """
    with ground.database.reading() as connection:
        head = chain.read_head(connection)
    if head is None:
        raise AuditBroken("the head of the audit chain is missing; run 'linna verify'")
    return AuditHead(number=head.number, sha256=head.sha256)


def parse_head(text: str) -> chain.Head:
    """Return the head that `linna audit head` printed as NUMBER:SHA256.

    Raises
    ------
    InvalidInput
        If the text is something else.
    """
    number, _, sha256 = text.strip().partition(":")
    if (
        not (number.isascii() and number.isdigit())
        or len(sha256) != 64
        or set(sha256) - set("0123456789abcdef")
    ):
        raise InvalidInput(
            "audit head", "", "NUMBER:SHA256 as 'linna audit head' prints it", repr(text)[:100]
        )
    return chain.Head(int(number), sha256)


def _entry(row: repository.Row) -> AuditEntry:
    return AuditEntry(
        number=row["id"],
        time=time_text(row["utc_ns"]),
        actor=row["actor"],
        action=row["action"],
        target=row["target"],
        detail=row["detail"],
        previous_sha256=row["previous_sha256"],
        sha256=row["sha256"],
    )
