"""Standing requests: the planner fills the coming days, replaces failed windows and says why others are left out.

`plan_tick` may be called at any time, by any number of processes: a plan is stored by the process that counts it first,
and the windows depend on the stored plan, the ephemeris and mission time only. Candidates are searched in whole days of
UTC, so that they are the same in every call.
"""

import functools
import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sqlalchemy import Connection

from ground_service.access.service import audit
from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.contacts.commanding import store as commands
from ground_service.contacts.links import service as links
from ground_service.errors import PASSING, GroundError, InvalidInput, NotFound, PlanConflicts, StateConflict
from ground_service.ground import Ground
from ground_service.http.model import UtcTime
from ground_service.missions.ephemerides import service
from ground_service.missions.ephemerides.model import Ephemeris
from ground_service.missions.model import Mission
from ground_service.planning import model, store
from ground_service.planning import service as planning
from ground_service.planning.core import Constraints, Planner, data_octets, frames_between
from ground_service.planning.filling import Option, ResourceGrid, choose
from ground_service.planning.preparation import gap_ns
from ground_service.planning.progress import note_reason
from ground_service.planning.store import RequestRecord
from ground_service.planning.window_states import COMMITTED
from ground_service.store.event_kinds import PlanChanged, RequestChanged, publish
from ground_service.store.vehicles import get_vehicle, lock_spacecraft, vehicle_id
from lunar.constants import DAY_NS, NS
from lunar.errors import EphemerisCoverageError, LunarError

log = logging.getLogger(__name__)

PLANNER = "planner"
STEP_S = 300.0
LEAD_NS = 600 * NS
"""Windows begin at least this long after the plan is made, and after the contact that carries their telecommands."""

HISTORY_NS = 2 * 3600 * NS
"""The battery is taken to be full one orbit before the plan begins."""

RELEASE_AHEAD_NS = 2 * DAY_NS
"""Telecommands are released for windows of the coming days only: the on-board schedule holds 64 activities."""

AGAIN_NS = 3600 * NS
"""A plan that depends on the same things is not made again within this time."""

NO_CONTACT = "its telecommands found no contact before it began"
NOT_RELEASED = "its telecommands were not released before it began"
NOT_APPROVED = "it was not approved before it began"


def add_request(ground: Ground, given: model.StandingRequestIn, *, actor: str) -> model.StandingRequest:
    """Add an active standing request.

    Raises
    ------
    InvalidInput
        Its durations or times contradict each other.
    """
    terms = given.terms()
    _check_terms(terms)
    anchor = mission_now_ns() if terms.start is None else terms.start.utc_ns
    with ground.database.writing() as connection:
        planning.require_described(connection, given.spacecraft_id)
        vehicle = vehicle_id(connection, given.spacecraft_id, given.instance)
        key = store.add_request(
            connection, vehicle, given.name, terms, anchor_utc_ns=anchor, actor=actor, now_utc_ns=utc_now_ns()
        )
        _note(connection, actor, "add", key, "active")
        return store.get_request(connection, key)


def change_request(
    ground: Ground, request_id: int, change: model.StandingRequestChange, *, actor: str
) -> model.StandingRequest:
    """Pause or resume a standing request, or replace its terms; planned windows stay.

    Raises
    ------
    StateConflict
        Another request changed it at the same time.
    """
    with ground.database.writing() as connection:
        found = store.get_request_record(connection, request_id)
        columns: dict[str, Any] = {"changed_utc_ns": utc_now_ns()}
        if change.state is not None:
            columns["state"] = change.state
        if change.terms is not None:
            _check_terms(change.terms)
            columns["terms"] = change.terms.model_dump(mode="json", exclude_none=True)
            columns["priority"] = change.terms.priority
            if change.terms.start is not None:
                columns["anchor_utc_ns"] = change.terms.start.utc_ns
        if not store.change_request(connection, request_id, found.version, **columns):
            raise StateConflict("request", request_id, f"version {found.version}", "a newer one")
        _note(connection, actor, "change", request_id, change.state or found.state)
        return store.get_request(connection, request_id)


