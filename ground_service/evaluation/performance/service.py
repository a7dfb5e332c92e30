"""Performance of a spacecraft over many passes, and monthly reports of it."""

import calendar
import hashlib
import logging
import math
import re
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, func, select

from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.errors import DatabaseBusy, InvalidInput, NotFound, Stopping, fault_of
from ground_service.evaluation.alignment import bounds_per_degree
from ground_service.evaluation.model import PassFigures, StoredReport
from ground_service.evaluation.performance import core
from ground_service.evaluation.performance.model import (
    ChangePoint,
    MonthlyReport,
    MonthlyReportFilter,
    PassPerformance,
    Performance,
    StoredMonthlyReport,
)
from ground_service.evaluation.service import PREFERRED_ESTIMATORS
from ground_service.evaluation.store import newest_reports
from ground_service.evaluation.verdict import NEES_DEGREES
from ground_service.ground import Ground
from ground_service.http.model import PageOf, UtcTime
from ground_service.passes.model import PassRecord
from ground_service.store import repository
from ground_service.store.files import register_file
from ground_service.store.vehicles import FLOWN, get_vehicle
from lunar.constants import DAY_NS
from lunar.timescales import format_utc, parse_utc
from reports.statistics import sigma_remark
from reports.values import HeadlineFigure, MeanByGroup, MonthlyReportValue, RequirementOverTime

_PASSES, _VEHICLES = repository.PASSES, repository.VEHICLES
_MONTHLY = repository.MONTHLY_REPORTS
_BLOCK = 500
PASSES_LIMIT = 5000
"""Largest number of passes in a span."""


def reported_passes(
    connection: Connection, spacecraft_id: int, instance: str | None, start_utc_ns: int | None, stop_utc_ns: int | None
) -> tuple[list[tuple[PassRecord, StoredReport]], int]:
    """Return the passes of a spacecraft that begin in a span and have a report, with the newest one, by time.

    The second value is the number of all passes in the span.

    Raises
    ------
    InvalidInput
        There are too many passes in the span.
    """
    query = (
        select(_PASSES)
        .join(_VEHICLES, _VEHICLES.c.id == _PASSES.c.vehicle_id)
        .where(_VEHICLES.c.ccsds_id == spacecraft_id)
        .order_by(_PASSES.c.start_utc_ns, _PASSES.c.id)
    )
    if instance is not None:
        query = query.where(_VEHICLES.c.instance == instance)
    if start_utc_ns is not None:
        query = query.where(_PASSES.c.start_utc_ns >= start_utc_ns)
    if stop_utc_ns is not None:
        query = query.where(_PASSES.c.start_utc_ns < stop_utc_ns)
    total = int(connection.execute(select(func.count()).select_from(query.subquery())).scalar_one())
    if total > PASSES_LIMIT:
        expected = f"at most {PASSES_LIMIT} passes in the span from start to stop"
        raise InvalidInput(f"performance of spacecraft {spacecraft_id}", "", expected, f"{total} passes")
    records = [PassRecord.of(row) for row in connection.execute(query).mappings()]
    reports: dict[int, StoredReport] = {}
    for first in range(0, len(records), _BLOCK):
        ids = [one.id for one in records[first : first + _BLOCK]]
        reports |= {one.pass_id: one for one in newest_reports(connection, ids)}
    return [(one, reports[one.id]) for one in records if one.id in reports], total


def spacecraft_with_passes(connection: Connection, instance: str) -> list[int]:
    """Return the spacecraft that have passes in an instance."""
    query = select(_VEHICLES.c.ccsds_id).join(_PASSES, _PASSES.c.vehicle_id == _VEHICLES.c.id).distinct()
    query = query.where(_VEHICLES.c.instance == instance)
    return [int(one) for one in connection.execute(query.order_by(_VEHICLES.c.ccsds_id)).scalars()]


def add_monthly_report(connection: Connection, report: StoredMonthlyReport) -> bool:
    """Add a monthly report; return False if one with this id exists."""
    values = report.model_dump(exclude={"created"})
    added = repository.add_new(connection, _MONTHLY, **values, created_utc_ns=report.created.utc_ns)
    return added is not None


def get_monthly_report(connection: Connection, report_id: str) -> StoredMonthlyReport:
    return StoredMonthlyReport.of(repository.get(connection, _MONTHLY, report_id, "monthly report"))


