"""STK ephemeris files (``.e``), both ways; trajectories as CSV and TUM.

Read are the formats EphemerisTimePosVel and EphemerisTimePosVelAcc (accelerations are not used) about the
Moon in ICRF or J2000 axes, times in seconds since ScenarioEpoch (UTC).  An epoch that occurs twice in a row,
or is listed under SegmentBoundaryTimes, ends a segment.  States come out in ICRF axes, m and m/s.

References
----------
Ansys STK help, "Ephemeris File Format (*.e)".
"""

import re
from itertools import pairwise

import numpy as np

from lunar import frames
from lunar.arrays import FloatArray, IntArray
from lunar.constants import NS
from lunar.ephemeris import Ephemeris, EphemerisSegment, parse_numbers, resampled
from lunar.errors import DataFileError, EphemerisError, TimeFormatError, UnknownFrameError, UnknownTimeSystemError
from lunar.timescales import format_tai, in_leap_second, parse_tai, tdb_s_from_tai_ns, utc_ns_from_tai_ns
from lunar.visibility import subsatellite

_STATE_WIDTH = {"EPHEMERISTIMEPOSVEL": 7, "EPHEMERISTIMEPOSVELACC": 10}
_UNITS_M = {"METERS": 1.0, "KILOMETERS": 1000.0, "METER": 1.0, "KILOMETER": 1000.0}
_ROUNDED_NS = 1_000_000
"""Times of boundaries may be rounded to this; states are further apart."""
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
_EPOCH = re.compile(r"(\d{1,2})\s+([A-Za-z]{3})[a-z]*\s+(\d{4})\s+(\d{1,2}:\d{2}:\d{2}(?:\.\d*)?)\Z", re.ASCII)
_IGNORED = (
    "NUMBEROFEPHEMERISPOINTS",
    "SCENARIOEPOCH",
    "INTERPOLATIONMETHOD",
    "INTERPOLATIONSAMPLESM1",
    "INTERPOLATIONORDER",
    "DISTANCEUNIT",
    "CENTRALBODY",
    "COORDINATESYSTEM",
    "COORDINATESYSTEMEPOCH",
    "TIMEFORMAT",
    "BLOCKINGFACTOR",
    "MESSAGELEVEL",
    "STKVERSION",
)


def parse_stk(text: str, source: str = "STK text") -> Ephemeris:
    """Return the ephemeris in the text of an STK file; ``source`` names it in errors.

    Raises
    ------
    DataFileError
        Where the text is cut short or says something that cannot be, with its line.
    UnknownFrameError, UnknownTimeSystemError
        Where axes, central body or time format are none that can be converted.
    """
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    comments = tuple(line[1:].strip() for _, line in lines if line.startswith("#"))
    lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
    if not lines or not lines[0][1].lower().startswith("stk.v."):
        raise DataFileError(source, "line 1", "stk.v.<version>", repr(lines[0][1][:40]) if lines else "nothing")
    if len(lines) < 2 or lines[1][1].upper() != "BEGIN EPHEMERIS":
        found = repr(lines[1][1][:40]) if len(lines) > 1 else "the end of the file"
        raise DataFileError(source, f"line {lines[min(1, len(lines) - 1)][0]}", "BEGIN Ephemeris", found)
    header: dict[str, tuple[str, int]] = {}
    boundary_s: list[float] = []
    at, width = 2, 0
    while width == 0:
        if at >= len(lines):
            raise DataFileError(source, f"line {lines[-1][0]}", "EphemerisTimePosVel", "the end of the file")
        number, line = lines[at]
        key, _, value = line.partition(" ")
        key = key.upper()
        at += 1
        if key in _STATE_WIDTH:
            width = _STATE_WIDTH[key]
        elif line.upper() == "BEGIN SEGMENTBOUNDARYTIMES":
            while at < len(lines) and lines[at][1].upper() != "END SEGMENTBOUNDARYTIMES":
                boundary_s += [_number(source, *lines[at])]
                at += 1
            at += 1
        elif key in _IGNORED:
            header[key] = value.strip(), number
        else:
            known = "EphemerisTimePosVel, EphemerisTimePosVelAcc or a known keyword"
            raise DataFileError(source, f"line {number}", known, repr(line[:60]))
    epoch_tai_ns = _scenario_epoch(source, header)
    scale_m, turn = _units_and_axes(source, header)
    rows, first_line, at = _rows(source, lines, at, width)
    if not any(line.upper() == "END EPHEMERIS" for _, line in lines[at:]):
        raise DataFileError(source, f"line {lines[-1][0]}", "END Ephemeris", "the end of the file: it is cut short")
    if "NUMBEROFEPHEMERISPOINTS" in header:
        value, number = header["NUMBEROFEPHEMERISPOINTS"]
        if value != str(len(rows)):
            raise DataFileError(source, f"line {number}", f"NumberOfEphemerisPoints {len(rows)}", value)
    tai_ns = _epochs(epoch_tai_ns, rows[:, 0])
    position_m, velocity_m_s = scale_m * rows[:, 1:4] @ turn.T, scale_m * rows[:, 4:7] @ turn.T
    method, degree = _interpolation(source, header)
    segments = []
    for part in _parts(source, tai_ns, _epochs(epoch_tai_ns, np.array(boundary_s)), lines, first_line):
        segments.append(
            EphemerisSegment(
                utc_ns_from_tai_ns(tai_ns[part]),
                position_m[part],
                velocity_m_s[part],
                interpolation=method,
                degree=degree,
                tai_ns=tai_ns[part],
            )
        )
    return Ephemeris(tuple(segments), "STK", comments)


