"""Entities of jobs."""

from typing import Any

from pydantic import Field

from ground_service.http.model import Entity, Paging, UtcTime


class Job(Entity):
    """A background job."""

    id: str
    kind: str = Field(examples=["report"])
    state: str = Field(examples=["done"], description="queued, running, done or failed")
    progress: float = Field(ge=0.0, le=1.0)
    attempts: int
    arguments: dict[str, Any]
    result: dict[str, Any] | None
    error: str | None
    traceparent: str | None = Field(description="W3C trace context of the step that entered it")
    created: UtcTime
    started: UtcTime | None
    finished: UtcTime | None


class JobFilter(Paging):
    """Jobs to list."""

    kind: str | None = Field(default=None, max_length=40, examples=["regression"])