def delete_request(ground: Ground, request_id: int, *, actor: str) -> None:
    """Delete a standing request; its windows stay in the plan."""
    with ground.database.writing() as connection:
        store.delete_request(connection, request_id)
        _note(connection, actor, "delete", request_id, "deleted")


def plan_tick(ground: Ground, now_utc_ns: int | None = None, vehicle_id: int | None = None) -> dict[str, int]:
    """Bring the plan up to date: fail windows that can no longer begin, fill the coming days, approve and release.

    The plan is that of a vehicle; None: of all.

    Returns
    -------
    dict
        Numbers of windows `failed`, `added`, `approved` and `released`.
    """
    now = mission_now_ns() if now_utc_ns is None else now_utc_ns
    done = {"failed": fail_late(ground, now, vehicle_id), "added": 0, "approved": 0, "released": 0}
    requests = ground.read(store.active_requests, vehicle_id)
    for request_id in requests:
        ground.check_stopping()
        try:
            done["added"] += _fill(ground, request_id, now)
        except PASSING:
            raise
        except (GroundError, LunarError) as error:  # the windows of other requests are still planned and sent
            log.warning("standing request %d: %s", request_id, error)
    approved, released = _advance(ground, now, vehicle_id)
    return done | {"approved": approved, "released": released}


def fail_late(ground: Ground, now_utc_ns: int | None = None, vehicle_id: int | None = None) -> int:
    """Fail windows that began without their telecommands being sent, or without approval; return their number."""
    now = mission_now_ns() if now_utc_ns is None else now_utc_ns
    with ground.database.reading() as connection:
        late = store.unfinished_windows(connection, now, vehicle_id)
        waiting = [
            one
            for one in late
            if one.state == "draft" or not ({"sent"} & commands.states_of_window(connection, one.id))
        ]
    failed = 0
    for window in waiting:
        reason = NO_CONTACT if window.telecommands else NOT_RELEASED
        if window.state == "draft":
            reason = NOT_APPROVED
        failed += _decided(ground, window, "failed", reason)
    return failed


def needs_plan(ground: Ground) -> bool:
    """Return whether `plan_tick` may have something to do: there are active requests or approved windows."""
    with ground.database.reading() as connection:
        return bool(store.active_requests(connection) or store.unfinished_windows(connection, 2**62))


def planned_with(ground: Ground, ephemeris_id: int) -> list[int]:
    """Return the planned vehicles of whose spacecraft an ephemeris is; all of them if it was withdrawn."""
    with ground.database.reading() as connection:
        vehicles = store.planned_vehicles(connection)
        try:
            name = service.get_ephemeris(connection, ephemeris_id).object_name
        except NotFound:
            return vehicles
        numbers = {one: get_vehicle(connection, one).ccsds_id for one in vehicles}
        return [
            one for one, number in numbers.items() if planning.mission_of(connection, number).spacecraft.is_object(name)
        ]


def _advance(ground: Ground, now: int, vehicle_id: int | None) -> tuple[int, int]:
    """Approve drafts where the mission description permits it, and release the telecommands of approved windows."""
    with ground.database.reading() as connection:
        soon = [
            one
            for one in store.unfinished_windows(connection, now + RELEASE_AHEAD_NS, vehicle_id)
            if one.request_id is not None and one.start.utc_ns > now
        ]
        automatic = {
            one.spacecraft_id: planning.mission_of(connection, one.spacecraft_id).approval.windows == "automatic"
            for one in soon
        }
    approved = released = 0
    for window in soon:
        state = window.state
        if state == "draft" and automatic[window.spacecraft_id]:
            if not _decided(ground, window, "approved", None):
                continue
            approved += 1
            state = "approved"
        if state == "approved" and not window.telecommands:
            try:
                planning.uplink_window(ground, window.id, actor=PLANNER)
                released += 1
            except PASSING:
                raise
            except GroundError as error:
                log.warning("window %d: %s", window.id, error)
                note_reason(ground, window.id, f"its telecommands cannot be released: {error}")
    return approved, released


