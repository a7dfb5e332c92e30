"""HTTP operations on passes, their telemetry, and pass archives."""

from typing import Annotated, Any

from fastapi import Path, Query, Request, Response
from fastapi.responses import JSONResponse

from ground_service.access.security import Operator, UploadOf, Viewer, add_list, added_once, idempotent_id
from ground_service.errors import InvalidInput
from ground_service.http.common import (
    API_PREFIX,
    GroundOf,
    IdempotencyKey,
    Instance,
    Name,
    OnceKey,
    PagingOf,
    PassId,
    SpacecraftId,
    linked,
    upload_body,
)
from ground_service.http.model import PageOf, RequestTime, ns_of
from ground_service.http.requests import operations, problems
from ground_service.jobs.service import DispatcherOf, Job, get_job
from ground_service.passes import archive_import, model, parameters, service, store
from ground_service.passes import live as newest
from ground_service.passes.series import STATE_VALUES, series_document
from ground_service.store.vehicles import FLOWN

EXPORT_MEDIA: dict[model.ExportFormat, str] = {
    "json": "application/json",
    "csv": "text/csv; charset=utf-8",
    "parquet": "application/vnd.apache.parquet",
}
UPLOAD_PATHS = (f"{API_PREFIX}/archives",)

MaxPoints = Annotated[int, Query(ge=1, le=10_000, description="Most intervals of a series")]
Parameter = Annotated[str, Path(max_length=200, examples=["temperature_c"])]

passes = operations("passes")


@passes.post("/archives", status_code=202, openapi_extra=upload_body("Zip file of a pass archive"))
async def upload_archive(
    response: Response,
    upload: UploadOf,
    ground: GroundOf,
    caller: Operator,
    dispatcher: DispatcherOf,
    name: Name = "archive.zip",
    idempotency_key: IdempotencyKey = None,
) -> Job:
    """Import a zipped pass archive: manifest, downlink, reference, catalogue and images."""
    stored = await upload.stored()
    job_id = idempotent_id("archive", caller, idempotency_key)

    def enter() -> Job:
        service.keep_archive(ground, stored, name)
        job = dispatcher.submit("archive", {"sha256": stored.sha256, "name": name}, job_id=job_id)
        return ground.read(get_job, job)

    job = await upload.run(enter)
    response.headers["Location"] = f"{API_PREFIX}/jobs/{job.id}"
    return job


add_list(passes, "/passes", store.list_passes)


@passes.post("/passes", status_code=201)
def define_pass(
    ground: GroundOf, caller: Operator, given: model.PassDefinition, idempotency_key: OnceKey = None
) -> model.PassDetail:
    """Define a pass: an interval of a spacecraft's time."""

    def define() -> model.PassDetail:
        pass_id = service.define_pass(
            ground,
            name=given.name,
            start_utc_ns=given.start.utc_ns,
            stop_utc_ns=given.stop.utc_ns,
            spacecraft_id=given.spacecraft_id,
            instance=given.instance,
        )
        return service.get_pass(ground, pass_id)

    return added_once(ground, model.PassDetail, caller.name, idempotency_key, given, define)


@passes.get("/passes/{pass_id}")
def get_pass(ground: GroundOf, _: Viewer, pass_id: PassId) -> model.PassDetail:
    """Show a pass with its manifest and reports."""
    return service.get_pass(ground, pass_id)


@passes.get("/passes/{pass_id}/completeness")
def get_completeness(ground: GroundOf, _: Viewer, pass_id: PassId) -> model.Completeness:
    """Count the received and missing packets of a pass."""
    return model.Completeness.of_accounting(service.completeness(ground, pass_id))


@passes.get("/passes/{pass_id}/detections")
def list_detections(
    ground: GroundOf, _: Viewer, request: Request, pass_id: PassId, asked: PagingOf
) -> PageOf[model.Detection]:
    """List the detections of a pass, in time order."""
    return linked(request, service.detections(ground, pass_id, asked))


@passes.get("/passes/{pass_id}/states", response_model=model.States)
def get_states(
    ground: GroundOf,
    _: Viewer,
    pass_id: PassId,
    estimator: Annotated[str, Query(max_length=40, examples=["spherical"])] = "paper",
    value: Annotated[list[str] | None, Query(max_length=len(STATE_VALUES))] = None,
    max_points: MaxPoints = 1000,
) -> Response:
    """Return series of one estimator's states: minimum, maximum and mean per interval, gaps marked."""
    names = tuple(value) if value else ("latitude_deg", "longitude_deg", "altitude_m")
    found = service.state_series(ground, pass_id, estimator, names, max_points)
    return JSONResponse({"estimator": estimator, "series": [series_document(one) for one in found]})


@passes.get("/passes/{pass_id}/events")
def list_events(ground: GroundOf, _: Viewer, request: Request, pass_id: PassId, asked: PagingOf) -> PageOf[model.Event]:
    """List the event reports of a pass, in time order."""
    return linked(request, service.list_events(ground, pass_id, asked))


@passes.get("/passes/{pass_id}/craters")
def list_craters(
    ground: GroundOf, _: Viewer, request: Request, pass_id: PassId, asked: PagingOf
) -> PageOf[model.Crater]:
    """List the craters of the catalogue of a pass, the largest first."""
    return linked(request, service.craters(ground, pass_id, asked))


@passes.get("/events", responses=problems(404))
def list_spacecraft_events(
    ground: GroundOf, _: Viewer, request: Request, asked: Annotated[model.EventFilter, Query()]
) -> PageOf[model.SpacecraftEvent]:
    """List the event reports of all passes of a spacecraft, newest first."""
    return linked(request, service.spacecraft_events(ground, asked))


