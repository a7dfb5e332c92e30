"""The operations on telemetry, ephemerides, passes, jobs and reports under /api/v1."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from starlette.responses import JSONResponse

from ground_service.access.idempotency import once
from ground_service.clock import utc_now_ns
from ground_service.ephemerides import service as ephemeris_service
from ground_service.errors import InvalidInput, NotFound
from ground_service.evaluation.report_overview import report_overview
from ground_service.evaluation.service import pass_summary
from ground_service.http import schemas
from ground_service.http.common import (
    API_PREFIX,
    PROBLEMS,
    GroundOf,
    IdempotencyKey,
    Instance,
    Key,
    Limit,
    Name,
    Offset,
    OnceKey,
    Operator,
    PassId,
    RowId,
    SpacecraftId,
    Viewer,
    idempotent_id,
    page_of,
)
from ground_service.http.requests import StrictRoute
from ground_service.http.times import time_of
from ground_service.http.uploads import UploadOf
from ground_service.http.views import (
    ephemeris_view,
    ingest_view,
    job_view,
    pass_detail_view,
    pass_view,
    series_view,
    time_text,
)
from ground_service.ingest.service import FLOWN, Place, enter_ingest
from ground_service.passes import service as pass_service
from ground_service.passes.series import STATE_VALUES
from ground_service.store import repository
from ground_service.worker.upkeep import spacecraft_trends, trend_view

UPLOAD_PATHS = tuple(f"{API_PREFIX}/{name}" for name in ("telemetry", "ephemerides", "archives"))

REPORT_MEDIA = {"html": "text/html", "pdf": "application/pdf", "json": "application/json"}

router = APIRouter(route_class=StrictRoute, prefix=API_PREFIX, responses=PROBLEMS)


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
    upload: UploadOf,
    ground: GroundOf,
    caller: Operator,
    name: Name = "reference",
    precedence: Annotated[int, Query(ge=-1000, le=1000)] = 0,
) -> Any:
    """Add a reference ephemeris: a CCSDS OEM or an STK .e file as the body."""
    stored = await upload.stored()

    def add() -> dict[str, Any]:
        row = ephemeris_service.add_ephemeris(
            ground, stored, name=name, precedence=precedence, actor=caller.name
        )
        return ephemeris_view(row)

    return await upload.run(add)


@router.get("/ephemerides", response_model=schemas.PageOf[schemas.Ephemeris])
def list_ephemerides(ground: GroundOf, _: Viewer, limit: Limit = 100, offset: Offset = 0) -> Any:
    """Reference ephemerides, the newest first."""
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.EPHEMERIDES, limit=limit, offset=offset)
    return page_of([ephemeris_view(row) for row in page.rows], page.total, limit, offset)


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
    upload: UploadOf,
    ground: GroundOf,
    caller: Operator,
    spacecraft_id: Annotated[int | None, Query(ge=0, le=1023, description="Needed for bare packets")] = None,
    instance: Instance = FLOWN,
    name: Name = "upload",
    stream: Annotated[
        str | None,
        Query(
            min_length=1,
            max_length=200,
            pattern=r"^[^\x00-\x1f\x7f]*$",
            description="Stream to which the octets belong; requires `offset`",
        ),
    ] = None,
    offset: Annotated[
        int | None, Query(ge=0, lt=1 << 62, description="Offset of the piece in `stream`, in octets")
    ] = None,
    idempotency_key: IdempotencyKey = None,
) -> schemas.IngestAccepted:
    """Ingest a downlink, or a piece of one cut at any octet.

    A downlink is a stream of CADUs or of space packets. Pieces are joined by `stream` and `offset` if given, otherwise
    by order of arrival and by content.
    """
    if (stream is None) != (offset is None):
        raise InvalidInput("telemetry", "stream, offset", "both or neither", "one of them")
    place = None if stream is None or offset is None else Place(stream, offset)
    stored = await upload.stored()
    if stored.octets == 0:
        raise InvalidInput("body", "", "the octets of a downlink", "nothing")
    job_id = idempotent_id("ingest", caller, idempotency_key)
    dispatcher = request.app.state.dispatcher

    def enter() -> tuple[int, str]:
        ingest_id, job = enter_ingest(
            ground,
            stored,
            name,
            spacecraft_id=spacecraft_id,
            instance=instance,
            place=place,
            job_id=job_id,
        )
        dispatcher.start(job)
        return ingest_id, job

    ingest_id, job = await upload.run(enter)
    response.headers["Location"] = f"{API_PREFIX}/ingests/{ingest_id}"
    return schemas.IngestAccepted(ingest_id=ingest_id, job_id=job, sha256=stored.sha256, octets=stored.octets)


@router.post(
    "/archives",
    status_code=202,
    response_model=schemas.Job,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def upload_archive(
    request: Request,
    response: Response,
    upload: UploadOf,
    ground: GroundOf,
    caller: Operator,
    name: Name = "archive.zip",
    idempotency_key: IdempotencyKey = None,
) -> Any:
    """Take a zipped pass archive (manifest, downlink, reference, catalogue, images) and import it."""
    stored = await upload.stored()
    job_id = idempotent_id("archive", caller, idempotency_key)
    dispatcher = request.app.state.dispatcher

    def enter() -> str:
        with ground.database.writing() as connection:
            repository.register_file(connection, stored, "archive", name, utc_now_ns())
        return str(dispatcher.submit("archive", {"sha256": stored.sha256, "name": name}, job_id=job_id))

    job = await upload.run(enter)
    response.headers["Location"] = f"{API_PREFIX}/jobs/{job}"
    return await upload.run(get_job, ground, caller, job)


@router.get("/ingests", response_model=schemas.PageOf[schemas.Ingest])
def list_ingests(ground: GroundOf, _: Viewer, limit: Limit = 100, offset: Offset = 0) -> Any:
    """Ingests, the newest first."""
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.INGESTS, limit=limit, offset=offset)
    return page_of([ingest_view(row) for row in page.rows], page.total, limit, offset)


@router.get("/ingests/{ingest_id}", response_model=schemas.Ingest)
def get_ingest(ground: GroundOf, _: Viewer, ingest_id: RowId) -> Any:
    """One ingest: its state and what was in the file."""
    with ground.database.reading() as connection:
        return ingest_view(repository.get(connection, repository.INGESTS, ingest_id, "ingest"))


# Passes


@router.get("/passes", response_model=schemas.PageOf[schemas.PassSummary])
def list_passes(ground: GroundOf, _: Viewer, limit: Limit = 100, offset: Offset = 0) -> Any:
    """Passes, the newest first."""
    page = pass_service.list_passes(ground, limit=limit, offset=offset)
    return page_of([pass_view(row) for row in page.rows], page.total, limit, offset)


@router.post("/passes", status_code=201, response_model=schemas.PassDetail)
def define_pass(
    ground: GroundOf, caller: Operator, given: schemas.PassDefinition, idempotency_key: OnceKey = None
) -> Any:
    """Keep an interval of a spacecraft's time as a pass."""

    def define() -> dict[str, Any]:
        pass_id = pass_service.define_pass(
            ground,
            name=given.name,
            start_utc_ns=time_of(given.start, "start"),
            stop_utc_ns=time_of(given.stop, "stop"),
            spacecraft_id=given.spacecraft_id,
            instance=given.instance,
        )
        return pass_detail_view(pass_service.get_pass(ground, pass_id))

    return once(
        ground,
        actor=caller.name,
        operation="pass",
        key=idempotency_key,
        request=given.model_dump(mode="json"),
        work=define,
    )


