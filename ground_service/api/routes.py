"""The operations under /api/v1, and those a deployment watches the service with."""

from __future__ import annotations

import asyncio
import hashlib
import queue
import threading
from collections.abc import Iterator
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from ground_service.api import schemas
from ground_service.api.problems import TooLarge
from ground_service.api.security import requires
from ground_service.errors import InvalidInput
from ground_service.processing.verification import STAGES
from ground_service.services import commanding
from ground_service.services import ephemerides as ephemeris_service
from ground_service.services import passes as pass_service
from ground_service.services.ground import Ground
from ground_service.services.ingest import FLOWN, begin_ingest
from ground_service.services.passes import STATE_VALUES
from ground_service.services.users import Caller
from ground_service.store import repository
from ground_service.store.files import StoredFile
from lunar.timescales import parse_utc
from tmtc.dictionary import FAILURES

API_PREFIX = "/api/v1"
FAILURE_NAMES = dict(FAILURES)
UPLOAD_PATHS = (f"{API_PREFIX}/telemetry", f"{API_PREFIX}/ephemerides")

_PROBLEMS: dict[int | str, dict[str, Any]] = {
    status: {"model": schemas.Problem, "content": {"application/problem+json": {}}, "description": text_}
    for status, text_ in (
        (401, "No valid token"),
        (403, "The role does not allow it"),
        (404, "Not found"),
        (409, "Conflict"),
        (413, "Too large"),
        (422, "Invalid input"),
        (503, "Store unavailable"),
    )
}

router = APIRouter(prefix=API_PREFIX, responses=_PROBLEMS)
operations = APIRouter(include_in_schema=False)

Viewer = Annotated[Caller, Depends(requires("viewer"))]
Operator = Annotated[Caller, Depends(requires("operator"))]
Limit = Annotated[int, Query(ge=1, le=1000, description="Items in a page")]
Offset = Annotated[int, Query(ge=0, le=2**31 - 1, description="Items before the page")]
PassId = Annotated[int, Path(ge=1, le=2**31 - 1)]
RowId = Annotated[int, Path(ge=1, le=2**53)]
Key = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        max_length=128,
        description="The same key again gives the same job, not another",
    ),
]
Name = Annotated[str, Query(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]


def ground_of(request: Request) -> Ground:
    """The opened service."""
    ground: Ground = request.app.state.ground
    return ground


GroundOf = Annotated[Ground, Depends(ground_of)]


# Reference ephemerides


@router.post(
    "/ephemerides",
    status_code=201,
    response_model=schemas.Ephemeris,
    openapi_extra={
        "requestBody": {"required": True, "content": {"text/plain": {"schema": {"type": "string"}}}}
    },
)
async def upload_ephemeris(
    request: Request,
    ground: GroundOf,
    caller: Operator,
    name: Name = "reference",
    precedence: Annotated[int, Query(ge=-1000, le=1000)] = 0,
) -> schemas.Ephemeris:
    """Add a reference ephemeris: a CCSDS OEM or an STK .e file as the body."""
    stored = await _stored_body(request)
    row = await run_in_threadpool(
        ephemeris_service.add_ephemeris, ground, stored, name=name, precedence=precedence, actor=caller.name
    )
    return _ephemeris(row)


@router.get("/ephemerides", response_model=schemas.PageOf[schemas.Ephemeris])
def list_ephemerides(ground: GroundOf, _: Viewer, limit: Limit = 100, offset: Offset = 0) -> Any:
    """Reference ephemerides, the newest first."""
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.EPHEMERIDES, limit=limit, offset=offset)
    return _page(page, [_ephemeris(row) for row in page.rows], limit, offset)


# Telemetry


