"""SQL of the counts of work."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import ColumnElement, Connection, exists, func, select

from ground_service.store import repository


@dataclass(frozen=True, slots=True)
class WorkCounts:
    """Jobs by kind and state, ingests by state, and passes; the oldest waiting job and the oldest unfinished ingest."""

    jobs: dict[tuple[str, str], int]
    ingests: dict[str, int]
    passes: int
    oldest_job_utc_ns: int | None
    oldest_ingest_utc_ns: int | None


def count_work(connection: Connection) -> WorkCounts:
    """Return the present counts."""
    jobs, ingests, passes = repository.JOBS.c, repository.INGESTS.c, repository.PASSES

    def oldest(column: ColumnElement[int], condition: ColumnElement[bool]) -> int | None:
        found = connection.execute(select(func.min(column)).where(condition)).scalar()
        return None if found is None else int(found)

    by_job = connection.execute(select(jobs.kind, jobs.state, func.count()).group_by(jobs.kind, jobs.state))
    by_ingest = connection.execute(select(ingests.state, func.count()).group_by(ingests.state))
    return WorkCounts(
        {(kind, state): int(count) for kind, state, count in by_job},
        {state: int(count) for state, count in by_ingest},
        int(connection.execute(select(func.count()).select_from(passes)).scalar_one()),
        # The work of regressions is planned: a verdict waits for its replays.
        oldest(
            jobs.created_utc_ns,
            (jobs.state == "queued") & jobs.kind.not_in(("regression", "analysis", "replay", "rendering")),
        ),
        oldest(ingests.received_utc_ns, ingests.state.not_in(("done", "failed", "withdrawn"))),
    )


def vehicles_received(connection: Connection, instance: str) -> list[int]:
    """Return the numbers of the spacecraft from which telemetry was received in an instance."""
    vehicles, packets = repository.VEHICLES.c, repository.PACKETS.c
    received = exists().where(packets.vehicle_id == vehicles.id)
    query = select(vehicles.ccsds_id).where(vehicles.instance == instance, received)
    return [int(one) for one in connection.execute(query.order_by(vehicles.ccsds_id)).scalars()]


def newest_correlations(connection: Connection) -> dict[tuple[int, str], int]:
    """Return when the newest time correlation of each vehicle was made (UTC, ns), by spacecraft number and instance."""
    vehicles, made = repository.VEHICLES.c, repository.CORRELATIONS.c
    query = (
        select(vehicles.ccsds_id, vehicles.instance, func.max(made.created_utc_ns))
        .join_from(repository.VEHICLES, repository.CORRELATIONS, made.vehicle_id == vehicles.id)
        .group_by(vehicles.ccsds_id, vehicles.instance)
    )
    return {(int(number), instance): int(utc_ns) for number, instance, utc_ns in connection.execute(query)}
