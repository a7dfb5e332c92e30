"""Times of entities: UTC in integer nanoseconds inside the program, RFC 3339 text outside it."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from ground_service.errors import InvalidInput
from lunar.errors import LunarError
from lunar.utc import format_utc, parse_utc

LATEST_UTC_NS = parse_utc("2130-01-01T00:00:00Z")
"""The on-board clock (48 bits of 2^-16 s since 2000) ends in 2136."""

TIME_DIGITS = 6
"""Digits of a second in texts; further digits are not parsed by the date-time types of most languages."""

EXAMPLE_TIME = "2029-08-07T06:00:00Z"


class UtcTime(str):
    """RFC 3339 text of a time, to the microsecond, with its nanoseconds since 1970 in `utc_ns`."""

    __slots__ = ("utc_ns",)
    utc_ns: int

    def __new__(cls, time: int | str) -> UtcTime:
        """Return the time of nanoseconds or of a text."""
        utc_ns = parse_utc(time) if isinstance(time, str) else int(time)
        text = super().__new__(cls, time_text(utc_ns))
        text.utc_ns = utc_ns
        return text

    @property
    def datetime(self) -> datetime:
        """The time as a datetime in UTC, to the microsecond."""
        return datetime.fromisoformat(self)

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: Any, _handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            _read, serialization=core_schema.plain_serializer_function_ser_schema(str)
        )

    @classmethod
    def __get_pydantic_json_schema__(
        cls, _schema: CoreSchema, _handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"type": "string", "format": "date-time", "examples": [f"{EXAMPLE_TIME[:-1]}.000000Z"]}


def time_text(utc_ns: int) -> str:
    """Return the RFC 3339 text of a time, in whole microseconds."""
    return format_utc(int(utc_ns) // 1000 * 1000, TIME_DIGITS)


def time_of(value: object, where: str) -> int:
    """Return the nanoseconds of a time that was given as text.

    Raises
    ------
    InvalidInput
        The value is not a time, or a time that the on-board clock cannot show.
    """
    try:
        return _given(value).utc_ns
    except ValueError as error:
        expected, _, found = str(error).removeprefix("expected ").rpartition(", found ")
        raise InvalidInput(where, "", expected, found) from None


def ns_of(time: UtcTime | None) -> int | None:
    """Return the nanoseconds of a time; None without one."""
    return None if time is None else time.utc_ns


def _given(value: object) -> UtcTime:
    if isinstance(value, UtcTime):
        return value
    if not isinstance(value, str):
        raise ValueError(f"expected a time such as {EXAMPLE_TIME}, found {str(value)[:40]!r}")
    try:
        time = UtcTime(value)
    except LunarError:
        raise ValueError(f"expected a time such as {EXAMPLE_TIME}, found {value[:40]!r}") from None
    if not 0 <= time.utc_ns < LATEST_UTC_NS:
        raise ValueError(f"expected a time between 1970 and 2130, found {value[:40]!r}")
    return time


def _read(value: Any) -> UtcTime:
    if isinstance(value, UtcTime):
        return value
    if isinstance(value, str) or (isinstance(value, int) and not isinstance(value, bool)):
        return UtcTime(value)
    raise ValueError(f"expected a time such as {EXAMPLE_TIME}, found {type(value).__name__}")


GivenTime = Annotated[
    UtcTime, BeforeValidator(_given), Field(examples=[EXAMPLE_TIME], description="UTC, RFC 3339")
]
"""A time in a request: text only, within the range of the on-board clock."""