def format_stk(ephemeris: Ephemeris) -> str:
    """Return STK ``.e`` text in ICRF axes, m and m/s, times in seconds since the first epoch.

    Segments follow each other with the shared epoch twice and listed under SegmentBoundaryTimes.

    Raises
    ------
    EphemerisError
        Where there is a gap between segments, which the format cannot hold.
    """
    segments = resampled(ephemeris).segments
    for earlier, later in pairwise(segments):
        if later.tai_ns[0] != earlier.tai_ns[-1]:
            raise EphemerisError("an STK .e file: expected segments that follow each other, found a gap between two")
    start_tai_ns = int(segments[0].tai_ns[0])
    method = segments[0].interpolation.capitalize() if segments[0].interpolation != "LINEAR" else "Lagrange"
    samples = segments[0].degree // 2 if method == "Hermite" else segments[0].degree
    lines = [
        "stk.v.12.0",
        *(f"# {comment}".rstrip() for comment in ephemeris.comments),
        "BEGIN Ephemeris",
        f"NumberOfEphemerisPoints {sum(len(s.utc_ns) for s in segments)}",
        f"ScenarioEpoch {_format_epoch(start_tai_ns)}",
        f"InterpolationMethod {method}",
        f"InterpolationSamplesM1 {max(samples, 1)}",
        "CentralBody Moon",
        "CoordinateSystem ICRF",
        "DistanceUnit Meters",
    ]
    if len(segments) > 1:
        lines.append("BEGIN SegmentBoundaryTimes")
        lines += [_seconds(int(s.tai_ns[-1]) - start_tai_ns) for s in segments[:-1]]
        lines.append("END SegmentBoundaryTimes")
    lines.append("EphemerisTimePosVel")
    for segment in segments:
        elapsed = (segment.tai_ns - start_tai_ns).tolist()
        states = np.concatenate([segment.position_m, segment.velocity_m_s], axis=1).tolist()
        row = "%s %.6f %.6f %.6f %.9f %.9f %.9f"
        lines += [row % (_seconds(t), *state) for t, state in zip(elapsed, states, strict=True)]
    return "\n".join([*lines, "END Ephemeris", ""])


def _rows(source: str, lines: list[tuple[int, str]], at: int, width: int) -> tuple[FloatArray, int, int]:
    """Return numbers (n, width), the index of the first line and that of the line after the last."""
    first = at
    while at < len(lines) and lines[at][1][0] in "+-.0123456789":
        at += 1
    if at == first:
        raise DataFileError(source, f"line {lines[first - 1][0]}", "states after this line", "none")
    rows = parse_numbers([line for _, line in lines[first:at]], width)
    if rows is None:
        for number, line in lines[first:at]:
            if len(line.split()) != width:
                found = f"{len(line.split())} values"
                raise DataFileError(source, f"line {number}", f"a time and {width - 1} numbers", found)
            for token in line.split():
                _number(source, number, token)
        raise DataFileError(source, f"line {lines[first][0]}", "states of numbers", "others")
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if bad.size:
        raise DataFileError(source, f"line {lines[first + int(bad[0])][0]}", "finite numbers", "NaN or infinity")
    return rows, first, at


