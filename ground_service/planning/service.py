"""Planned observation windows: searched, entered, decided on, and carried up as time-tagged telecommands."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from sqlalchemy import Connection

from ground_service.access.service import audit
from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.contacts.commanding import service as commanding
from ground_service.contacts.commanding import store as commands
from ground_service.errors import Conflict, InvalidInput, NotFound, PlanConflict, PlanConflicts, StateConflict
from ground_service.ground import Ground, run_apart
from ground_service.http.model import Paging, UtcTime
from ground_service.missions import store as missions
from ground_service.missions.catalogues import catalogue_of
from ground_service.missions.ephemerides import service
from ground_service.missions.ephemerides.model import Ephemeris
from ground_service.missions.ephemerides.service import open_ephemeris
from ground_service.missions.frames import camera_of, declared_frames
from ground_service.missions.model import Mission
from ground_service.missions.places import outages_of, stations_of
from ground_service.missions.timekeeping.core import ticks_of_utc_ns
from ground_service.missions.timekeeping.store import load_correlations
from ground_service.planning import core, model, preparation, store
from ground_service.planning.filling import Option, ResourceGrid
from ground_service.planning.model import (
    AssessedWindow,
    Contact,
    PlannedTelecommand,
    SearchResult,
    Window,
    WindowEntry,
    WindowPrediction,
    WindowRecord,
    WindowSearch,
)
from ground_service.planning.window_states import PlannedSpan, span_conflicts
from ground_service.store.event_kinds import WindowChanged, publish
from ground_service.store.vehicles import lock_spacecraft, vehicle_id
from ground_service.toml import REASON_LIMIT, require_line
from lunar.catalogue import CraterCatalogue
from lunar.constants import NS
from lunar.datafolder import DataFolder
from lunar.ephemeris import Ephemeris as States
from lunar.errors import EphemerisCoverageError
from tmtc.dictionary.arguments import argument_text

SEARCH_LIMIT_S = 31 * 86_400
STEPS_LIMIT = 100_000
APART_S = 7 * 86_400
"""Longer spans are searched in another process."""

BATTERY_FLOOR = 0.3
"""A window that would draw the battery below this share is in conflict with the power there is."""

BATTERY_HISTORY_S = 7200
"""The battery is taken to be full one orbit before a window that is checked by itself."""

VERIFICATION_MARGIN_S = 3600
DELETE = "delete_activity"
ENABLE = "enable_schedule"

DAYLIGHT_RAD = (0.0, math.pi / 2.0)
"""A camera needs the Sun above the horizon of the sub-satellite point."""

_DECIDABLE = {
    "draft": ("approved", "uplinked", "failed"),
    "approved": ("draft",),
    "failed": ("draft", "approved", "uplinked", "executing", "executed", "downlinked", "processed"),
}
"""States in which a window can be decided, by decision."""


def search_windows(ground: Ground, given: WindowSearch) -> SearchResult:
    """Search candidate windows over a reference ephemeris.

    Without `ephemeris_id` the ephemeris that covers the start of the span best is used. Craters are those of
    the catalogue of the mission description in force.

    Raises
    ------
    InvalidInput
        If a constraint needs data that are not available, or the span is too long for its step.
    NotFound
        If there is no such ephemeris.
    """
    start = None if given.start is None else given.start.utc_ns
    stop = None if given.stop is None else given.stop.utc_ns
    with ground.database.reading() as connection:
        if given.spacecraft_id is not None:
            require_described(connection, given.spacecraft_id)
        references = ephemerides_for(connection, given.ephemeris_id, start, stop, given.spacecraft_id)
        mission = mission_of(connection, given.spacecraft_id)
        constraints = observable(given.constraints(), mission)
        commitments = store.commitments(connection, given.spacecraft_id, given.instance)
    reference, spans = _covered_spans(ground, references, start, stop, given.step_s)
    start = reference.start.utc_ns if start is None else start
    stop = reference.stop.utc_ns if stop is None else stop
    _check_span(start, stop, given.step_s, reference)
    now = mission_now_ns()
    if stop <= now:
        raise Conflict(
            f"search: expected a span that ends after the mission time {UtcTime(now)}, found {UtcTime(stop)}"
        )
    start = max(start, now)
    catalogue = catalogue_of(ground, mission) if constraints.craters_per_frame is not None else None
    mare = _mare(ground.data) if constraints.mare is not None else None
    if constraints.mare is not None and mare is None:
        raise InvalidInput("search", "terrain", "an albedo map among the public data", "none")
    planner = planner_of(ground, reference, mission, catalogue, mare)
    found = []
    for first, last in spans:
        if last > start:
            part = replace(planner, ephemeris=_part(planner.ephemeris, first, last))
            terms = (constraints, max(first, start), last, given.cadence_s)
            is_long = last - terms[1] > APART_S * NS and mare is None  # a map cannot be handed over
            search = functools.partial(part.search, *terms, step_s=given.step_s, commitments=commitments)
            found.append(run_apart(search) if is_long else search())
    names = [f"ephemeris {reference.name}", f"orientation {planner.orientation.name}"]
    if len(spans) > 1:
        names[0] += f" without {len(spans) - 1} spans that it does not cover"
    if catalogue is not None:
        names.append(f"crater catalogue {catalogue.source}")
    if mare is not None:
        names.append("albedo map")
    return SearchResult(
        ephemeris_id=reference.id,
        data=names,
        candidates=[model.Candidate.from_core(one) for part in found for one in part.candidates],
        contacts=[Contact.of(asdict(one)) for part in found for one in part.contacts],
        rejected=[model.RejectedSpan.of(asdict(one)) for part in found for one in part.rejected],
        reason=next((part.reason for part in found if part.reason is not None), None)
        if not any(part.candidates for part in found)
        else None,
    )


def observable(constraints: core.Constraints, mission: Mission) -> core.Constraints:
    """Return constraints with the limits of images that a mission description states: latitude, and daylight."""
    limit, daylight = mission.observation.latitude_limit_deg, mission.observation.needs_daylight
    if limit is not None:
        constraints = replace(constraints, limit_rad=math.radians(limit))
    if daylight is None:
        daylight = mission.camera.fov_deg is not None
    if daylight and constraints.sun_elevation_rad is None:
        constraints = replace(constraints, sun_elevation_rad=DAYLIGHT_RAD)
    return constraints


def add_window(ground: Ground, entry: WindowEntry, *, actor: str) -> Window:
    """Enter a window as a draft.

    Raises
    ------
    PlanConflicts
        If it contradicts committed windows or what the spacecraft has.
    """
    with ground.database.writing() as connection:
        return insert_window(ground, connection, entry, actor=actor)


def insert_window(ground: Ground, connection: Connection, entry: WindowEntry, *, actor: str) -> Window:
    """Add a window as `add_window` does, within the caller's transaction."""
    _check_entry(entry)
    require_described(connection, entry.spacecraft_id)
    vehicle = vehicle_id(connection, entry.spacecraft_id, entry.instance)
    lock_spacecraft(connection, vehicle)
    assessed = _assessed(ground, connection, vehicle, 0, entry, "draft")
    mission_id = missions.in_force(connection, vehicle)
    key = store.add_window(connection, vehicle, assessed, mission_id=mission_id, actor=actor, now_utc_ns=utc_now_ns())
    _note(connection, actor, "enter", key, "draft", {"name": entry.name})
    return store.get_window(connection, key)


