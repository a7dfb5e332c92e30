"""Base classes of entities, pages of lists, and problem documents."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Generic, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field

Item = TypeVar("Item")

TIME_COLUMN = "_utc_ns"
"""Ending of database columns with times; the fields of entities have the name without it."""

InstanceName = Annotated[
    str, Field(min_length=1, max_length=96, pattern=r"^[A-Za-z0-9._@-]+$", examples=["flight"])
]
SpacecraftNumber = Annotated[int, Field(ge=0, le=1023, examples=[76])]


class Entity(BaseModel):
    """Base class of entities: database row, API response, client result and printed object in one definition."""

    model_config = ConfigDict(extra="forbid", frozen=True)

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


class Given(BaseModel):
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