def _decided(ground: Ground, window: model.WindowRecord, decision: str, reason: str | None) -> int:
    try:
        planning.change_window(ground, window.id, actor=PLANNER, changes={}, decision=decision, reason=reason)
    except GroundError as error:  # conflicts, or another process or a person was faster
        log.warning("window %d: %s", window.id, error)
        return 0
    return 1


@dataclass(frozen=True, slots=True)
class _Situation:
    """Inputs of a plan."""

    request: RequestRecord
    mission: Mission
    references: tuple[Ephemeris, ...]
    mine: tuple[model.WindowRecord, ...]
    others: tuple[model.WindowRecord, ...]


def _fill(ground: Ground, request_id: int, now: int) -> int:
    """Plan the windows of one request up to its horizon; return their number."""
    with ground.database.reading() as connection:
        request = store.get_request_record(connection, request_id)
        end = now + round(request.terms.horizon_days * DAY_NS)
        last = store.get_plan(connection, request_id)
        windows = store.windows_around(connection, request.vehicle_id, _first_needed(request, now))
        situation = _Situation(
            request,
            planning.mission_of(connection, request.spacecraft_id),
            tuple(service.covering_ephemerides(connection, now, end, request.spacecraft_id)),
            tuple(one for one in windows if one.request_id == request_id),
            tuple(one for one in windows if one.state in COMMITTED or one.state == "draft"),
        )
    if request.terms.stop is not None:
        end = min(end, request.terms.stop.utc_ns)
    start = max(now + LEAD_NS, request.anchor_utc_ns)
    quota = _quota(situation, start, end)
    if not any(number > 0 for number in quota.values()) and request.plans > 0:
        return 0
    if last.planned is not None and last.basis == _basis(situation) and now - last.planned.utc_ns < AGAIN_NS:
        return 0
    reason = None
    covered = max((one.stop.utc_ns for one in situation.references), default=0)
    if not situation.references:
        reason = "no reference ephemeris covers the coming days"
    elif covered < end:
        reason = f"the reference ephemeris ends at {UtcTime(covered)}"
        end = covered
    candidates, excluded = _candidates(ground, situation, start, end) if end > start else ([], None)
    chosen, rejected = _chosen(ground, situation, candidates, quota, now, end)
    if not candidates and excluded is not None:
        reason = excluded if reason is None else f"{excluded}; {reason}"
    return _stored(ground, situation, chosen, rejected, reason, now, end)


def _basis(situation: _Situation) -> str:
    """Return a hash of the revision, the service, the request and the windows that are not in the plan any more."""
    parts = [
        situation.mission.revision,
        str(situation.request.version),
        *(one.sha256 for one in situation.references),
        *(str(one.id) for one in situation.mine if one.state == "failed"),
    ]
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:16]


def _quota(situation: _Situation, start: int, end: int) -> dict[int, int]:
    """Return how many windows are still to be planned, by number of the period."""
    request = situation.request
    if end <= start:
        return {}
    quota = dict.fromkeys(range(_period(request, start), _period(request, end - 1) + 1), request.terms.windows)
    for one in situation.mine:
        period = _period(request, one.start.utc_ns)
        if one.state != "failed" and period in quota:
            quota[period] -= 1
    return quota


def _period(request: RequestRecord, utc_ns: int) -> int:
    return (utc_ns - request.anchor_utc_ns) // round(request.terms.period_days * DAY_NS)


def _first_needed(request: RequestRecord, now: int) -> int:
    """Return the time from which windows count for a plan: the begin of the present period, at least a day ago."""
    period_ns = round(request.terms.period_days * DAY_NS)
    return min(now - DAY_NS, request.anchor_utc_ns + _period(request, now) * period_ns)