def change_window(
    ground: Ground,
    window_id: int,
    *,
    actor: str,
    changes: Mapping[str, Any],
    decision: str | None = None,
    reason: str | None = None,
    expected: Callable[[Window], None] | None = None,
) -> Window:
    """Change a draft, or decide on a window: approved, back to draft, or failed with a reason.

    A window whose telecommands were sent does not fail before others have deleted them on board: it is cancelling.

    Parameters
    ----------
    changes
        Fields of `WindowEntry` to replace.
    expected
        Called with the row first, inside the transaction; raises where the caller saw another one.

    Raises
    ------
    PlanConflicts
        If what results contradicts committed windows or what the spacecraft has.
    Conflict
        If the state does not allow it.
    """
    if reason:
        require_line(reason, "window", "reason", REASON_LIMIT)
    with ground.database.writing() as connection:
        window = _locked_window(connection, window_id)
        if expected is not None:
            expected(window)
        if changes and window.state != "draft":
            raise StateConflict("window", window_id, "draft", window.state)
        if decision is not None and window.state not in _DECIDABLE[decision]:
            raise StateConflict("window", window_id, " or ".join(_DECIDABLE[decision]), window.state)
        if decision == "draft" and "sent" in commands.states_of_window(connection, window_id):
            raise StateConflict("telecommands of window", window_id, "released, rejected or none", "sent")
        entry = replace(window.entry(), **changes)
        _check_entry(entry)
        wanted = decision or window.decision
        values: dict[str, Any] = {}
        if changes or decision == "approved":
            values = store.columns_of(_assessed(ground, connection, window.vehicle_id, window_id, entry, wanted))
        if decision in ("draft", "failed"):
            commands.withdraw_window(connection, window_id, actor=actor, now_utc_ns=utc_now_ns())
        if (
            decision == "failed"
            and window.state in ("approved", "uplinked", "executing")
            and _delete_on_board(connection, window, actor)
        ):
            decision = wanted = "cancelling"
        if changes:
            values["edited_by"] = actor
        if decision is not None:
            values["decided_by"] = actor
            values["mission_id"] = missions.in_force(connection, window.vehicle_id)
        changed = store.change_window(
            connection,
            window,
            **values,
            decision=wanted,
            state=wanted if decision else window.state,
            reason=reason,
            version=window.version + 1,
            changed_utc_ns=utc_now_ns(),
        )
        if not changed:
            found = store.get_window(connection, window_id)
            raise StateConflict("window", window_id, window.state, found.state)
        _note(connection, actor, decision or "change", window_id, wanted, {"reason": reason or ""})
        return store.get_window(connection, window_id)


