"""Plans as documents: windows out of one service and into another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sqlalchemy import Connection, select

from ground_service.errors import InvalidInput
from ground_service.ground import Ground
from ground_service.http.times import UtcTime
from ground_service.planning.model import Plan, PlanWindow, WindowEntry
from ground_service.planning.service import insert_window
from ground_service.store import repository
from ground_service.store.counters import lock_spacecraft
from ground_service.store.vehicles import vehicle_id


def export_plan(ground: Ground) -> Plan:
    """Return all windows that have not failed, in order of time."""
    table, vehicles = repository.WINDOWS, repository.VEHICLES
    with ground.database.reading() as connection:
        rows = (
            connection.execute(
                select(table, vehicles.c.ccsds_id, vehicles.c.instance)
                .join(vehicles, vehicles.c.id == table.c.vehicle_id)
                .where(table.c.state != "failed")
                .order_by(table.c.start_utc_ns, table.c.id)
            )
            .mappings()
            .all()
        )
    known = {row["id"] for row in rows}
    return Plan(
        windows=[
            PlanWindow(
                key=f"w{row['id']}",
                after=f"w{row['predecessor_id']}" if row["predecessor_id"] in known else None,
                name=row["name"],
                start=UtcTime(row["start_utc_ns"]),
                stop=UtcTime(row["stop_utc_ns"]),
                cadence_s=row["cadence_s"],
                spacecraft_id=row["ccsds_id"],
                instance=row["instance"],
            )
            for row in rows
        ]
    )


def import_plan(ground: Ground, entries: Sequence[PlanWindow], *, actor: str) -> dict[str, int]:
    """Enter the windows of a plan as drafts, or none where one is refused; the id of each by its key.

    A window of the same spacecraft, span and name that is there already is taken for the same.

    Raises
    ------
    InvalidInput
        If keys repeat, or name a predecessor that the plan does not hold before.
    PlanConflicts
        If a window contradicts committed ones.
    """
    ids: dict[str, int] = {}
    ordered = _in_order(entries)
    with ground.database.writing() as connection:
        # Lock all spacecraft of the plan in a fixed order, so that simultaneous imports do not deadlock.
        for spacecraft_id, instance in sorted({(one.spacecraft_id, one.instance) for one in entries}):
            vehicle = vehicle_id(connection, spacecraft_id, instance)
            vehicles = repository.VEHICLES.c.id
            connection.execute(
                select(vehicles).where(vehicles == vehicle).with_for_update(read=True, key_share=True)
            )
            lock_spacecraft(connection, vehicle)
        for entry in ordered:
            window = replace(entry.entry(), predecessor_id=ids[entry.after] if entry.after else None)
            found = _known(connection, window)
            if found is None:
                found = insert_window(ground, connection, window, actor=actor).id
            ids[entry.key] = found
    return ids


def _in_order(entries: Sequence[PlanWindow]) -> list[PlanWindow]:
    """Predecessors before those that follow them."""
    by_key = {entry.key: entry for entry in entries}
    if len(by_key) != len(entries):
        raise InvalidInput("plan", "windows", "keys that differ", "one twice")
    ordered: list[PlanWindow] = []
    done: set[str] = set()
    left = list(entries)
    while left:
        ready = [entry for entry in left if entry.after is None or entry.after in done]
        if not ready:
            raise InvalidInput(
                "plan", f"windows.{left[0].key}.after", "the key of a window before it", repr(left[0].after)
            )
        ordered += ready
        done |= {entry.key for entry in ready}
        left = [entry for entry in left if entry.key not in done]
    return ordered


def _known(connection: Connection, window: WindowEntry) -> int | None:
    row = repository.find(
        connection,
        repository.WINDOWS,
        vehicle_id=vehicle_id(connection, window.spacecraft_id, window.instance),
        name=window.name,
        start_utc_ns=window.start_utc_ns,
        stop_utc_ns=window.stop_utc_ns,
    )
    return None if row is None else int(row["id"])