@router.post(
    "/telemetry",
    status_code=202,
    response_model=schemas.IngestAccepted,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def upload_telemetry(
    request: Request,
    response: Response,
    ground: GroundOf,
    caller: Operator,
    spacecraft_id: Annotated[int | None, Query(ge=0, le=1023, description="Needed for bare packets")] = None,
    instance: Annotated[str, Query(min_length=1, max_length=96, pattern=r"^[A-Za-z0-9._@-]+$")] = FLOWN,
    name: Name = "upload",
    idempotency_key: IdempotencyKey = None,
) -> schemas.IngestAccepted:
    """Take a downlink (a stream of CADUs or of space packets) and ingest it."""
    stored = await _stored_body(request)
    if stored.octets == 0:
        raise InvalidInput("body", "", "the octets of a downlink", "nothing")
    job_id = _job_id("ingest", caller, idempotency_key)
    dispatcher = request.app.state.dispatcher

    def enter() -> tuple[int, str]:
        if job_id is not None:
            with ground.database.reading() as connection:
                known = repository.find(connection, repository.JOBS, id=job_id)
            if known is not None:
                return int(known["arguments"]["ingest_id"]), job_id
        ingest_id = begin_ingest(ground, stored, name)
        arguments = {"ingest_id": ingest_id, "spacecraft_id": spacecraft_id, "instance": instance}
        return ingest_id, dispatcher.submit("ingest", arguments, job_id=job_id)

    ingest_id, job = await run_in_threadpool(enter)
    response.headers["Location"] = f"{API_PREFIX}/ingests/{ingest_id}"
    return schemas.IngestAccepted(ingest_id=ingest_id, job_id=job, sha256=stored.sha256, octets=stored.octets)


@router.get("/ingests", response_model=schemas.PageOf[schemas.Ingest])
def list_ingests(ground: GroundOf, _: Viewer, limit: Limit = 100, offset: Offset = 0) -> Any:
    """Ingests, the newest first."""
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.INGESTS, limit=limit, offset=offset)
    return _page(page, [_ingest(row) for row in page.rows], limit, offset)


@router.get("/ingests/{ingest_id}", response_model=schemas.Ingest)
def get_ingest(ground: GroundOf, _: Viewer, ingest_id: RowId) -> schemas.Ingest:
    """One ingest: its state and what was in the file."""
    with ground.database.reading() as connection:
        return _ingest(repository.get(connection, repository.INGESTS, ingest_id, "ingest"))


# Passes


@router.get("/passes", response_model=schemas.PageOf[schemas.PassSummary])
def list_passes(ground: GroundOf, _: Viewer, limit: Limit = 100, offset: Offset = 0) -> Any:
    """Passes, the newest first."""
    page = pass_service.list_passes(ground, limit=limit, offset=offset)
    return _page(page, [_pass(row) for row in page.rows], limit, offset)


@router.post("/passes", status_code=201, response_model=schemas.PassDetail)
def define_pass(ground: GroundOf, _: Operator, given: schemas.PassDefinition) -> schemas.PassDetail:
    """Keep an interval of a spacecraft's time as a pass."""
    pass_id = pass_service.define_pass(
        ground,
        name=given.name,
        start_utc_ns=parse_utc(given.start),
        stop_utc_ns=parse_utc(given.stop),
        spacecraft_id=given.spacecraft_id,
        instance=given.instance,
    )
    return get_pass(ground, _, pass_id)


@router.get("/passes/{pass_id}", response_model=schemas.PassDetail)
def get_pass(ground: GroundOf, _: Viewer, pass_id: PassId) -> schemas.PassDetail:
    """One pass with its manifest and the reports made of it."""
    row = pass_service.get_pass(ground, pass_id)
    return schemas.PassDetail(
        **_pass(row).model_dump(),
        spacecraft_id=row["spacecraft_id"],
        instance=row["instance"],
        archive_sha256=row["archive_digest"],
        manifest=row["manifest"],
        reports=row["reports"],
    )


@router.get("/passes/{pass_id}/completeness", response_model=schemas.Completeness)
def get_completeness(ground: GroundOf, _: Viewer, pass_id: PassId) -> schemas.Completeness:
    """Packets of a pass that came and that did not."""
    found = pass_service.completeness(ground, pass_id)
    return schemas.Completeness(
        packets=found.packets,
        lost=found.lost,
        duplicates=found.duplicates,
        conflicts=found.conflicts,
        crc_errors=found.crc_errors,
        octets_skipped=found.octets_skipped,
        frames_bad=found.frames_bad,
        symbols_corrected=found.symbols_corrected,
        by_apid=[
            schemas.ApidCompleteness(
                apid=apid, name=one.name, packets=one.packets, lost=one.lost, conflicts=one.conflicts
            )
            for apid, one in sorted(found.by_apid.items())
        ],
    )


@router.get("/passes/{pass_id}/detections", response_model=schemas.PageOf[schemas.DetectionItem])
def get_detections(
    ground: GroundOf, _: Viewer, pass_id: PassId, limit: Limit = 100, offset: Offset = 0
) -> Any:
    """Detections of a pass in time order."""
    items, total = pass_service.detections(ground, pass_id, limit=limit, offset=offset)
    return schemas.PageOf[schemas.DetectionItem](
        items=[
            schemas.DetectionItem(
                frame_number=item.frame_number,
                time=schemas.time_text(item.utc_ns),
                u_px=item.u_px,
                v_px=item.v_px,
                diameter_px=item.diameter_px,
                score=item.score,
                size_class=item.size_class,
            )
            for item in items
        ],
        total=total,
        limit=limit,
        offset=offset,
    )