def _delete_on_board(connection: Connection, window: WindowRecord, actor: str) -> list[int]:
    """Release telecommands that delete the activities of a window on board; return their ids.

    One person can do that, as one can stop an observation.
    """
    now, on_board = mission_now_ns(), commands.activities_on_board(connection, window.id)
    if on_board and window.start.utc_ns <= now < window.stop.utc_ns:
        raise Conflict(
            f"window {window.id}: began at {window.start}, too late to delete its activities; "
            "perform_function stop_observation ends the observation"
        )
    if now >= window.stop.utc_ns:
        return []
    approval = commanding.Approval("", actor)
    ids = [
        commanding.add_released(
            connection,
            window.vehicle_id,
            DELETE,
            {"request_id": request},
            actor=actor,
            window_id=window.id,
            approval=approval,
        )
        for request in on_board
    ]
    commands.limit_sending(connection, ids, window.start.utc_ns)
    return ids


def delete_window(
    ground: Ground, window_id: int, *, actor: str, expected: Callable[[Window], None] | None = None
) -> None:
    """Delete a window from the plan, unless its telecommands were sent.

    `expected` is as in `change_window`.

    Raises
    ------
    Conflict
        If its telecommands were sent, or it is the predecessor of another window.
    """
    with ground.database.writing() as connection:
        window = _locked_window(connection, window_id)
        if expected is not None:
            expected(window)
        if "sent" in commands.states_of_window(connection, window_id) or window.pass_id is not None:
            raise Conflict(f"window {window_id}: was uplinked; it can be declared failed, not deleted")
        follower = store.follower_of(connection, window_id)
        if follower is not None:
            raise Conflict(f"window {window_id}: is the predecessor of window {follower}")
        commands.withdraw_window(connection, window_id, actor=actor, now_utc_ns=utc_now_ns())
        commands.unlink_window(connection, window_id)
        store.delete_window(connection, window_id)
        _note(connection, actor, "delete", window_id, "deleted", {"name": window.name})


