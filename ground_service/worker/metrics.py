"""Metrics, health and status operations: requests, their time, and the state of the work."""

import logging
import re
import secrets
import time
from pathlib import Path

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ground_service.access.security import Viewer
from ground_service.errors import Draining
from ground_service.ground import Ground
from ground_service.http.common import GroundOf
from ground_service.http.requests import operations
from ground_service.jobs import service
from ground_service.jobs.service import KINDS, JobFilter
from ground_service.logs import span
from ground_service.worker.condition import Health, ServiceStatus, read_condition, service_status

BUCKETS = (0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 30.0)


class Metrics:
    """The figures of one application.

    Parameters
    ----------
    backups
        Folder of backups; None: their age is unknown and not stated.
    broker_url
        Broker; None: jobs run in this process.
    """

    def __init__(self, backups: Path | None = None, broker_url: str | None = None) -> None:
        self._registry = CollectorRegistry()
        self._backups, self._broker_url = backups, broker_url
        self.requests = Counter(
            "linna_http_requests", "Requests answered", ("method", "route", "status"), registry=self._registry
        )
        self.seconds = Histogram(
            "linna_http_request_seconds",
            "Time from request to answer",
            ("method", "route"),
            buckets=BUCKETS,
            registry=self._registry,
        )
        self._jobs = Gauge("linna_jobs", "Jobs by state", ("kind", "state"), registry=self._registry)
        self._ingests = Gauge("linna_ingests", "Ingests by state", ("state",), registry=self._registry)
        self._passes = Gauge("linna_passes", "Passes", registry=self._registry)
        self._queue_age = self._gauge("linna_queue_age_seconds", "Age of the oldest job that waits; 0: none waits")
        self._lag = self._gauge("linna_ingest_lag_seconds", "Age of the oldest unfinished ingest; 0: none")
        self._free = self._gauge("linna_disk_free_bytes", "Free space of the archive's file system")
        self._size = self._gauge("linna_disk_size_bytes", "Size of the archive's file system")
        self._scheduler = self._gauge("linna_scheduler", "Processes that do the recurring work: 1 or 0")
        self._backed_up = self._gauge("linna_backup_configured", "Whether LINNA_BACKUPS names a folder: 1 or 0")
        self._backup = self._gauge("linna_backup_age_seconds", "Age of the newest backup", ("folder",))
        self._correlation = self._gauge(
            "linna_time_correlation_age_seconds",
            "Time since the newest time correlation was made",
            # Prometheus has its own label `instance`, and would rename one of the metric.
            ("spacecraft_id", "spacecraft_instance"),
        )
        # With labels, so that they have no sample where they do not apply.
        self._broker = self._gauge("linna_broker_up", "Whether the broker answers: 1 or 0", ("kind",))
        self._runner = self._gauge("linna_runner_up", "Whether a worker sees a runner: 1 or 0", ("kind",))
        self._processes = self._gauge("linna_processes", "Running processes of the deployment", ("kind",))
        self._disagreements = self._gauge("linna_disagreements", "Settings and folders in which processes differ")

    def _gauge(self, name: str, text: str, labels: tuple[str, ...] = ()) -> Gauge:
        return Gauge(name, text, labels, registry=self._registry)

    def answer(self, ground: Ground) -> Response:
        """All figures, those of the work read from the database now."""
        now = read_condition(ground, self._backups, self._broker_url)
        counts = now.counts
        # A state that nothing is in any more has no row, and must not keep its last count.
        labelled = (self._jobs, self._ingests, self._backup, self._correlation, self._processes)
        for gauge in (*labelled, self._broker, self._runner):
            gauge.clear()
        for kind, count in now.processes.items():
            self._processes.labels(kind).set(count)
        if now.broker is not None:
            self._broker.labels("redis").set(float(now.broker))
        if now.runner is not None:
            self._runner.labels("exchange").set(float(now.runner))
        self._disagreements.set(len(now.disagreements))
        self._queue_age.set(now.queue_age_s)
        self._lag.set(now.ingest_lag_s)
        self._free.set(now.disk_free)
        self._size.set(now.disk_size)
        self._scheduler.set(float(now.scheduler is not None))
        self._backed_up.set(float(self._backups is not None))
        if self._backups is not None and now.backup_age_s is not None:
            self._backup.labels(str(self._backups)).set(now.backup_age_s)
        for (number, instance), age_s in now.correlation_ages_s.items():
            self._correlation.labels(str(number), instance).set(age_s)
        # The first failure of a kind is an increase only if there was a 0 before.
        for kind in KINDS:
            self._jobs.labels(kind, "failed").set(0)
        for (kind, state), count in counts.jobs.items():
            self._jobs.labels(kind, state).set(count)
        for state, count in counts.ingests.items():
            self._ingests.labels(state).set(count)
        self._passes.set(counts.passes)
        return Response(generate_latest(self._registry), media_type=CONTENT_TYPE_LATEST)


