"""Performance of a spacecraft over many passes, and monthly reports of it."""

from __future__ import annotations

import calendar
import hashlib
import math
import re
from collections.abc import Sequence
from typing import Any

from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput, NotFound
from ground_service.evaluation.model import PassFigures, StoredReport
from ground_service.evaluation.report_overview import PREFERRED_ESTIMATORS
from ground_service.ground import Ground
from ground_service.http.times import UtcTime
from ground_service.passes.model import PassRecord
from ground_service.performance import store
from ground_service.performance.core import (
    ALTITUDE_EDGES_KM,
    FALSE_ALARM_RATE,
    METRICS,
    SUN_EDGES_DEG,
    change_points,
    interval_name,
    interval_names,
    mean_level,
    rolling_counts,
    wilson,
)
from ground_service.performance.documents import monthly_value
from ground_service.performance.model import (
    ChangePoint,
    GroupFigures,
    MonthlyReport,
    PassPerformance,
    Performance,
    RollingRequirement,
    StoredMonthlyReport,
)
from ground_service.store.stored_files import register_file
from lunar.timescales import format_utc, parse_utc

WINDOW_DAYS = 7.0
DAY_NS = 86_400_000_000_000
NOT_STATED = "not stated"
_MONTH = re.compile(r"^(2[0-9]{3})-(0[1-9]|1[0-2])$")

Reported = tuple[PassRecord, StoredReport]


def performance(
    ground: Ground,
    spacecraft_id: int,
    *,
    instance: str | None = None,
    start_utc_ns: int | None = None,
    stop_utc_ns: int | None = None,
    window_days: float = WINDOW_DAYS,
) -> Performance:
    """Return the performance of a spacecraft over its reported passes that begin in a span, by default all.

    Parameters
    ----------
    instance
        Instance of the spacecraft; None: all, imported passes included.
    window_days
        Length of the rolling window of the requirements.
    """
    with ground.database.reading() as connection:
        found = store.reported_passes(connection, spacecraft_id, instance, start_utc_ns, stop_utc_ns)
    passes = [_pass_performance(record, report) for record, report in found]
    return Performance(
        spacecraft_id=spacecraft_id,
        instance=instance,
        window_days=window_days,
        false_alarm_rate=FALSE_ALARM_RATE,
        passes=passes,
        groups=group_figures(passes),
        changes=_changes(passes),
        requirements=_requirements(found, round(window_days * DAY_NS)),
    )


def _pass_performance(record: PassRecord, report: StoredReport) -> PassPerformance:
    figures = PassFigures.model_validate(report.summary)
    conditions = figures.conditions
    names = [name for name in PREFERRED_ESTIMATORS if name in figures.navigation]
    judged = None if conditions is None else conditions.estimator
    estimator = judged if judged in names else names[0] if names else None
    errors = None if estimator is None else figures.navigation[estimator]
    return PassPerformance(
        pass_id=record.id,
        name=record.name,
        start=UtcTime(record.start_utc_ns),
        report_id=report.id,
        estimator=estimator,
        recall=figures.detector.recall,
        drift_percent=None if errors is None else errors.drift_percent,
        median_error_m=None if errors is None else errors.median_3d_m,
        altitude_km=None if conditions is None else conditions.altitude_km,
        sun_elevation_deg=None if conditions is None else conditions.sun_elevation_deg,
        terrain=figures.evidence_level,
        build="" if conditions is None else conditions.build,
        frames=figures.frames,
        packets=figures.packets,
        packets_lost=figures.packets_lost,
        verdict_level=figures.verdict_level,
    )


def group_figures(passes: Sequence[PassPerformance]) -> list[GroupFigures]:
    """Return the mean of each metric by altitude, elevation of the Sun, terrain and build."""
    factors: list[tuple[str, list[str], list[str]]] = []
    for factor, name, edges, unit in (
        ("altitude", "altitude_km", ALTITUDE_EDGES_KM, "km"),
        ("sun elevation", "sun_elevation_deg", SUN_EDGES_DEG, "°"),
    ):
        groups = [interval_name(_number(getattr(one, name)), edges, unit) for one in passes]
        factors.append((factor, groups, interval_names(edges, unit)))
    for factor, name in (("terrain", "terrain"), ("build", "build")):
        groups = [getattr(one, name) or NOT_STATED for one in passes]
        factors.append((factor, groups, sorted(set(groups))))
    found = []
    for factor, groups, order in factors:
        for group in order:
            members = [one for one, its in zip(passes, groups, strict=True) if its == group]
            for metric in METRICS if members else ():
                level = mean_level([_number(getattr(one, metric)) for one in members])
                found.append(
                    GroupFigures(
                        factor=factor,
                        group=group,
                        metric=metric,
                        passes=level.passes,
                        mean=_known(level.mean),
                        low=_known(level.low),
                        high=_known(level.high),
                    )
                )
    return found


def _changes(passes: Sequence[PassPerformance]) -> list[ChangePoint]:
    found = []
    for metric in METRICS:
        for change in change_points([_number(getattr(one, metric)) for one in passes]):
            first = passes[change.index]
            found.append(
                ChangePoint(
                    metric=metric,
                    pass_id=first.pass_id,
                    time=first.start,
                    before=change.before,
                    after=change.after,
                    passes_before=change.count_before,
                    passes_after=change.count_after,
                    p_value=change.p_value,
                )
            )
    return sorted(found, key=lambda one: (one.time.utc_ns, one.metric))


