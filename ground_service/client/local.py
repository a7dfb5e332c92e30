"""In-process client of the ground service, without a server."""

from __future__ import annotations

import inspect
import weakref
from collections.abc import Callable
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

from pydantic import ValidationError

from ground_service.client.connection import whole_file
from ground_service.client.tasks import Client
from ground_service.errors import GroundError
from ground_service.jobs.service import Dispatcher, Job, get_job

if TYPE_CHECKING:
    from pathlib import Path

    import httpx

    from ground_service.evaluation.model import PassFigures
    from ground_service.ground import Ground
    from ground_service.http.model import PageOf

LOCAL_URL = "http://localhost"


class LocalClient(Client):
    """Client of an open ground service in this process, as administrator `actor`; closing it closes the service.

    Access to the local database implies full access. Lists are read and reports made directly, which takes no HTTP
    libraries; where that fails, the operation states the fault.

    Parameters
    ----------
    background
        Run jobs in a thread, so that their progress can be followed; otherwise each job finishes before its request
        returns.
    """

    def __init__(self, ground: Ground, actor: str, *, background: bool = False) -> None:
        super().__init__(LOCAL_URL)
        self._ground = ground
        self._caller = (actor, background)
        self._end = weakref.finalize(self, ground.close)

    def close(self) -> None:
        """Close the service."""
        super().close()
        self._end()

    @cached_property
    def _dispatcher(self) -> Dispatcher:
        """Dispatcher of the jobs; from now on, the follow-up work of events is done."""
        self._ground.database.listeners.add(FollowUpOnDemand(self._ground))
        if not self._caller[1]:
            return LocalDispatcher(self._ground)
        from ground_service.worker.dispatch import ThreadDispatcher

        return ThreadDispatcher(self._ground)

    def _transport(self) -> httpx.BaseTransport:
        from ground_service.client.transport import LocalTransport

        return LocalTransport(self._ground, self._caller[0], self._dispatcher)

    def request_report(self, pass_id: int, *, key: str | None = None) -> Job:
        """Request a report of a pass; a job creates it."""
        from ground_service.passes.store import get_pass

        try:
            self._ground.read(get_pass, pass_id)
        except (GroundError, OverflowError):
            return super().request_report(pass_id, key=key)
        if key is not None:
            return super().request_report(pass_id, key=key)
        return self.get_job(self._dispatcher.submit("report", {"pass_id": pass_id}))

    def get_job(self, job_id: str) -> Job:
        """Show a job: its state, and its result when it is done."""
        try:
            return self._ground.read(get_job, job_id)
        except GroundError:
            return super().get_job(job_id)

    def get_report(self, report_id: str, out: Path, *, format: Literal["html", "pdf", "json"] | None = None) -> None:
        """Return a report as HTML, PDF or JSON."""
        from ground_service.evaluation.service import report_document

        try:
            octets = report_document(self._ground, report_id, format or "json")
        except (GroundError, AttributeError):
            return super().get_report(report_id, out, format=format)
        with whole_file(out) as partial:
            partial.write_bytes(octets)

    def get_report_summary(self, report_id: str) -> PassFigures:
        """Return the figures of a report."""
        from ground_service.evaluation.model import PassFigures
        from ground_service.evaluation.store import get_report

        try:
            return PassFigures.model_validate(self._ground.read(get_report, report_id).summary)
        except GroundError:
            return super().get_report_summary(report_id)

    def _page(self, reads: str, item: Any, path: str, query: dict[str, Any]) -> PageOf[Any]:
        if not reads:
            return super()._page(reads, item, path, query)
        module, _, name = reads.rpartition(".")
        work = getattr(import_module(f"ground_service.{module}"), name)
        _, asked = inspect.signature(work, eval_str=True).parameters.values()
        stated = {key: value for key, value in query.items() if value is not None}
        try:
            found: PageOf[Any] = self._ground.read(work, asked.annotation.model_validate(stated))
        except (GroundError, ValidationError):  # the operation states the fault
            return super()._page("", item, path, query)
        return found


class LocalDispatcher(Dispatcher):
    """Dispatcher that finishes every job before its request returns."""

    def start(self, job_id: str) -> None:
        from ground_service.worker.jobs import run_job

        run_job(self._ground, job_id)

    def resume(self) -> None:
        """Leave unfinished jobs of other processes to the server."""

    def close(self) -> None:
        """No job runs between requests."""


class FollowUpOnDemand:
    """In-process follow-up work of events; its code is imported on the first event."""

    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        self._follow_up: Callable[[frozenset[str]], None] | None = None

    def __call__(self, kinds: frozenset[str]) -> None:
        if self._follow_up is None:
            from ground_service.worker.follow_up import FollowUp

            self._follow_up = FollowUp(self._ground, None)
        self._follow_up(kinds)


local_client = LocalClient
