"""Times as text in requests."""

from __future__ import annotations

from ground_service.errors import InvalidInput
from lunar.errors import LunarError
from lunar.timescales import parse_utc

LATEST_UTC_NS = parse_utc("2130-01-01T00:00:00Z")
"""The on-board clock (48 bits of 2^-16 s since 2000) ends in 2136."""


def time_of(text: str, where: str) -> int:
    """Nanoseconds of a time as text.

    Raises
    ------
    InvalidInput
        If it is no time, or none that the on-board clock can show.
    """
    try:
        utc_ns = parse_utc(text)
    except LunarError:
        raise InvalidInput(where, "", "a time such as 2029-08-07T06:00:00Z", repr(text)) from None
    if not 0 <= utc_ns < LATEST_UTC_NS:
        raise InvalidInput(where, "", "a time between 1970 and 2130", repr(text))
    return utc_ns
