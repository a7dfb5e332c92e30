"""Entities of stored display objects."""

from __future__ import annotations

import json
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from ground_service.http.model import Entity, Given
from ground_service.http.times import UtcTime
from ground_service.text import LINE_PATTERN_JSON

DOCUMENT_LIMIT_OCTETS = 256 << 10
DEPTH_LIMIT = 64
"""Largest number of objects and lists inside each other in a document."""

OBJECTS_LIMIT = 2000
"""Largest number of stored objects."""

KEY_PATTERN = r"^[A-Za-z0-9_-]{1,64}$"
_LINE = Field(min_length=1, max_length=200, pattern=LINE_PATTERN_JSON)


class DisplaySummary(Entity):
    """A stored object in a list."""

    key: str = Field(examples=["5b0ac4d2-8d35-4a6c-a4a9-0d4fd4d1a3b1"])
    name: str = Field(examples=["Pass shift"])
    type: str = Field(examples=["layout"])
    version: int
    octets: int
    created_by: str
    created: UtcTime
    changed_by: str
    changed: UtcTime


class Display(DisplaySummary):
    """A stored object of the telemetry displays."""

    document: dict[str, Any] = Field(description="The domain object of Open MCT")


class DisplayIn(Given):
    """An object to store."""

    name: Annotated[str, _LINE]
    type: Annotated[str, _LINE]
    version: int = Field(ge=0, le=2**31 - 1, description="Version that it replaces; 0: a new object")
    document: Annotated[dict[str, Any], AfterValidator(lambda document: _small(document))]


def packed(document: dict[str, Any]) -> str:
    """Return a document as it is stored."""
    return json.dumps(document, ensure_ascii=False, separators=(",", ":"), allow_nan=False)


def _small(document: dict[str, Any]) -> dict[str, Any]:
    level: list[Any] = [document]
    for _ in range(DEPTH_LIMIT):
        inside = [one.values() if isinstance(one, dict) else one for one in level]
        level = [value for values in inside for value in values if isinstance(value, dict | list)]
    if level:
        raise ValueError(f"expected at most {DEPTH_LIMIT} levels of objects and lists, found more")
    octets = len(packed(document).encode())
    if octets > DOCUMENT_LIMIT_OCTETS:
        raise ValueError(f"expected at most {DOCUMENT_LIMIT_OCTETS} octets, found {octets}")
    return document
