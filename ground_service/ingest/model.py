"""Entities of ingests."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from ground_service.http.model import Entity
from ground_service.http.times import UtcTime


class IngestAccepted(Entity):
    """A stored upload that will be ingested."""

    ingest_id: int = Field(examples=[1])
    job_id: str
    sha256: str
    octets: int


class Ingest(Entity):
    """One ingest of one file."""

    id: int = Field(examples=[1])
    state: str = Field(examples=["done"], description="queued, running, done or failed")
    sha256: str
    received: UtcTime
    finished: UtcTime | None
    error: str | None
    dictionary_version: int = Field(examples=[1])
    accounting: dict[str, Any]