@passes.get("/passes/{pass_id}/parameters")
def list_parameters(ground: GroundOf, _: Viewer, pass_id: PassId) -> model.PassParameters:
    """List the parameters with series: of the payload, and of packets that the mission description defines."""
    return parameters.pass_parameters(ground, pass_id)


@passes.get(
    "/passes/{pass_id}/packets/{packet}",
    response_class=Response,
    responses={200: {"content": {media: {} for media in EXPORT_MEDIA.values()}}},
)
def get_packets(
    ground: GroundOf,
    _: Viewer,
    pass_id: PassId,
    packet: Annotated[str, Path(max_length=200, description="Packet of the dictionary, or XTCE container")],
    format: Annotated[model.ExportFormat, Query(description="Format of the file")] = "json",
) -> Response:
    """Return the decoded packets of one kind in a pass, in order of on-board time, with UTC."""
    octets = parameters.export_packets(ground, pass_id, packet, format)
    return Response(octets, media_type=EXPORT_MEDIA[format])


@passes.get("/passes/{pass_id}/telemetry/{parameter}", response_model=model.ParameterSeries)
def get_parameter(
    ground: GroundOf, _: Viewer, pass_id: PassId, parameter: Parameter, max_points: MaxPoints = 1000
) -> Response:
    """Return the series of a housekeeping parameter of a pass."""
    return JSONResponse(series_document(service.parameter_series(ground, pass_id, parameter, max_points)))


@passes.get("/spacecraft/{spacecraft_id}/telemetry/{parameter}", response_model=model.ParameterSeries)
def get_trend(
    ground: GroundOf,
    _: Viewer,
    spacecraft_id: SpacecraftId,
    parameter: Parameter,
    instance: Instance = FLOWN,
    start: RequestTime | None = None,
    stop: RequestTime | None = None,
    max_points: MaxPoints = 1000,
) -> Response:
    """Return the series of a housekeeping parameter of a spacecraft over an interval; by default over all."""
    found = service.trend_series(
        ground, spacecraft_id, instance, parameter, max_points, start_utc_ns=ns_of(start), stop_utc_ns=ns_of(stop)
    )
    return JSONResponse(series_document(found))


@passes.get("/spacecraft")
def list_spacecraft(ground: GroundOf, caller: Viewer) -> PageOf[model.SpacecraftInstance]:
    """List the spacecraft, flown ones first."""
    return PageOf.all_of(caller.own(newest.list_spacecraft(ground)))


@passes.get("/spacecraft/{spacecraft_id}/parameters")
def list_spacecraft_parameters(
    ground: GroundOf, _: Viewer, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> PageOf[model.ParameterInfo]:
    """List the parameters of a spacecraft with series."""
    return PageOf.all_of(parameters.spacecraft_parameters(ground, spacecraft_id, instance))


PNG: dict[int | str, dict[str, Any]] = {200: {"content": {"application/octet-stream": {}}, "description": "PNG image"}}


@passes.get("/spacecraft/{spacecraft_id}/images")
def list_images(
    ground: GroundOf,
    _: Viewer,
    spacecraft_id: SpacecraftId,
    start: RequestTime,
    stop: RequestTime,
    instance: Instance = FLOWN,
) -> PageOf[model.Image]:
    """List the images of an interval: downlinked thumbnails, and frames of pass archives; at most 2000."""
    return PageOf.all_of(archive_import.list_images(ground, spacecraft_id, instance, start.utc_ns, stop.utc_ns))


@passes.get("/spacecraft/{spacecraft_id}/thumbnails/{ticks}", response_class=Response, responses=PNG)
def get_thumbnail(
    ground: GroundOf,
    _: Viewer,
    spacecraft_id: SpacecraftId,
    ticks: Annotated[int, Path(ge=0, lt=1 << 48, description="On-board time of the frame, 2^-16 s")],
    instance: Instance = FLOWN,
    detections: Annotated[bool, Query(description="Enlarge it and draw the detections of the payload")] = False,
) -> Response:
    """Return a downlinked thumbnail as PNG."""
    octets = archive_import.thumbnail_image(ground, spacecraft_id, instance, ticks, detections=detections)
    return Response(octets, media_type="image/png")


@passes.get("/passes/{pass_id}/images/{frame_number}", response_class=Response, responses=PNG)
def get_image(
    ground: GroundOf,
    _: Viewer,
    pass_id: PassId,
    frame_number: Annotated[int, Path(ge=0, lt=1 << 32)],
    detections: Annotated[bool, Query(description="Draw the detections of the payload")] = False,
) -> Response:
    """Return a frame of a pass archive as PNG."""
    octets = archive_import.archived_image(ground, pass_id, frame_number, detections=detections)
    return Response(octets, media_type="image/png")


@passes.get("/parameters", responses=problems(404))
def list_live_parameters(
    ground: GroundOf,
    _: Viewer,
    spacecraft_id: Annotated[int, Query(ge=0, le=1023, examples=[76])],
    instance: Instance = FLOWN,
    live: Annotated[bool, Query(description="Newest values; series are listed by pass")] = True,
) -> PageOf[model.LiveParameter]:
    """List the newest value of every parameter of a spacecraft, with its age and limit state."""
    if not live:
        raise InvalidInput("query", "live", "true; series are under /passes/{id}/telemetry", "false")
    return PageOf.all_of(newest.live_parameters(ground, spacecraft_id, instance))


@passes.get("/spacecraft/{spacecraft_id}/trends")
def list_trends(
    ground: GroundOf, _: Viewer, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> list[model.Trend]:
    """List statistics, slope and limit state of the housekeeping parameters over 30 days of on-board time."""
    return service.spacecraft_trends(ground, spacecraft_id, instance)