log = logging.getLogger(__name__)

_UNLOGGED = ("/healthz", "/readyz", "/metrics")
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")


class Watch:
    """Counts, times and logs every request; counts by its route, never by its path, so that there are few series.

    Each has an id, the caller's own or a new one: it is in the answer (X-Request-ID) and in the log.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = time.perf_counter()
        status = 500
        given = Headers(scope=scope).get("x-request-id", "")
        request_id = given if _REQUEST_ID.fullmatch(given) else secrets.token_hex(8)
        scope.setdefault("state", {})["request_id"] = request_id

        async def noted(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message)["X-Request-ID"] = request_id
            await send(message)

        with span(scope["method"], parent=Headers(scope=scope).get("traceparent")) as further:
            try:
                await self._app(scope, receive, noted)
            finally:
                took_s = time.perf_counter() - started
                further.update(self._note(scope, status, took_s, request_id))

    def _note(self, scope: Scope, status: int, took_s: float, request_id: str) -> dict[str, object]:
        """Count and log a request; return the attributes of its span."""
        route = getattr(scope.get("route"), "path", "none")
        self._metrics.requests.labels(scope["method"], route, status).inc()
        self._metrics.seconds.labels(scope["method"], route).observe(took_s)
        if scope["path"] not in _UNLOGGED:
            fields = {
                "request_id": request_id,
                "method": scope["method"],
                "path": scope["path"],
                "route": route,
                "status": status,
                "ms": round(1e3 * took_s, 1),
                "caller": scope["state"].get("caller"),
                "address": (scope.get("client") or (None,))[0],
            }
            log.info("%s %s %d", scope["method"], scope["path"], status, extra=fields)
        return {
            "name": f"{scope['method']} {route}",
            "http.request.method": scope["method"],
            "http.route": route,
            "http.response.status_code": status,
        }


status = operations("status")


@status.get("/status")
def get_status(request: Request, ground: GroundOf, _: Viewer) -> ServiceStatus:
    """Show the condition of the deployment: waiting work, disk, backups, time correlations, scheduler."""
    return service_status(ground, request.app.state.backups, request.app.state.broker)


probes = APIRouter(include_in_schema=False)


@probes.get("/healthz")
async def healthz() -> Health:
    """Report that the process is alive."""
    return Health(status="ok")


@probes.get("/readyz")
def readyz(request: Request, ground: GroundOf) -> Health:
    """Report that the service can be used: its database and archive can be read and written, and it is not draining."""
    if request.app.state.draining:
        raise Draining
    ground.read(service.list_jobs, JobFilter(limit=1))
    ground.database.require_writable()
    ground.files.require_writable()
    return Health(status="ok")


@probes.get("/metrics")
def metrics(request: Request, ground: GroundOf) -> Response:
    """Figures for Prometheus."""
    answer: Response = request.app.state.metrics.answer(ground)
    return answer
