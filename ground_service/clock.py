"""Clocks of the service: the wall clock, and the mission time, which a simulated mission sets.

The wall clock counts for leases, time-outs, tokens and the audit log. The mission time counts for everything that
depends on the time at the spacecraft: contacts, plans and windows. A mission description can state its clock;
otherwise it is the wall clock.
"""

import mmap
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

_INSTANT = struct.Struct("<q")


def utc_now_ns() -> int:
    """Nanoseconds since 1970-01-01T00:00:00 UTC."""
    return time.time_ns()


@dataclass(frozen=True, slots=True)
class TelemetryTime:
    """Mission time that stands at the newest telemetry, which cannot be compared with it.

    `recorded`: that of archives alone. What arrives later is compared with the wall clock.
    """

    utc_ns: int
    recorded: bool = False

    def __call__(self) -> int:
        """Return the time."""
        return self.utc_ns


@dataclass(slots=True)
class _Source:
    read: Callable[[], int] | None = None
    stated: Callable[[], int] | None = None


_mission = _Source()


def mission_now_ns() -> int:
    """Mission time: nanoseconds since 1970-01-01T00:00:00 UTC.

    That of a simulation, otherwise the clock that the mission descriptions in force state, otherwise the wall clock.
    """
    return (_mission.read or _mission.stated or utc_now_ns)()


def independent_now_ns() -> int | None:
    """Return the mission time if another clock than telemetry states it."""
    now, source = mission_now_ns(), _mission.read or _mission.stated
    if isinstance(source, TelemetryTime):
        return utc_now_ns() if source.recorded else None
    return now


def is_stated() -> bool:
    """Return whether a mission description or a simulation states the mission time, which is else the wall clock."""
    return (_mission.read or _mission.stated) is not None


def is_recorded() -> bool:
    """Return whether the mission time is that of recorded passes, of which nothing flies."""
    mission_now_ns()  # a clock that is read when it is first needed
    source = _mission.read or _mission.stated
    return isinstance(source, TelemetryTime) and source.recorded


def set_mission_clock(read: Callable[[], int] | None = None) -> None:
    """Take the mission time of this process from a function, whatever is stated; None: no longer."""
    _mission.read = read


def follow_missions(stated: Callable[[], int] | None) -> None:
    """Take the mission time of this process from a clock that mission descriptions state; None: none."""
    _mission.stated = stated


@dataclass(slots=True, eq=False)
class ClockFile:
    """Mission time in a file of eight octets (int64 nanoseconds, little-endian), shared between processes.

    The wall clock is read until the file exists and holds a time.
    """

    path: Path
    _map: mmap.mmap | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def read(self) -> int:
        """Return the time in the file."""
        if self._map is None:
            self._open()
        if self._map is None:
            return utc_now_ns()
        return int(_INSTANT.unpack_from(self._map)[0]) or utc_now_ns()

    def _open(self) -> None:
        with self._lock:
            try:
                with self.path.open("rb") as file:
                    self._map = mmap.mmap(file.fileno(), _INSTANT.size, access=mmap.ACCESS_READ)
            except (OSError, ValueError):  # not written yet
                self._map = None