def uplink_window(ground: Ground, window_id: int, *, actor: str) -> list[int]:
    """Release the telecommands of an approved window; their ids. Asking again gives the same ones.

    The schedule is enabled, and the start and the stop of the observation are inserted into it at their on-board
    times (PUS service 11). The telecommands inside are on record too, so that their own verification is followed.

    Raises
    ------
    Conflict
        If the window is not approved, begins too soon, or its predecessor is in the way.
    """
    with ground.database.writing() as connection:
        window = _locked_window(connection, window_id)
        ids = commands.carriers_of_window(connection, window_id)
        if "sent" in commands.states_of_window(connection, window_id):
            return ids
        if window.start.utc_ns <= mission_now_ns():
            raise Conflict(f"window {window_id} began at {window.start}: its telecommands are not sent")
        if ids:
            return ids
        if window.state != "approved":
            raise StateConflict("window", window_id, "approved", window.state)
        require_described(connection, window.spacecraft_id)
        mission = mission_of(connection, window.spacecraft_id)
        conflicts = _span_conflicts(connection, window.vehicle_id, window_id, window.entry(), mission)
        if conflicts:
            raise PlanConflicts(f"window {window_id}", conflicts)
        ticks_of = _ticks_of(connection, window)
        timeout_s = round(max(window.stop.utc_ns - mission_now_ns(), 0) / NS) + VERIFICATION_MARGIN_S
        approval = commanding.Approval(window.edited_by, window.decided_by)
        activities, uploads = _activities(ground, connection, window, ticks_of)
        if uploads is not None:
            store.note_uploads(connection, window_id, uploads)
        ids = [
            commanding.add_released(
                connection, window.vehicle_id, ENABLE, {}, actor=actor, window_id=window_id, approval=approval
            )
        ]
        for utc_ns, command, arguments in activities:
            ids.append(
                commanding.add_scheduled(
                    connection,
                    window.vehicle_id,
                    command,
                    arguments,
                    release_ticks=ticks_of(utc_ns),
                    actor=actor,
                    timeout_s=timeout_s,
                    window_id=window_id,
                    approval=approval,
                )
            )
        commands.limit_sending(connection, ids, window.start.utc_ns)
        _note(connection, actor, "uplink", window_id, window.state, {"telecommands": ids})
        return ids


def preview_window(ground: Ground, window_id: int) -> list[PlannedTelecommand]:
    """Return the telecommands that `uplink_window` would release now, in the order in which they act.

    Raises
    ------
    NotFound
        A table needs a reference ephemeris, and none covers the window.
    """
    with ground.database.reading() as connection:
        window = store.get_record(connection, window_id)
        try:
            activities, _ = _activities(ground, connection, window, _ticks_of(connection, window))
        except Conflict:
            raise NotFound("ephemeris", f"that covers window {window_id}") from None
    planned: list[tuple[int | None, str, dict[str, Any]]] = [(None, ENABLE, {}), *activities]
    return [
        PlannedTelecommand(
            time=None if utc_ns is None else UtcTime(utc_ns), name=name, text=argument_text(name, arguments)
        )
        for utc_ns, name, arguments in planned
    ]


def _ticks_of(connection: Connection, window: WindowRecord) -> preparation.TicksOf:
    correlations = load_correlations(connection, window.vehicle_id)
    return lambda utc_ns: ticks_of_utc_ns(utc_ns, correlations)


def _activities(
    ground: Ground, connection: Connection, window: WindowRecord, ticks_of: preparation.TicksOf
) -> tuple[list[preparation.Activity], model.WindowUploads | None]:
    """Return the activities of a window in order of time, and what they load on board."""
    start, stop = window.start.utc_ns, window.stop.utc_ns
    # The observation ends by the second telecommand; by itself a frame later should that one be lost.
    duration_s = (stop - start) / NS + window.cadence_s
    further, uploads = _preparation(ground, connection, window, ticks_of)
    named: list[preparation.Activity] = [
        (utc_ns, "perform_function", {"function_id": function, "argument_1": first, "argument_2": second})
        for utc_ns, function, first, second in (
            (start, "start_observation", duration_s, window.cadence_s),
            (stop, "stop_observation", 0.0, 0.0),
        )
    ]
    return sorted([*further, *named], key=lambda one: one[0]), uploads


