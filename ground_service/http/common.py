"""Routers of the HTTP operations; parameters, error responses and pages that they share."""

from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Depends, Header, Path, Query, Request

from ground_service.ground import Ground
from ground_service.http.model import PageOf, Paging
from ground_service.toml import LINE_PATTERN_JSON

Item = TypeVar("Item")

API_PREFIX = "/api/v1"


@dataclass(frozen=True, slots=True)
class Router:
    """Router `name` in the module `module`; most of its operations are under the path `segment` of the API."""

    module: str
    name: str
    segment: str

    def imported(self) -> ModuleType:
        """Return the module."""
        return import_module(self.module)

    def load(self) -> APIRouter:
        """Return the router."""
        router: APIRouter = getattr(self.imported(), self.name)
        return router


OPERATIONS = (
    Router("ground_service.passes.routes", "passes", "passes"),
    Router("ground_service.ingest.routes", "ingests", "telemetry"),
    Router("ground_service.evaluation.routes", "evaluation", "reports"),
    Router("ground_service.evaluation.performance.routes", "reports", "monthly-reports"),
    Router("ground_service.evaluation.landmarks.routes", "landmarks", "landmarks"),
    Router("ground_service.exports.routes", "exports", "exports"),
    Router("ground_service.missions.ephemerides.routes", "ephemerides", "ephemerides"),
    Router("ground_service.jobs.routes", "jobs", "jobs"),
    Router("ground_service.missions.routes", "missions", "missions"),
    Router("ground_service.missions.timekeeping.routes", "timekeeping", "spacecraft"),
    Router("ground_service.planning.routes", "planning", "windows"),
    Router("ground_service.contacts.links.routes", "links", "links"),
    Router("ground_service.planning.routes", "requests", "requests"),
    Router("ground_service.contacts.commanding.routes", "telecommands", "telecommands"),
    Router("ground_service.passes.alarms.routes", "alarms", "alarms"),
    Router("ground_service.regression.routes", "regressions", "regressions"),
    Router("ground_service.access.routes", "access", "users"),
    Router("ground_service.worker.metrics", "status", "status"),
)
"""Operations of the HTTP API, imported when they are needed."""

IDEMPOTENCY_HEADER = "Idempotency-Key"
IF_MATCH_HEADER = "If-Match"

PassId = Annotated[int, Path(ge=1, le=2**31 - 1)]
RowId = Annotated[int, Path(ge=1, le=2**53)]
SpacecraftId = Annotated[int, Path(ge=0, le=1023)]
Key = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]
IdempotencyKey = Annotated[
    str | None,
    Header(alias=IDEMPOTENCY_HEADER, max_length=128, description="The same key again gives the same job, not another"),
]
OnceKey = Annotated[
    str | None,
    Header(
        alias=IDEMPOTENCY_HEADER,
        max_length=128,
        description="The same request again with the same key does nothing and is answered as the first was",
    ),
]
Instance = Annotated[str, Query(min_length=1, max_length=96, pattern=r"^[A-Za-z0-9._@-]+$")]
Name = Annotated[str, Query(min_length=1, max_length=200, pattern=LINE_PATTERN_JSON)]


async def ground_of(request: Request) -> Ground:
    """Return the opened service."""
    ground: Ground = request.app.state.ground
    return ground


GroundOf = Annotated[Ground, Depends(ground_of)]


PagingOf = Annotated[Paging, Query()]


def linked(request: Request, page: PageOf[Item]) -> PageOf[Item]:
    """Return a page of a list with links to its neighbours."""

    def link(offset: int) -> str:
        url = request.url.include_query_params(limit=page.limit, offset=offset)
        return f"{url.path}?{url.query}"

    after = page.offset + page.limit
    return page.model_copy(
        update={
            "next": link(after) if after < page.total else None,
            "previous": link(max(page.offset - page.limit, 0)) if page.offset > 0 else None,
        }
    )


def upload_body(content: str) -> dict[str, Any]:
    """Return the OpenAPI description of a request body that is streamed into the archive.

    The type is application/octet-stream for every content, which all generators of clients know; a request may state
    another type.
    """
    schema = {"type": "string", "format": "binary"}
    body = {"description": content, "required": True, "content": {"application/octet-stream": {"schema": schema}}}
    return {"requestBody": body}
