"""Entities of the state of the service."""

from __future__ import annotations

from pydantic import Field

from ground_service.http.model import Entity, UtcTime


class Health(Entity):
    """State of the service."""

    status: str = Field(examples=["ok"])


class CorrelationAge(Entity):
    """Age of the newest time correlation of a spacecraft in one instance."""

    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])
    age_s: float = Field(description="Time since it was made, s")


class ServiceStatus(Entity):
    """Condition of the deployment: waiting work, disk, backups, time correlations, scheduler."""

    time: UtcTime = Field(description="Time of day, as in records and logs")
    mission_time: UtcTime = Field(description="Time of operations: contacts, windows and shelved alarms")
    complaints: list[str] = Field(description="What an operator has to look after; empty: nothing")
    jobs: dict[str, int] = Field(description="Number of jobs by state", examples=[{"done": 12, "queued": 1}])
    ingests: dict[str, int] = Field(description="Number of ingests by state", examples=[{"done": 3}])
    queue_age_s: float = Field(description="Age of the oldest job that waits, s; 0: none waits")
    ingest_lag_s: float = Field(description="Age of the oldest unfinished ingest, s; 0: none")
    disk_free_octets: int
    disk_octets: int
    backup_age_s: float | None = Field(description="Age of the newest backup, s; null: unknown")
    scheduler: str | None = Field(description="Process that does the recurring work; null: none")
    processes: dict[str, int] = Field(
        description="Running processes by kind; empty: the service is one process", examples=[{"api": 2}]
    )
    correlations: list[CorrelationAge]
