"""Parameters, error responses and pages that HTTP operations share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Header, Path, Query, Request
from starlette.datastructures import URL

from ground_service.ground import Ground
from ground_service.http.model import PageOf
from ground_service.text import LINE_PATTERN_JSON

Item = TypeVar("Item")

API_PREFIX = "/api/v1"
IDEMPOTENCY_HEADER = "Idempotency-Key"
IF_MATCH_HEADER = "If-Match"

PassId = Annotated[int, Path(ge=1, le=2**31 - 1)]
RowId = Annotated[int, Path(ge=1, le=2**53)]
SpacecraftId = Annotated[int, Path(ge=0, le=1023)]
Key = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias=IDEMPOTENCY_HEADER,
        max_length=128,
        description="The same key again gives the same job, not another",
    ),
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


@dataclass(frozen=True, slots=True)
class Paging:
    """The requested page of a list."""

    limit: int
    offset: int
    url: URL

    def page(self, items: Sequence[Item], total: int) -> PageOf[Item]:
        """Return the page with links to its neighbours."""
        after, before = self.offset + self.limit, max(self.offset - self.limit, 0)
        return PageOf(
            items=list(items),
            total=total,
            limit=self.limit,
            offset=self.offset,
            next=self._link(after) if after < total else None,
            previous=self._link(before) if self.offset > 0 else None,
        )

    def _link(self, offset: int) -> str:
        url = self.url.include_query_params(limit=self.limit, offset=offset)
        return f"{url.path}?{url.query}"


async def paging(
    request: Request,
    limit: Annotated[int, Query(ge=1, le=1000, description="Items in a page")] = 100,
    offset: Annotated[int, Query(ge=0, le=2**31 - 1, description="Items before the page")] = 0,
) -> Paging:
    """Return the page that a request asks for."""
    return Paging(limit, offset, request.url)


PagingOf = Annotated[Paging, Depends(paging)]


def upload_body(content: str) -> dict[str, Any]:
    """Return the OpenAPI description of a request body that is streamed into the archive.

    The type is application/octet-stream for every content, which all generators of clients know; a request may state
    another type.
    """
    schema = {"type": "string", "format": "binary"}
    body = {
        "description": content,
        "required": True,
        "content": {"application/octet-stream": {"schema": schema}},
    }
    return {"requestBody": body}
