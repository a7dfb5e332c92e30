"""Dispatch of jobs: to this process without a broker, otherwise to the workers."""

import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor

from ground_service.errors import PASSING
from ground_service.ground import Ground
from ground_service.jobs.service import Dispatcher, get_job, unfinished_jobs
from ground_service.settings import Settings
from ground_service.worker.jobs import run_job

log = logging.getLogger(__name__)

FIRST_WAIT_S = 10.0
LONGEST_WAIT_S = 300.0
"""A job that the database or the disk stopped waits so long before it is taken up again, doubled each time."""


class InlineDispatcher(Dispatcher):
    """Does every job at once, before `submit` returns."""

    def start(self, job_id: str) -> None:
        run_job(self._ground, job_id)

    def resume(self) -> None:
        for identity in self._ground.read(unfinished_jobs):
            run_job(self._ground, identity)

    def close(self) -> None:
        """No job runs between calls."""


class ThreadDispatcher(Dispatcher):
    """Does jobs one after another in a thread of this process, as a server without workers does.

    Notifications wait for other people's computers, and have a thread of their own.
    """

    def __init__(self, ground: Ground) -> None:
        super().__init__(ground)
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="job")
        self._senders = ThreadPoolExecutor(max_workers=1, thread_name_prefix="notification")
        self._waiting: set[str] = set()
        self._held: dict[str, tuple[float, float]] = {}
        self._lock = threading.Lock()

    def start(self, job_id: str) -> None:
        with self._lock:
            if job_id in self._waiting:
                return
            self._waiting.add(job_id)
        kind = self._ground.read(get_job, job_id).kind
        (self._senders if kind == "notification" else self._pool).submit(self._run, job_id)

    def resume(self) -> None:
        for identity in self._ground.read(unfinished_jobs):
            if self._held.get(identity, (0.0, 0.0))[0] <= time.monotonic():
                self.start(identity)

    def _run(self, job_id: str) -> None:
        try:
            run_job(self._ground, job_id)
            self._held.pop(job_id, None)
        except PASSING as error:
            wait_s = min(2.0 * self._held.get(job_id, (0.0, FIRST_WAIT_S / 2.0))[1], LONGEST_WAIT_S)
            self._held[job_id] = (time.monotonic() + wait_s, wait_s)
            log.warning("job %s did not finish: %s", job_id, error)
        except Exception:  # outermost loop of the thread: the job could not be ended and is started again later
            log.exception("job %s did not finish", job_id)
        finally:
            with self._lock:
                self._waiting.discard(job_id)

    def close(self) -> None:
        self._ground.stopping.set()
        for pool in (self._pool, self._senders):
            pool.shutdown(wait=True, cancel_futures=True)


class CeleryDispatcher(Dispatcher):
    """Sends jobs to the workers over the broker."""

    def __init__(self, ground: Ground, settings: Settings) -> None:
        super().__init__(ground)
        self._settings = settings

    def start(self, job_id: str) -> None:
        """Send a job to the workers; a broker that is away gets it from `resume` later."""
        from kombu.exceptions import OperationalError

        from ground_service.worker.app import send_job

        try:
            send_job(self._settings, job_id)
        except (OperationalError, OSError) as error:
            log.warning("job %s: the broker is away (%s); it will be sent again", job_id, error)

    def resume(self) -> None:
        """Send unfinished jobs that are not in the queue again: a killed broker or worker may have lost them.

        One that a worker is doing is done once all the same: `run_job` leaves it to that worker.
        """
        from kombu.exceptions import OperationalError

        from ground_service.worker.app import queued_jobs

        unfinished = self._ground.read(unfinished_jobs)
        if not unfinished:
            return
        try:
            queued = set(queued_jobs(self._settings))
        except (OperationalError, OSError) as error:
            log.warning("the broker is away: %s", error)
            return
        for identity in unfinished:
            if identity not in queued:
                self.start(identity)

    def close(self) -> None:
        """Leave the jobs to the workers."""


def dispatcher_for(ground: Ground, settings: Settings, *, inline: bool = False) -> Dispatcher:
    """The dispatcher that the settings ask for; without a broker `inline` does jobs before `submit` returns."""
    if settings.resolved_broker_url() is not None:
        return CeleryDispatcher(ground, settings)
    return InlineDispatcher(ground) if inline else ThreadDispatcher(ground)
