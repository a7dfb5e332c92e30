"""Requests about plans, checked by their schemas, as the planning service takes them."""

from __future__ import annotations

from typing import Any

from ground_service.ground import Ground
from ground_service.http.times import time_of
from ground_service.planning.core import SearchResult
from ground_service.planning.exchange import PlanEntry
from ground_service.planning.model import Plan, WindowChange, WindowIn, WindowSearch
from ground_service.planning.service import WindowEntry, search_windows
from ground_service.store.repository import Row


def search(ground: Ground, given: WindowSearch) -> tuple[SearchResult, Row, tuple[str, ...]]:
    """What `planning.search_windows` finds for a request."""
    return search_windows(
        ground,
        given.constraints(),
        start_utc_ns=None if given.start is None else time_of(given.start, "start"),
        stop_utc_ns=None if given.stop is None else time_of(given.stop, "stop"),
        cadence_s=given.cadence_s,
        step_s=given.step_s,
        resources=given.resources.value(),
        ephemeris_id=given.ephemeris_id,
        catalogue_pass_id=given.catalogue_pass_id,
        spacecraft_id=given.spacecraft_id,
        instance=given.instance,
    )


def window_entry(given: WindowIn) -> WindowEntry:
    """The window that a request asks for."""
    return WindowEntry(
        name=given.name,
        start_utc_ns=time_of(given.start, "start"),
        stop_utc_ns=time_of(given.stop, "stop"),
        cadence_s=given.cadence_s,
        spacecraft_id=given.spacecraft_id,
        instance=given.instance,
        predecessor_id=given.predecessor_id,
        ephemeris_id=given.ephemeris_id,
        resources=given.resources.value(),
    )


def window_changes(given: WindowChange) -> dict[str, Any]:
    """The fields of a window that a request changes."""
    changes: dict[str, Any] = {}
    for name, value in given.model_dump(exclude_unset=True, exclude={"state", "reason"}).items():
        if name in ("start", "stop"):
            if value is not None:
                changes[f"{name}_utc_ns"] = time_of(value, name)
        elif value is not None or name == "predecessor_id":
            changes[name] = value
    return changes


def plan_entries(given: Plan) -> list[PlanEntry]:
    """The windows of a plan."""
    return [
        PlanEntry(
            key=one.key,
            after=one.after,
            window=WindowEntry(
                name=one.name,
                start_utc_ns=time_of(one.start, f"windows.{one.key}.start"),
                stop_utc_ns=time_of(one.stop, f"windows.{one.key}.stop"),
                cadence_s=one.cadence_s,
                spacecraft_id=one.spacecraft_id,
                instance=one.instance,
            ),
        )
        for one in given.windows
    ]
