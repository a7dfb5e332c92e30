"""Counters and locks of spacecraft operations: one row for each spacecraft, locked during changes.

A transaction that changes the telecommands or the plan of a spacecraft locks its row first, and rows of telecommands
and windows afterwards. All processes use this lock order, which prevents deadlocks.
"""

from __future__ import annotations

import hashlib

from sqlalchemy import Connection, select, text, update

from ground_service.store.repository import COMMAND_COUNTERS, add_new


def lock_spacecraft(connection: Connection, vehicle: int) -> int:
    """Lock the operations of a vehicle until the transaction ends; return the number of assigned sequence counts."""
    query = (
        select(COMMAND_COUNTERS.c.telecommands)
        .where(COMMAND_COUNTERS.c.vehicle_id == vehicle)
        .with_for_update()
    )
    given = connection.execute(query).scalar()
    if given is None:
        add_new(connection, COMMAND_COUNTERS, vehicle_id=vehicle, telecommands=0)
        given = connection.execute(query).scalar_one()
    return int(given)


def next_telecommand(connection: Connection, vehicle: int, first: int = 0) -> int:
    """Return the number of the next telecommand of a vehicle, from `first` on, unwrapped; the number is unique."""
    if lock_spacecraft(connection, vehicle) == 0:
        mine = COMMAND_COUNTERS.c.vehicle_id == vehicle
        connection.execute(update(COMMAND_COUNTERS).where(mine).values(telecommands=first))
    taken = connection.execute(
        update(COMMAND_COUNTERS)
        .where(COMMAND_COUNTERS.c.vehicle_id == vehicle)
        .values(telecommands=COMMAND_COUNTERS.c.telecommands + 1)
        .returning(COMMAND_COUNTERS.c.telecommands)
    ).scalar_one()
    return int(taken) - 1


def hold(connection: Connection, name: str) -> None:
    """Lock `name` until the transaction ends; SQLite needs no lock because it has one writer."""
    if connection.dialect.name == "postgresql":
        digest = hashlib.blake2b(name.encode(), digest_size=8).digest()
        key = int.from_bytes(digest, "big", signed=True)
        connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": key})
