"""Mission time of a service, as the mission descriptions in force state it."""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from sqlalchemy import Connection

from ground_service.clock import TelemetryTime, follow_missions, utc_now_ns
from ground_service.errors import GroundError, NotFound
from ground_service.ground import Ground
from ground_service.missions import store
from ground_service.missions.timekeeping.core import utc_ns_of_ticks
from ground_service.missions.timekeeping.store import load_correlations
from ground_service.store.vehicles import FLOWN, all_vehicles, find_vehicle
from lunar.timescales import parse_utc

REFRESH_S = 5.0
"""Interval in which a process looks for another description in force, and for newer telemetry."""

log = logging.getLogger(__name__)


def stated_clock(connection: Connection) -> Callable[[], int] | None:
    """Return the mission clock of the descriptions in force; None for the wall clock, or if they state several.

    Without descriptions in force and telemetry of a flight, it stands at the newest telemetry of the archives.
    """
    missions = store.missions_in_force(connection)
    if not missions:
        return _recorded(connection)
    stated = {number: one.time.mission_clock for number, one in missions.items() if one.time.mission_clock}
    if len(set(stated.values())) > 1:
        log.warning("mission descriptions in force state several mission clocks: the wall clock is used")
    if len(set(stated.values())) != 1:
        return None
    clock = next(iter(stated.values()))
    if clock.source == "wall":
        return None
    if clock.source == "telemetry":
        known = [time for one in stated if (time := _newest_of_flight(connection, one)) is not None]
        return TelemetryTime(max(known)) if known else None
    mission, wall = parse_utc(clock.mission or ""), parse_utc(clock.wall or "")
    return lambda: mission + round((utc_now_ns() - wall) * clock.rate)


def _recorded(connection: Connection) -> TelemetryTime | None:
    vehicles = all_vehicles(connection)
    newest = {one.id: _newest_telemetry(connection, one.id) for one in vehicles}
    if any(one.instance == FLOWN and newest[one.id] is not None for one in vehicles):
        return None
    known = [time for time in newest.values() if time is not None]
    return TelemetryTime(max(known), recorded=True) if known else None


def _newest_of_flight(connection: Connection, spacecraft_id: int) -> int | None:
    try:
        return _newest_telemetry(connection, find_vehicle(connection, spacecraft_id, FLOWN).id)
    except NotFound:
        return None


def _newest_telemetry(connection: Connection, vehicle: int) -> int | None:
    ticks = store.newest_ticks(connection, vehicle)
    if ticks is None:
        return None
    utc_ns, _ = utc_ns_of_ticks(np.array([ticks]), load_correlations(connection, vehicle))
    return int(utc_ns[0])


def read_mission_clock(ground: Ground) -> None:
    """Take the mission time of this process from the descriptions in force, as they are now."""
    follow_missions(ground.read(stated_clock))


@contextmanager
def mission_clock(ground: Ground) -> Iterator[None]:
    """Take the mission time of this process from the descriptions in force until the end of the block."""
    stopping = threading.Event()

    def follow() -> None:
        while not stopping.wait(REFRESH_S):
            try:
                read_mission_clock(ground)
            except GroundError as error:
                log.warning("the mission clock cannot be read: %s", error)

    read_mission_clock(ground)
    thread = threading.Thread(target=follow, name="mission clock", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join()
        follow_missions(None)
