"""HTTP operations on the performance over many passes and on monthly reports."""

from typing import Annotated, Literal

from fastapi import Path, Query, Response

from ground_service.access.security import Operator, Viewer, add_list
from ground_service.evaluation.performance import service
from ground_service.evaluation.performance.model import MonthlyReport, Performance
from ground_service.evaluation.routes import REPORT_MEDIA
from ground_service.http.common import GroundOf, Key
from ground_service.http.model import InstanceName, RequestTime, ns_of
from ground_service.http.requests import operations
from ground_service.store.vehicles import FLOWN

Spacecraft = Annotated[int, Path(ge=0, le=1023)]
Month = Annotated[str, Path(pattern=r"^2[0-9]{3}-(0[1-9]|1[0-2])$", examples=["2029-08"])]

reports = operations("reports")


@reports.get("/spacecraft/{spacecraft_id}/performance")
def get_performance(
    ground: GroundOf,
    _: Viewer,
    spacecraft_id: Spacecraft,
    instance: Annotated[
        InstanceName | None, Query(description="Default: the flown one if it has passes, otherwise all imported passes")
    ] = None,
    start: RequestTime | None = None,
    stop: RequestTime | None = None,
    window_days: Annotated[
        float, Query(gt=0.0, le=3660.0, description="Length of the rolling window of the requirements")
    ] = service.WINDOW_DAYS,
) -> Performance:
    """Return recall, drift and error over the reported passes, by condition, with changes of level."""
    return service.performance(
        ground,
        spacecraft_id,
        instance=instance,
        start_utc_ns=ns_of(start),
        stop_utc_ns=ns_of(stop),
        window_days=window_days,
    )


@reports.post("/spacecraft/{spacecraft_id}/monthly-reports/{month}", status_code=201)
def add_monthly_report(
    ground: GroundOf, _: Operator, spacecraft_id: Spacecraft, month: Month, instance: InstanceName = FLOWN
) -> MonthlyReport:
    """Add the report of a month of one instance; the same content gives the same report."""
    return service.make_monthly_report(ground, spacecraft_id, month, instance=instance)


add_list(reports, "/monthly-reports", service.list_monthly_reports)


@reports.get(
    "/monthly-reports/{report_id}",
    response_class=Response,
    responses={200: {"content": {media: {} for media in REPORT_MEDIA.values()}, "description": "The report"}},
)
def get_monthly_report(
    ground: GroundOf, _: Viewer, report_id: Key, format: Literal["html", "pdf", "json"] = "html"
) -> Response:
    """Return a monthly report as HTML, PDF or JSON."""
    sha256 = str(getattr(ground.read(service.get_monthly_report, report_id), f"{format}_sha256"))
    media = REPORT_MEDIA[format] + ("; charset=utf-8" if format == "html" else "")
    return Response(ground.files.get(sha256), media_type=media)
