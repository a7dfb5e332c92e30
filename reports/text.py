"""Numbers, times and counts as the reports print them."""

import math
from datetime import UTC, datetime, timedelta

THIN_SPACE = "\u202f"
NOT_A_VALUE = "–"
_MONTHS = (
    "January", "February", "March", "April", "May", "June",
    "July", "August", "September", "October", "November", "December",
)  # fmt: skip
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def utc_fields(utc_ns: int) -> tuple[int, int, int, int, int, int]:
    """Year, month, day, hour, minute, second of a time, cut to the second."""
    moment = _EPOCH + timedelta(seconds=int(utc_ns) // 1_000_000_000)
    return moment.year, moment.month, moment.day, moment.hour, moment.minute, moment.second


def month_name(month: int) -> str:
    return _MONTHS[month - 1]


def utc_ns_of(text: str) -> int:
    """Return the nanoseconds since 1970 of an RFC 3339 text in UTC, to the microsecond."""
    return (datetime.fromisoformat(text) - _EPOCH) // timedelta(microseconds=1) * 1000


def utc_text(utc_ns: int | None, *, date: bool = True) -> str:
    """A time to the second: 2029-08-09 10:14:32 UTC."""
    if utc_ns is None:
        return NOT_A_VALUE
    year, month, day, hour, minute, second = utc_fields(utc_ns)
    clock = f"{hour:02d}:{minute:02d}:{second:02d}"
    return f"{year:04d}-{month:02d}-{day:02d} {clock} UTC" if date else clock


def duration_text(seconds: float) -> str:
    """A length of time in words that fit its size."""
    if not math.isfinite(seconds):
        return NOT_A_VALUE
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 2 * 3600:
        return f"{seconds / 60:.1f} min"
    if seconds < 3 * 86_400:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86_400:.1f} d"


def rate_text(rate: float | None) -> str:
    """Return a small share such as a bit error rate."""
    if rate is None:
        return NOT_A_VALUE
    return f"{rate:.1e}" if rate else "0"


def count_text(count: int | None) -> str:
    """A count with thin spaces between thousands."""
    return NOT_A_VALUE if count is None else f"{count:,}".replace(",", THIN_SPACE)


def counted(count: int, units: str) -> str:
    """Return a count and its units, stated in the plural: 1 pass, 2 passes."""
    one = units.removesuffix("es") if units.endswith("sses") else units.removesuffix("s")
    return f"{count} {one if count == 1 else units}"


def computed_text(count: int | None, absent: str = "not computed") -> str:
    """Return a count with thin spaces between thousands, or a text if it was not computed."""
    return absent if count is None else count_text(count)


def number_text(value: float | None, decimals: int) -> str:
    """A number with fixed decimals and thin spaces between thousands, a dash where there is none."""
    if value is None or not math.isfinite(value):
        return NOT_A_VALUE
    text = f"{value:,.{decimals}f}".replace(",", THIN_SPACE)
    return text.replace("-", "−")


def significant_text(value: float | int | str | None, digits: int = 3) -> str:
    """Format a number with given significant digits, never in powers of ten between 1e-3 and 1e7; text stays text."""
    if value is None:
        return NOT_A_VALUE
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        return count_text(value)
    if not math.isfinite(value):
        return NOT_A_VALUE
    if value == 0:
        return "0"
    exponent = int(f"{value:.{digits - 1}e}".partition("e")[2])
    if exponent < -3 or exponent > 6:
        return f"{value:.{digits - 1}e}".replace("-", "−")
    return number_text(round(value, digits - 1 - exponent), max(0, digits - 1 - exponent))


def headline_text(value: float | int | str | None) -> str:
    """A number of the first page to three digits; one that rounds to zero is stated as below the last digit."""
    if isinstance(value, float) and 0.0 < abs(value) < 1e-3:
        return "< 0.001" if value > 0.0 else "> −0.001"
    return significant_text(value)


def percent_text(part: float | None, whole: float | None, decimals: int = 1) -> str:
    """A share in percent, a dash where the whole is nothing."""
    if part is None or not whole:
        return NOT_A_VALUE
    return f"{number_text(100.0 * part / whole, decimals)}{THIN_SPACE}%"


def length_text(metres: float | None) -> str:
    """A length with its unit: 84.0 m, 1.31 km, 59.0 km."""
    if metres is None or not math.isfinite(metres):
        return NOT_A_VALUE
    if abs(metres) >= 999.5:
        return f"{significant_text(metres / 1000)} km"
    return f"{significant_text(metres)} m"


def hash_text(digest: str) -> str:
    """A long hash in groups of eight, so that it can break over lines."""
    return " ".join(digest[i : i + 8] for i in range(0, len(digest), 8))


def loss_text(loss: float, relative: bool) -> str:
    """Return a loss as a number, or as a percentage if it is a share of the baseline."""
    return f"{100.0 * loss:,.{1 if abs(loss) < 0.1 else 0}f} %" if relative else f"{loss:.3g}"