def _number(source: str, number: int, token: str) -> float:
    try:
        return float(token)
    except ValueError:
        raise DataFileError(source, f"line {number}", "a number", repr(token[:40])) from None


def _scenario_epoch(source: str, header: dict[str, tuple[str, int]]) -> int:
    value, number = header.get("TIMEFORMAT", ("EpSec", 0))
    if value.upper() != "EPSEC":
        raise UnknownTimeSystemError(value, ("EpSec",), f"{source}: line {number}: TimeFormat")
    if "SCENARIOEPOCH" not in header:
        raise DataFileError(source, "header", "ScenarioEpoch", "none")
    value, number = header["SCENARIOEPOCH"]
    match = _EPOCH.match(value)
    month = match[2].capitalize() if match else ""
    if match is None or month not in _MONTHS:
        raise DataFileError(source, f"line {number}", "an epoch like 7 Aug 2029 00:00:00.000", repr(value))
    try:
        clock = match[4] if len(match[4].split(":")[0]) == 2 else "0" + match[4]
        return parse_tai(f"{match[3]}-{_MONTHS.index(month) + 1:02d}-{int(match[1]):02d}T{clock}")
    except TimeFormatError:
        raise DataFileError(source, f"line {number}", "an epoch that exists", repr(value)) from None


def _units_and_axes(source: str, header: dict[str, tuple[str, int]]) -> tuple[float, FloatArray]:
    unit, number = header.get("DISTANCEUNIT", ("Meters", 0))
    if unit.upper() not in _UNITS_M:
        raise DataFileError(source, f"line {number}", "DistanceUnit Meters or Kilometers", repr(unit))
    body, number = header.get("CENTRALBODY", ("Earth", 0))
    if body.upper() != "MOON":
        place = f"line {number}" if number else "header"
        raise DataFileError(source, place, "CentralBody Moon", repr(body) if number else "none, which means Earth")
    axes, number = header.get("COORDINATESYSTEM", ("Fixed", 0))
    if axes.upper() in frames.ICRF_NAMES:
        turn = np.eye(3)
    elif axes.upper() in frames.J2000_NAMES:
        turn = frames.icrf_from_j2000()
    else:
        place = f"{source}: line {number}" if number else f"{source}: CoordinateSystem"
        raise UnknownFrameError(axes, (*frames.ICRF_NAMES, *frames.J2000_NAMES), place)
    return _UNITS_M[unit.upper()], turn


def _interpolation(source: str, header: dict[str, tuple[str, int]]) -> tuple[str, int]:
    method, number = header.get("INTERPOLATIONMETHOD", ("Lagrange", 0))
    if method.upper() not in ("HERMITE", "LAGRANGE", "LAGRANGEVOP"):
        raise DataFileError(source, f"line {number}", "InterpolationMethod Hermite or Lagrange", repr(method))
    value, number = header.get("INTERPOLATIONSAMPLESM1", header.get("INTERPOLATIONORDER", ("5", 0)))
    if not value.isdigit() or not 1 <= int(value) <= 30:
        raise DataFileError(source, f"line {number}", "an interpolation order of 1 to 30", repr(value))
    if method.upper() == "HERMITE":
        return "HERMITE", 2 * int(value) + 1
    # Interpolation in orbital elements is not offered; states in Hermite form are at least as good on such
    # files.
    return ("HERMITE", 7) if method.upper() == "LAGRANGEVOP" else ("LAGRANGE", int(value))


def _epochs(epoch_tai_ns: int, elapsed_s: FloatArray) -> IntArray:
    whole = np.floor(elapsed_s)
    elapsed_ns = whole.astype(np.int64) * NS + np.rint((elapsed_s - whole) * NS).astype(np.int64)
    return np.asarray(epoch_tai_ns + elapsed_ns, dtype=np.int64)


