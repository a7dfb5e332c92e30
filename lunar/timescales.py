"""UTC, TAI, TDB and the on-board clock.

``utc_ns`` is a count of nanoseconds since 1970-01-01T00:00:00 UTC in days of 86,400 s (the POSIX count): an
``int`` or an int64 array.  It repeats itself after a leap second, in which only ``tai_ns`` tells instants apart:
texts of such epochs are read by `parse_tai` and refused by `parse_utc`.  ``tai_ns`` counts nanoseconds since
1970-01-01T00:00:00 TAI. ``tdb_s`` is a float64 of TDB seconds past J2000 (2000-01-01T12:00:00 TDB), good to
0.1 us in this century, for dynamics and frames only.  ``ticks`` counts units of 2^-16 s since the on-board
epoch 2000-01-01T00:00:00 TAI.

Every conversion takes a number and gives a number, or an array and gives an array of the same shape.

References
----------
Leap seconds: IERS Bulletin C; none is announced after 2017-01-01, and later epochs use 37 s.  Before 1972 UTC
was not kept in whole seconds of TAI; those epochs use 10 s. TDB - TT: Kaplan 2005, USNO Circular 179,
equation 2.6 (good to 10 us from 1600 to 2200).
"""

from functools import cache
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import FloatArray, IntArray
from lunar.constants import NS
from lunar.errors import LeapSecondError, TimeFormatError
from lunar.utc import LEAP_DATES as LEAP_DATES
from lunar.utc import format_utc as format_utc
from lunar.utc import parse_utc as parse_utc

TT_MINUS_TAI_NS = 32_184_000_000
TICKS_PER_SECOND = 65_536

TIME_SYSTEMS = ("UTC", "TAI", "TT", "TDB", "GPS")
"""Time scales that ephemeris files may use."""

_COUNT_MINUS_TAI_NS = {"TAI": 0, "TT": TT_MINUS_TAI_NS, "TDB": TT_MINUS_TAI_NS, "GPS": -19 * NS}

J2000_TT_AS_UTC_COUNT_NS = 946_728_000 * NS
"""2000-01-01T12:00:00 as a count of 86,400 s days since 1970, in whatever scale it is read."""

ONBOARD_EPOCH_TAI_NS = 946_684_800 * NS
"""2000-01-01T00:00:00 TAI, counted since 1970-01-01T00:00:00 TAI."""

# Kaplan 2005, equation 2.6: amplitude in s, rate in rad per Julian century, phase in rad.
_TDB_TERMS = np.array(
    [
        (0.001657, 628.3076, 6.2401),
        (0.000022, 575.3385, 4.2970),
        (0.000014, 1256.6152, 6.1969),
        (0.000005, 606.9777, 4.0212),
        (0.000005, 52.9691, 0.4444),
        (0.000002, 21.3299, 5.5431),
    ]
)


def utc_texts(utc_ns: ArrayLike, unit: Literal["us", "ns"] = "ns") -> list[str]:
    """Return the ISO 8601 texts of epochs (n,), cut to ``unit``, with ``Z``."""
    texts = np.datetime_as_string(np.asarray(utc_ns, dtype="datetime64[ns]"), unit=unit)
    return [f"{text}Z" for text in texts.tolist()]


@cache
def _leap_table(dates: tuple[str, ...]) -> tuple[IntArray, IntArray]:
    """Return the UTC counts (n,) from which each TAI - UTC holds, and TAI - UTC (n,) in ns."""
    starts = np.array(dates, dtype="datetime64[ns]").astype(np.int64)
    return starts, (10 + np.arange(len(dates), dtype=np.int64)) * NS


@overload
def tai_ns_from_utc_ns(utc_ns: int) -> int: ...
@overload
def tai_ns_from_utc_ns(utc_ns: IntArray) -> IntArray: ...
def tai_ns_from_utc_ns(utc_ns: Any) -> Any:
    """Return nanoseconds since 1970-01-01T00:00:00 TAI."""
    counts = np.asarray(utc_ns, dtype=np.int64)
    starts, offsets = _leap_table(tuple(LEAP_DATES))
    index = np.searchsorted(starts, counts, side="right") - 1
    return _as_given(counts + offsets[np.maximum(index, 0)], int)


@overload
def utc_ns_from_tai_ns(tai_ns: int) -> int: ...
@overload
def utc_ns_from_tai_ns(tai_ns: IntArray) -> IntArray: ...
def utc_ns_from_tai_ns(tai_ns: Any) -> Any:
    """Return ``utc_ns``; the leap second itself gives the counts of the second after it."""
    counts = np.asarray(tai_ns, dtype=np.int64)
    # A leap second starts one second before the new offset holds, and is counted like the first second after
    # it.
    starts, offsets = _leap_table(tuple(LEAP_DATES))
    index = np.searchsorted(starts + offsets, counts, side="right") - 1
    return _as_given(counts - offsets[np.maximum(index, 0)], int)


def in_leap_second(tai_ns: Any) -> Any:
    """Return whether instants (...) are within a leap second."""
    counts = np.asarray(tai_ns, dtype=np.int64)
    return _as_given(tai_ns_from_utc_ns(utc_ns_from_tai_ns(counts)) != counts, bool)


def parse_tai(text: str, time_system: str = "UTC") -> int:
    """Return ``tai_ns`` of a text in one of `TIME_SYSTEMS`, in UTC also within a leap second; raises as `parse_utc`."""
    try:
        return int(to_tai_ns(parse_utc(text), time_system))
    except LeapSecondError as error:
        if time_system != "UTC":
            raise TimeFormatError(text) from None
        return tai_ns_from_utc_ns(error.next_utc_ns) - NS


