"""State vector tables of JPL Horizons in CSV form, Moon-centred.

References
----------
Horizons manual, vector tables: output types 2 and 3 with CSV_FORMAT = YES; the header states centre, frame and units,
the table lies between `$$SOE` and `$$EOE`.  Times are TDB.
"""

import re
from datetime import datetime

import numpy as np

from lunar.constants import NS
from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.errors import DataFileError, UnknownFrameError
from lunar.timescales import format_tai, to_tai_ns, utc_ns_from_tai_ns

UNITS_M = {"KM-S": (1e3, 1e3), "M-S": (1.0, 1.0), "KM-D": (1e3, 1e3 / 86_400.0)}
"""Metres and metres per second in units of the table, by its name for them."""

_CENTRE = re.compile(r"Center body name:\s*(.*?)\s*\((-?\d+)\)")
_TARGET = re.compile(r"Target body name:\s*(.*?)\s*(?:\{|$)")
_DATE = re.compile(r"A\.D\. (\d{4}-[A-Z][a-z]{2}-\d{2} \d{2}:\d{2}:\d{2})(?:\.(\d{1,9}))?\Z")
_COLUMNS = ("X", "Y", "Z", "VX", "VY", "VZ")
_MOON = "301"


def is_horizons(text: str) -> bool:
    """Return whether a text looks like an answer of Horizons."""
    return "$$SOE" in text


def parse_horizons(text: str, source: str = "Horizons table") -> Ephemeris:
    """Return the ephemeris in a Horizons vector table; ``source`` names it in errors.

    Raises
    ------
    DataFileError
        Where the table is cut short or says something that cannot be, with its line.
    UnknownFrameError
        Where the axes are not those of ICRF.
    """
    lines = text.splitlines()
    marks = [k for k, line in enumerate(lines) if line.strip() in ("$$SOE", "$$EOE")]
    if len(marks) != 2 or lines[marks[0]].strip() != "$$SOE":
        raise DataFileError(source, "", "a table between $$SOE and $$EOE", f"{len(marks)} of the marks")
    first, last = marks
    name, scale = _header(lines[:first], source)
    where = _columns(lines[:first], source)
    epochs: list[int] = []
    states: list[list[float]] = []
    for number, line in enumerate(lines[first + 1 : last], start=first + 2):
        fields = [field.strip() for field in line.split(",")]
        try:
            states.append([float(fields[k]) for k in where[1:]])
            epochs.append(_epoch_ns(fields[where[0]]))
        except (ValueError, IndexError, OverflowError):
            expected = "a date like A.D. 2029-Aug-07 00:00:00.0000 and six numbers"
            raise DataFileError(source, f"line {number}", expected, repr(line[:60])) from None
        if not np.all(np.isfinite(states[-1])):
            raise DataFileError(source, f"line {number}", "finite numbers", repr(line[:60]))
        if len(epochs) > 1 and epochs[-1] <= epochs[-2]:
            expected = f"an epoch after {format_tai(epochs[-2])}"
            raise DataFileError(source, f"line {number}", expected, format_tai(epochs[-1]))
    if not states:
        raise DataFileError(source, f"line {first + 1}", "at least one state", "none")
    values = np.array(states)
    tai_ns = np.array(epochs, dtype=np.int64)
    segment = EphemerisSegment(
        utc_ns_from_tai_ns(tai_ns),
        scale[0] * values[:, :3],
        scale[1] * values[:, 3:],
        object_name=name,
        object_id=name,
        tai_ns=tai_ns,
    )
    return Ephemeris((segment,), "JPL Horizons")


def _header(lines: list[str], source: str) -> tuple[str, tuple[float, float]]:
    """Return the name of the target, and metres and metres per second in units of the table."""
    stated: dict[str, tuple[int, str]] = {}
    for number, line in enumerate(lines, start=1):
        key, colon, value = line.partition(":")
        if colon:
            stated.setdefault(key.strip().lower(), (number, value.strip()))
    text = "\n".join(lines)
    centre = _CENTRE.search(text)
    if centre is None or centre[2] != _MOON:
        found = "none" if centre is None else f"{centre[1]} ({centre[2]})"
        raise DataFileError(source, "Center body name", "Moon (301)", found)
    number, units = stated.get("output units", (1, "none"))
    if units.partition(",")[0] not in UNITS_M:
        raise DataFileError(source, f"line {number}", f"Output units of {', '.join(UNITS_M)}", repr(units))
    number, frame = stated.get("reference frame", (1, "none"))
    if not frame.upper().startswith("ICRF"):
        raise UnknownFrameError(frame, ("ICRF",), f"{source}: line {number}")
    for key, expected in (("output type", "GEOMETRIC"), ("center-site name", "BODY CENTER")):
        number, found = stated.get(key, (1, expected))
        if not found.upper().startswith(expected):
            raise DataFileError(source, f"line {number}", f"{key.capitalize()} {expected}", repr(found))
    target = _TARGET.search(next((line for line in lines if "Target body name" in line), ""))
    name = re.sub(r"\s*\([^)]*\)", "", target[1]).strip() if target else ""
    return name or "HORIZONS TARGET", UNITS_M[units.partition(",")[0]]


def _columns(lines: list[str], source: str) -> list[int]:
    """Return the places of the calendar date and of the six numbers of a state."""
    for line in reversed(lines):
        names = [name.strip() for name in line.split(",")]
        if "Calendar Date (TDB)" in names:
            missing = [name for name in _COLUMNS if name not in names]
            if missing:
                raise DataFileError(source, "columns", f"a column {missing[0]}", "none")
            return [names.index("Calendar Date (TDB)"), *(names.index(name) for name in _COLUMNS)]
    expected = "columns with Calendar Date (TDB), of a vector table with CSV_FORMAT=YES"
    raise DataFileError(source, "columns", expected, "none")


def _epoch_ns(text: str) -> int:
    match = _DATE.match(text)
    if match is None:
        raise ValueError(text)
    whole = datetime.strptime(match[1] + " +0000", "%Y-%b-%d %H:%M:%S %z").timestamp()
    count = int(whole) * NS + int(((match[2] or "") + "000000000")[:9])
    return int(to_tai_ns(count, "TDB"))
