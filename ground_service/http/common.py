"""Parameters, error responses and pages that HTTP operations share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Header, Path, Query, Request

from ground_service.ground import Ground
from ground_service.http.model import PageOf
from ground_service.text import LINE_PATTERN_JSON

API_PREFIX = "/api/v1"
IDEMPOTENCY_HEADER = "Idempotency-Key"
IF_MATCH_HEADER = "If-Match"

Limit = Annotated[int, Query(ge=1, le=1000, description="Items in a page")]
Offset = Annotated[int, Query(ge=0, le=2**31 - 1, description="Items before the page")]
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


Item = TypeVar("Item")


def page_of(items: Sequence[Item], total: int, limit: int, offset: int) -> PageOf[Item]:
    """Return a page of a list."""
    return PageOf(items=list(items), total=total, limit=limit, offset=offset)


def upload_body(media: str) -> dict[str, Any]:
    """Return the OpenAPI description of a request body that is streamed into the archive."""
    schema = {"type": "string"} if media.startswith("text/") else {"type": "string", "format": "binary"}
    return {"requestBody": {"required": True, "content": {media: {"schema": schema}}}}
