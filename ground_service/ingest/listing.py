"""Lookup of ingests."""

from __future__ import annotations

from ground_service.ground import Ground
from ground_service.ingest.model import Ingest
from ground_service.store import repository


def get_ingest(ground: Ground, ingest_id: int) -> Ingest:
    """Return an ingest.

    Raises
    ------
    NotFound
        There is no such ingest.
    """
    with ground.database.reading() as connection:
        return _ingest(repository.get(connection, repository.INGESTS, ingest_id, "ingest"))


def list_ingests(ground: Ground, *, limit: int = 100, offset: int = 0) -> tuple[list[Ingest], int]:
    """Return a page of the ingests, newest first, and the total number."""
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.INGESTS, limit=limit, offset=offset)
    return [_ingest(row) for row in page.rows], page.total


def _ingest(row: repository.Row) -> Ingest:
    return Ingest.of(row, sha256=row["file_sha256"])
