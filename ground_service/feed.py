"""What happened, in one numbered row, for those who watch: every item has the next number, none is ever missing.

Items are written in the transaction that they speak of, so what is announced has happened. Numbers are given in the
order of commits: on PostgreSQL a lock sees to that, SQLite has one writer anyway.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, func, select, text

from ground_service.clock import utc_now_ns
from ground_service.ground import Ground
from ground_service.store import repository

FEED_LOCK = 7602


def publish(connection: Connection, kind: str, payload: Mapping[str, Any]) -> None:
    """Announce something in the transaction that makes it so; best done last, as others wait for its end."""
    if connection.dialect.name == "postgresql":
        connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": FEED_LOCK})
    repository.add(connection, repository.FEED, utc_ns=utc_now_ns(), kind=kind, payload=dict(payload))


def read_feed(ground: Ground, after: int, limit: int = 200) -> list[dict[str, Any]]:
    """Items with numbers above `after`, in order."""
    table = repository.FEED
    with ground.database.reading() as connection:
        rows = connection.execute(
            select(table).where(table.c.id > after).order_by(table.c.id).limit(limit)
        ).mappings()
        return [dict(row) for row in rows]


def last_number(ground: Ground) -> int:
    """Number of the newest item; 0 when nothing has happened."""
    with ground.database.reading() as connection:
        return int(connection.execute(select(func.max(repository.FEED.c.id))).scalar() or 0)
