"""HTTP operations on evaluations and reports."""

from typing import Annotated, Literal

from fastapi import Query, Request, Response

from ground_service.access.security import Operator, Viewer, idempotent_id
from ground_service.evaluation import service, store
from ground_service.evaluation.model import PassFigures, Report, ReportOverview, ReportSummary
from ground_service.http.common import API_PREFIX, GroundOf, IdempotencyKey, Key, PagingOf, PassId, linked
from ground_service.http.model import PageOf
from ground_service.http.requests import operations
from ground_service.jobs.service import DispatcherOf, Job, get_job
from ground_service.passes.store import get_pass

REPORT_MEDIA = {"html": "text/html", "pdf": "application/pdf", "json": "application/json"}

evaluation = operations("reports")


@evaluation.get("/passes/{pass_id}/summary")
def evaluate_pass(ground: GroundOf, _: Viewer, pass_id: PassId) -> PassFigures:
    """Evaluate a pass now: frames, packets, detector, navigation and baselines."""
    return PassFigures.model_validate(service.pass_summary(ground, pass_id))


@evaluation.post("/passes/{pass_id}/reports", status_code=202)
def request_report(
    response: Response,
    ground: GroundOf,
    caller: Operator,
    dispatcher: DispatcherOf,
    pass_id: PassId,
    idempotency_key: IdempotencyKey = None,
) -> Job:
    """Request a report of a pass; a job creates it."""
    ground.read(get_pass, pass_id)
    job_id = dispatcher.submit(
        "report", {"pass_id": pass_id}, job_id=idempotent_id(f"report {pass_id}", caller, idempotency_key)
    )
    response.headers["Location"] = f"{API_PREFIX}/jobs/{job_id}"
    return ground.read(get_job, job_id)


@evaluation.get(
    "/reports/{report_id}",
    response_class=Response,
    responses={200: {"content": {media: {} for media in REPORT_MEDIA.values()}, "description": "The report"}},
)
def get_report(
    request: Request,
    ground: GroundOf,
    _: Viewer,
    report_id: Key,
    format: Annotated[Literal["html", "pdf", "json"] | None, Query(description="Default: by the Accept header")] = None,
) -> Response:
    """Return a report as HTML, PDF or JSON."""
    kind = format or preferred_kind(request.headers.get("accept", ""))
    media = REPORT_MEDIA[kind] + ("; charset=utf-8" if kind == "html" else "")
    return Response(service.report_document(ground, report_id, kind), media_type=media)


def preferred_kind(accept: str) -> str:
    """Return the document format that an Accept header prefers; JSON without a preference."""
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


@evaluation.get("/reports")
def list_newest_reports(
    ground: GroundOf,
    _: Viewer,
    pass_id: Annotated[list[int], Query(min_length=1, max_length=200, description="Passes; can be repeated")],
) -> PageOf[ReportSummary]:
    """List verdict and main figures of the newest report of each of these passes that has one."""
    return PageOf.all_of(service.newest_reports(ground, pass_id))


@evaluation.get("/passes/{pass_id}/reports")
def list_reports(ground: GroundOf, _: Viewer, request: Request, pass_id: PassId, asked: PagingOf) -> PageOf[Report]:
    """List the reports of a pass, newest first, with the changes that a re-evaluation made."""
    return linked(request, ground.read(store.list_reports, pass_id, asked))


@evaluation.get("/reports/{report_id}/summary")
def get_report_summary(ground: GroundOf, _: Viewer, report_id: Key) -> PassFigures:
    """Return the figures of a report."""
    return PassFigures.model_validate(ground.read(store.get_report, report_id).summary)


@evaluation.get("/reports/{report_id}/overview")
def get_report_overview(
    ground: GroundOf, _: Viewer, report_id: Key, max_points: Annotated[int, Query(ge=1, le=10_000)] = 600
) -> ReportOverview:
    """Return the verdict and headline figures of a report, and the 3-D error of every solution over time."""
    return service.report_overview(ground, report_id, max_points)
