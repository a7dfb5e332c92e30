"""UTC as text: ISO 8601 and nanoseconds of 86,400 s days since 1970, without arrays."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

from lunar.errors import TimeFormatError

NS = 1_000_000_000

_ISO = re.compile(
    r"(\d{4})-(?:(\d{2})-(\d{2})|(\d{3}))(?:[T ](\d{2}):(\d{2})(?::(\d{2})(?:\.(\d*))?)?)?(?:Z|\+00:00)?\Z",
    re.ASCII,
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


FIRST_YEAR, LAST_YEAR = 1700, 2250
"""Years whose nanoseconds since 1970 fit 64 bits."""


def parse_utc(text: str) -> int:
    """Return ``utc_ns`` of a text like ``2029-08-07T00:00:00.000Z`` or ``2029-219T00:00:00`` (day of year).

    The time of day and the ``Z`` may be absent; a second 60 counts as the first of the next minute; digits
    past the nanosecond are dropped.

    Raises
    ------
    TimeFormatError
        Where the text is no such epoch, or names a day or an hour that does not exist.
    """
    match = _ISO.match(text.strip())
    if match is None:
        raise TimeFormatError(text)
    year, month, day, day_of_year, hour, minute, second, fraction = match.groups()
    try:
        if day_of_year is None:
            date = datetime(int(year), int(month), int(day), tzinfo=UTC)
        else:
            date = datetime(int(year), 1, 1, tzinfo=UTC) + timedelta(days=int(day_of_year) - 1)
            if int(day_of_year) < 1 or date.year != int(year):
                raise TimeFormatError(text)
    except ValueError:
        raise TimeFormatError(text) from None
    if not FIRST_YEAR <= date.year <= LAST_YEAR:
        raise TimeFormatError(text)
    hours, minutes, seconds = int(hour or 0), int(minute or 0), int(second or 0)
    if hours > 23 or minutes > 59 or seconds > 60 or (seconds == 60 and minutes != 59):
        raise TimeFormatError(text)
    whole = (date - _EPOCH).days * 86_400 + hours * 3600 + minutes * 60 + seconds
    return whole * NS + int(((fraction or "") + "000000000")[:9])


def format_utc(utc_ns: int, digits: int = 3) -> str:
    """Return the ISO 8601 text of an epoch, rounded to ``digits`` (0 to 9) decimals, with ``Z``."""
    step = 10 ** (9 - digits)
    whole, rest = divmod((int(utc_ns) + step // 2) // step * step, NS)
    fraction = f".{rest // step:0{digits}d}" if digits else ""
    return (_EPOCH + timedelta(seconds=whole)).strftime("%Y-%m-%dT%H:%M:%S") + fraction + "Z"
