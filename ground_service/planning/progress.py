"""Windows brought up to date with what came down: called after every ingest, uplink and report.

The state is worked out afresh from the archive each time (`processing.window_states`), so telemetry may come in any
order. A window that has telemetry is given a pass, which its report is then made of.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, func, select

from ground_service.clock import utc_now_ns
from ground_service.commanding.command_state import command_view
from ground_service.events import WindowChanged, publish
from ground_service.ground import Ground
from ground_service.ingest.core import account_sequence
from ground_service.ingest.redecode import readable_version
from ground_service.missions import store as missions
from ground_service.planning.window_states import WindowFacts, state_of
from ground_service.store import repository, telemetry
from ground_service.store.counters import lock_spacecraft
from ground_service.store.states import change_if
from ground_service.timekeeping.core import TimeCorrelation, ticks_of_utc_ns
from ground_service.timekeeping.store import load_correlations
from lunar.constants import NANOSECONDS_PER_SECOND
from tmtc.codes import EVENTS

MARGIN_NS = 60 * NANOSECONDS_PER_SECOND
"""Reports of the start and the stop may be this far from the planned times."""

_EVENT_CODES = {name: code for code, name in EVENTS}
STARTED, STOPPED = _EVENT_CODES["observation_started"], _EVENT_CODES["observation_stopped"]
HEARD_TICKS = 7 * 86_400 << 16
_REPORTS = ("housekeeping", "events", "verifications")
_SCIENCE = ("detections", "navigation_states", "frame_outcomes")


def advance_windows(ground: Ground, vehicle: int) -> int:
    """Bring the approved windows of a vehicle up to date; how many changed their state."""
    table = repository.WINDOWS
    with ground.database.reading() as connection:
        pending = connection.execute(
            select(func.count()).select_from(table).where(*_open(vehicle))
        ).scalar_one()
    if not pending:
        return 0
    changed: list[tuple[int, str]] = []
    with ground.database.writing() as connection:
        lock_spacecraft(connection, vehicle)
        correlations = load_correlations(connection, vehicle)
        rows = connection.execute(
            select(table).where(*_open(vehicle)).order_by(table.c.start_utc_ns)
        ).mappings()
        for row in [dict(row) for row in rows]:
            state = _advance(connection, row, correlations)
            if state is not None:
                changed.append((row["id"], state))
        for window_id, state in changed:
            publish(connection, WindowChanged(id=window_id, state=state))
    return len(changed)


def _advance(
    connection: Connection, row: Mapping[str, Any], correlations: tuple[TimeCorrelation, ...]
) -> str | None:
    """Return the new state of a window; None if it has not changed, or the window was decided meanwhile."""
    facts = _facts(connection, row, correlations)
    state, reason = state_of(facts)
    values: dict[str, Any] = {}
    if facts.frames > 0 and row["pass_id"] is None:
        mission_id = row["mission_id"] or missions.in_force(connection, row["vehicle_id"])
        values |= {"pass_id": _pass_of(connection, row, mission_id), "mission_id": mission_id}
    if state != row["state"]:
        values |= {"state": state, "reason": reason, "changed_utc_ns": utc_now_ns()}
    found = {"version": row["version"], "state": row["state"], "pass_id": row["pass_id"]}
    if values and not change_if(connection, repository.WINDOWS, row["id"], found, **values):
        return None
    return None if state == row["state"] else state


def _facts(
    connection: Connection, row: Mapping[str, Any], correlations: tuple[TimeCorrelation, ...]
) -> WindowFacts:
    vehicle = row["vehicle_id"]
    start = ticks_of_utc_ns(row["start_utc_ns"] - MARGIN_NS, correlations)
    stop = ticks_of_utc_ns(row["stop_utc_ns"] + MARGIN_NS, correlations)
    events = telemetry.samples(
        connection, "events", vehicle, start, stop, readable_version(connection, vehicle), ("event_id",)
    )["event_id"]
    commands = [
        command_view(connection, dict(command))
        for command in connection.execute(
            select(repository.TELECOMMANDS).where(
                repository.TELECOMMANDS.c.window_id == row["id"],
                repository.TELECOMMANDS.c.state != "rejected",
            )
        ).mappings()
    ]
    frames = _frames(connection, vehicle, start, stop)
    headers = telemetry.packet_headers(connection, vehicle, start, stop) if frames else None
    reported = row["pass_id"] is not None and (
        repository.find(connection, repository.REPORTS, pass_id=row["pass_id"]) is not None
    )
    predecessor = (
        repository.get(connection, repository.WINDOWS, row["predecessor_id"], "window")
        if row["predecessor_id"] is not None
        else None
    )
    return WindowFacts(
        decision=row["decision"],
        predecessor_failed=predecessor is not None and predecessor["state"] == "failed",
        command_states=tuple(view.state for view in commands),
        frames=frames,
        started=STARTED in events,
        stopped=STOPPED in events,
        heard_after=_heard(connection, vehicle, stop),
        lost=None
        if headers is None
        else sum(
            account_sequence(headers["ticks"][here], headers["sequence_count"][here]).lost
            for here in (headers["apid"] == apid for apid in set(headers["apid"].tolist()))
        ),
        reported=reported,
    )


def _frames(connection: Connection, vehicle: int, start: int, stop: int) -> int:
    """Images of the span that anything came down about."""
    most = 0
    for kind in _SCIENCE:
        table = repository.SAMPLES[kind]
        most = max(
            most,
            connection.execute(
                select(func.count(func.distinct(table.c.ticks))).where(
                    table.c.vehicle_id == vehicle,
                    table.c.dictionary_version == readable_version(connection, vehicle),
                    table.c.ticks.between(start, stop),
                )
            ).scalar_one(),
        )
    return most


def _heard(connection: Connection, vehicle: int, after_ticks: int) -> bool:
    """Whether reports made in the days after an on-board time have come down (a wild clock does not count)."""
    for kind in _REPORTS:
        table = repository.SAMPLES[kind]
        found = connection.execute(
            select(table.c.ticks)
            .where(
                table.c.vehicle_id == vehicle,
                table.c.dictionary_version == readable_version(connection, vehicle),
                table.c.ticks > after_ticks,
                table.c.ticks <= after_ticks + HEARD_TICKS,
            )
            .limit(1)
        ).first()
        if found is not None:
            return True
    return False


def _open(vehicle: int) -> tuple[Any, ...]:
    """Which windows can still come further."""
    table = repository.WINDOWS
    return (
        table.c.vehicle_id == vehicle,
        table.c.decision == "approved",
        table.c.state != "processed",
    )


def _pass_of(connection: Connection, row: Mapping[str, Any], mission_id: int | None) -> int:
    """A pass over the span of the window."""
    return int(
        repository.add(
            connection,
            repository.PASSES,
            vehicle_id=row["vehicle_id"],
            name=row["name"],
            start_utc_ns=row["start_utc_ns"],
            stop_utc_ns=row["stop_utc_ns"],
            archive_digest=None,
            manifest={
                "window_id": row["id"],
                "cadence_s": row["cadence_s"],
                "frames_expected": row["predicted"].get("frames"),
            },
            ephemeris_id=row["ephemeris_id"],
            catalogue_sha256=None,
            attitude_sha256=None,
            mission_id=mission_id,
            created_utc_ns=utc_now_ns(),
        )
    )
