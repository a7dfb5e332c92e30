"""Base classes of entities, pages of lists, problem documents, and formats of times."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Annotated, Any, Generic, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from ground_service.errors import InvalidInput
from lunar.errors import LunarError
from lunar.utc import format_utc, parse_utc

Item = TypeVar("Item")

TIME_COLUMN = "_utc_ns"
"""Ending of database columns with times; the fields of entities have the name without it."""

InstanceName = Annotated[str, Field(min_length=1, max_length=96, pattern=r"^[A-Za-z0-9._@-]+$", examples=["flight"])]
SpacecraftNumber = Annotated[int, Field(ge=0, le=1023, examples=[76])]


class Entity(BaseModel):
    """Base class of entities: database row, API response, client result and printed object in one definition."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    @classmethod
    def of(cls, row: Mapping[Any, Any], **values: Any) -> Self:
        """Return the entity of a database row: columns by field name, times without `_utc_ns`.

        `values` are fields that are not columns, or replace them.
        """
        for name in cls.model_fields:
            if name not in values:
                column = name if name in row else name + TIME_COLUMN
                if column in row:
                    values[name] = row[column]
        return cls.model_validate(values)


class RequestModel(BaseModel):
    """Base class of requests; values are not converted between types, such as true to 1."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Paging(BaseModel):
    """Query of a list: the page; capabilities add the filters of their entities."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    limit: int = Field(default=100, ge=1, le=1000, description="Items in a page")
    offset: int = Field(default=0, ge=0, le=2**31 - 1, description="Items before the page")

    def filters(self) -> dict[str, Any]:
        """Return the filters that are stated."""
        return {
            name: value
            for name in type(self).model_fields
            if name not in Paging.model_fields and (value := getattr(self, name)) not in (None, [])
        }

    def page(self, items: Iterable[Item], total: int) -> PageOf[Item]:
        """Return the page with these items."""
        return PageOf(items=list(items), total=total, limit=self.limit, offset=self.offset)


class PageOf(Entity, Generic[Item]):
    """A page of a list."""

    items: list[Item]
    total: int = Field(description="Number of items in all pages", examples=[1])
    limit: int = Field(examples=[100])
    offset: int = Field(examples=[0])
    next: str | None = Field(
        default=None, description="Address of the next page", examples=["/api/v1/passes?limit=100&offset=100"]
    )
    previous: str | None = Field(default=None, description="Address of the previous page")

    @classmethod
    def model_parametrized_name(cls, params: tuple[Any, ...]) -> str:
        """Return the name of the page of an entity, such as JobPage."""
        return f"{params[0].__name__}Page"

    @classmethod
    def all_of(cls, items: list[Item]) -> Self:
        """Return a list as its only page."""
        return cls(items=items, total=len(items), limit=max(len(items), 1), offset=0)


class Problem(BaseModel):
    """An RFC 9457 problem document."""

    type: str = Field(examples=["about:blank"])
    title: str = Field(examples=["not found"])
    status: int = Field(examples=[404])
    detail: str = Field(examples=["pass 7: not found"])
    instance: str | None = Field(default=None, examples=["/api/v1/passes/7"])
    request_id: str | None = Field(default=None, description="Id of the request in the log")
    errors: list[dict[str, str]] | None = Field(default=None, description="All faults of the request")
    state: str | None = Field(default=None, description="For a conflict: the state found instead")


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
    def __get_pydantic_json_schema__(cls, _schema: CoreSchema, _handler: GetJsonSchemaHandler) -> dict[str, Any]:
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


RequestTime = Annotated[UtcTime, BeforeValidator(_given), Field(examples=[EXAMPLE_TIME], description="UTC, RFC 3339")]
"""A time in a request: text only, within the range of the on-board clock."""