def list_monthly_reports(connection: Connection, asked: MonthlyReportFilter) -> PageOf[MonthlyReport]:
    """List the monthly reports, newest month first."""
    order = (_MONTHLY.c.month.desc(), _MONTHLY.c.created_utc_ns.desc(), _MONTHLY.c.id)
    rows, total = repository.page(connection, select(_MONTHLY), asked, *order)
    return asked.page((_shown(StoredMonthlyReport.of(row)) for row in rows), total)


def _shown(report: StoredMonthlyReport) -> MonthlyReport:
    return MonthlyReport.model_validate(report.model_dump(include=set(MonthlyReport.model_fields)))


def monthly_value(found: Performance, month: str) -> MonthlyReportValue:
    """Return the report of a month as a value; it follows from the performance alone."""
    verdict, level = _verdict(found)
    if found.changes:
        count = len(found.changes)
        verdict += f"; {count} {'change' if count == 1 else 'changes'} of level"
    levels = sorted({one.terrain for one in found.passes})
    return MonthlyReportValue(
        title=f"Spacecraft {found.spacecraft_id} ({found.instance or 'all instances'}), {month}",
        month=month,
        verdict=verdict,
        verdict_level=level,
        evidence_level=levels[0] if len(levels) == 1 else "",
        headline=_headline(found),
        passes=tuple(found.passes),
        groups=tuple(found.groups),
        changes=tuple(found.changes),
        requirements=tuple(found.requirements),
        window_days=found.window_days,
        false_alarm_rate=found.false_alarm_rate,
        provenance={
            "reports": f"{_coverage(found)}; the newest report of each",
            "evidence levels": "; ".join(one or "not stated" for one in levels),
        },
        not_available={"data_sources": "stated in the reports of the passes"},
    )


def _verdict(found: Performance) -> tuple[str, str]:
    """Return verdict and level; "met" only if every pass is judged on every requirement with a limit."""
    failed = sum(one.not_met > 0 for one in found.requirements)
    judged = [one for one in found.requirements if one.met + one.not_met]
    unknown = [one for one in found.requirements if one.limit is not None and one.unknown]
    missing = found.passes_in_span - len(found.passes)
    if failed:
        verdict, level = f"requirements not met in every pass: {failed} of {len(judged)} judged", "not met"
    elif judged and not unknown and not missing:
        verdict, level = f"requirements met in every pass: {len(judged)} of {len(judged)} judged", "met"
    else:
        verdict, level = (f"requirements judged: {len(judged)} of {len(found.requirements)}, none missed", "unknown")
    if unknown:
        worst = max(unknown, key=lambda one: one.unknown)
        verdict += f"; {worst.name} not judged on {worst.unknown} of {worst.passes} passes"
    if len(unknown) > 1:
        verdict += f", {len(unknown) - 1} more not judged on every pass"
    if missing:
        verdict += f"; {_coverage(found)}"
    return verdict, level


def _coverage(found: Performance) -> str:
    return f"{len(found.passes)} of {found.passes_in_span} passes have a report"


def _headline(found: Performance) -> tuple[HeadlineFigure, ...]:
    def mean(name: str) -> float | None:
        known = [float(value) for one in found.passes if (value := getattr(one, name)) is not None]
        return sum(known) / len(known) if known else None

    recall = mean("recall")
    return (
        HeadlineFigure("Passes", len(found.passes)),
        HeadlineFigure("Packets lost", sum(one.packets_lost for one in found.passes)),
        HeadlineFigure("Recall", None if recall is None else 100.0 * recall, "%", "mean of the passes"),
        HeadlineFigure("Drift", mean("drift_percent"), "% of path", "mean of the passes"),
        HeadlineFigure("Median error", mean("median_error_m"), "m", "mean of the passes"),
    )


WINDOW_DAYS = 7.0
NOT_STATED = "not stated"
_MONTH = re.compile(r"^(2[0-9]{3})-(0[1-9]|1[0-2])$")

Reported = tuple[PassRecord, StoredReport, PassFigures]

