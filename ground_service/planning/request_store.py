"""SQL of standing requests."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, func, select, update

from ground_service.errors import NotFound
from ground_service.http.model import PageOf, Paging, UtcTime
from ground_service.planning.model import RequestPlan, RequestTerms, StandingRequest, WindowRecord
from ground_service.planning.store import records_where
from ground_service.store import repository
from ground_service.store.vehicles import get_vehicle

_REQUESTS, _WINDOWS = repository.STANDING_REQUESTS, repository.WINDOWS


@dataclass(frozen=True, slots=True)
class RequestRecord:
    """A standing request with the columns that only the service uses."""

    id: int
    vehicle_id: int
    spacecraft_id: int
    instance: str
    name: str
    state: str
    terms: RequestTerms
    anchor_utc_ns: int
    plans: int
    version: int


def add_request(
    connection: Connection,
    vehicle: int,
    name: str,
    terms: RequestTerms,
    *,
    anchor_utc_ns: int,
    actor: str,
    now_utc_ns: int,
) -> int:
    """Add an active request; return its id. Its first period begins at `anchor_utc_ns`."""
    return int(
        repository.add(
            connection,
            _REQUESTS,
            vehicle_id=vehicle,
            name=name,
            state="active",
            priority=terms.priority,
            terms=terms.model_dump(mode="json", exclude_none=True),
            plans=0,
            anchor_utc_ns=anchor_utc_ns,
            version=1,
            created_by=actor,
            created_utc_ns=now_utc_ns,
            changed_utc_ns=now_utc_ns,
        )
    )


def get_request(connection: Connection, request_id: int) -> StandingRequest:
    """Return a request."""
    return _request(connection, repository.get(connection, _REQUESTS, request_id, "request"))


def get_request_record(connection: Connection, request_id: int) -> RequestRecord:
    """Return a request for the planner."""
    return _record(connection, repository.get(connection, _REQUESTS, request_id, "request"))


def list_requests(connection: Connection, asked: Paging) -> PageOf[StandingRequest]:
    """List the standing requests, newest first."""
    rows, total = repository.newest(connection, _REQUESTS, asked)
    return asked.page((_request(connection, row) for row in rows), total)


def active_requests(connection: Connection, vehicle_id: int | None = None) -> list[int]:
    """Return the ids of the active requests of a vehicle, None: of all, by priority, then the oldest first."""
    query = select(_REQUESTS.c.id).where(_REQUESTS.c.state == "active")
    if vehicle_id is not None:
        query = query.where(_REQUESTS.c.vehicle_id == vehicle_id)
    return [
        int(key)
        for key in connection.execute(query.order_by(_REQUESTS.c.priority.desc(), _REQUESTS.c.id)).scalars()
    ]


def change_request(connection: Connection, request_id: int, version: int, **columns: Any) -> bool:
    """Change columns of a request that still has a version; return whether it had."""
    statement = (
        update(_REQUESTS)
        .where(_REQUESTS.c.id == request_id, _REQUESTS.c.version == version)
        .values(version=version + 1, **columns)
    )
    return connection.execute(statement).rowcount == 1


def delete_request(connection: Connection, request_id: int) -> None:
    """Delete a request; its windows stay."""
    connection.execute(update(_WINDOWS).where(_WINDOWS.c.request_id == request_id).values(request_id=None))
    if connection.execute(_REQUESTS.delete().where(_REQUESTS.c.id == request_id)).rowcount != 1:
        raise NotFound("request", request_id)


def claim_plan(connection: Connection, found: RequestRecord) -> bool:
    """Count a plan of a request unless another process has planned it, or it was changed, since it was read."""
    statement = (
        update(_REQUESTS)
        .where(
            _REQUESTS.c.id == found.id, _REQUESTS.c.plans == found.plans, _REQUESTS.c.version == found.version
        )
        .values(plans=found.plans + 1)
    )
    return connection.execute(statement).rowcount == 1


def set_plan(connection: Connection, plan: RequestPlan) -> None:
    """Enter the plan of a request."""
    planned = None if plan.planned is None else plan.planned.utc_ns
    values: Mapping[str, Any] = {"plan": plan.model_dump(mode="json"), "planned_utc_ns": planned}
    connection.execute(update(_REQUESTS).where(_REQUESTS.c.id == plan.request_id).values(**values))


def get_plan(connection: Connection, request_id: int) -> RequestPlan:
    """Return the last plan of a request; an empty one before the first."""
    found = repository.get(connection, _REQUESTS, request_id, "request")["plan"]
    if found is None:
        return RequestPlan(
            request_id=request_id,
            planned=None,
            until=None,
            reason="not planned yet",
            basis="",
            candidates=[],
            replaced=[],
        )
    return RequestPlan.model_validate(found)


def assign_window(connection: Connection, window_id: int, request_id: int) -> None:
    """Enter the request that a window was planned for."""
    repository.change(connection, _WINDOWS, window_id, request_id=request_id)


def windows_around(connection: Connection, vehicle: int, since_utc_ns: int) -> list[WindowRecord]:
    """Return the windows of a vehicle that end after a time."""
    return records_where(connection, _WINDOWS.c.vehicle_id == vehicle, _WINDOWS.c.stop_utc_ns > since_utc_ns)


def planned_vehicles(connection: Connection) -> list[int]:
    """Return the ids of the vehicles with an active request or an unfinished window."""
    active = select(_REQUESTS.c.vehicle_id).where(_REQUESTS.c.state == "active")
    windows = {one.vehicle_id for one in unfinished_windows(connection, 2**62)}
    return sorted({*connection.execute(active).scalars(), *windows})


def unfinished_windows(
    connection: Connection, until_utc_ns: int, vehicle_id: int | None = None
) -> list[WindowRecord]:
    """Return the drafts, and the approved windows without an uplink, that begin before a time.

    Those of a vehicle; None: of all.
    """
    return records_where(
        connection,
        _WINDOWS.c.start_utc_ns <= until_utc_ns,
        *(() if vehicle_id is None else (_WINDOWS.c.vehicle_id == vehicle_id,)),
        _WINDOWS.c.state.in_(("approved", "draft")),
    )


def _request(connection: Connection, row: repository.Row) -> StandingRequest:
    vehicle = get_vehicle(connection, row["vehicle_id"])
    counts = (
        select(_WINDOWS.c.state, func.count())
        .where(_WINDOWS.c.request_id == row["id"])
        .group_by(_WINDOWS.c.state)
    )
    windows = {str(state): int(number) for state, number in connection.execute(counts)}
    planned = row["planned_utc_ns"]
    return StandingRequest.of(
        row,
        spacecraft_id=vehicle.ccsds_id,
        instance=vehicle.instance,
        terms=RequestTerms.model_validate_json(json.dumps(row["terms"])),
        windows=dict(sorted(windows.items())),
        planned=None if planned is None else UtcTime(planned),
    )


_RECORDED = ("id", "vehicle_id", "name", "state", "anchor_utc_ns", "plans", "version")


def _record(connection: Connection, row: repository.Row) -> RequestRecord:
    vehicle = get_vehicle(connection, row["vehicle_id"])
    return RequestRecord(
        **{name: row[name] for name in _RECORDED},
        spacecraft_id=vehicle.ccsds_id,
        instance=vehicle.instance,
        terms=RequestTerms.model_validate_json(json.dumps(row["terms"])),
    )