def _preparation(
    ground: Ground, connection: Connection, window: WindowRecord, ticks_of: preparation.TicksOf
) -> tuple[list[preparation.Activity], model.WindowUploads | None]:
    """Return the activities that prepare a window, where its mission description asks for uploads, and the uploads."""
    mission = None if window.mission_id is None else missions.get_mission(connection, window.mission_id)
    if mission is None or mission.uploads is None:
        return [], None
    start, stop = window.start.utc_ns, window.stop.utc_ns
    found = service.covering_ephemerides(
        connection, start - preparation.MARGIN_NS, stop + preparation.MARGIN_NS, window.spacecraft_id
    )
    whole = [
        one
        for one in found
        if one.start.utc_ns <= start - preparation.MARGIN_NS
        and stop + preparation.MARGIN_NS <= one.stop.utc_ns
        and _covered_spans(ground, [one], start, stop, 60.0)[1] == [(start, stop)]
    ]
    orientation = declared_frames(mission.frames, ground.data).orientation or ground.orientation
    uploads, begin, experiment = mission.uploads, None, None
    error_m, age_h = mission.experiment.orbit_error_m, mission.experiment.orbit_age_h
    if error_m is not None and whole and _is_of_experiment(connection, window, mission):
        old = [one for one in whole if one.start.utc_ns <= start - round((age_h or 0.0) * 3600 * NS)]
        # Without an ephemeris of that age, the oldest arc: its age is recorded.
        orbit = old[0] if old else min(whole, key=lambda one: one.start.utc_ns)
        begin = preparation.experiment_state(open_ephemeris(ground, orbit), error_m, start, window.spacecraft_id)
        uploads = preparation.experiment_accuracy(uploads, error_m, begin)
        age = None if age_h is None else round((start - orbit.start.utc_ns) / (3600 * NS), 2)
        experiment = model.StartedOrbit(orbit_error_m=error_m, orbit_age_h=age)
    activities, state = preparation.prepare_window(
        uploads,
        open_ephemeris(ground, whole[0]) if whole else None,
        orientation,
        start,
        stop,
        ticks_of,
        8 * window.id,
        begin,
    )
    if state is None:
        return activities, None
    uploaded = model.UploadedState(
        utc=UtcTime(state.utc_ns),
        position_icrf_m=tuple(state.position_icrf_m.tolist()),
        velocity_icrf_m_s=tuple(state.velocity_icrf_m_s.tolist()),
    )
    return activities, model.WindowUploads(start_state=uploaded, experiment=experiment)


def _is_of_experiment(connection: Connection, window: WindowRecord, mission: Mission) -> bool:
    """Return whether a window belongs to the experiment of its mission description, which needs a start state."""
    if mission.uploads is None or "initial_state" not in mission.uploads.tables:
        return False
    if mission.experiment.windows != "first_of_day":
        return True
    start = window.start.utc_ns
    day = start - start % (86_400 * NS)
    before = store.windows_between(connection, window.spacecraft_id, window.instance, day, start)
    return not any(one.start.utc_ns >= day for one in before)


def _assessed(
    ground: Ground, connection: Connection, vehicle: int, window_id: int, entry: WindowEntry, decision: str
) -> AssessedWindow:
    """Return a request with its prediction."""
    mission = mission_of(connection, entry.spacecraft_id)
    conflicts = _span_conflicts(connection, vehicle, window_id, entry, mission)
    if entry.start_utc_ns <= (now := mission_now_ns()):
        expected = f"expected a start after the mission time {UtcTime(now)}, found {UtcTime(entry.start_utc_ns)}"
        conflicts.append(PlanConflict("past", None, expected))
    commitments = store.commitments(connection, entry.spacecraft_id, entry.instance, without=window_id)
    prediction = _prediction(ground, connection, entry, mission, commitments)
    frames = core.frames_between(entry.start_utc_ns, entry.stop_utc_ns, entry.cadence_s)
    resources = resources_of(mission)
    octets = core.data_octets(frames, resources.detections_per_frame, resources.estimators)
    limit = mission.observation.latitude_limit_deg
    if prediction is not None:
        peak = prediction.storage_peak_octets
        furthest = math.degrees(max(map(abs, prediction.latitude_rad)))
        if limit is not None and furthest > limit:
            conflicts.append(
                PlanConflict(
                    "latitude",
                    None,
                    f"expected latitudes within the {limit:g} deg of the mission description, found {furthest:.1f} deg",
                )
            )
        if prediction.battery_minimum < BATTERY_FLOOR:
            conflicts.append(
                PlanConflict(
                    "power",
                    None,
                    f"the battery would fall to {100 * prediction.battery_minimum:.0f} %, "
                    f"expected {100 * BATTERY_FLOOR:.0f} % or more",
                )
            )
    else:
        if (conflict := _coverage_conflict(connection, entry, mission)) is not None:
            conflicts.append(conflict)
        mine = Option(entry.start_utc_ns, entry.stop_utc_ns, octets)
        peak, _ = core.storage_peak([*commitments, mine], (), resources.downlink_bit_s, mine)
    if peak > resources.storage_octets:
        conflicts.append(
            PlanConflict(
                "storage", None, f"{peak} octets would be stored on board, expected at most {resources.storage_octets}"
            )
        )
    if conflicts:
        what = f"window {window_id}" if window_id else "window"
        raise PlanConflicts(f"{what} as {decision}", conflicts)
    conditions = {} if prediction is None else dict(model.Candidate.from_core(prediction))
    predicted = WindowPrediction.model_validate({"frames": frames} | conditions)
    return AssessedWindow(entry, octets, predicted)