def _requirements(found: Sequence[Reported], window_ns: int) -> list[RollingRequirement]:
    """Return the requirements of the newest report over the window that ends at the newest pass."""
    if not found:
        return []
    rows = [
        {one.key: one for one in PassFigures.model_validate(report.summary).requirements}
        for _, report in found
    ]
    times = [record.start_utc_ns for record, _ in found]
    requirements = []
    for key, newest in rows[-1].items():
        statuses = [row[key].status if key in row else "unknown" for row in rows]
        counts = rolling_counts(times, statuses, window_ns)
        shares = [
            one.get("met", 0) / (one.get("met", 0) + one.get("not met", 0))
            for one in counts
            if one.get("met", 0) + one.get("not met", 0)
        ]
        last = counts[-1]
        met, not_met = last.get("met", 0), last.get("not met", 0)
        share = wilson(met, met + not_met)
        requirements.append(
            RollingRequirement(
                key=key,
                name=newest.name,
                unit=newest.unit,
                limit=newest.limit,
                passes=sum(last.values()),
                met=met,
                not_met=not_met,
                unknown=sum(last.values()) - met - not_met,
                share_met=_known(share.share),
                low=_known(share.low),
                high=_known(share.high),
                lowest_share=min(shares, default=None),
            )
        )
    return requirements


def make_monthly_report(ground: Ground, spacecraft_id: int, month: str) -> MonthlyReport:
    """Make the report of a month (YYYY-MM, UTC) of a spacecraft, and return it; the same content is stored once.

    Raises
    ------
    InvalidInput
        This is not a month, or it has no pass with a report.
    """
    start_utc_ns, stop_utc_ns = month_span(month)
    found = performance(
        ground,
        spacecraft_id,
        start_utc_ns=start_utc_ns,
        stop_utc_ns=stop_utc_ns,
        window_days=(stop_utc_ns - start_utc_ns) / DAY_NS,
    )
    if not found.passes:
        raise InvalidInput(
            f"monthly report of spacecraft {spacecraft_id}", month, "passes with a report", "none"
        )
    from reports.render import render_pages, to_json

    value = monthly_value(found, month)
    data = to_json(value).encode()
    identity = hashlib.blake2b(f"{spacecraft_id} {month} ".encode() + data, digest_size=16).hexdigest()
    with ground.database.reading() as connection:
        try:
            return _entity(store.get_monthly_report(connection, identity))
        except NotFound:
            pass
    page, printed = render_pages(value)
    now = utc_now_ns()
    stored = {
        kind: ground.files.put_octets(octets)
        for kind, octets in (("html", page.encode()), ("pdf", printed), ("json", data))
    }
    with ground.database.writing() as connection:
        for kind, file in stored.items():
            register_file(connection, file, "report", f"report of {month} ({kind})", now)
        report = StoredMonthlyReport(
            id=identity,
            spacecraft_id=spacecraft_id,
            month=month,
            passes=len(found.passes),
            verdict=value.verdict,
            created=UtcTime(now),
            html_sha256=stored["html"].sha256,
            pdf_sha256=stored["pdf"].sha256,
            json_sha256=stored["json"].sha256,
        )
        store.add_monthly_report(connection, report)
        return _entity(store.get_monthly_report(connection, identity))


def make_due_report(ground: Ground, spacecraft_id: int) -> MonthlyReport | None:
    """Make the report of the last complete month (mission time); None if this month has no pass with a report.

    Late data give a new report of this month.
    """
    try:
        return make_monthly_report(ground, spacecraft_id, last_month(utc_now_ns()))
    except InvalidInput:
        return None


def make_due_reports(ground: Ground) -> list[dict[str, Any]]:
    """Make the reports of the last complete month of all spacecraft; return their ids."""
    with ground.database.reading() as connection:
        spacecraft = store.spacecraft_with_passes(connection)
    made = [make_due_report(ground, one) for one in spacecraft]
    return [
        {"spacecraft_id": one.spacecraft_id, "month": one.month, "report": one.id}
        for one in made
        if one is not None
    ]


def due_report_of_vehicle(ground: Ground, vehicle: int) -> MonthlyReport | None:
    """Make the report of the last complete month of the spacecraft of a vehicle; see `make_due_report`."""
    with ground.database.reading() as connection:
        spacecraft = store.spacecraft_of_vehicle(connection, vehicle)
    return make_due_report(ground, spacecraft)


def month_span(month: str) -> tuple[int, int]:
    """Return start and stop of a month (YYYY-MM), UTC, ns.

    Raises
    ------
    InvalidInput
        This is not a month.
    """
    found = _MONTH.fullmatch(month)
    if found is None:
        raise InvalidInput("month", "", "a month such as 2029-08", month[:40])
    days = calendar.monthrange(int(found[1]), int(found[2]))[1]
    start = parse_utc(f"{month}-01T00:00:00Z")
    return start, parse_utc(f"{month}-{days:02d}T00:00:00Z") + DAY_NS


def last_month(utc_ns: int) -> str:
    """Return the last complete month before a time."""
    first = parse_utc(f"{format_utc(utc_ns)[:7]}-01T00:00:00Z")
    return format_utc(first - DAY_NS)[:7]


def get_monthly_report(ground: Ground, report_id: str) -> StoredMonthlyReport:
    """Return a monthly report.

    Raises
    ------
    NotFound
        There is no such report.
    """
    with ground.database.reading() as connection:
        return store.get_monthly_report(connection, report_id)


def list_monthly_reports(
    ground: Ground, *, spacecraft_id: int | None = None, limit: int = 100, offset: int = 0
) -> tuple[list[MonthlyReport], int]:
    """Return a page of the monthly reports, newest month first, and their number."""
    with ground.database.reading() as connection:
        return store.list_monthly_reports(connection, spacecraft_id, limit=limit, offset=offset)


def _entity(report: StoredMonthlyReport) -> MonthlyReport:
    return MonthlyReport.model_validate({name: getattr(report, name) for name in MonthlyReport.model_fields})


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
