"""The report of one pass: a `PassReport` laid out as a document."""

from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from reports.document import Block, Document
from reports.errors import InconsistentReport
from reports.figures.canvas import TimeScale
from reports.figures.theme import series_styles
from reports.sections.accounting import frames_and_packets
from reports.sections.common import PassView
from reports.sections.detection import detector_section, galleries
from reports.sections.matching import matching
from reports.sections.navigation import altitude, consistency_section, dependence, drift, errors
from reports.sections.opening import about, provenance_and_data
from reports.sections.payload_map import payload_map
from reports.sections.records import configuration, ledger
from reports.sections.summary import summary
from reports.sections.surroundings import ground_track, housekeeping_and_events
from reports.text import duration_text, utc_text
from reports.values import PassReport


def pass_document(report: PassReport) -> Document:
    """The document of a pass.

    Raises
    ------
    InconsistentReport
        when arrays of one series differ in length
    """
    check(report)
    view = PassView(report, _time_scale(report), series_styles([(s.name, s.kind) for s in report.navigation]))
    sections: tuple[Callable[[PassView], list[Block]], ...] = (
        lambda v: provenance_and_data(v.report),
        frames_and_packets,
        matching,
        errors,
        drift,
        altitude,
        consistency_section,
        dependence,
        detector_section,
        galleries,
        payload_map,
        ground_track,
        housekeeping_and_events,
        ledger,
        configuration,
    )
    blocks: list[Block] = summary(view)
    for section in sections:
        blocks.extend(section(view))
    return Document("Pass report", report.title, report.pass_id, _about(view), tuple(blocks))


def check(report: PassReport) -> None:
    """Refuse a report whose arrays do not fit together."""
    for one in report.navigation:
        n = len(one.utc_ns)
        where = f"navigation series {one.name!r}"
        shapes: dict[str, tuple[NDArray[Any] | None, tuple[int, ...]]] = {
            "latitude_deg": (one.latitude_deg, (n,)),
            "longitude_deg": (one.longitude_deg, (n,)),
            "altitude_m": (one.altitude_m, (n,)),
            "error_rtn_m": (one.error_rtn_m, (n, 3)),
            "sigma_rtn_m": (one.sigma_rtn_m, (n, 3)),
            "reset_error_m": (one.reset_error_m, (n,)),
            "matched": (one.matched, (n,)),
            "nis": (one.nis, (n,)),
            "nis_dof": (one.nis_dof, (n,)),
            "nees": (one.nees, (n,)),
            "squared_normalised_errors": (one.squared_normalised_errors, (n,)),
            "sun_elevation_deg": (one.sun_elevation_deg, (n,)),
            "time_since_fix_s": (one.time_since_fix_s, (n,)),
        }
        for name, (value, shape) in shapes.items():
            if value is not None and value.shape != shape:
                raise InconsistentReport(f"{where}, {name}", f"shape {shape}", f"shape {value.shape}")
        for name, labels in (("outcome", one.outcome), ("reset_trigger", one.reset_trigger), ("terrain", one.terrain)):
            if labels and len(labels) != n:
                raise InconsistentReport(f"{where}, {name}", f"{n} labels", str(len(labels)))
    track = report.reference
    if track is not None and not (
        len(track.utc_ns) == len(track.latitude_deg) == len(track.longitude_deg) == len(track.altitude_m)
    ):
        raise InconsistentReport("reference track", f"{len(track.utc_ns)} samples in every array", "another number")


def _time_scale(report: PassReport) -> TimeScale:
    if report.span is not None:
        return TimeScale(report.span.start_utc_ns, report.span.stop_utc_ns)
    arrays = [s.utc_ns for s in report.navigation if len(s.utc_ns)]
    if report.reference is not None and len(report.reference.utc_ns):
        arrays.append(report.reference.utc_ns)
    if not arrays:
        return TimeScale(0, 1_000_000_000)
    return TimeScale(min(int(a.min()) for a in arrays), max(int(a.max()) for a in arrays) + 1)


def _about(view: PassView) -> tuple[tuple[str, str], ...]:
    time = view.time
    if time.start_utc_ns <= 0:
        return about(view.report)
    return about(
        view.report,
        ("From", utc_text(time.start_utc_ns)),
        ("to", utc_text(time.stop_utc_ns)),
        ("length", duration_text(time.length_s)),
    )
