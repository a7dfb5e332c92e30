"""SQL of reference ephemerides."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, select, update

from ground_service.http.model import PageOf, Paging
from ground_service.missions.ephemerides.model import Ephemeris
from ground_service.missions.store import mission_in_force
from ground_service.store import repository
from ground_service.store.files import StoredFile
from lunar import ephemeris

EPHEMERIDES = repository.EPHEMERIDES


def add_ephemeris(
    connection: Connection,
    stored: StoredFile,
    content: ephemeris.Ephemeris,
    *,
    name: str,
    precedence: int,
    now_utc_ns: int,
) -> Ephemeris:
    """Add the ephemeris of an archived file."""
    key = repository.add(
        connection,
        EPHEMERIDES,
        file_sha256=stored.sha256,
        name=name,
        object_name=content.segments[0].object_name,
        frame=content.segments[0].frame,
        start_utc_ns=content.start_utc_ns,
        stop_utc_ns=content.stop_utc_ns,
        states=sum(len(segment.utc_ns) for segment in content.segments),
        precedence=precedence,
        created_utc_ns=now_utc_ns,
    )
    return get_ephemeris(connection, key)


def find_ephemeris(connection: Connection, *, sha256: str, precedence: int, name: str) -> Ephemeris | None:
    """Return the entry of a file with this precedence and name; None without any."""
    found = repository.find(connection, EPHEMERIDES, file_sha256=sha256, precedence=precedence, name=name)
    return None if found is None else _ephemeris(found)


def get_ephemeris(connection: Connection, ephemeris_id: int) -> Ephemeris:
    """Return an ephemeris."""
    return _ephemeris(repository.get(connection, EPHEMERIDES, ephemeris_id, "ephemeris"))


def list_ephemerides(connection: Connection, asked: Paging) -> PageOf[Ephemeris]:
    """List the reference ephemerides, newest first."""
    rows, total = repository.newest(connection, EPHEMERIDES, asked)
    return asked.page(map(_ephemeris, rows), total)


def covering_ephemerides(
    connection: Connection, start_utc_ns: int, stop_utc_ns: int, spacecraft_id: int | None
) -> list[Ephemeris]:
    """Return the ephemerides of a spacecraft that overlap an interval, by precedence, then the newest first."""
    table = EPHEMERIDES.c
    query = (
        select(EPHEMERIDES)
        .where(table.start_utc_ns <= stop_utc_ns, table.stop_utc_ns >= start_utc_ns)
        .order_by(table.precedence.desc(), table.id.desc())
    )
    mission = mission_in_force(connection, spacecraft_id)
    rows = connection.execute(query).mappings()
    return [
        _ephemeris(row) for row in rows if mission is None or mission.spacecraft.is_object(row["object_name"])
    ]


def withdraw_ephemeris(connection: Connection, ephemeris_id: int) -> Ephemeris:
    """Delete the entry of an ephemeris, whose file is kept, and return it; passes and windows use others."""
    found = get_ephemeris(connection, ephemeris_id)
    for table in (repository.PASSES, repository.WINDOWS):
        users = update(table).where(table.c.ephemeris_id == ephemeris_id)
        connection.execute(users.values(ephemeris_id=None))
    connection.execute(EPHEMERIDES.delete().where(EPHEMERIDES.c.id == ephemeris_id))
    return found


def _ephemeris(row: Mapping[Any, Any]) -> Ephemeris:
    return Ephemeris.of(row, sha256=row["file_sha256"])