def _parts(
    source: str, tai_ns: IntArray, boundary_tai_ns: IntArray, lines: list[tuple[int, str]], first: int
) -> list[slice]:
    """Return the slices of the smooth arcs."""
    steps = np.diff(tai_ns)
    if np.any(steps < 0):
        k = int(np.flatnonzero(steps < 0)[0]) + 1
        raise DataFileError(source, f"line {lines[first + k][0]}", "a time after the one before", "an earlier one")
    at = np.searchsorted(tai_ns, boundary_tai_ns - _ROUNDED_NS)
    shared = tai_ns[np.minimum(at, len(tai_ns) - 1)]
    unknown = (shared > boundary_tai_ns + _ROUNDED_NS) & (boundary_tai_ns > tai_ns[0])
    if unknown.any():
        found = format_tai(int(boundary_tai_ns[unknown][0]), 6)
        raise DataFileError(source, "SegmentBoundaryTimes", "times of states", f"{found}, at which there is none")
    starts = [0, *(np.flatnonzero(steps == 0) + 1).tolist(), len(tai_ns)]
    parts = []
    for begin, end in pairwise(starts):
        # A boundary inside an arc whose epoch occurs once: its state belongs to both sides.
        cuts = np.flatnonzero(np.isin(tai_ns[begin + 1 : end - 1], shared)) + begin + 1
        edges = [begin, *cuts.tolist(), end - 1]
        parts += [slice(a, b + 1) for a, b in pairwise(edges) if b > a or end - begin == 1]
    return parts


def _format_epoch(tai_ns: int) -> str:
    date, _, clock = format_tai(tai_ns, 9).rstrip("Z").partition("T")
    year, month, day = map(int, date.split("-"))
    return f"{day} {_MONTHS[month - 1]} {year} {clock}"


def _seconds(elapsed_ns: int) -> str:
    return f"{elapsed_ns // NS}.{elapsed_ns % NS:09d}"


CSV_COLUMNS = (
    *("utc", "x_km", "y_km", "z_km", "vx_km_s", "vy_km_s", "vz_km_s"),
    *("latitude_deg", "longitude_deg", "altitude_km"),
)


def format_csv(ephemeris: Ephemeris, orientation: frames.Orientation) -> str:
    """Return states (ICRF, Moon-centred) and sub-satellite points (mean-Earth, 0..360 E) as CSV text.

    An epoch that two arcs share has two lines.
    """
    tai_ns, position_m, velocity_m_s = _states(ephemeris)
    latitude, longitude, altitude_m = subsatellite(position_m, tdb_s_from_tai_ns(tai_ns), orientation)
    states = np.concatenate([position_m, velocity_m_s], axis=1) / 1e3
    places = np.stack([np.degrees(latitude), np.degrees(longitude) % 360.0, altitude_m / 1e3], axis=1)
    row = "%s,%.9f,%.9f,%.9f,%.12f,%.12f,%.12f,%.8f,%.8f,%.6f"
    values = np.concatenate([states, places], axis=1).tolist()
    lines = [
        row % (format_tai(t, 3 if t % 10**6 == 0 else 9), *v) for t, v in zip(tai_ns.tolist(), values, strict=True)
    ]
    return "\n".join([",".join(CSV_COLUMNS), *lines, ""])


def format_tum(ephemeris: Ephemeris) -> str:
    """Return poses in TUM form: seconds since 1970 UTC, ICRF metres, and the RTN axes as the body's attitude.

    Raises
    ------
    EphemerisError
        Where a state is within a leap second, which has no count of its own.
    """
    tai_ns, position_m, velocity_m_s = _states(ephemeris)
    if (leap := tai_ns[in_leap_second(tai_ns)]).size:
        found = format_tai(int(leap[0]))
        raise EphemerisError(f"TUM, seconds since 1970: expected states outside of leap seconds, found {found}")
    icrf_from_rtn = np.swapaxes(frames.rtn_from_inertial(position_m, velocity_m_s), -1, -2)
    # Scalar last in this format.
    attitude = np.roll(frames.continuous_quaternions(frames.quaternion_from_matrix(icrf_from_rtn)), -1, axis=-1)
    values = np.concatenate([position_m, attitude], axis=1).tolist()
    row = "%d.%09d %.6f %.6f %.6f %.12f %.12f %.12f %.12f"
    utc_ns = utc_ns_from_tai_ns(tai_ns).tolist()
    lines = [row % (*divmod(t, NS), *v) for t, v in zip(utc_ns, values, strict=True)]
    return "\n".join([*lines, ""])


def _states(ephemeris: Ephemeris) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the epochs, positions and velocities of all arcs."""
    segments = resampled(ephemeris).segments
    parts = zip(*((one.tai_ns, one.position_m, one.velocity_m_s) for one in segments), strict=True)
    tai_ns, position_m, velocity_m_s = map(np.concatenate, parts)
    return tai_ns, position_m, velocity_m_s