def planner_of(
    ground: Ground, reference: Ephemeris, mission: Mission, catalogue: CraterCatalogue | None = None, mare: Any = None
) -> core.Planner:
    """Return a planner with camera and orientation of the mission; defaults replace what it does not state."""
    orientation = declared_frames(mission.frames, ground.data).orientation or ground.orientation
    return core.Planner(
        open_ephemeris(ground, reference),
        orientation,
        resources_of(mission),
        camera_of(mission.camera),
        catalogue,
        mare,
        preparation.gap_ns(mission.uploads),
    )


def require_described(connection: Connection, spacecraft_id: int) -> None:
    """Refuse to plan for a spacecraft that no mission description states, unless there is no description at all.

    Raises
    ------
    Conflict
        There is none; the message names the known spacecraft.
    """
    described = missions.missions_in_force(connection)
    if described and spacecraft_id not in described:
        known = ", ".join(map(str, sorted(described)))
        raise Conflict(
            f"spacecraft {spacecraft_id}: expected one that a mission description states ({known}), found none; "
            "add its description first"
        )


def mission_of(connection: Connection, spacecraft_id: int | None) -> Mission:
    """Return the description in force of a spacecraft; without any, one that states nothing."""
    return missions.mission_in_force(connection, spacecraft_id) or Mission(name="not stated")


def resources_of(mission: Mission) -> core.Resources:
    """Return the resources that a mission description states, with defaults for the others."""
    stated, default = mission.resources, asdict(core.Resources())
    rates = [one.downlink_bps for one in (mission.link.stations or {}).values() if one.downlink_bps is not None]
    given: dict[str, Any] = {
        "storage_octets": None if stated.storage_mib is None else round(stated.storage_mib * (1 << 20)),
        "downlink_bit_s": min(rates, default=None) if stated.downlink_kbit_s is None else stated.downlink_kbit_s * 1e3,
        "stations": stations_of(mission.link) or core.Resources().stations,
    }
    given = stated.model_dump(include=set(default)) | given
    return core.Resources(**default | {name: value for name, value in given.items() if value is not None})


def assumed_resources(mission: Mission) -> list[str]:
    """Return which of battery, storage and downlink a mission description does not state."""
    stated, rates = mission.resources, (mission.link.stations or {}).values()
    known = {
        "battery": stated.battery_wh is not None,
        "storage": stated.storage_mib is not None,
        "downlink": stated.downlink_kbit_s is not None or any(one.downlink_bps is not None for one in rates),
    }
    return [name for name, is_stated in known.items() if not is_stated]


def battery_floor(mission: Mission) -> float:
    """Return the smallest charge, share of the capacity, of a mission description or of the planner."""
    return max(mission.resources.minimum_battery or 0.0, BATTERY_FLOOR)


def resource_grid(planner: core.Planner, mission: Mission, start: int, count: int, step_s: float) -> ResourceGrid:
    """Return the resources in `count` steps from a time on, as far as the ephemeris reaches."""
    resources, hours = planner.resources, mission.resources.observe_hours_per_day
    middles = start + (np.arange(count, dtype=np.int64) * 2 + 1) * round(step_s * NS / 2)
    sunlit = planner.sunlit(np.minimum(middles, planner.ephemeris.stop_utc_ns))
    return ResourceGrid(
        start_utc_ns=start,
        step_s=step_s,
        gain_wh=(sunlit * resources.generation_w - resources.idle_w) * step_s / 3600.0,
        downlink_octets=planner.downlink_octets(start, count, step_s, outages_of(mission.link)),
        battery_wh=resources.battery_wh,
        floor_wh=battery_floor(mission) * resources.battery_wh,
        observing_w=resources.observing_w,
        storage_octets=resources.storage_octets,
        observe_s_per_day=None if hours is None else hours * 3600.0,
        gap_ns=planner.gap_ns,
    )


