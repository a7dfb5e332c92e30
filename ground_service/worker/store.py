"""SQL of the counts of work."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, func, select

from ground_service.store import repository


@dataclass(frozen=True, slots=True)
class WorkCounts:
    """Jobs by kind and state, ingests by state, and passes."""

    jobs: dict[tuple[str, str], int]
    ingests: dict[str, int]
    passes: int


def count_work(connection: Connection) -> WorkCounts:
    """Return the present counts."""
    jobs, ingests, passes = repository.JOBS.c, repository.INGESTS.c, repository.PASSES
    by_job = connection.execute(select(jobs.kind, jobs.state, func.count()).group_by(jobs.kind, jobs.state))
    by_ingest = connection.execute(select(ingests.state, func.count()).group_by(ingests.state))
    return WorkCounts(
        {(kind, state): int(count) for kind, state, count in by_job},
        {state: int(count) for state, count in by_ingest},
        int(connection.execute(select(func.count()).select_from(passes)).scalar_one()),
    )
