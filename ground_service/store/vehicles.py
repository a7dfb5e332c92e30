"""SQL of vehicles and their counters: spacecraft in one instance, a domain of time and sequence counts each."""

import hashlib
from collections.abc import Collection
from dataclasses import dataclass

from sqlalchemy import Connection, or_, select, text, union, update
from sqlalchemy.exc import IntegrityError

from ground_service.errors import InvalidInput, NotFound
from ground_service.store import repository
from ground_service.store.repository import COMMAND_COUNTERS, add_new
from ground_service.toml import require_line

ARCHIVE_ACTOR = "archive"
"""Actor of mission descriptions that are imported with pass archives."""

FLOWN = "flight"
"""Instance of the spacecraft that flies; others are emulated or replayed runs."""

SPACECRAFT_ID_MAX = 1023
"""Largest spacecraft id: a transfer frame has ten bits for it (CCSDS 132.0-B)."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A spacecraft in one instance: see `models.VEHICLES`."""

    id: int
    ccsds_id: int
    instance: str
    decoded_version: int | None
    redecoding_version: int | None
    redecoded_to: int | None
    redecode_until: int | None


def get_vehicle(connection: Connection, vehicle: int, kind: str = "vehicle") -> Vehicle:
    """Return a vehicle.

    Raises
    ------
    NotFound
        There is none; `kind` names it in the message.
    """
    return Vehicle(**repository.get(connection, repository.VEHICLES, vehicle, kind))


def find_vehicle(connection: Connection, ccsds_id: int, instance: str) -> Vehicle:
    """Return the vehicle of a spacecraft in one instance."""
    row = repository.find(connection, repository.VEHICLES, ccsds_id=ccsds_id, instance=instance)
    if row is None:
        raise NotFound("spacecraft", f"{ccsds_id} ({instance})")
    return Vehicle(**row)


def all_vehicles(connection: Connection) -> list[Vehicle]:
    return [Vehicle(**row) for row in connection.execute(select(repository.VEHICLES)).mappings()]


def used_vehicles(connection: Connection) -> list[Vehicle]:
    """Return the vehicles that a description states or that have data, plans, telecommands or a hold.

    What was entered for a mistyped spacecraft, and deleted or rejected, leaves a vehicle with nothing.
    """
    table, commands, held = repository.VEHICLES, repository.TELECOMMANDS, repository.HANDOVERS
    owned = (repository.PASSES, repository.INGESTS, repository.WINDOWS, repository.STANDING_REQUESTS)
    used = union(
        *(select(one.c.vehicle_id) for one in owned),
        select(commands.c.vehicle_id).where(commands.c.state != "rejected"),
        select(held.c.vehicle_id).where(held.c.held_by.is_not(None)),
    )
    described = select(repository.MISSIONS.c.ccsds_id).where(repository.MISSIONS.c.ccsds_id.is_not(None))
    query = select(table).where(or_(table.c.id.in_(used), table.c.ccsds_id.in_(described)))
    return [Vehicle(**row) for row in connection.execute(query).mappings()]


def lock_vehicle(connection: Connection, vehicle: int) -> Vehicle:
    """Return a vehicle, locked until the transaction ends.

    The lock waits for the transactions that store its packets, and keeps others out.
    """
    table = repository.VEHICLES
    row = connection.execute(select(table).where(table.c.id == vehicle).with_for_update()).mappings().first()
    if row is None:
        raise NotFound("vehicle", vehicle)
    return Vehicle(**row)


def vehicle_id(connection: Connection, ccsds_id: int, instance: str) -> int:
    """Return the vehicle id of a spacecraft in one instance; create it if it is new.

    Raises
    ------
    InvalidInput
        If the id does not fit a transfer frame, or the instance is not a printable line.
    """
    if isinstance(ccsds_id, bool) or not 0 <= ccsds_id <= SPACECRAFT_ID_MAX:
        raise InvalidInput("spacecraft", "id", f"0 to {SPACECRAFT_ID_MAX}", str(ccsds_id)[:40])
    require_line(instance, "spacecraft", "instance")
    found = repository.find(connection, repository.VEHICLES, ccsds_id=ccsds_id, instance=instance)
    if found is not None:
        return int(found["id"])
    try:
        with connection.begin_nested():
            return int(repository.add(connection, repository.VEHICLES, ccsds_id=ccsds_id, instance=instance))
    except IntegrityError:
        again = repository.find(connection, repository.VEHICLES, ccsds_id=ccsds_id, instance=instance)
        if again is None:
            raise
        return int(again["id"])


def spacecraft_of_missions(connection: Connection, names: Collection[str]) -> frozenset[int]:
    """Return the spacecraft whose mission description in force has one of these names."""
    table = repository.MISSIONS.c
    query = select(table.ccsds_id, table.name).where(table.ccsds_id.is_not(None), table.entered_by != ARCHIVE_ACTOR)
    rows = connection.execute(query.order_by(table.created_utc_ns, table.id))
    newest = {int(number): name for number, name in rows}
    return frozenset(number for number, name in newest.items() if name in names)


def change_vehicle(connection: Connection, vehicle: int, **columns: int | None) -> None:
    """Change columns of a vehicle, whose row the caller has locked."""
    repository.change(connection, repository.VEHICLES, vehicle, **columns)


def decoded_version(connection: Connection, vehicle: int, newest: int) -> int:
    """The dictionary version to read a vehicle in: the newest that all of its packets are decoded with."""
    found = connection.execute(
        select(repository.VEHICLES.c.decoded_version).where(repository.VEHICLES.c.id == vehicle)
    ).scalar()
    return newest if found is None else int(found)


def lock_spacecraft(connection: Connection, vehicle: int) -> int:
    """Lock the operations of a vehicle until the transaction ends; return the number of assigned sequence counts."""
    query = select(COMMAND_COUNTERS.c.telecommands).where(COMMAND_COUNTERS.c.vehicle_id == vehicle).with_for_update()
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
