"""Evaluation of passes: conditions, report and overview of reports, rendered and kept."""

import hashlib
import json
import math
import threading
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ground_service.clock import utc_now_ns
from ground_service.errors import PASSING, NotFound, storage_error
from ground_service.evaluation import store
from ground_service.evaluation.alignment import reference_states
from ground_service.evaluation.core import PassInputs, evaluate_pass, summary_of
from ground_service.evaluation.extras import sun_angles, surface_map
from ground_service.evaluation.inputs import align_pass, load_pass_inputs
from ground_service.evaluation.model import PassFigures, ReportOverview, ReportSummary, StoredReport, changed_figures
from ground_service.ground import Ground
from ground_service.http.model import UtcTime
from ground_service.passes.core import downsample
from ground_service.passes.store import get_pass
from ground_service.store.event_kinds import PassEvaluated, publish
from ground_service.store.files import FileArchive, make_durable_folder, register_file, replace_durably
from lunar.arrays import FloatArray
from lunar.timescales import format_utc
from reports import drawings
from reports.document import evidence_number
from reports.values import PassReport

SAMPLES = 61
"""Epochs of the reference over the pass, from which the medians are computed."""


def conditions_of(inputs: PassInputs) -> dict[str, Any]:
    """Return median altitude and elevation of the Sun along the reference, the build, and the judged estimator.

    Altitude is above the sphere, elevation at the sub-satellite point; both are None where the reference or the
    orientation is unknown, the elevation also where the images had another light than that of the ephemeris.
    """
    utc_ns = np.linspace(inputs.start_utc_ns, inputs.stop_utc_ns, SAMPLES).astype(np.int64)
    track = reference_states(inputs.reference, inputs.orientation, utc_ns)
    return {
        "altitude_km": _median(track.altitude_m / 1e3),
        "sun_elevation_deg": _median(sun_angles(track).elevation_deg) if inputs.sun_known else None,
        "build": inputs.build,
        "estimator": inputs.limits.estimator,
        "map_offset_m": None if inputs.map_offset is None else inputs.map_offset.sigma_enu_m[0],
    }


