"""The application: `create_app` joins the service, its dispatcher and the routes."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from anyio import to_thread
from fastapi import FastAPI
from starlette.concurrency import run_in_threadpool
from starlette.routing import Route

from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.commanding.service import note_timeouts
from ground_service.errors import GroundError
from ground_service.ground import ground_from_settings
from ground_service.http import problems
from ground_service.http.common import API_PREFIX
from ground_service.http.limits import BodyLimit, HeadersAndTags, RateLimit, SharedBudgets
from ground_service.http.openapi import DescribedApi
from ground_service.http.origins import LOOPBACK, SameOrigin
from ground_service.http.proxies import ForwardedHeaders, TrustedProxies
from ground_service.http.requests import PlainText
from ground_service.http.uploads import UploadPool
from ground_service.links.supervisor import LinkSupervisor
from ground_service.planning.standing import needs_plan
from ground_service.routers import OPERATIONS
from ground_service.settings import Settings
from ground_service.web.displays import FOLDER, displays
from ground_service.web.documentation import documentation
from ground_service.web.live import live
from ground_service.web.pages import pages
from ground_service.web.payload_console import payload_console
from ground_service.web.sockets import Sockets
from ground_service.worker.dispatch import dispatcher_for
from ground_service.worker.follow_up import follow_in_process
from ground_service.worker.jobs import enter_redecoding
from ground_service.worker.metrics import Metrics, Watch
from ground_service.worker.routes import operations
from ground_service.worker.upkeep import nightly_job_id, plan_job_id

log = logging.getLogger(__name__)

DAY_NS = 86_400_000_000_000
NIGHT_NS = 1_800_000_000_000
"""The nightly job is entered at 00:30 UTC."""

CATCH_UP_S = 60.0
"""A service that was not running then enters it so long after its start."""

SWEEP_S = 15.0

SQLITE_THREADS = 4
SERVER_THREADS = 20


def create_app(settings: Settings, *, inline_jobs: bool = False) -> FastAPI:
    """The HTTP application of a deployment.

    Parameters
    ----------
    inline_jobs
        Do jobs before the answer is sent (without a broker only), for tests and scripts.
    """

    budgets = shared_budgets(settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        ground = ground_from_settings(settings)
        app.state.ground = ground
        app.state.uploads = UploadPool(settings.uploads_at_once)
        # Together with the threads of uploads, jobs and the feed, not more than the connections to the database.
        threads = SQLITE_THREADS if ground.database.dialect == "sqlite" else SERVER_THREADS
        to_thread.current_default_thread_limiter().total_tokens = threads
        app.state.dispatcher = dispatcher_for(ground, settings, inline=inline_jobs)
        app.state.follow_up = follow_in_process(ground, app.state.dispatcher.start)
        for job in enter_redecoding(ground):
            log.warning("decoding the archive again with a newer dictionary: job %s", job)
            app.state.dispatcher.start(job)
        if inline_jobs or settings.resolved_broker_url() is None:
            app.state.dispatcher.resume()
        app.state.follow_up.drain()
        supervisor = LinkSupervisor(ground) if settings.links else None
        if supervisor is not None:
            supervisor.start()
        app.state.sockets = Sockets(
            ground,
            open_without_users=app.state.open_without_users,
            per_user=settings.sockets_per_user,
            total=settings.sockets,
        )
        chores = [
            asyncio.create_task(work)
            for work in (_nights(app, settings), _sweeps(app), app.state.sockets.run())
        ]
        try:
            yield
        finally:
            for chore in chores:
                chore.cancel()
            await asyncio.gather(*chores, return_exceptions=True)
            if supervisor is not None:
                await asyncio.to_thread(supervisor.stop)
            await asyncio.to_thread(app.state.uploads.close)
            app.state.dispatcher.close()
            ground.close()
            if budgets is not None:
                await budgets.close()

    app = DescribedApi(
        title="LINNA ground service",
        version="1",
        summary="Ingest, archive and evaluation of crater-based navigation",
        openapi_url=f"{API_PREFIX}/openapi.json",
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
    )
    app.state.open_without_users = settings.host in LOOPBACK
    app.state.live_console = settings.resolved_live_console()
    app.state.openmct = settings.openmct or FOLDER
    app.state.upload_limit_octets = settings.upload_limit_mib << 20
    routers = (*(one.load() for one in OPERATIONS), operations, pages, displays, documentation)
    for one in (*routers, live, payload_console):
        app.include_router(one)
    app.state.operations = [route for one in routers for route in one.routes if isinstance(route, Route)]
    app.state.metrics = Metrics()
    problems.install(app)
    _add_middleware(app, settings, budgets)
    return app


def _add_middleware(app: FastAPI, settings: Settings, budgets: SharedBudgets | None) -> None:
    """Add what runs around each request; the last one added runs first."""
    app.add_middleware(
        BodyLimit,
        upload_paths=tuple(
            path for one in OPERATIONS for path in getattr(one.imported(), "UPLOAD_PATHS", ())
        ),
        upload_limit_octets=settings.upload_limit_mib << 20,
    )
    app.add_middleware(RateLimit, per_second=settings.rate_limit_per_s, budgets=budgets)
    app.add_middleware(PlainText)
    app.add_middleware(SameOrigin, hosts=(settings.host, *settings.allowed_hosts), api_prefix=API_PREFIX)
    app.add_middleware(HeadersAndTags)
    app.add_middleware(Watch, metrics=app.state.metrics)
    app.add_middleware(ForwardedHeaders, proxies=TrustedProxies(settings.trusted_proxies))


def shared_budgets(settings: Settings) -> SharedBudgets | None:
    """Return the rate limit budgets that API processes share in a Redis broker; None without one."""
    broker = settings.resolved_broker_url()
    if settings.rate_limit_per_s <= 0.0 or broker is None or not broker.startswith(("redis://", "rediss://")):
        return None
    return SharedBudgets(broker, settings.rate_limit_per_s)


async def _nights(app: FastAPI, settings: Settings) -> None:
    """Enter the nightly job once a day; it is one job however many servers and schedulers enter it."""
    if settings.resolved_broker_url() is not None:
        return  # the workers' scheduler does it
    wait_s = CATCH_UP_S
    while True:
        left_s = (NIGHT_NS - utc_now_ns() % DAY_NS) % DAY_NS / 1e9
        await asyncio.sleep(min(wait_s, left_s) + 1.0)
        wait_s = DAY_NS / 1e9
        if utc_now_ns() % DAY_NS < NIGHT_NS:
            continue  # the last night's was before this day, and the next is to come
        try:
            await run_in_threadpool(
                app.state.dispatcher.submit,
                "nightly",
                {"retention_days": settings.retention_days},
                job_id=nightly_job_id(utc_now_ns()),
            )
        except GroundError:
            log.exception("the nightly job could not be entered")


def _plan(app: FastAPI) -> None:
    """Enter the job of the plan once an hour of mission time, however many servers do."""
    if needs_plan(app.state.ground):
        app.state.dispatcher.submit("plan", {}, job_id=plan_job_id(mission_now_ns()))


async def _sweeps(app: FastAPI) -> None:
    """Take up, every now and then, jobs that something left unfinished, and note telecommands whose end is overdue."""
    since = utc_now_ns() - DAY_NS
    while True:
        await asyncio.sleep(SWEEP_S)
        try:
            await run_in_threadpool(app.state.dispatcher.resume)
            await run_in_threadpool(app.state.follow_up.drain)
            await run_in_threadpool(_plan, app)
            until = utc_now_ns()
            for command in await run_in_threadpool(note_timeouts, app.state.ground, since, until):
                log.warning("telecommand %d: its end is overdue", command, extra={"telecommand": command})
            since = until
        except GroundError as error:
            log.warning("unfinished work could not be looked after: %s", error)
