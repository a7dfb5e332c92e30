"""How the work of the service stands, counted."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import func, select

from ground_service.ground import Ground
from ground_service.store import repository


@dataclass(frozen=True, slots=True)
class WorkCounts:
    """Jobs by kind and state, ingests by state, and passes."""

    jobs: dict[tuple[str, str], int]
    ingests: dict[str, int]
    passes: int


def work_counts(ground: Ground) -> WorkCounts:
    """Counts as they are now."""
    jobs, ingests, passes = repository.JOBS, repository.INGESTS, repository.PASSES
    with ground.database.reading() as connection:
        by_job = connection.execute(
            select(jobs.c.kind, jobs.c.state, func.count()).group_by(jobs.c.kind, jobs.c.state)
        )
        by_ingest = connection.execute(select(ingests.c.state, func.count()).group_by(ingests.c.state))
        return WorkCounts(
            {(row[0], row[1]): int(row[2]) for row in by_job},
            {row[0]: int(row[1]) for row in by_ingest},
            int(connection.execute(select(func.count()).select_from(passes)).scalar_one()),
        )