@router.get("/passes/{pass_id}", response_model=schemas.PassDetail)
def get_pass(ground: GroundOf, _: Viewer, pass_id: PassId) -> Any:
    """One pass with its manifest and the reports made of it."""
    return pass_detail_view(pass_service.get_pass(ground, pass_id))


@router.get("/passes/{pass_id}/summary")
def get_summary(ground: GroundOf, _: Viewer, pass_id: PassId) -> dict[str, Any]:
    """The figures of a pass, evaluated now: frames, packets, detector, navigation and baselines."""
    return pass_summary(ground, pass_id)


@router.get("/passes/{pass_id}/completeness", response_model=schemas.Completeness)
def get_completeness(ground: GroundOf, _: Viewer, pass_id: PassId) -> schemas.Completeness:
    """Packets of a pass that came and that did not."""
    found = pass_service.completeness(ground, pass_id)
    return schemas.Completeness(
        packets=found.packets,
        expected=found.expected,
        lost=found.lost,
        lost_at_edges=found.lost_at_edges,
        duplicates=found.duplicates,
        conflicts=found.conflicts,
        crc_errors=found.crc_errors,
        octets_skipped=found.octets_skipped,
        frames=found.frames,
        frames_bad=found.frames_bad,
        symbols_corrected=found.symbols_corrected,
        by_apid=[
            schemas.ApidCompleteness(
                apid=apid,
                name=one.name,
                packets=one.packets,
                lost=one.lost,
                lost_at_edges=one.lost_at_edges,
                duplicates=one.duplicates,
                conflicts=one.conflicts,
                crc_errors=one.crc_errors,
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
                time=time_text(item.utc_ns),
                u_px=item.u_px,
                v_px=item.v_px,
                diameter_px=item.diameter_px,
                score=item.score,
                size_class=item.size_class,
                correlation_id=item.correlation_id,
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
) -> Any:
    """Series of one estimator's states, made short: least, greatest and mean value per stretch, gaps marked."""
    names = tuple(value) if value else ("latitude_deg", "longitude_deg", "altitude_m")
    document = pass_service.states_document(ground, pass_id, estimator, names, max_points)
    return Response(document, media_type="application/json")


@router.get("/passes/{pass_id}/events", response_model=schemas.PageOf[schemas.EventItem])
def get_events(ground: GroundOf, _: Viewer, pass_id: PassId, limit: Limit = 100, offset: Offset = 0) -> Any:
    """Event reports of a pass in time order."""
    found = pass_service.events(ground, pass_id)
    return schemas.PageOf[schemas.EventItem](
        items=[
            schemas.EventItem(
                time=time_text(event.utc_ns),
                severity=event.severity,
                name=event.name,
                detail=event.detail,
                correlation_id=event.correlation_id,
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
) -> Any:
    """The series of one housekeeping parameter."""
    document = pass_service.parameter_document(ground, pass_id, parameter, max_points)
    return Response(document, media_type="application/json")


@router.get("/spacecraft/{spacecraft_id}/telemetry/{parameter}", response_model=schemas.SeriesOut)
def get_trend(
    ground: GroundOf,
    _: Viewer,
    spacecraft_id: SpacecraftId,
    parameter: Annotated[str, Path(max_length=64)],
    instance: Instance = FLOWN,
    start: Annotated[str | None, Query(max_length=40)] = None,
    stop: Annotated[str | None, Query(max_length=40)] = None,
    max_points: Annotated[int, Query(ge=1, le=10_000)] = 1000,
) -> Any:
    """The series of one housekeeping parameter over any span: its trend."""
    found = pass_service.trend_series(
        ground,
        spacecraft_id,
        instance,
        parameter,
        max_points,
        start_utc_ns=None if start is None else time_of(start, "start"),
        stop_utc_ns=None if stop is None else time_of(stop, "stop"),
    )
    return JSONResponse(series_view(found))


# Reports and jobs


@router.post("/passes/{pass_id}/reports", status_code=202, response_model=schemas.Job)
def request_report(
    request: Request,
    response: Response,
    ground: GroundOf,
    caller: Operator,
    pass_id: PassId,
    idempotency_key: IdempotencyKey = None,
) -> Any:
    """Have a report of a pass made."""
    pass_service.get_pass(ground, pass_id)
    job_id = request.app.state.dispatcher.submit(
        "report", {"pass_id": pass_id}, job_id=idempotent_id(f"report {pass_id}", caller, idempotency_key)
    )
    response.headers["Location"] = f"{API_PREFIX}/jobs/{job_id}"
    return get_job(ground, caller, job_id)


@router.get("/jobs", response_model=schemas.PageOf[schemas.Job])
def list_jobs(
    ground: GroundOf,
    _: Viewer,
    kind: Annotated[str | None, Query(max_length=40, examples=["regression"])] = None,
    limit: Limit = 100,
    offset: Offset = 0,
) -> Any:
    """Jobs, the newest first; those of one kind where it is named."""
    equal: dict[str, Any] = {} if kind is None else {"kind": kind}
    with ground.database.reading() as connection:
        page = repository.page(connection, repository.JOBS, limit=limit, offset=offset, **equal)
    return page_of([job_view(row) for row in page.rows], page.total, limit, offset)


@router.get("/jobs/{job_id}", response_model=schemas.Job)
def get_job(ground: GroundOf, _: Viewer, job_id: Key) -> Any:
    """One job: its state, and its result when it is done."""
    with ground.database.reading() as connection:
        return job_view(repository.get(connection, repository.JOBS, job_id, "job"))


@router.get(
    "/reports/{report_id}",
    response_class=Response,
    responses={200: {"content": {media: {} for media in REPORT_MEDIA.values()}, "description": "The report"}},
)
def get_report(
    request: Request,
    ground: GroundOf,
    _: Viewer,
    report_id: Key,
    format: Annotated[
        Literal["html", "pdf", "json"] | None, Query(description="Default: by the Accept header")
    ] = None,
) -> Response:
    """A report as HTML, PDF or JSON."""
    with ground.database.reading() as connection:
        row = repository.get(connection, repository.REPORTS, report_id, "report")
    kind = format or preferred_kind(request.headers.get("accept", ""))
    sha256 = row[f"{kind}_sha256"]
    if sha256 is None:
        raise NotFound(f"report {report_id} as", kind)
    media = REPORT_MEDIA[kind] + ("; charset=utf-8" if kind == "html" else "")
    return Response(ground.files.get(sha256), media_type=media)


def preferred_kind(accept: str) -> str:
    """The kind of document that an Accept header likes best; JSON where it does not say."""
    best, weight = "json", 0.0
    for part in accept.split(","):
        media, *parameters = (piece.strip() for piece in part.split(";"))
        quality = next((text[2:] for text in parameters if text.startswith("q=")), "1")
        try:
            value = float(quality)
        except ValueError:
            continue
        kind = next((kind for kind, name in REPORT_MEDIA.items() if name == media.lower()), None)
        if kind is not None and value > weight:
            best, weight = kind, value
    return best


@router.get("/reports/{report_id}/summary")
def get_report_summary(ground: GroundOf, _: Viewer, report_id: Key) -> dict[str, Any]:
    """The figures of a report."""
    with ground.database.reading() as connection:
        summary: dict[str, Any] = repository.get(connection, repository.REPORTS, report_id, "report")[
            "summary"
        ]
    return summary


@router.get("/reports/{report_id}/overview", response_model=schemas.ReportOverview)
def get_report_overview(
    ground: GroundOf,
    _: Viewer,
    report_id: Key,
    max_points: Annotated[int, Query(ge=1, le=10_000)] = 600,
) -> Any:
    """What a page shows of a report: verdict, headline figures, and the 3-D error of every solution made short."""
    return JSONResponse(report_overview(ground, report_id, max_points))


@router.get("/spacecraft/{spacecraft_id}/trends", response_model=list[schemas.Trend])
def get_trends(ground: GroundOf, _: Viewer, spacecraft_id: SpacecraftId, instance: Instance = FLOWN) -> Any:
    """Housekeeping parameters over the last 30 days of on-board time: statistics, slope, worst limit state."""
    return [trend_view(trend) for trend in spacecraft_trends(ground, spacecraft_id, instance)]