def _prediction(
    ground: Ground, connection: Connection, entry: WindowEntry, mission: Mission, commitments: Sequence[Option]
) -> core.Candidate | None:
    """Predict the window if a reference ephemeris covers it."""
    candidates = (
        [service.get_ephemeris(connection, entry.ephemeris_id)]
        if entry.ephemeris_id is not None
        else service.covering_ephemerides(connection, entry.start_utc_ns, entry.stop_utc_ns, entry.spacecraft_id)
    )
    for one in candidates:
        start, stop = one.start.utc_ns, one.stop.utc_ns
        if start <= entry.start_utc_ns and entry.stop_utc_ns <= stop:
            planner = planner_of(ground, one, mission)
            try:
                return planner.predict(
                    entry.start_utc_ns,
                    entry.stop_utc_ns,
                    entry.cadence_s,
                    since_utc_ns=max(start, entry.start_utc_ns - BATTERY_HISTORY_S * NS),
                    until_utc_ns=stop,
                    commitments=commitments,
                )
            except EphemerisCoverageError:
                continue
    return None


def _coverage_conflict(connection: Connection, entry: WindowEntry, mission: Mission) -> PlanConflict | None:
    """Return the conflict of a window that no ephemeris covers.

    A window needs one if it names it, or if tables for it are made from it (`[uploads]` of the mission description).
    """
    if entry.ephemeris_id is None and mission.uploads is None:
        return None
    known = service.list_ephemerides(connection, Paging(limit=1)).items
    if not known:
        return None
    newest = known[0] if entry.ephemeris_id is None else service.get_ephemeris(connection, entry.ephemeris_id)
    return PlanConflict(
        "ephemeris",
        None,
        f"expected a time that a reference ephemeris covers (ephemeris {newest.id} from {newest.start} to "
        f"{newest.stop}), found {UtcTime(entry.start_utc_ns)} to {UtcTime(entry.stop_utc_ns)}",
    )


def _span_conflicts(
    connection: Connection, vehicle: int, window_id: int, entry: WindowEntry, mission: Mission
) -> list[PlanConflict]:
    gap = preparation.gap_ns(mission.uploads)
    spans = store.neighbours(connection, vehicle, entry, gap)
    predecessor = next((span for span in spans if span.id == entry.predecessor_id), None)
    if entry.predecessor_id is not None and predecessor is None:
        raise NotFound("window", entry.predecessor_id)
    mine = PlannedSpan(window_id, entry.start_utc_ns, entry.stop_utc_ns, "draft")
    return span_conflicts(mine, predecessor, spans, gap)


def ephemerides_for(
    connection: Connection, ephemeris_id: int | None, start: int | None, stop: int | None, spacecraft_id: int | None
) -> list[Ephemeris]:
    """Return the ephemerides that cover a span, the best first: all of it, then by precedence and coverage."""
    if ephemeris_id is not None:
        return [service.get_ephemeris(connection, ephemeris_id)]
    first = start if start is not None else -(2**62)
    last = stop if stop is not None else 2**62
    found = service.covering_ephemerides(connection, first, last, spacecraft_id)
    if not found:
        known = service.covering_ephemerides(connection, -(2**62), 2**62, spacecraft_id)
        spans = "; ".join(f"{one.name}, {one.start} to {one.stop}" for one in known[:3])
        raise NotFound("ephemeris", f"over the span of the search (known: {spans or 'none'})")

    def covered(one: Ephemeris) -> int:
        return min(one.stop.utc_ns, last) - max(one.start.utc_ns, first)

    whole = last - first if start is not None and stop is not None else 2**63
    return sorted(found, key=lambda one: (covered(one) >= whole, one.precedence, covered(one), one.id), reverse=True)


def _part(ephemeris: States, start: int, stop: int) -> States:
    """Return the part of an ephemeris between two times without a hole; the whole if it has a single segment."""
    mine = [one for one in ephemeris.segments if one.start_utc_ns <= stop and one.stop_utc_ns >= start]
    return ephemeris if len(ephemeris.segments) == 1 else replace(ephemeris, segments=tuple(mine))


