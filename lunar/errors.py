"""Errors of ``lunar``, each with a message of one line.

LunarError
├── DataFileError            a file is missing, truncated or has an invalid value
├── TimeFormatError          a text that is not a UTC epoch
│   └── LeapSecondError      a UTC epoch within a leap second, where a count of 86,400 s days has none
├── UnknownTimeSystemError   a time scale that cannot be converted
├── UnknownFrameError        a reference frame or centre that cannot be converted
├── EphemerisError           states that form no ephemeris, or that a file format cannot hold
│   └── UnmovedByGravity     states that the gravity of the Moon does not move
├── EphemerisCoverageError   an epoch outside the span of an ephemeris or orientation, or inside a gap of it
├── MissingLibrary           an optional library is not installed
├── LensError                a distortion under which some pixels have no unique ray
└── OrbitError               elements or states that are not an orbit about the Moon
    └── ImpactError          the orbit intersects the ground, with epoch and place
"""

import math
from collections.abc import Iterable
from pathlib import Path


class LunarError(Exception):
    """Base of all errors raised by ``lunar``."""


class DataFileError(LunarError):
    """A data file that cannot be used: which file, where in it, what was expected and found."""

    def __init__(self, path: Path | str, where: str, expected: str, found: str) -> None:
        self.path = path
        self.where = where
        self.expected = expected
        self.found = found
        place = f"{path}: {where}" if where else str(path)
        super().__init__(f"{place}: expected {expected}, found {found}")


class MissingLibrary(LunarError):
    """A library that is an optional dependency is not installed."""

    def __init__(self, what: str, library: str, extra: str) -> None:
        self.library = library
        self.extra = extra
        super().__init__(f"{what}: expected the library {library}, found none; install {extra}")


class LensError(LunarError):
    """A lens distortion under which some pixels of the image have no ray, or several."""


class TimeFormatError(LunarError):
    """A text that is not a UTC epoch."""

    expected = "a UTC epoch like 2029-08-07T00:00:00.000Z"

    def __init__(self, text: str) -> None:
        self.text = text
        super().__init__(f"expected {self.expected}, found {text!r}")


class LeapSecondError(TimeFormatError):
    """A UTC epoch within a leap second; ``next_utc_ns`` is the epoch one second later."""

    expected = "a UTC epoch outside of a leap second, which counts of 86,400 s days leave out"

    def __init__(self, text: str, next_utc_ns: int) -> None:
        self.next_utc_ns = next_utc_ns
        super().__init__(text)


class UnknownTimeSystemError(LunarError):
    """A time scale that cannot be converted."""

    def __init__(self, name: str, known: Iterable[str], where: str = "") -> None:
        self.name = name
        prefix = f"{where}: " if where else ""
        super().__init__(f"{prefix}expected a time system out of {', '.join(known)}, found {name!r}")


class UnknownFrameError(LunarError):
    """A reference frame or centre that cannot be converted."""

    def __init__(self, name: str, known: Iterable[str], where: str = "") -> None:
        self.name = name
        prefix = f"{where}: " if where else ""
        super().__init__(f"{prefix}expected a reference frame out of {', '.join(known)}, found {name!r}")


class EphemerisError(LunarError):
    """States that form no ephemeris, or that a file format cannot hold."""


class UnmovedByGravity(EphemerisError):
    """States that do not move as the gravity of the Moon moves them: radius in m, accelerations in m/s2."""

    def __init__(self, name: str, radius_m: float, expected_m_s2: float, found_m_s2: float, off: float) -> None:
        self.where = f"states of {name}"
        self.expected = (
            f"an acceleration of {expected_m_s2:.4g} m/s2 by gravity {radius_m / 1e3:.6g} km "
            "from the centre of the Moon"
        )
        self.found = (
            f"{found_m_s2:.4g} m/s2, {100.0 * off:.3g} % off; "
            "rotating axes, other units (metres for kilometres) or another centre?"
        )
        super().__init__(f"{self.where}: expected {self.expected}, found {self.found}")


class EphemerisCoverageError(LunarError):
    """An epoch at which nothing is known: outside the covered span, or in a gap between segments."""

    def __init__(self, requested: str, covered: str, what: str = "ephemeris") -> None:
        self.requested = requested
        self.covered = covered
        super().__init__(f"{what}: expected an epoch within {covered}, found {requested}; nothing is extrapolated")


class OrbitError(LunarError):
    """Elements or states that are no orbit about the Moon."""


class ImpactError(OrbitError):
    """The orbit meets the ground; angles are mean-Earth latitude and east longitude of the place."""

    def __init__(self, utc_ns: int, epoch: str, latitude_rad: float, longitude_rad: float) -> None:
        self.utc_ns = utc_ns
        self.latitude_rad = latitude_rad
        self.longitude_rad = longitude_rad
        super().__init__(
            f"the orbit hits the Moon at {epoch}, "
            f"latitude {math.degrees(latitude_rad):.3f} deg, "
            f"longitude {math.degrees(longitude_rad) % 360.0:.3f} deg E"
        )