def _candidates(
    ground: Ground, situation: _Situation, start: int, end: int
) -> tuple[list[tuple[int, int]], str | None]:
    """Return the spans that fulfil the constraints, day by day, each in the preferred ephemeris that covers it.

    Without any, the second value is what excludes them on the first day.
    """
    constraints = planning.observable(situation.request.terms.constraints(), situation.mission)
    found: list[tuple[int, int]] = []
    planners: list[tuple[Planner, int, int]] = []
    for day in range(start // DAY_NS, -(-end // DAY_NS)):
        ground.check_stopping()
        begin, stop = day * DAY_NS, (day + 1) * DAY_NS
        for reference in situation.references:
            first, last = max(begin, reference.start.utc_ns), min(stop, reference.stop.utc_ns)
            if first <= max(begin, start) and last >= min(stop, end) and last > first:
                planner = planning.planner_of(ground, reference, situation.mission)
                key = (reference.sha256, situation.mission.revision)
                found += _spans_of(_Keyed(key, planner), constraints, first, last)
                planners.append((planner, max(first, start), min(last, end)))
                break
    found = [span for span in found if start <= span[0] and span[1] <= end]
    if found or not planners:
        return found, None
    planner, first, last = planners[0]
    return [], planner.exclusion(constraints, first, last)


@dataclass(frozen=True)
class _Keyed:
    """A planner, equal to others of the same ephemeris and mission description."""

    key: tuple[str, str]
    planner: Planner = field(compare=False)


@functools.lru_cache(maxsize=16)
def _spans_of(keyed: _Keyed, constraints: Constraints, start: int, stop: int) -> tuple[tuple[int, int], ...]:
    try:
        return tuple(keyed.planner.spans(constraints, start, stop))
    except EphemerisCoverageError:
        return ()


def _chosen(
    ground: Ground,
    situation: _Situation,
    candidates: Sequence[tuple[int, int]],
    quota: dict[int, int],
    now: int,
    end: int,
) -> tuple[list[Option], dict[Option, str]]:
    """Return the windows to plan, and the reasons of the other candidates."""
    request, resources = situation.request, planning.resources_of(situation.mission)
    rejected: dict[Option, str] = {}
    options = []
    passes = _uplinks(ground, situation, now, end)
    for start, stop in candidates:
        frames = frames_between(start, stop, request.terms.cadence_s)
        octets = data_octets(frames, resources.detections_per_frame, resources.estimators)
        option = Option(start, stop, octets, 1.0, _period(request, start))
        before = [one for one in passes or () if one + LEAD_NS <= start]
        gap = gap_ns(situation.mission.uploads)
        if any(one.start.utc_ns < stop + gap and start < one.stop.utc_ns + gap for one in situation.others):
            rejected[option] = "overlaps a planned window or its telecommands"
        elif passes is not None and not before:
            rejected[option] = "no contact before it to send its telecommands"
        else:
            options.append(option)
    if not options:
        return [], rejected
    grid = _grid(ground, situation, now, end)
    committed = [
        Option(one.start.utc_ns, one.stop.utc_ns, one.data_octets)
        for one in situation.others
        if one.stop.utc_ns > grid.start_utc_ns and one.start.utc_ns < end
    ]
    chosen, reasons = choose(grid, options, committed, quota)
    most = situation.mission.resources.windows_on_board
    if most is not None:
        left = max(most - sum(one.stop.utc_ns > now for one in situation.others), 0)
        chosen, late = chosen[:left], chosen[left:]
        reasons |= dict.fromkeys(late, f"the telecommands of {most} windows wait on board")
    return chosen, rejected | reasons


def _uplinks(ground: Ground, situation: _Situation, now: int, end: int) -> list[int] | None:
    """Return the starts of the contacts of links with an uplink; None if they cannot be predicted."""
    starts: list[int] = []
    known = False
    for declared in links.declared_links(ground).values():
        if declared.spacecraft_id == situation.request.spacecraft_id and declared.link.uplink is not None:
            contacts, reason = links.predict(ground, declared, now, end)
            known |= reason is None
            starts += [max(one.start_utc_ns, now) for one in contacts]
    return sorted(starts) if known else None


def _grid(ground: Ground, situation: _Situation, now: int, end: int) -> ResourceGrid:
    """Return the resources from an orbit before now until a day after the horizon, as far as the ephemeris reaches."""
    reference = max(situation.references, key=lambda one: one.stop.utc_ns)
    start = max(now - HISTORY_NS, reference.start.utc_ns)
    stop = min(end + DAY_NS, reference.stop.utc_ns)
    planner = planning.planner_of(ground, reference, situation.mission)
    count = max(int((stop - start) // round(STEP_S * NS)), 1)
    grid = planning.resource_grid(planner, situation.mission, start, count, STEP_S)
    terms, stated = situation.request.terms, situation.mission.resources
    return replace(
        grid,
        floor_wh=max(terms.minimum_battery, stated.minimum_battery or 0.0) * grid.battery_wh,
        downlink_within_s=86_400.0 if terms.needs_contact else float("inf"),
    )


def _stored(
    ground: Ground,
    situation: _Situation,
    chosen: Sequence[Option],
    rejected: dict[Option, str],
    reason: str | None,
    now: int,
    end: int,
) -> int:
    """Enter the chosen windows and the plan in one transaction, unless another process did; return their number."""
    request = situation.request
    with ground.database.writing() as connection:
        lock_spacecraft(connection, request.vehicle_id)
        if not store.claim_plan(connection, request):
            return 0
        planned = []
        ids = []
        for option in chosen:
            entry = model.WindowEntry(
                name=f"{request.name} {UtcTime(option.start_utc_ns)[:16]}",
                start_utc_ns=option.start_utc_ns,
                stop_utc_ns=option.stop_utc_ns,
                cadence_s=request.terms.cadence_s,
                spacecraft_id=request.spacecraft_id,
                instance=request.instance,
            )
            try:
                window = planning.insert_window(ground, connection, entry, actor=PLANNER)
            except PlanConflicts as error:
                rejected[option] = str(error)
                continue
            store.assign_window(connection, window.id, request.id)
            ids.append(window.id)
            planned.append(_candidate(option, window.id, None))
        planned += [_candidate(option, None, why) for option, why in rejected.items()]
        failed = [one for one in situation.mine if one.state == "failed"]
        plan = model.RequestPlan(
            request_id=request.id,
            planned=UtcTime(now),
            until=UtcTime(max(end, now)),
            reason=reason,
            basis=_basis(situation),
            candidates=sorted(planned, key=lambda one: one.start.utc_ns),
            replaced=[{"window_id": one.id, "reason": one.reason} for one in failed],
        )
        store.set_plan(connection, plan)
        if ids:
            lost = tuple(one.id for one in failed)
            publish(connection, PlanChanged(request_id=request.id, windows_added=tuple(ids), windows_failed=lost))
    return len(ids)


def _candidate(option: Option, window_id: int | None, reason: str | None) -> model.PlannedCandidate:
    return model.PlannedCandidate(
        start=UtcTime(option.start_utc_ns),
        stop=UtcTime(option.stop_utc_ns),
        outcome="rejected" if window_id is None else "planned",
        window_id=window_id,
        reason=reason,
    )


def _check_terms(terms: model.RequestTerms) -> None:
    if terms.minimum_duration_s > terms.maximum_duration_s:
        raise InvalidInput(
            "request",
            "minimum_duration_s",
            f"at most maximum_duration_s ({terms.maximum_duration_s:g})",
            f"{terms.minimum_duration_s:g}",
        )
    if terms.start is not None and terms.stop is not None and terms.stop.utc_ns <= terms.start.utc_ns:
        raise InvalidInput("request", "stop", "a time after the start", "one before it")


def _note(connection: Connection, actor: str, action: str, request_id: int, state: str) -> None:
    audit(connection, actor, f"{action} request", str(request_id), {"state": state})
    publish(connection, RequestChanged(id=request_id, state=state))