@router.get("/passes/{pass_id}/states", response_model=schemas.States)
def get_states(
    ground: GroundOf,
    _: Viewer,
    pass_id: PassId,
    estimator: Annotated[str, Query(max_length=40, examples=["spherical"])] = "paper",
    value: Annotated[list[str] | None, Query(max_length=len(STATE_VALUES))] = None,
    max_points: Annotated[int, Query(ge=1, le=10_000)] = 1000,
) -> schemas.States:
    """Series of one estimator's states, made short: least, greatest and mean value per stretch, gaps marked."""
    names = tuple(value) if value else ("latitude_deg", "longitude_deg", "altitude_m")
    found = pass_service.state_series(ground, pass_id, estimator, names, max_points)
    return schemas.States(estimator=estimator, series=[_series(one) for one in found])


@router.get("/passes/{pass_id}/events", response_model=schemas.PageOf[schemas.EventItem])
def get_events(ground: GroundOf, _: Viewer, pass_id: PassId, limit: Limit = 100, offset: Offset = 0) -> Any:
    """Event reports of a pass in time order."""
    found = pass_service.events(ground, pass_id)
    return schemas.PageOf[schemas.EventItem](
        items=[
            schemas.EventItem(
                time=schemas.time_text(event.utc_ns),
                severity=event.severity,
                name=event.name,
                detail=event.detail,
            )
            for event in found[offset : offset + limit]
        ],
        total=len(found),
        limit=limit,
        offset=offset,
    )


@router.get("/passes/{pass_id}/telemetry/{parameter}", response_model=schemas.SeriesOut)
def get_parameter(
    ground: GroundOf,
    _: Viewer,
    pass_id: PassId,
    parameter: Annotated[str, Path(max_length=64)],
    max_points: Annotated[int, Query(ge=1, le=10_000)] = 1000,
) -> schemas.SeriesOut:
    """The series of one housekeeping parameter."""
    return _series(pass_service.parameter_series(ground, pass_id, parameter, max_points))


# Telecommands


@router.get("/telecommands", response_model=schemas.PageOf[schemas.Telecommand])
def list_telecommands(
    ground: GroundOf,
    _: Viewer,
    state: Annotated[str | None, Query(pattern="^(queued|released|rejected|sent)$")] = None,
    limit: Limit = 100,
    offset: Offset = 0,
) -> Any:
    """Telecommands with their verification, the newest first."""
    views, total = commanding.list_commands(ground, state=state, limit=limit, offset=offset)
    return {"items": [_telecommand(view) for view in views], "total": total, "limit": limit, "offset": offset}


@router.post("/telecommands", status_code=201, response_model=schemas.Telecommand)
def enter_telecommand(ground: GroundOf, caller: Operator, given: schemas.CommandEntry) -> schemas.Telecommand:
    """Queue a telecommand; the dictionary has to accept it."""
    command_id = commanding.enter_command(
        ground,
        given.name,
        given.arguments,
        spacecraft_id=given.spacecraft_id,
        instance=given.instance,
        timeout_s=given.timeout_s,
        actor=caller.name,
    )
    return _telecommand(commanding.get_command(ground, command_id))


@router.get("/telecommands/{command_id}", response_model=schemas.Telecommand)
def get_telecommand(ground: GroundOf, _: Viewer, command_id: RowId) -> schemas.Telecommand:
    """One telecommand with its verification."""
    return _telecommand(commanding.get_command(ground, command_id))


@router.post("/telecommands/{command_id}/release", response_model=schemas.Telecommand)
def release_telecommand(ground: GroundOf, caller: Operator, command_id: RowId) -> schemas.Telecommand:
    """Release a queued telecommand; a critical one by another person than who entered it."""
    commanding.release_command(ground, command_id, actor=caller.name)
    return _telecommand(commanding.get_command(ground, command_id))


@router.post("/telecommands/{command_id}/reject", response_model=schemas.Telecommand)
def reject_telecommand(
    ground: GroundOf, caller: Operator, command_id: RowId, given: schemas.Rejection
) -> schemas.Telecommand:
    """Take a queued telecommand out of the queue."""
    commanding.reject_command(ground, command_id, actor=caller.name, reason=given.reason)
    return _telecommand(commanding.get_command(ground, command_id))