def _median(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


REAL_TERRAIN_LEVEL = 3
"""Lowest evidence level with real terrain."""


@dataclass(frozen=True, slots=True)
class MadeReport:
    """A report that was made, its files and its figures."""

    report_id: str
    pass_id: int
    html: Path
    json: Path
    summary: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Reevaluation:
    """Number of the event that causes a re-evaluation, the report before it, and what was evaluated again."""

    event: int
    previous: StoredReport
    inputs: PassInputs
    report: PassReport


def evaluate(ground: Ground, pass_id: int, *, created_utc: str = "") -> PassReport:
    """The report of a pass as a value; the same archive gives the same value."""
    return _evaluated(ground, load_pass_inputs(ground, pass_id, created_utc=created_utc))


def _evaluated(ground: Ground, inputs: PassInputs) -> PassReport:
    # The face of the real Moon belongs under tracks over the real Moon only.
    level = evidence_number(inputs.evidence_level)
    if ground.data.albedo is not None and level is not None and level >= REAL_TERRAIN_LEVEL:
        inputs = replace(inputs, surface=surface_map(ground.data.albedo))
    return evaluate_pass(inputs)


def pass_summary(ground: Ground, pass_id: int) -> dict[str, Any]:
    """The figures of a pass that a script asks for; see `summary_of`."""
    inputs = load_pass_inputs(ground, pass_id)
    return _summary(_evaluated(ground, inputs), inputs)


def make_report(
    ground: Ground,
    pass_id: int,
    *,
    report_id: str | None = None,
    out: Path | None = None,
    again: Reevaluation | None = None,
) -> MadeReport:
    """Evaluate a pass, render its report as HTML and JSON, and keep them with the form that its PDF is made of.

    Parameters
    ----------
    report_id
        Name of the report; the same name again gives the report that was made under it.
    out
        Folder for the documents; ``reports/pass-<id>`` under the service's home when None.
    again
        Re-evaluation to render; the changed figures are stored with the new report.
    """
    identity = report_id or uuid.uuid4().hex
    now = utc_now_ns()
    is_first = again is None and ground.read(store.newest_report, pass_id) is None
    with drawings.drawing_processes(is_first) as processes:  # few figures of a later report are new
        if again is None:
            inputs = load_pass_inputs(ground, pass_id, created_utc=format_utc(now))
            report = _evaluated(ground, inputs)
        else:
            inputs, report = again.inputs, replace(again.report, created_utc=format_utc(now))
        documents = _documents(report, drawings.KeptDrawings(processes))
    stored = {kind: ground.files.put_octets(octets) for kind, octets in documents.items()}
    summary = _summary(report, inputs)
    with ground.database.writing() as connection:
        for kind, file in stored.items():
            register_file(connection, file, "report", f"report of pass {pass_id} ({kind})", now)
        record = get_pass(connection, pass_id)
        added = store.add_report(
            connection,
            StoredReport(
                id=identity,
                pass_id=pass_id,
                html_sha256=stored["html"].sha256,
                json_sha256=stored["json"].sha256,
                pdf_sha256=None,
                print_sha256=stored["print"].sha256,
                summary=summary,
                mission_id=record.mission_id,
                event_number=None if again is None else again.event,
                previous_id=None if again is None else again.previous.id,
                changes=None if again is None else changed_figures(again.previous.summary, summary),
                created_utc_ns=now,
            ),
        )
        if added:
            publish(
                connection,
                PassEvaluated(
                    report_id=identity,
                    pass_id=pass_id,
                    vehicle_id=record.vehicle_id,
                    event=None if again is None else again.event,
                ),
            )
    folder = out if out is not None else ground.home / "reports" / f"pass-{pass_id}"
    html, data = folder / "report.html", folder / "report.json"
    with suppress(OSError):
        (folder / "report.pdf").unlink()  # of the report before
    _write_whole(html, documents["html"])
    _write_whole(data, documents["json"])
    return MadeReport(identity, pass_id, html, data, summary)


_typesetting = threading.Lock()
"""Held while this process makes a PDF: who reads the same one waits for it."""


def report_document(ground: Ground, report_id: str, kind: str) -> bytes:
    """Return a report as html, json or pdf; the PDF is made when it is first read, and kept where that is possible.

    It follows from stored octets only: processes that make it at the same time make the same file.

    Raises
    ------
    NotFound
        If there is no such report, or it is one of an earlier version without PDF.
    """
    report = ground.read(store.get_report, report_id)
    sha256: str | None = getattr(report, f"{kind}_sha256")
    if sha256 is not None:
        return ground.files.get(sha256)
    if report.print_sha256 is None:
        raise NotFound(f"report {report_id} as", kind)
    with _typesetting:
        sha256 = ground.read(store.get_report, report_id).pdf_sha256
        return _made_pdf(ground, report, report.print_sha256) if sha256 is None else ground.files.get(sha256)


def _made_pdf(ground: Ground, report: StoredReport, print_sha256: str) -> bytes:
    from reports.pdf_pages import pdf_of

    octets = pdf_of(ground.files.get(print_sha256), ground.files.get(report.html_sha256).decode())
    with suppress(*PASSING):
        file = ground.files.put_octets(octets)
        with ground.database.writing() as connection:
            register_file(connection, file, "report", f"report of pass {report.pass_id} (pdf)", utc_now_ns())
            store.set_pdf(connection, report.id, file.sha256)
    return octets


def reevaluate(ground: Ground, pass_id: int, *, report_id: str, event: int) -> MadeReport | None:
    """Evaluate a pass again because of an event; return the new report, or None if nothing in it would differ."""
    with ground.database.reading() as connection:
        made = store.has_report(connection, report_id)
        previous = store.newest_report(connection, pass_id, other_than=report_id)
    if previous is None:
        return None
    from reports.render import to_json

    if not made:
        align_pass(ground, pass_id)  # late data can be what its catalogue was missing
    inputs = load_pass_inputs(ground, pass_id, created_utc=format_utc(previous.created_utc_ns))
    report = _evaluated(ground, inputs)
    if not made and hashlib.sha256(to_json(report).encode()).hexdigest() == previous.json_sha256:
        return None
    again = Reevaluation(event, previous, inputs, report)
    return make_report(ground, pass_id, report_id=report_id, again=again)


def _documents(report: PassReport, drawn: drawings.Drawings) -> dict[str, bytes]:
    """Return the octets of a report by kind."""
    from reports.render import render_pages, to_json

    page, form = render_pages(report, drawn)
    return {"html": page.encode(), "json": to_json(report).encode(), "print": form}


def _summary(report: PassReport, inputs: PassInputs) -> dict[str, Any]:
    return {**plain(summary_of(report)), "pass_id": int(inputs.pass_id), "conditions": plain(conditions_of(inputs))}


def plain(value: Any) -> Any:
    """A value as JSON knows it: NaN and infinities as None, numbers of numpy as Python's."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _write_whole(path: Path, octets: bytes) -> None:
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        make_durable_folder(path.parent)
        temporary.write_bytes(octets)
        replace_durably(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise storage_error(error, path.parent) from None


PREFERRED_ESTIMATORS = ("anchored", "spherical", "paper")
"""Order in which the estimator of the main figures is chosen."""

_TEXTS = ("title", "verdict", "verdict_level", "evidence_level", "created_utc", "headline", "not_available")


def report_overview(ground: Ground, report_id: str, max_points: int) -> ReportOverview:
    """Return the header of a report and the 3-D error of each navigation solution in at most `max_points` intervals.

    The columns of a series have equal length: UTC in seconds at the middle of each interval, minimum, maximum and mean
    error in metres, and whether a gap precedes the interval.
    """
    sha256 = ground.read(store.get_report, report_id).json_sha256
    return ReportOverview(report_id=report_id, **_overview(ground.files, sha256, max_points))


def newest_reports(ground: Ground, pass_ids: Sequence[int]) -> list[ReportSummary]:
    """Return verdict and main figures of the newest report of each of these passes that has one."""
    with ground.database.reading() as connection:
        return [_report_overview_summary(one) for one in store.newest_reports(connection, pass_ids)]


def _report_overview_summary(report: StoredReport) -> ReportSummary:
    figures = PassFigures.model_validate(report.summary)
    names = [name for name in PREFERRED_ESTIMATORS if name in figures.navigation]
    estimator = names[0] if names else None
    return ReportSummary(
        id=report.id,
        pass_id=report.pass_id,
        created=UtcTime(report.created_utc_ns),
        verdict=figures.verdict,
        verdict_level=figures.verdict_level,
        evidence_level=figures.evidence_level,
        estimator=estimator,
        median_error_m=None if estimator is None else figures.navigation[estimator].median_3d_m,
        recall=figures.detector.recall,
        frames=figures.frames,
    )


@lru_cache(maxsize=64)
def _overview(files: FileArchive, sha256: str, max_points: int) -> dict[str, Any]:
    """Return the overview of a stored document; documents never change, so results are cached."""
    document = json.loads(files.get(sha256))
    return {
        **{name: document.get(name) for name in _TEXTS},
        # Reports of earlier versions have no table.
        "requirements": document.get("requirements") or [],
        "navigation": [_series(one, max_points) for one in document["navigation"]],
    }


def _series(one: Mapping[str, Any], max_points: int) -> dict[str, Any]:
    error = np.array(one["error_rtn_m"], dtype=np.float64).reshape(-1, 3)
    times = np.array(one["utc_ns"], dtype=np.int64)
    buckets = downsample(times, np.sqrt(np.sum(error**2, axis=1)), max_points)
    middle = (buckets.start_utc_ns // 2 + buckets.stop_utc_ns // 2) / 1e9
    return {
        "name": one["name"],
        "kind": one["kind"],
        "time_s": np.round(middle, 3).tolist(),
        "min_m": np.round(buckets.low, 3).tolist(),
        "max_m": np.round(buckets.high, 3).tolist(),
        "mean_m": np.round(buckets.mean, 3).tolist(),
        "after_gap": buckets.after_gap.tolist(),
    }
