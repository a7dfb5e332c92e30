"""The client of the ground service: the operations of the HTTP API, and tasks over several of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ground_service.client.connection import JobFailed, new_key
from ground_service.client.operations import Operations
from ground_service.errors import InvalidInput

if TYPE_CHECKING:
    from ground_service.ingest.model import Ingest
    from ground_service.jobs.service import Job
    from ground_service.missions.model import MissionDetail

FIRST_WAIT_S, LONGEST_WAIT_S = 0.05, 2.0


@dataclass(frozen=True, slots=True)
class Uplink:
    """Octets to radiate now, and the ids of the telecommands in them."""

    octets: bytes
    telecommands: tuple[int, ...]


class Client(Operations):
    """Operations of a ground service.

    Operations that create something take an idempotency key: the service processes requests with the same key once. The
    default is a new key for each call, so that a request can be repeated after a broken connection.
    """

    def ingest_file(self, file: Path | bytes, **options: Any) -> Ingest:
        """Upload a downlink with the options of `upload_telemetry`, and wait until it is ingested."""
        accepted = self.upload_telemetry(file, **options)
        self.wait(accepted.job_id)
        return self.get_ingest(accepted.ingest_id)

    def import_archive(self, archive: Path) -> int:
        """Upload a pass archive (folder or zip), wait until it is imported, and return the id of the pass."""
        try:
            return self._import_archive(archive)
        except JobFailed as error:
            raise JobFailed(error.status, f"{archive}: {error}") from None

    def _import_archive(self, archive: Path) -> int:
        if archive.is_file():
            return int(self._result(self.upload_archive(archive))["pass_id"])
        from ground_service.passes.archive_import import zip_folder

        if not (archive / "manifest.json").is_file():
            raise InvalidInput(str(archive), "", "a pass archive with manifest.json", "no manifest.json")
        packed = zip_folder(archive)
        try:
            return int(self._result(self.upload_archive(packed, name=f"{archive.name}.zip"))["pass_id"])
        finally:
            packed.unlink()

    def add_mission(self, file: Path | bytes, *, name: str | None = None) -> MissionDetail:
        """Add a mission description (TOML) as a revision, with the XTCE files that it names."""
        if isinstance(file, Path):
            from ground_service.missions.definitions import read_mission_file

            name = name or file.name
            file = read_mission_file(file)
        return super().add_mission(file, name=name)

    def make_report(self, pass_id: int) -> str:
        """Request a report, wait until it is rendered, and return its id."""
        return str(self._result(self.request_report(pass_id))["report_id"])

    def take_uplink(
        self,
        spacecraft_id: int,
        *,
        instance: str = "flight",
        format: Literal["cltu", "packets"] = "cltu",
        key: str | None = None,
    ) -> Uplink:
        """Take all released telecommands; they count as sent from then on."""
        response = self._send(
            "POST",
            "/uplink",
            query={"spacecraft_id": spacecraft_id, "instance": instance, "format": format},
            key=key or new_key(),
        )
        ids = response.headers.get("X-Telecommands", "").split(",")
        return Uplink(response.content, tuple(int(text) for text in ids if text))

    def wait(self, job_id: str, *, progress: Callable[[Job], None] | None = None) -> Job:
        """Return a job when it is done.

        Raises
        ------
        JobFailed
            The job failed; the message is its error.
        """
        pause = FIRST_WAIT_S
        while True:
            job = self.get_job(job_id)
            if job.state == "failed":
                raise JobFailed(422, str(job.error))
            if progress is not None:
                progress(job)
            if job.state == "done":
                return job
            time.sleep(pause)
            pause = min(2.0 * pause, LONGEST_WAIT_S)

    def _result(self, job: Job) -> dict[str, Any]:
        return self.wait(job.id).result or {}