log = logging.getLogger(__name__)


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
        Instance of the spacecraft; None: the flown one if it has passes, otherwise all imported passes.
    window_days
        Length of the rolling window of the requirements.

    Raises
    ------
    InvalidInput
        There are too many passes in the span.
    """
    with ground.database.reading() as connection:
        if instance is None and spacecraft_id in spacecraft_with_passes(connection, FLOWN):
            instance = FLOWN
        stored, total = reported_passes(connection, spacecraft_id, instance, start_utc_ns, stop_utc_ns)
    found = [(record, report, PassFigures.model_validate(report.summary)) for record, report in stored]
    passes = [_pass_performance(*one) for one in found]
    return Performance(
        spacecraft_id=spacecraft_id,
        instance=instance,
        window_days=window_days,
        false_alarm_rate=core.FALSE_ALARM_RATE,
        passes_in_span=total,
        passes=passes,
        groups=group_figures(passes),
        changes=_changes(passes),
        requirements=_requirements(found, round(window_days * DAY_NS)),
    )


def _pass_performance(record: PassRecord, report: StoredReport, figures: PassFigures) -> PassPerformance:
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
        map_offset_m=None if conditions is None else conditions.map_offset_m,
        terrain=figures.evidence_level,
        build="" if conditions is None else conditions.build,
        frames=figures.frames,
        packets=figures.packets,
        packets_lost=figures.packets_lost,
        verdict_level=figures.verdict_level,
    )


def group_figures(passes: Sequence[PassPerformance]) -> list[MeanByGroup]:
    """Return the mean of each metric by altitude, elevation of the Sun, terrain and build."""
    factors: list[tuple[str, list[str], list[str]]] = []
    for factor, name, edges, unit in (
        ("altitude", "altitude_km", core.ALTITUDE_EDGES_KM, "km"),
        ("sun elevation", "sun_elevation_deg", core.SUN_EDGES_DEG, "°"),
    ):
        groups = [core.interval_name(_number(getattr(one, name)), edges, unit) for one in passes]
        factors.append((factor, groups, core.interval_names(edges, unit)))
    for factor, name in (("terrain", "terrain"), ("build", "build")):
        groups = [getattr(one, name) or NOT_STATED for one in passes]
        factors.append((factor, groups, sorted(set(groups))))
    found = []
    for factor, groups, order in factors:
        for group in order:
            members = [one for one, its in zip(passes, groups, strict=True) if its == group]
            for metric in core.METRICS if members else ():
                level = core.mean_level([_number(getattr(one, metric)) for one in members])
                found.append(
                    MeanByGroup(
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
    for metric in core.METRICS:
        for change in core.change_points([_number(getattr(one, metric)) for one in passes]):
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


def _requirements(found: Sequence[Reported], window_ns: int) -> list[RequirementOverTime]:
    """Return the requirements of all reports over the window that ends at the newest pass.

    Name, unit and limit are those of the newest report that has the requirement.
    """
    if not found:
        return []
    rows = [{one.key: one for one in figures.requirements} for _, _, figures in found]
    times = [record.start_utc_ns for record, _, _ in found]
    newest_of = {key: one for row in rows for key, one in row.items()}
    order = dict.fromkeys(key for row in reversed(rows) for key in row)
    requirements = []
    for key in order:
        newest = newest_of[key]
        statuses = [row[key].status if key in row else "unknown" for row in rows]
        counts = core.rolling_counts(times, statuses, window_ns)
        shares = [
            one.get("met", 0) / (one.get("met", 0) + one.get("not met", 0))
            for one in counts
            if one.get("met", 0) + one.get("not met", 0)
        ]
        last = counts[-1]
        met, not_met = last.get("met", 0), last.get("not met", 0)
        share = core.wilson(met, met + not_met)
        requirements.append(
            RequirementOverTime(
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
                remark=_consistency_remark(key, [row[key].value for row in rows[-sum(last.values()) :] if key in row]),
            )
        )
    return requirements


def _consistency_remark(key: str, values: Sequence[float | None]) -> str:
    """Return whether the mean NEES or NIS per degree of some passes, each at least one draw, is outside its bounds.

    The bounds of the NEES are those of chi-square, of the NIS those of Student's t: a pass has many draws of it.
    """
    known = [value for value in values if value is not None]
    if not key.startswith("consistency.") or len(known) < 2:
        return ""
    level = core.mean_level(known)
    low, high = 1.0 - level.high + level.mean, 1.0 + level.mean - level.low
    if key == "consistency.nees":
        low, high = bounds_per_degree(NEES_DEGREES, len(known), core.CONFIDENCE)
    wrong = sigma_remark(level.mean, low, high)
    return f"mean {level.mean:.2f} of {len(known)} passes: {wrong}" if wrong else ""


def make_monthly_report(ground: Ground, spacecraft_id: int, month: str, *, instance: str = FLOWN) -> MonthlyReport:
    """Make the report of a month (YYYY-MM, UTC) of a spacecraft in one instance, and return it.

    The same content is stored once.

    Raises
    ------
    InvalidInput
        This is not a month, or it has no pass with a report.
    """
    found = _month(ground, spacecraft_id, instance, month)
    if not found.passes:
        raise InvalidInput(
            f"monthly report of spacecraft {spacecraft_id} ({instance})", month, "passes with a report", "none"
        )
    return _keep_monthly_report(ground, found, instance, month)


def _month(ground: Ground, spacecraft_id: int, instance: str, month: str) -> Performance:
    start_utc_ns, stop_utc_ns = month_span(month)
    return performance(
        ground,
        spacecraft_id,
        instance=instance,
        start_utc_ns=start_utc_ns,
        stop_utc_ns=stop_utc_ns,
        window_days=(stop_utc_ns - start_utc_ns) / DAY_NS,
    )


def _keep_monthly_report(ground: Ground, found: Performance, instance: str, month: str) -> MonthlyReport:
    from reports.pdf_pages import pdf_of
    from reports.render import render_pages, to_json

    value = monthly_value(found, month)
    data = to_json(value).encode()
    said = f"{found.spacecraft_id} {instance} {month} ".encode()
    identity = hashlib.blake2b(said + data, digest_size=16).hexdigest()
    with ground.database.reading() as connection:
        try:
            return _entity(get_monthly_report(connection, identity))
        except NotFound:
            pass
    page, form = render_pages(value)
    now = utc_now_ns()
    stored = {
        kind: ground.files.put_octets(octets)
        for kind, octets in (("html", page.encode()), ("pdf", pdf_of(form, page)), ("json", data))
    }
    with ground.database.writing() as connection:
        for kind, file in stored.items():
            register_file(connection, file, "report", f"report of {month} ({kind})", now)
        report = StoredMonthlyReport(
            id=identity,
            spacecraft_id=found.spacecraft_id,
            instance=instance,
            month=month,
            passes=len(found.passes),
            verdict=value.verdict,
            created=UtcTime(now),
            html_sha256=stored["html"].sha256,
            pdf_sha256=stored["pdf"].sha256,
            json_sha256=stored["json"].sha256,
        )
        add_monthly_report(connection, report)
        return _entity(get_monthly_report(connection, identity))


def make_due_report(ground: Ground, spacecraft_id: int, instance: str = FLOWN) -> MonthlyReport | None:
    """Make the report of the last complete month (mission time); None if this month has no pass with a report.

    Late data give a new report of this month.
    """
    month = last_month(mission_now_ns())
    found = _month(ground, spacecraft_id, instance, month)
    return _keep_monthly_report(ground, found, instance, month) if found.passes else None


def make_due_reports(ground: Ground) -> tuple[list[dict[str, Any]], list[int]]:
    """Make the reports of the last complete month of all flown spacecraft.

    The first value has the reports. The second has the spacecraft whose report failed; the log states why.
    """
    spacecraft = ground.read(spacecraft_with_passes, FLOWN)
    made: list[dict[str, Any]] = []
    failed = []
    for one in spacecraft:
        with fault_of(f"monthly report of spacecraft {one}", passing=(Stopping, DatabaseBusy)) as faults:
            report = make_due_report(ground, one)
            if report is not None:
                made.append({"spacecraft_id": one, "month": report.month, "report": report.id})
        failed += [one for _ in faults]
    return made, failed


def due_report_of_vehicle(ground: Ground, vehicle: int) -> MonthlyReport | None:
    """Make the report of the last complete month of a vehicle; see `make_due_report`."""
    found = ground.read(get_vehicle, vehicle)
    return make_due_report(ground, found.ccsds_id, found.instance)


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
    return format_utc(parse_utc(f"{format_utc(utc_ns)[:7]}-01T00:00:00Z") - DAY_NS)[:7]


def _entity(report: StoredMonthlyReport) -> MonthlyReport:
    return MonthlyReport.model_validate({name: getattr(report, name) for name in MonthlyReport.model_fields})


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
