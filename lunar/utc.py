"""UTC as text: ISO 8601 and nanoseconds of 86,400 s days since 1970, without arrays."""

import re
from datetime import UTC, datetime, timedelta

from lunar.constants import NS
from lunar.errors import LeapSecondError, TimeFormatError

_ISO = re.compile(
    r"(\d{4})-(?:(\d{2})-(\d{2})|(\d{3}))(?:[T ](\d{2}):(\d{2})(?::(\d{2})(?:\.(\d*))?)?)?(?:Z|\+00:00)?\Z", re.ASCII
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


# fmt: off
LEAP_DATES = [
    "1972-01-01", "1972-07-01", "1973-01-01", "1974-01-01", "1975-01-01", "1976-01-01", "1977-01-01",
    "1978-01-01", "1979-01-01", "1980-01-01", "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01",
    "1988-01-01", "1990-01-01", "1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01",
    "1997-07-01", "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01",
]
# fmt: on
"""Days before which UTC had a leap second; TAI - UTC is 10 s on the first one.  A new one is added here only."""

FIRST_YEAR, LAST_YEAR = 1700, 2250
"""Years whose nanoseconds since 1970 fit 64 bits."""


def parse_utc(text: str) -> int:
    """Return ``utc_ns`` of a text like ``2029-08-07T00:00:00.000Z`` or ``2029-219T00:00:00`` (day of year).

    The time of day and the ``Z`` may be absent; digits past the nanosecond are dropped.

    Raises
    ------
    TimeFormatError
        Where the text is no such epoch, or names a day, an hour or a leap second that does not exist.
    LeapSecondError
        Where it is within a leap second; `lunar.timescales.parse_tai` reads these too.
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
    if hours > 23 or minutes > 59 or seconds > 60:
        raise TimeFormatError(text)
    whole = (date - _EPOCH).days * 86_400 + hours * 3600 + minutes * 60 + seconds
    utc_ns = whole * NS + int(((fraction or "") + "000000000")[:9])
    if seconds == 60:
        ends_day = (hours, minutes) == (23, 59)
        if not ends_day or f"{date + timedelta(days=1):%Y-%m-%d}" not in LEAP_DATES[1:]:
            raise TimeFormatError(text)
        raise LeapSecondError(text, utc_ns)
    return utc_ns


def format_utc(utc_ns: int, digits: int = 3) -> str:
    """Return the ISO 8601 text of an epoch, rounded to ``digits`` (0 to 9) decimals, with ``Z``."""
    step = 10 ** (9 - digits)
    whole, rest = divmod((int(utc_ns) + step // 2) // step * step, NS)
    fraction = f".{rest // step:0{digits}d}" if digits else ""
    return (_EPOCH + timedelta(seconds=whole)).strftime("%Y-%m-%dT%H:%M:%S") + fraction + "Z"
