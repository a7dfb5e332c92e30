"""Plans as documents: windows out of one service and into another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ground_service.errors import InvalidInput
from ground_service.ground import Ground
from ground_service.planning import store
from ground_service.planning.model import Plan, PlanWindow
from ground_service.planning.service import insert_window
from ground_service.store.vehicles import vehicle_id


def export_plan(ground: Ground) -> Plan:
    """Return all windows that have not failed, in order of time."""
    with ground.database.reading() as connection:
        windows = store.planned_windows(connection)
    known = {window.id for window in windows}
    return Plan(
        windows=[
            PlanWindow(
                key=f"w{window.id}",
                after=f"w{window.predecessor_id}" if window.predecessor_id in known else None,
                name=window.name,
                start=window.start,
                stop=window.stop,
                cadence_s=window.cadence_s,
                spacecraft_id=window.spacecraft_id,
                instance=window.instance,
            )
            for window in windows
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
            store.lock_plan(connection, vehicle_id(connection, spacecraft_id, instance))
        for entry in ordered:
            window = replace(entry.entry(), predecessor_id=ids[entry.after] if entry.after else None)
            vehicle = vehicle_id(connection, window.spacecraft_id, window.instance)
            found = store.find_same(connection, vehicle, window)
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
