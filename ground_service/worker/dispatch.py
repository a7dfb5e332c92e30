"""Who does a job: this process when there is no broker, the workers when there is one."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol

from ground_service.services.ground import Ground
from ground_service.services.jobs import enter_job, run_job, unfinished_jobs
from ground_service.settings import Settings


class Dispatcher(Protocol):
    """Takes jobs and sees to it that they are done."""

    def submit(self, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None) -> str:
        """Enter a job and have it done; its id."""

    def resume(self) -> None:
        """Take up jobs that an earlier process left unfinished."""

    def close(self) -> None:
        """Let jobs that run here come to their end."""


class InlineDispatcher:
    """Does every job at once, before `submit` returns."""

    def __init__(self, ground: Ground) -> None:
        self._ground = ground

    def submit(self, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None) -> str:
        identity = enter_job(self._ground, kind, arguments, job_id=job_id)
        run_job(self._ground, identity)
        return identity

    def resume(self) -> None:
        for identity in unfinished_jobs(self._ground):
            run_job(self._ground, identity)

    def close(self) -> None:
        pass


class ThreadDispatcher:
    """Does jobs one after another in a thread of this process, as a server without workers does."""

    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="job")
        self.pending: set[Future[Any]] = set()

    def submit(self, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None) -> str:
        identity = enter_job(self._ground, kind, arguments, job_id=job_id)
        self._start(identity)
        return identity

    def resume(self) -> None:
        for identity in unfinished_jobs(self._ground):
            self._start(identity)

    def _start(self, identity: str) -> None:
        future = self._pool.submit(run_job, self._ground, identity)
        self.pending.add(future)
        future.add_done_callback(self.pending.discard)

    def close(self) -> None:
        self._pool.shutdown(wait=True)


class CeleryDispatcher:
    """Sends jobs to the workers over the broker."""

    def __init__(self, ground: Ground, settings: Settings) -> None:
        self._ground = ground
        self._settings = settings

    def submit(self, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None) -> str:
        from ground_service.worker.app import send_job

        identity = enter_job(self._ground, kind, arguments, job_id=job_id)
        send_job(self._settings, identity)
        return identity

    def resume(self) -> None:
        """The broker keeps what was sent to it; nothing is to be done here."""

    def close(self) -> None:
        pass


def dispatcher_for(ground: Ground, settings: Settings, *, inline: bool = False) -> Dispatcher:
    """The dispatcher that the settings ask for; without a broker `inline` does jobs before `submit` returns."""
    if settings.resolved_broker_url() is not None:
        return CeleryDispatcher(ground, settings)
    return InlineDispatcher(ground) if inline else ThreadDispatcher(ground)
