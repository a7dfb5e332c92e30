"""Lookup of ingests."""

from __future__ import annotations

from ground_service.ground import Ground
from ground_service.ingest import store
from ground_service.ingest.model import Ingest


def get_ingest(ground: Ground, ingest_id: int) -> Ingest:
    """Return an ingest.

    Raises
    ------
    NotFound
        There is no such ingest.
    """
    with ground.database.reading() as connection:
        return store.get_ingest(connection, ingest_id)


def list_ingests(ground: Ground, *, limit: int = 100, offset: int = 0) -> tuple[list[Ingest], int]:
    """Return a page of the ingests, newest first, and the total number."""
    with ground.database.reading() as connection:
        return store.list_ingests(connection, limit=limit, offset=offset)