def format_tai(tai_ns: int, digits: int = 3) -> str:
    """Return the UTC text of an instant, rounded to ``digits`` decimals, with second 60 in a leap second."""
    step = 10 ** (9 - digits)
    rounded = (int(tai_ns) + step // 2) // step * step
    leap = int(in_leap_second(rounded))
    text = format_utc(utc_ns_from_tai_ns(rounded) - leap * NS, digits)
    return text.replace(":59:59", ":59:60") if leap else text


@overload
def tdb_s_from_utc_ns(utc_ns: int) -> float: ...
@overload
def tdb_s_from_utc_ns(utc_ns: IntArray) -> FloatArray: ...
def tdb_s_from_utc_ns(utc_ns: Any) -> Any:
    """Return TDB seconds past J2000."""
    return tdb_s_from_tai_ns(tai_ns_from_utc_ns(utc_ns))


def tdb_s_from_tai_ns(tai_ns: Any) -> Any:
    """Return TDB seconds past J2000."""
    tt_s = (np.asarray(tai_ns, dtype=np.int64) + (TT_MINUS_TAI_NS - J2000_TT_AS_UTC_COUNT_NS)) / NS
    return _as_given(tt_s + tdb_minus_tt_s(tt_s), float)


@overload
def utc_ns_from_tdb_s(tdb_s: float) -> int: ...
@overload
def utc_ns_from_tdb_s(tdb_s: FloatArray) -> IntArray: ...
def utc_ns_from_tdb_s(tdb_s: Any) -> Any:
    """Return ``utc_ns``, to the 0.1 us that a float64 of seconds can tell apart."""
    seconds = np.asarray(tdb_s, dtype=np.float64)
    # TDB - TT changes by less than 1e-9 of the 2 ms between the two arguments: no iteration is needed.
    correction_ns = np.rint(tdb_minus_tt_s(seconds) * NS).astype(np.int64)
    whole = np.floor(seconds)
    tdb_ns = whole.astype(np.int64) * NS + np.rint((seconds - whole) * NS).astype(np.int64)
    tai_ns = tdb_ns - correction_ns + (J2000_TT_AS_UTC_COUNT_NS - TT_MINUS_TAI_NS)
    return _as_given(np.asarray(utc_ns_from_tai_ns(tai_ns)), int)


def tdb_minus_tt_s(tt_s: FloatArray | float) -> FloatArray:
    """Return TDB - TT in seconds at TT (or TDB) seconds past J2000."""
    centuries = np.asarray(tt_s, dtype=np.float64) / (36_525.0 * 86_400.0)
    amplitude, rate, phase = _TDB_TERMS.T
    periodic = np.sum(amplitude * np.sin(rate * centuries[..., None] + phase), axis=-1)
    return np.asarray(periodic + 0.000010 * centuries * np.sin(628.3076 * centuries + 4.2490), dtype=np.float64)


def to_tai_ns(counts: Any, time_system: str) -> Any:
    """Return ``tai_ns`` of calendar counts (ns of 86,400 s days since 1970) read in one of `TIME_SYSTEMS`."""
    values = np.asarray(counts, dtype=np.int64)
    if time_system == "UTC":
        return _as_given(tai_ns_from_utc_ns(values), int)
    if time_system == "TDB":
        tdb_s = (values - J2000_TT_AS_UTC_COUNT_NS) / NS
        values = values - np.rint(tdb_minus_tt_s(tdb_s) * NS).astype(np.int64)
    return _as_given(values - _COUNT_MINUS_TAI_NS[time_system], int)


def from_tai_ns(tai_ns: Any, time_system: str) -> Any:
    """Return calendar counts (ns of 86,400 s days since 1970) in one of `TIME_SYSTEMS` at ``tai_ns``."""
    values = np.asarray(tai_ns, dtype=np.int64)
    if time_system == "UTC":
        return _as_given(utc_ns_from_tai_ns(values), int)
    counts = values + _COUNT_MINUS_TAI_NS[time_system]
    if time_system == "TDB":
        tt_s = (counts - J2000_TT_AS_UTC_COUNT_NS) / NS
        counts = counts + np.rint(tdb_minus_tt_s(tt_s) * NS).astype(np.int64)
    return _as_given(counts, int)


@overload
def ticks_from_utc_ns(utc_ns: int) -> int: ...
@overload
def ticks_from_utc_ns(utc_ns: IntArray) -> IntArray: ...
def ticks_from_utc_ns(utc_ns: Any) -> Any:
    """Return the reading of an ideal on-board clock, rounded to the nearest tick of 2^-16 s."""
    since_epoch = tai_ns_from_utc_ns(np.asarray(utc_ns, dtype=np.int64)) - ONBOARD_EPOCH_TAI_NS
    whole, rest = np.divmod(since_epoch, NS)
    return _as_given(np.asarray(whole * TICKS_PER_SECOND + (rest * TICKS_PER_SECOND + NS // 2) // NS), int)


@overload
def utc_ns_from_ticks(ticks: int) -> int: ...
@overload
def utc_ns_from_ticks(ticks: IntArray) -> IntArray: ...
def utc_ns_from_ticks(ticks: Any) -> Any:
    """Return the ``utc_ns`` at which an ideal on-board clock shows ``ticks``."""
    whole, rest = np.divmod(np.asarray(ticks, dtype=np.int64), TICKS_PER_SECOND)
    tai_ns = ONBOARD_EPOCH_TAI_NS + whole * NS + (rest * NS + TICKS_PER_SECOND // 2) // TICKS_PER_SECOND
    return _as_given(np.asarray(utc_ns_from_tai_ns(np.asarray(tai_ns))), int)


def _as_given(values: Any, scalar: type[int] | type[float] | type[bool]) -> Any:
    array = np.asarray(values)
    return scalar(array) if array.ndim == 0 else array