def _covered_spans(
    ground: Ground, references: Sequence[Ephemeris], start: int | None, stop: int | None, step_s: float
) -> tuple[Ephemeris, list[tuple[int, int]]]:
    """Return the first ephemeris without a hole in a span, otherwise that with the fewest, and what it covers."""
    best: tuple[float, Ephemeris, list[tuple[int, int]]] | None = None
    for one in references:
        first = max(one.start.utc_ns, one.start.utc_ns if start is None else start)
        last = min(one.stop.utc_ns, one.stop.utc_ns if stop is None else stop)
        if last - first > SEARCH_LIMIT_S * NS:
            return one, [(first, last)]
        times = np.append(np.arange(first, last, max(round(step_s * NS), 1), dtype=np.int64), last)
        known = open_ephemeris(ground, one).covers(times)
        if known.all():
            return one, [(first, last)]
        edges = np.flatnonzero(np.diff(np.concatenate(([False], known, [False])).astype(np.int8)))
        spans = [(int(times[a]), int(times[b - 1])) for a, b in edges.reshape(-1, 2).tolist() if b - a > 1]
        if best is None or known.sum() > best[0]:
            best = float(known.sum()), one, spans
    assert best is not None
    return best[1], best[2]


def _check_span(start: int, stop: int, step_s: float, reference: Ephemeris) -> None:
    if stop <= start:
        raise InvalidInput("search", "stop", "a time after the start", "one before it")
    if stop - start > SEARCH_LIMIT_S * NS or (stop - start) / (step_s * NS) > STEPS_LIMIT:
        raise InvalidInput(
            "search",
            "stop",
            f"at most {SEARCH_LIMIT_S // 86_400} days and {STEPS_LIMIT} steps",
            f"{(stop - start) / NS:.0f} s in steps of {step_s} s",
        )
    if start < reference.start.utc_ns or stop > reference.stop.utc_ns:
        raise InvalidInput(
            "search", "start, stop", f"a span that ephemeris {reference.id} ({reference.name}) covers", "another"
        )


def _check_entry(entry: WindowEntry) -> None:
    require_line(entry.name, "window", "name")
    duration = (entry.stop_utc_ns - entry.start_utc_ns) / NS
    if duration <= 0:
        raise InvalidInput("window", "stop", "a time after the start", "one before it")
    if duration > 86_400:
        raise InvalidInput("window", "stop", "at most a day after the start", f"{duration:.0f} s")


@functools.lru_cache(maxsize=2)
def _mare(data: DataFolder) -> Any:
    """Return whether the ground is mare: darker than the value that best parts the albedo map in two (Otsu 1979)."""
    if data.albedo is None:
        return None
    from PIL import Image

    with Image.open(data.albedo) as image:
        grey = np.asarray(image.convert("L").resize((720, 360)), dtype=np.uint8)
    # The poles are stretched in the map and belong to the highlands: they would outweigh the maria.
    counts = np.bincount(grey[40:320].ravel(), minlength=256).astype(np.float64)
    share = np.cumsum(counts) / counts.sum()
    mean = np.cumsum(counts * np.arange(256)) / counts.sum()
    with np.errstate(invalid="ignore", divide="ignore"):
        between = (mean[-1] * share - mean) ** 2 / (share * (1.0 - share))
    dark = grey <= int(np.nanargmax(between))

    def at(latitude_rad: Any, longitude_rad: Any) -> Any:
        rows = np.clip(((90.0 - np.degrees(latitude_rad)) * 2.0).astype(np.int64), 0, 359)
        columns = ((np.degrees(longitude_rad) + 180.0) % 360.0 * 2.0).astype(np.int64) % 720
        return dark[rows, columns]

    return at


def _locked_window(connection: Connection, window_id: int) -> WindowRecord:
    """Lock the plan of the spacecraft of a window until the transaction ends, and return the window."""
    lock_spacecraft(connection, store.get_record(connection, window_id).vehicle_id)
    return store.get_record(connection, window_id)


def _note(connection: Connection, actor: str, action: str, window_id: int, state: str, detail: dict[str, Any]) -> None:
    audit(connection, actor, f"{action} window", str(window_id), detail)
    publish(connection, WindowChanged(id=window_id, state=state))
