"""What the operations share: who asks, which service answers, pages, uploads, idempotency keys."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any

from fastapi import Depends, Header, Path, Query, Request

from ground_service.access.service import Caller
from ground_service.ground import Ground
from ground_service.http import schemas
from ground_service.http.security import requires
from ground_service.text import LINE_PATTERN_JSON

API_PREFIX = "/api/v1"

PROBLEMS: dict[int | str, dict[str, Any]] = {
    status: {"model": schemas.Problem, "content": {"application/problem+json": {}}, "description": text_}
    for status, text_ in (
        (400, "Malformed request"),
        (401, "No valid token"),
        (403, "The role does not allow it"),
        (404, "Not found"),
        (409, "Conflict"),
        (412, "Precondition failed"),
        (413, "Too large"),
        (415, "Encoding not supported"),
        (421, "Not a name of this service"),
        (422, "Invalid input"),
        (429, "Too many requests"),
        (503, "Busy, or store unavailable"),
        (507, "No space left"),
    )
}


Viewer = Annotated[Caller, Depends(requires("viewer"))]
Operator = Annotated[Caller, Depends(requires("operator"))]
Admin = Annotated[Caller, Depends(requires("admin"))]
Limit = Annotated[int, Query(ge=1, le=1000, description="Items in a page")]
Offset = Annotated[int, Query(ge=0, le=2**31 - 1, description="Items before the page")]
PassId = Annotated[int, Path(ge=1, le=2**31 - 1)]
RowId = Annotated[int, Path(ge=1, le=2**53)]
SpacecraftId = Annotated[int, Path(ge=0, le=1023)]
Key = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        max_length=128,
        description="The same key again gives the same job, not another",
    ),
]
OnceKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        max_length=128,
        description="The same request again with the same key does nothing and is answered as the first was",
    ),
]
Instance = Annotated[str, Query(min_length=1, max_length=96, pattern=r"^[A-Za-z0-9._@-]+$")]
Name = Annotated[str, Query(min_length=1, max_length=200, pattern=LINE_PATTERN_JSON)]


async def ground_of(request: Request) -> Ground:
    """The opened service."""
    ground: Ground = request.app.state.ground
    return ground


GroundOf = Annotated[Ground, Depends(ground_of)]


def idempotent_id(what: str, caller: Caller, key: str | None) -> str | None:
    """The id of the job that an idempotency key of this caller stands for."""
    if key is None:
        return None
    return hashlib.sha256(f"{caller.name}\0{what}\0{key}".encode()).hexdigest()[:32]


def page_of(items: list[Any], total: int, limit: int, offset: int) -> dict[str, Any]:
    """A page of a list."""
    return {"items": items, "total": total, "limit": limit, "offset": offset}