@router.post(
    "/uplink",
    response_class=Response,
    responses={200: {"content": {"application/octet-stream": {}}, "description": "What is to be sent now"}},
)
def take_uplink(
    ground: GroundOf,
    caller: Operator,
    spacecraft_id: Annotated[int, Query(ge=0, le=1023)],
    instance: Annotated[str, Query(min_length=1, max_length=96, pattern=r"^[A-Za-z0-9._@-]+$")] = FLOWN,
    format: Annotated[str, Query(pattern="^(cltu|packets)$")] = "cltu",
) -> Response:
    """Take all released telecommands as octets to radiate; they count as sent from then on."""
    stream, ids = commanding.take_uplink(
        ground, spacecraft_id=spacecraft_id, instance=instance, framed=format == "cltu", actor=caller.name
    )
    return Response(
        stream,
        media_type="application/octet-stream",
        headers={"X-Telecommands": ",".join(str(number) for number in ids)},
    )


# Reports and jobs


@router.post("/passes/{pass_id}/reports", status_code=202, response_model=schemas.Job)
def request_report(
    request: Request,
    response: Response,
    ground: GroundOf,
    caller: Operator,
    pass_id: PassId,
    idempotency_key: IdempotencyKey = None,
) -> schemas.Job:
    """Have a report of a pass made."""
    pass_service.get_pass(ground, pass_id)
    job_id = request.app.state.dispatcher.submit(
        "report", {"pass_id": pass_id}, job_id=_job_id(f"report {pass_id}", caller, idempotency_key)
    )
    response.headers["Location"] = f"{API_PREFIX}/jobs/{job_id}"
    return get_job(ground, caller, job_id)


@router.get("/jobs", response_model=schemas.PageOf[schemas.Job])
def list_jobs(ground: GroundOf, _: Viewer, limit: Limit = 100, offset: Offset = 0) -> Any:
    """Jobs, the newest first."""
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.JOBS, limit=limit, offset=offset)
    return _page(page, [_job(row) for row in page.rows], limit, offset)


@router.get("/jobs/{job_id}", response_model=schemas.Job)
def get_job(ground: GroundOf, _: Viewer, job_id: Key) -> schemas.Job:
    """One job: its state, and its result when it is done."""
    with ground.database.reading() as connection:
        return _job(repository.get(connection, repository.JOBS, job_id, "job"))


@router.get(
    "/reports/{report_id}",
    response_class=Response,
    responses={200: {"content": {"text/html": {}, "application/json": {}}, "description": "The report"}},
)
def get_report(
    request: Request,
    ground: GroundOf,
    _: Viewer,
    report_id: Key,
    format: Annotated[
        str | None, Query(pattern="^(html|json)$", description="Default: by the Accept header")
    ] = None,
) -> Response:
    """A report as HTML or JSON."""
    with ground.database.reading() as connection:
        row = repository.get(connection, repository.REPORTS, report_id, "report")
    wants_html = "text/html" in request.headers.get("accept", "")
    kind = format or ("html" if wants_html else "json")
    media = "text/html; charset=utf-8" if kind == "html" else "application/json"
    return Response(ground.files.get(row[f"{kind}_sha256"]), media_type=media)


# Watching the service


@operations.get("/healthz")
def healthz() -> schemas.Health:
    """The process lives."""
    return schemas.Health(status="ok")


@operations.get("/readyz")
def readyz(ground: GroundOf) -> schemas.Health:
    """The service can be used: its database answers."""
    with ground.database.reading() as connection:
        repository.page(connection, repository.JOBS, limit=1)
    return schemas.Health(status="ok")


@operations.get("/metrics")
def metrics(request: Request, ground: GroundOf) -> Response:
    """Figures for Prometheus."""
    return request.app.state.metrics.answer(ground)


async def _stored_body(request: Request) -> StoredFile:
    """The body, streamed into the archive of files with bounded memory."""
    ground = ground_of(request)
    limit: int = request.app.state.upload_limit_octets
    blocks: queue.Queue[bytes | BaseException | None] = queue.Queue(maxsize=8)
    stopped = threading.Event()

    def take() -> Iterator[bytes]:
        while True:
            block = blocks.get()
            if block is None:
                return
            if isinstance(block, BaseException):
                raise block
            yield block

    def store() -> StoredFile:
        try:
            return ground.files.put(take())
        finally:
            stopped.set()

    def hand_over(block: bytes | BaseException | None) -> None:
        while not stopped.is_set():
            try:
                blocks.put(block, timeout=0.2)
                return
            except queue.Full:
                continue

    task = asyncio.create_task(run_in_threadpool(store))
    taken = 0
    try:
        async for block in request.stream():
            taken += len(block)
            if taken > limit:
                raise TooLarge(f"body: expected at most {limit} octets")
            if block:
                try:
                    blocks.put_nowait(block)
                except queue.Full:
                    await run_in_threadpool(hand_over, block)
    except BaseException as error:
        await run_in_threadpool(hand_over, error)
        await asyncio.gather(task, return_exceptions=True)
        raise
    await run_in_threadpool(hand_over, None)
    return await task


