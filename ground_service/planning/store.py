"""SQL of planned windows and standing requests."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from sqlalchemy import Connection, func, or_, select, update
from sqlalchemy.sql import Select

from ground_service.contacts.commanding.store import ids_of_windows
from ground_service.errors import NotFound
from ground_service.http.model import PageOf, Paging, UtcTime
from ground_service.passes import store as passes
from ground_service.planning.filling import Option
from ground_service.planning.model import (
    AssessedWindow,
    RequestPlan,
    RequestTerms,
    StandingRequest,
    Window,
    WindowEntry,
    WindowFilter,
    WindowRecord,
    WindowUploads,
)
from ground_service.planning.window_states import COMMITTED, FLOWN, PlannedSpan
from ground_service.store import repository
from ground_service.store.repository import page, within
from ground_service.store.states import change_if
from ground_service.store.vehicles import get_vehicle
from ground_service.telemetry.decoding import readable_version

WINDOWS, VEHICLES = repository.WINDOWS, repository.VEHICLES

_REPORTS = ("housekeeping", "events", "verifications")

AnyWindow = TypeVar("AnyWindow", bound=Window)


def add_window(
    connection: Connection,
    vehicle: int,
    assessed: AssessedWindow,
    *,
    mission_id: int | None,
    actor: str,
    now_utc_ns: int,
) -> int:
    """Add a draft; return its id."""
    return int(
        repository.add(
            connection,
            WINDOWS,
            vehicle_id=vehicle,
            decision="draft",
            state="draft",
            mission_id=mission_id,
            version=1,
            created_by=actor,
            edited_by=actor,
            created_utc_ns=now_utc_ns,
            changed_utc_ns=now_utc_ns,
            **columns_of(assessed),
        )
    )


def columns_of(assessed: AssessedWindow) -> dict[str, Any]:
    """Return the columns of an assessed request."""
    entry = assessed.entry
    return {
        "name": entry.name,
        "start_utc_ns": entry.start_utc_ns,
        "stop_utc_ns": entry.stop_utc_ns,
        "cadence_s": entry.cadence_s,
        "predecessor_id": entry.predecessor_id,
        "ephemeris_id": entry.ephemeris_id,
        "data_octets": assessed.data_octets,
        "predicted": assessed.predicted.model_dump(mode="json", exclude_unset=True),
    }


def change_window(connection: Connection, found: WindowRecord, **columns: Any) -> bool:
    """Change columns of a window unless its version, state or pass has changed since; return whether it was changed."""
    unchanged = {"version": found.version, "state": found.state, "pass_id": found.pass_id}
    return change_if(connection, WINDOWS, found.id, unchanged, **columns)


def close_window(connection: Connection, window_id: int) -> None:
    """Record that missing packets of a window are not waited for."""
    change_if(connection, WINDOWS, window_id, {"closed": 0}, closed=1)


def note_uploads(connection: Connection, window_id: int, uploads: WindowUploads) -> None:
    """Record what the telecommands of a window load on board; a pass that exists already gets it too."""
    stated = uploads.model_dump(mode="json", exclude_unset=True)
    repository.change(connection, WINDOWS, window_id, uploads=stated)
    row = repository.get(connection, WINDOWS, window_id, "window")
    if row["pass_id"] is not None:
        known = repository.get(connection, repository.PASSES, row["pass_id"], "pass")["manifest"]
        repository.change(connection, repository.PASSES, row["pass_id"], manifest={**known, **stated})


def delete_window(connection: Connection, window_id: int) -> None:
    connection.execute(WINDOWS.delete().where(WINDOWS.c.id == window_id))


def get_window(connection: Connection, window_id: int) -> Window:
    return _one(connection, window_id, Window)


def get_record(connection: Connection, window_id: int) -> WindowRecord:
    """Return a window as `get_window` does, with the fields of the service."""
    return _one(connection, window_id, WindowRecord)


def list_windows(connection: Connection, asked: WindowFilter) -> PageOf[Window]:
    """List the planned windows, newest first."""
    rows, total = page(connection, _joined(), asked, WINDOWS.c.created_utc_ns.desc(), WINDOWS.c.id.desc())
    return asked.page(_windows(connection, rows, Window), total)


def open_windows(connection: Connection, vehicle: int) -> list[WindowRecord]:
    """Return the approved and cancelled windows of a vehicle that are not processed, in order of time."""
    mine = WINDOWS.c.vehicle_id == vehicle, WINDOWS.c.decision.in_(("approved", "cancelling"))
    return records_where(connection, *mine, WINDOWS.c.state != "processed")


def is_replaced(connection: Connection, window: WindowRecord) -> bool:
    """Return whether a window that was entered later, was approved and has not failed covers part of its time."""
    query = select(WINDOWS.c.id).where(
        WINDOWS.c.vehicle_id == window.vehicle_id,
        WINDOWS.c.id > window.id,
        WINDOWS.c.decision == "approved",
        WINDOWS.c.state != "failed",
        WINDOWS.c.start_utc_ns < window.stop.utc_ns,
        WINDOWS.c.stop_utc_ns > window.start.utc_ns,
    )
    return connection.execute(query.limit(1)).first() is not None


def records_where(connection: Connection, *conditions: Any) -> list[WindowRecord]:
    """Return the windows that fulfil conditions on their columns, in order of time."""
    query = _joined().where(*conditions).order_by(WINDOWS.c.start_utc_ns, WINDOWS.c.id)
    return _windows(connection, connection.execute(query).mappings().all(), WindowRecord)


def follower_of(connection: Connection, window_id: int) -> int | None:
    """Return the id of a window that a window is the predecessor of; None without any."""
    row = repository.find(connection, WINDOWS, predecessor_id=window_id)
    return None if row is None else int(row["id"])


def neighbours(connection: Connection, vehicle: int, entry: WindowEntry, gap_ns: int) -> list[PlannedSpan]:
    """Return the committed windows of a vehicle that are nearer to a request than a gap, and its predecessor."""
    query = select(WINDOWS.c.id, WINDOWS.c.start_utc_ns, WINDOWS.c.stop_utc_ns, WINDOWS.c.state).where(
        WINDOWS.c.vehicle_id == vehicle,
        or_(
            WINDOWS.c.state.in_(COMMITTED)
            & (WINDOWS.c.start_utc_ns < entry.stop_utc_ns + gap_ns)
            & (WINDOWS.c.stop_utc_ns > entry.start_utc_ns - gap_ns),
            WINDOWS.c.id == entry.predecessor_id,
        ),
    )
    return [PlannedSpan(*row) for row in connection.execute(query)]


def commitments(connection: Connection, spacecraft_id: int | None, instance: str, *, without: int = 0) -> list[Option]:
    """Return the windows of a spacecraft, except one, whose data are or will be on board."""
    query = (
        select(WINDOWS.c.start_utc_ns, WINDOWS.c.stop_utc_ns, WINDOWS.c.data_octets)
        .join(VEHICLES, VEHICLES.c.id == WINDOWS.c.vehicle_id)
        .where(
            VEHICLES.c.ccsds_id == spacecraft_id,
            VEHICLES.c.instance == instance,
            WINDOWS.c.id != without,
            WINDOWS.c.state.in_([state for state in COMMITTED if state != "downlinked"]),
        )
    )
    return [Option(*row) for row in connection.execute(query)]


def windows_between(
    connection: Connection, spacecraft_id: int, instance: str, start_utc_ns: int, stop_utc_ns: int
) -> list[WindowRecord]:
    """Return the windows of a spacecraft, except failed ones, that overlap an interval, in order of time."""
    return records_where(
        connection,
        VEHICLES.c.ccsds_id == spacecraft_id,
        VEHICLES.c.instance == instance,
        WINDOWS.c.state != "failed",
        WINDOWS.c.stop_utc_ns > start_utc_ns,
        WINDOWS.c.start_utc_ns < stop_utc_ns,
    )


def add_pass(connection: Connection, window: WindowRecord, mission_id: int | None, now_utc_ns: int) -> int:
    """Add the pass of the telemetry of a window; return its id."""
    uploads = {} if window.uploads is None else window.uploads.model_dump(mode="json", exclude_unset=True)
    return passes.add_pass(
        connection,
        vehicle_id=window.vehicle_id,
        name=f"{window.name} ({FLOWN})" if window.decision == "cancelling" else window.name,
        start_utc_ns=window.start.utc_ns,
        stop_utc_ns=window.stop.utc_ns,
        mission_id=mission_id,
        now_utc_ns=now_utc_ns,
        manifest={
            "window_id": window.id,
            "cadence_s": window.cadence_s,
            "frames_expected": window.predicted.frames,
            **uploads,
        },
        ephemeris_id=window.ephemeris_id,
    )


def has_report(connection: Connection, pass_id: int) -> bool:
    return repository.find(connection, repository.REPORTS, pass_id=pass_id) is not None


def has_reports_between(connection: Connection, vehicle: int, after_ticks: int, until_ticks: int) -> bool:
    """Return whether the payload reported after a time until another (included); a bound excludes wild clocks."""
    version = readable_version(connection, vehicle)
    for kind in _REPORTS:
        table = repository.SAMPLES[kind]
        query = select(table.c.ticks).where(within(table, (vehicle, after_ticks + 1, until_ticks, version)))
        if connection.execute(query.limit(1)).first() is not None:
            return True
    return False


def _joined() -> Select[Any]:
    return select(WINDOWS, VEHICLES.c.ccsds_id.label("spacecraft_id"), VEHICLES.c.instance).join(
        VEHICLES, VEHICLES.c.id == WINDOWS.c.vehicle_id
    )


def _one(connection: Connection, window_id: int, kind: type[AnyWindow]) -> AnyWindow:
    rows = connection.execute(_joined().where(WINDOWS.c.id == window_id)).mappings().all()
    found = _windows(connection, rows, kind)
    if not found:
        raise NotFound("window", window_id)
    return found[0]


def _windows(connection: Connection, rows: Sequence[Mapping[Any, Any]], kind: type[AnyWindow]) -> list[AnyWindow]:
    telecommands = ids_of_windows(connection, [row["id"] for row in rows])
    return [kind.of(row, telecommands=telecommands[row["id"]]) for row in rows]


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
        int(key) for key in connection.execute(query.order_by(_REQUESTS.c.priority.desc(), _REQUESTS.c.id)).scalars()
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
        .where(_REQUESTS.c.id == found.id, _REQUESTS.c.plans == found.plans, _REQUESTS.c.version == found.version)
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


def unfinished_windows(connection: Connection, until_utc_ns: int, vehicle_id: int | None = None) -> list[WindowRecord]:
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
    counts = select(_WINDOWS.c.state, func.count()).where(_WINDOWS.c.request_id == row["id"]).group_by(_WINDOWS.c.state)
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
