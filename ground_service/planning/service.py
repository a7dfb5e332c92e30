"""Planned observation windows: searched, entered, decided on, and carried up as time-tagged telecommands."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from sqlalchemy import Connection, or_, select

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.commanding import service as commanding
from ground_service.errors import Conflict, InvalidInput, NotFound, PlanConflict, PlanConflicts, StateConflict
from ground_service.events import WindowChanged, publish
from ground_service.ground import Ground
from ground_service.http.times import UtcTime
from ground_service.missions import store as missions
from ground_service.missions.frames import camera_of, declared_frames
from ground_service.missions.model import Mission
from ground_service.planning import model
from ground_service.planning.core import (
    Candidate,
    Commitment,
    Planner,
    Resources,
    data_octets,
    frames_between,
    storage_peak,
)
from ground_service.planning.model import Contact, SearchResult, Window, WindowEntry, WindowSearch
from ground_service.planning.window_states import COMMITTED, PlannedSpan, span_conflicts
from ground_service.store import repository
from ground_service.store.counters import lock_spacecraft
from ground_service.store.states import TELECOMMAND, change_if, move_all
from ground_service.store.vehicles import vehicle_id
from ground_service.text import REASON_LIMIT, require_line
from ground_service.timekeeping.core import ticks_of_utc_ns
from ground_service.timekeeping.store import load_correlations
from lunar.catalogue import CraterCatalogue, load_catalogue
from lunar.constants import NANOSECONDS_PER_SECOND
from lunar.datafolder import DataFolder
from lunar.ephemeris import Ephemeris
from lunar.ephemeris_files import load_ephemeris
from lunar.errors import EphemerisCoverageError

NS = NANOSECONDS_PER_SECOND

SEARCH_LIMIT_S = 31 * 86_400
STEPS_LIMIT = 100_000
BATTERY_FLOOR = 0.3
"""A window that would draw the battery below this share is in conflict with the power there is."""

BATTERY_HISTORY_S = 7200
"""The battery is taken to be full one orbit before a window that is checked by itself."""

VERIFICATION_MARGIN_S = 3600

_DECIDABLE = {
    "draft": ("approved", "uplinked", "failed"),
    "approved": ("draft",),
    "failed": ("draft", "approved", "uplinked", "executing", "executed", "downlinked", "processed"),
}
"""States in which a window can be decided, by decision."""


def search_windows(ground: Ground, given: WindowSearch) -> SearchResult:
    """Search candidate windows over a reference ephemeris.

    Without `ephemeris_id` the ephemeris that covers the start of the span best is used, without `catalogue_pass_id` the
    available public crater catalogue.

    Raises
    ------
    InvalidInput
        If a constraint needs data that are not available, or the span is too long for its step.
    NotFound
        If there is no such ephemeris or pass.
    """
    constraints = given.constraints()
    start = None if given.start is None else given.start.utc_ns
    stop = None if given.stop is None else given.stop.utc_ns
    with ground.database.reading() as connection:
        row = _ephemeris_for(connection, given.ephemeris_id, start, stop)
        mission = missions.mission_in_force(connection, given.spacecraft_id)
        commitments = _commitments(connection, given.spacecraft_id, given.instance)
        catalogue_sha256 = None
        if given.catalogue_pass_id is not None:
            record = repository.get(connection, repository.PASSES, given.catalogue_pass_id, "pass")
            catalogue_sha256 = record["catalogue_sha256"]
            if catalogue_sha256 is None:
                raise InvalidInput("search", "catalogue_pass_id", "a pass with a crater catalogue", "none")
    start = row["start_utc_ns"] if start is None else start
    stop = row["stop_utc_ns"] if stop is None else stop
    _check_span(start, stop, given.step_s, row)
    catalogue = _catalogue(ground, catalogue_sha256) if constraints.craters_per_frame is not None else None
    if constraints.craters_per_frame is not None and catalogue is None:
        raise InvalidInput(
            "search", "craters_per_frame", "a crater catalogue (catalogue_pass_id or public data)", "none"
        )
    mare = _mare(ground.data) if constraints.mare is not None else None
    if constraints.mare is not None and mare is None:
        raise InvalidInput("search", "terrain", "an albedo map among the public data", "none")
    planner = _planner(ground, row, mission, given.resources.value(), catalogue, mare)
    found = planner.search(
        constraints, start, stop, given.cadence_s, step_s=given.step_s, commitments=commitments
    )
    names = [f"ephemeris {row['name']}", f"orientation {planner.orientation.name}"]
    if catalogue is not None:
        names.append(f"crater catalogue {catalogue.source}")
    if mare is not None:
        names.append("albedo map")
    return SearchResult(
        ephemeris_id=row["id"],
        data=names,
        candidates=[model.Candidate.from_core(one) for one in found.candidates],
        contacts=[
            Contact(station=one.station, start=UtcTime(one.start_utc_ns), stop=UtcTime(one.stop_utc_ns))
            for one in found.contacts
        ],
        refused=found.refused,
    )


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
    vehicle = vehicle_id(connection, entry.spacecraft_id, entry.instance)
    lock_spacecraft(connection, vehicle)
    values = _assessed(ground, connection, vehicle, 0, entry, "draft")
    now = utc_now_ns()
    key = repository.add(
        connection,
        repository.WINDOWS,
        vehicle_id=vehicle,
        decision="draft",
        state="draft",
        mission_id=missions.in_force(connection, vehicle),
        version=1,
        created_by=actor,
        edited_by=actor,
        created_utc_ns=now,
        changed_utc_ns=now,
        **values,
    )
    _note(connection, actor, "enter", int(key), "draft", {"name": entry.name})
    return _window(connection, int(key))


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
        row = _locked_window(connection, window_id)
        if expected is not None:
            expected(Window.of(row))
        if changes and row["state"] != "draft":
            raise StateConflict("window", window_id, "draft", row["state"])
        if decision is not None and row["state"] not in _DECIDABLE[decision]:
            raise StateConflict("window", window_id, " or ".join(_DECIDABLE[decision]), row["state"])
        if decision == "draft" and "sent" in _command_states(connection, window_id):
            raise StateConflict("telecommands of window", window_id, "released, rejected or none", "sent")
        entry = replace(entry_of(row), **changes)
        _check_entry(entry)
        wanted = decision or row["decision"]
        values: dict[str, Any] = {}
        if changes or decision == "approved":
            values = _assessed(ground, connection, row["vehicle_id"], window_id, entry, wanted)
        if decision in ("draft", "failed"):
            _withdraw(connection, window_id, actor)
        if changes:
            values["edited_by"] = actor
        if decision is not None:
            values["decided_by"] = actor
            values["mission_id"] = missions.in_force(connection, row["vehicle_id"])
        changed = change_if(
            connection,
            repository.WINDOWS,
            window_id,
            {"version": row["version"], "state": row["state"]},
            **values,
            decision=wanted,
            state=wanted if decision else row["state"],
            reason=reason,
            version=row["version"] + 1,
            changed_utc_ns=utc_now_ns(),
        )
        if not changed:
            raise StateConflict("window", window_id, row["state"], window_row(connection, window_id)["state"])
        _note(connection, actor, decision or "change", window_id, wanted, {"reason": reason or ""})
        return _window(connection, window_id)


def delete_window(
    ground: Ground,
    window_id: int,
    *,
    actor: str,
    expected: Callable[[Window], None] | None = None,
) -> None:
    """Delete a window from the plan, unless its telecommands were sent.

    `expected` is as in `change_window`.

    Raises
    ------
    Conflict
        If its telecommands were sent, or it is the predecessor of another window.
    """
    with ground.database.writing() as connection:
        row = _locked_window(connection, window_id)
        if expected is not None:
            expected(Window.of(row))
        if "sent" in _command_states(connection, window_id) or row["pass_id"] is not None:
            raise Conflict(f"window {window_id}: was uplinked; it can be declared failed, not deleted")
        follower = repository.find(connection, repository.WINDOWS, predecessor_id=window_id)
        if follower is not None:
            raise Conflict(f"window {window_id}: is the predecessor of window {follower['id']}")
        _withdraw(connection, window_id, actor)
        commands = repository.TELECOMMANDS
        connection.execute(commands.update().where(commands.c.window_id == window_id).values(window_id=None))
        connection.execute(repository.WINDOWS.delete().where(repository.WINDOWS.c.id == window_id))
        _note(connection, actor, "delete", window_id, "deleted", {"name": row["name"]})


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
        row = _locked_window(connection, window_id)
        table = repository.TELECOMMANDS
        known = connection.execute(
            select(table.c.id)
            .where(table.c.window_id == window_id, table.c.carrier_id.is_(None), table.c.state != "rejected")
            .order_by(table.c.id)
        ).scalars()
        ids = [int(key) for key in known]
        if ids:
            return ids
        if row["state"] != "approved":
            raise StateConflict("window", window_id, "approved", row["state"])
        conflicts = _span_conflicts(connection, row["vehicle_id"], window_id, entry_of(row))
        if conflicts:
            raise PlanConflicts(f"window {window_id}", conflicts)
        correlations = load_correlations(connection, row["vehicle_id"])
        # The observation ends by the second telecommand; by itself a frame later should that one be lost.
        duration_s = (row["stop_utc_ns"] - row["start_utc_ns"]) / NS + row["cadence_s"]
        timeout_s = round(max(row["stop_utc_ns"] - utc_now_ns(), 0) / NS) + VERIFICATION_MARGIN_S
        activities = (
            (row["start_utc_ns"], ("start_observation", duration_s, row["cadence_s"])),
            (row["stop_utc_ns"], ("stop_observation", 0.0, 0.0)),
        )
        approval = commanding.Approval(row["edited_by"], row["decided_by"])
        ids = [
            commanding.add_released(
                connection,
                row["vehicle_id"],
                "enable_schedule",
                {},
                actor=actor,
                window_id=window_id,
                approval=approval,
            )
        ]
        for utc_ns, (function, first, second) in activities:
            ids.append(
                commanding.add_scheduled(
                    connection,
                    row["vehicle_id"],
                    "perform_function",
                    {"function_id": function, "argument_1": first, "argument_2": second},
                    release_ticks=ticks_of_utc_ns(utc_ns, correlations),
                    actor=actor,
                    timeout_s=timeout_s,
                    window_id=window_id,
                    approval=approval,
                )
            )
        _note(connection, actor, "uplink", window_id, row["state"], {"telecommands": ids})
        return ids


def get_window(ground: Ground, window_id: int) -> Window:
    """Return a window.

    Raises
    ------
    NotFound
        There is no such window.
    """
    with ground.database.reading() as connection:
        return _window(connection, window_id)


def list_windows(
    ground: Ground, *, state: str | None = None, limit: int = 100, offset: int = 0
) -> tuple[list[Window], int]:
    """Return a page of the windows, newest first, and the total number."""
    equal: dict[str, Any] = {"state": state} if state is not None else {}
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.WINDOWS, limit=limit, offset=offset, **equal)
        return [Window.of(_joined(connection, row)) for row in page.rows], page.total


def _window(connection: Connection, window_id: int) -> Window:
    return Window.of(window_row(connection, window_id))


def window_row(connection: Connection, window_id: int) -> repository.Row:
    """A window with the spacecraft it is for and the telecommands that carry it."""
    return _joined(connection, repository.get(connection, repository.WINDOWS, window_id, "window"))


def entry_of(row: Mapping[str, Any]) -> WindowEntry:
    """Return the entry that requests this window."""
    return WindowEntry(
        name=row["name"],
        start_utc_ns=row["start_utc_ns"],
        stop_utc_ns=row["stop_utc_ns"],
        cadence_s=row["cadence_s"],
        spacecraft_id=row["spacecraft_id"],
        instance=row["instance"],
        predecessor_id=row["predecessor_id"],
        ephemeris_id=row["ephemeris_id"],
        resources=Resources(**row["predicted"].get("resources", {})),
    )


def _assessed(
    ground: Ground, connection: Connection, vehicle: int, window_id: int, entry: WindowEntry, decision: str
) -> dict[str, Any]:
    """Columns of a window with its prediction, after every conflict was looked for."""
    conflicts = _span_conflicts(connection, vehicle, window_id, entry)
    commitments = _commitments(connection, entry.spacecraft_id, entry.instance, without=window_id)
    prediction = _prediction(ground, connection, entry, commitments)
    frames = frames_between(entry.start_utc_ns, entry.stop_utc_ns, entry.cadence_s)
    octets = data_octets(frames, entry.resources.detections_per_frame, entry.resources.estimators)
    if prediction is not None:
        peak = prediction.storage_peak_octets
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
        mine = Commitment(entry.start_utc_ns, entry.stop_utc_ns, octets)
        peak, _ = storage_peak([*commitments, mine], (), entry.resources.downlink_bit_s, mine)
    if peak > entry.resources.storage_octets:
        conflicts.append(
            PlanConflict(
                "storage",
                None,
                f"{peak} octets would be stored on board, expected at most {entry.resources.storage_octets}",
            )
        )
    if conflicts:
        what = f"window {window_id}" if window_id else "window"
        raise PlanConflicts(f"{what} as {decision}", conflicts)
    kept = {**asdict(entry.resources)}
    kept.pop("stations")
    return {
        "name": entry.name,
        "start_utc_ns": entry.start_utc_ns,
        "stop_utc_ns": entry.stop_utc_ns,
        "cadence_s": entry.cadence_s,
        "predecessor_id": entry.predecessor_id,
        "ephemeris_id": entry.ephemeris_id,
        "data_octets": octets,
        "predicted": {
            "frames": frames,
            "resources": kept,
            **(model.Candidate.from_core(prediction).model_dump(mode="json") if prediction else {}),
        },
    }


def _planner(
    ground: Ground,
    ephemeris: repository.Row,
    mission: Mission | None,
    resources: Resources,
    catalogue: CraterCatalogue | None = None,
    mare: Any = None,
) -> Planner:
    """Return a planner with camera and orientation of the mission; defaults replace what it does not state."""
    stated = Mission(name="not stated") if mission is None else mission
    orientation = declared_frames(stated.frames, ground.data).orientation or ground.orientation
    return Planner(
        _load(ground, ephemeris), orientation, resources, camera_of(stated.camera), catalogue, mare
    )


def _prediction(
    ground: Ground, connection: Connection, entry: WindowEntry, commitments: Sequence[Commitment]
) -> Candidate | None:
    """What the window would be like, where a reference ephemeris covers it."""
    mission = missions.mission_in_force(connection, entry.spacecraft_id)
    rows = (
        [repository.get(connection, repository.EPHEMERIDES, entry.ephemeris_id, "ephemeris")]
        if entry.ephemeris_id is not None
        else repository.covering_ephemerides(connection, entry.start_utc_ns, entry.stop_utc_ns)
    )
    for row in rows:
        if row["start_utc_ns"] <= entry.start_utc_ns and entry.stop_utc_ns <= row["stop_utc_ns"]:
            planner = _planner(ground, row, mission, entry.resources)
            try:
                return planner.predict(
                    entry.start_utc_ns,
                    entry.stop_utc_ns,
                    entry.cadence_s,
                    since_utc_ns=max(row["start_utc_ns"], entry.start_utc_ns - BATTERY_HISTORY_S * NS),
                    until_utc_ns=row["stop_utc_ns"],
                    commitments=commitments,
                )
            except EphemerisCoverageError:
                continue
    return None


def _span_conflicts(
    connection: Connection, vehicle: int, window_id: int, entry: WindowEntry
) -> list[PlanConflict]:
    table = repository.WINDOWS
    rows = connection.execute(
        select(table.c.id, table.c.start_utc_ns, table.c.stop_utc_ns, table.c.state).where(
            table.c.vehicle_id == vehicle,
            or_(
                table.c.state.in_(COMMITTED)
                & (table.c.start_utc_ns < entry.stop_utc_ns)
                & (table.c.stop_utc_ns > entry.start_utc_ns),
                table.c.id == entry.predecessor_id,
            ),
        )
    )
    spans = [PlannedSpan(*row) for row in rows]
    predecessor = next((span for span in spans if span.id == entry.predecessor_id), None)
    if entry.predecessor_id is not None and predecessor is None:
        raise NotFound("window", entry.predecessor_id)
    mine = PlannedSpan(window_id, entry.start_utc_ns, entry.stop_utc_ns, "draft")
    return span_conflicts(mine, predecessor, spans)


def _commitments(
    connection: Connection, spacecraft_id: int | None, instance: str, *, without: int = 0
) -> list[Commitment]:
    """Windows of a spacecraft whose data are or will be on board."""
    if spacecraft_id is None:
        return []
    table, vehicles = repository.WINDOWS, repository.VEHICLES
    rows = connection.execute(
        select(table.c.start_utc_ns, table.c.stop_utc_ns, table.c.data_octets)
        .join(vehicles, vehicles.c.id == table.c.vehicle_id)
        .where(
            vehicles.c.ccsds_id == spacecraft_id,
            vehicles.c.instance == instance,
            table.c.id != without,
            table.c.state.in_([state for state in COMMITTED if state != "downlinked"]),
        )
    )
    return [Commitment(*row) for row in rows]


def _ephemeris_for(
    connection: Connection, ephemeris_id: int | None, start: int | None, stop: int | None
) -> repository.Row:
    if ephemeris_id is not None:
        return repository.get(connection, repository.EPHEMERIDES, ephemeris_id, "ephemeris")
    first = start if start is not None else -(2**62)
    last = stop if stop is not None else 2**62
    rows = repository.covering_ephemerides(connection, first, last)
    if not rows:
        raise NotFound("ephemeris", "over the span of the search")

    def covered(row: repository.Row) -> int:
        return int(min(row["stop_utc_ns"], last) - max(row["start_utc_ns"], first))

    return max(rows, key=lambda row: (row["precedence"], covered(row), row["id"]))


def _check_span(start: int, stop: int, step_s: float, row: Mapping[str, Any]) -> None:
    if stop <= start:
        raise InvalidInput("search", "stop", "a time after the start", "one before it")
    if stop - start > SEARCH_LIMIT_S * NS or (stop - start) / (step_s * NS) > STEPS_LIMIT:
        raise InvalidInput(
            "search",
            "stop",
            f"at most {SEARCH_LIMIT_S // 86_400} days and {STEPS_LIMIT} steps",
            f"{(stop - start) / NS:.0f} s in steps of {step_s} s",
        )
    if start < row["start_utc_ns"] or stop > row["stop_utc_ns"]:
        raise InvalidInput(
            "search", "start, stop", f"a span that ephemeris {row['id']} ({row['name']}) covers", "another"
        )


def _check_entry(entry: WindowEntry) -> None:
    require_line(entry.name, "window", "name")
    duration = (entry.stop_utc_ns - entry.start_utc_ns) / NS
    if duration <= 0:
        raise InvalidInput("window", "stop", "a time after the start", "one before it")
    if duration > 86_400:
        raise InvalidInput("window", "stop", "at most a day after the start", f"{duration:.0f} s")


def _load(ground: Ground, row: Mapping[str, Any]) -> Ephemeris:
    return _loaded(str(ground.files.path(row["file_sha256"])))


@functools.lru_cache(maxsize=4)
def _loaded(path: str) -> Ephemeris:
    from pathlib import Path

    return load_ephemeris(Path(path))


def _catalogue(ground: Ground, sha256: str | None) -> CraterCatalogue | None:
    if sha256 is not None:
        return load_catalogue(ground.files.path(sha256))
    return _public_catalogue(ground.data)


@functools.lru_cache(maxsize=2)
def _public_catalogue(data: DataFolder) -> CraterCatalogue | None:
    path = data.catalogue_composite or data.catalogue_lu
    return load_catalogue(path) if path is not None else None


@functools.lru_cache(maxsize=2)
def _mare(data: DataFolder) -> Any:
    """Whether the ground is mare: darker than the value that best parts the albedo map in two (Otsu 1979)."""
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


def _joined(connection: Connection, row: repository.Row) -> repository.Row:
    vehicle = repository.get(connection, repository.VEHICLES, row["vehicle_id"], "vehicle")
    table = repository.TELECOMMANDS
    commands = connection.execute(
        select(table.c.id).where(table.c.window_id == row["id"]).order_by(table.c.id)
    ).scalars()
    return {
        **row,
        "spacecraft_id": vehicle["ccsds_id"],
        "instance": vehicle["instance"],
        "telecommands": [int(key) for key in commands],
    }


def _command_states(connection: Connection, window_id: int) -> set[str]:
    table = repository.TELECOMMANDS
    return set(connection.execute(select(table.c.state).where(table.c.window_id == window_id)).scalars())


def _withdraw(connection: Connection, window_id: int, actor: str) -> None:
    """Reject the telecommands of a window that were not sent."""
    move_all(
        connection,
        TELECOMMAND,
        [TELECOMMAND.table.c.window_id == window_id],
        "rejected",
        decided_by=actor,
        decided_utc_ns=utc_now_ns(),
        reason="the window was withdrawn",
    )


def _locked_window(connection: Connection, window_id: int) -> repository.Row:
    """Lock the plan of the spacecraft of a window until the transaction ends, and return the window."""
    row = repository.get(connection, repository.WINDOWS, window_id, "window")
    lock_spacecraft(connection, row["vehicle_id"])
    return window_row(connection, window_id)


def _note(
    connection: Connection, actor: str, action: str, window_id: int, state: str, detail: dict[str, Any]
) -> None:
    audit(connection, actor, f"{action} window", str(window_id), detail)
    publish(connection, WindowChanged(id=window_id, state=state))