def _job_id(what: str, caller: Caller, key: str | None) -> str | None:
    """The id of the job that an idempotency key of this caller stands for."""
    if key is None:
        return None
    return hashlib.sha256(f"{caller.name}\0{what}\0{key}".encode()).hexdigest()[:32]


def _page(page: repository.Page, items: list[Any], limit: int, offset: int) -> dict[str, Any]:
    return {"items": items, "total": page.total, "limit": limit, "offset": offset}


def _ephemeris(row: repository.Row) -> schemas.Ephemeris:
    return schemas.Ephemeris(
        id=row["id"],
        name=row["name"],
        object_name=row["object_name"],
        frame=row["frame"],
        start=schemas.time_text(row["start_utc_ns"]),
        stop=schemas.time_text(row["stop_utc_ns"]),
        states=row["states"],
        precedence=row["precedence"],
        sha256=row["file_sha256"],
    )


def _ingest(row: repository.Row) -> schemas.Ingest:
    return schemas.Ingest(
        id=row["id"],
        state=row["state"],
        sha256=row["file_sha256"],
        received=schemas.time_text(row["received_utc_ns"]),
        finished=schemas.rfc3339(row["finished_utc_ns"]),
        error=row["error"],
        dictionary_version=row["dictionary_version"],
        accounting=row["accounting"],
    )


def _pass(row: repository.Row) -> schemas.PassSummary:
    return schemas.PassSummary(
        id=row["id"],
        name=row["name"],
        start=schemas.time_text(row["start_utc_ns"]),
        stop=schemas.time_text(row["stop_utc_ns"]),
    )


def _telecommand(view: commanding.CommandView) -> schemas.Telecommand:
    row, fate = view.row, view.fate
    failures = FAILURE_NAMES
    return schemas.Telecommand(
        id=row["id"],
        name=row["name"],
        arguments=row["arguments"],
        spacecraft_id=view.spacecraft_id,
        instance=view.instance,
        state=view.state,
        critical=bool(row["critical"]),
        timed_out=fate is not None and fate.timed_out,
        requested_by=row["requested_by"],
        requested=schemas.time_text(row["created_utc_ns"]),
        decided_by=row["decided_by"],
        decided=schemas.rfc3339(row["decided_utc_ns"]),
        reason=row["reason"],
        sequence_count=row["sequence_count"],
        sent=schemas.rfc3339(row["sent_utc_ns"]),
        reports=[
            schemas.CommandReport(
                stage=STAGES.get(report.subtype, str(report.subtype)),
                ticks=report.ticks,
                step=report.step,
                failure=None
                if report.failure_code is None
                else failures.get(report.failure_code, str(report.failure_code)),
            )
            for report in (fate.reports if fate is not None else ())
        ],
    )


def _job(row: repository.Row) -> schemas.Job:
    return schemas.Job(
        id=row["id"],
        kind=row["kind"],
        state=row["state"],
        progress=row["progress"],
        attempts=row["attempts"],
        arguments=row["arguments"],
        result=row["result"],
        error=row["error"],
        created=schemas.time_text(row["created_utc_ns"]),
        started=schemas.rfc3339(row["started_utc_ns"]),
        finished=schemas.rfc3339(row["finished_utc_ns"]),
    )


def _series(series: pass_service.Series) -> schemas.SeriesOut:
    buckets = series.buckets
    columns = (
        buckets.start_utc_ns,
        buckets.stop_utc_ns,
        buckets.count,
        buckets.low,
        buckets.high,
        buckets.mean,
        buckets.after_gap,
    )
    return schemas.SeriesOut(
        name=series.name,
        unit=series.unit,
        samples=series.samples,
        correlation_id=series.correlation_id,
        buckets=[
            schemas.Bucket(
                start=schemas.time_text(start),
                stop=schemas.time_text(stop),
                count=count,
                min=low,
                max=high,
                mean=mean,
                after_gap=gap,
            )
            for start, stop, count, low, high, mean, gap in zip(*(c.tolist() for c in columns), strict=True)
        ],
    )
