"""A verdict written down: JSON for scripts, JUnit XML for continuous integration, a page for people."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ground_service.evaluation.detection.recall import expected_craters, match_detections
from ground_service.evaluation.inputs import read_image
from ground_service.evaluation.navigation.alignment import reference_states
from ground_service.evaluation.navigation.drift import navigation_statistics
from ground_service.evaluation.service import plain
from ground_service.ground import Ground
from ground_service.missions.model import weakest_evidence
from ground_service.regression import store
from ground_service.regression.archives import store_of
from ground_service.regression.gates.core import FAIL, INCONCLUSIVE, NOT_JUDGED, PASS, Gate
from ground_service.regression.model import JudgedGate, Verdict
from ground_service.regression.outcome import (
    JUDGED,
    JUDGED_STATES,
    PassVerdict,
    RegressionOutcome,
    pass_figures,
)
from ground_service.regression.replay_samples import PassContext, ReadDownlink
from lunar.timescales import format_utc
from reports.values import (
    ChangedFrame,
    GalleryFrame,
    HeadlineFigure,
    NavigationStatistics,
    RegressionGate,
    RegressionPass,
    RegressionReport,
)

CHANGED_FRAMES = 4
"""Frames shown side by side: those that changed most."""


def verdict_document(outcome: RegressionOutcome) -> Verdict:
    """Return the verdict as it is stored and printed; NaN and infinities are null."""
    return Verdict.model_validate(
        plain(
            {
                "verdict": outcome.verdict,
                "baseline": _build(outcome.baseline),
                "candidate": _build(outcome.candidate),
                "policy": {
                    "version": outcome.policy.policy.version,
                    "sha256": outcome.policy.sha256,
                    "confidence": outcome.policy.policy.confidence,
                    "power": outcome.policy.policy.power,
                },
                "frames": outcome.frames_judged,
                "frames_needed": outcome.frames_needed,
                "gates": [_gate(gate) for gate in outcome.gates],
                "passes": [_pass(one) for one in outcome.passes],
                "remarks": outcome.remarks,
            }
        )
    )


def regression_text(verdict: Verdict) -> str:
    """Return a summary for a terminal: verdict, failed and inconclusive gates, and the number of frames needed."""
    lines = [f"{verdict.candidate.title} against {verdict.baseline.title}: {verdict.verdict}"]
    for one in verdict.passes:
        if one.state != "judged":
            lines.append(f"  {one.name}: {one.state}: {one.detail}")
    order = (FAIL, INCONCLUSIVE, NOT_JUDGED, PASS)
    for gate in sorted(verdict.gates, key=lambda gate: order.index(gate.outcome)):
        if gate.passed:
            continue
        where = f" on {gate.pass_name}" if gate.pass_name else ""
        state = f"waived ({gate.outcome}): {gate.waived}" if gate.waived else gate.outcome
        lines.append(f"  {state}: {gate.name}{where}: {gate_text(gate)}")
    counts = {name: sum(gate.outcome == name for gate in verdict.gates) for name in order}
    lines.append(
        f"  {counts[PASS]} of {len(verdict.gates)} gates passed, {counts[FAIL]} failed, "
        f"{counts[INCONCLUSIVE]} inconclusive, "
        + (f"{counts[NOT_JUDGED]} not judged, " if counts[NOT_JUDGED] else "")
        + f"over {sum(one.state in JUDGED_STATES for one in verdict.passes)} of {len(verdict.passes)} passes "
        f"({verdict.frames} frames)"
    )
    if not verdict.gates:
        lines.append("  No gate was judged: the passes above give no comparable metric")
    if needed_text(verdict):
        lines.append(f"  {needed_text(verdict)}")
    lines += [f"  {remark}" for remark in verdict.remarks]
    return "\n".join(lines)


def gate_text(gate: JudgedGate) -> str:
    """Return the values of a gate, why it is inconclusive, and the number of frames needed."""
    if gate.outcome == NOT_JUDGED:
        return gate.reason or ""
    parts = [
        f"{_number(gate.baseline)} -> {_number(gate.candidate)} {gate.unit}".rstrip(),
        f"limit {_number(gate.limit)}",
    ]
    if gate.outcome == INCONCLUSIVE:
        reason = gate.reason or ""
        parts.append(reason)
        if not reason.startswith("unknown"):
            parts.append(f"resolution {_number(gate.resolution)}, margin {gate.margin:.3g}")
            parts.append(f"{gate.frames} frames, {_needed(gate.frames_needed)}")
    elif gate.reason:
        parts.append(gate.reason)
    return ", ".join(parts)


def needed_text(verdict: Verdict) -> str:
    """Return the number of frames and passes needed to decide every gate over the suite; empty if all are decided."""
    needed, frames = verdict.frames_needed, verdict.frames
    judged = sum(one.state in JUDGED_STATES for one in verdict.passes)
    if needed is None or needed <= frames or not judged:
        return ""
    passes = math.ceil(needed * judged / frames)
    return f"{needed:,} frames are needed to decide every gate over the suite (about {passes:,} passes of this length)"


def _needed(frames: int | None) -> str:
    return "needs an unknown number" if frames is None else f"needs {frames:,}"


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4g}"


def regression_junit(verdict: Verdict, finished_utc_ns: int) -> str:
    """Return JUnit XML with a test case for every gate and every pass.

    Elements, their order and their attributes are valid in the schema of the Jenkins xUnit plugin (junit-10.xsd) and in
    the stricter one of Apache Ant (JUnit.xsd). An inconclusive case is an error, which is neither a pass nor a failure;
    a waived case is skipped with its reason.
    """
    cases: list[tuple[str, str, str, str]] = []
    for one in verdict.passes:
        kind = {"candidate failed": "failure", NOT_JUDGED: "skipped"}.get(one.state, "error")
        if one.state in JUDGED_STATES:
            kind = ""
        cases.append((f"pass {one.name}", "passes", kind, one.detail and f"{one.state}: {one.detail}"))
    for gate in verdict.gates:
        kind = {PASS: "", FAIL: "failure", INCONCLUSIVE: "error", NOT_JUDGED: "skipped"}[gate.outcome]
        text = f"{gate.outcome}: {gate_text(gate)}"
        if gate.waived:
            kind, text = "skipped", f"waived: {gate.waived}; {text}"
        cases.append((f"{gate.name} ({gate.pass_name or 'suite'})", "gates", kind, text))
    if not verdict.gates:
        cases.append(("gates", "gates", "error", "inconclusive: no gate was judged"))
    kinds = [kind for _, _, kind, _ in cases]
    suite = ET.Element(
        "testsuite",
        name="linna regress",
        # The schema of Apache Ant permits neither fractions of a second nor a time zone: this is UTC.
        timestamp=format_utc(finished_utc_ns)[:19],
        hostname="localhost",
        tests=str(len(cases)),
        failures=str(kinds.count("failure")),
        errors=str(kinds.count("error")),
        skipped=str(kinds.count("skipped")),
        time="0",
    )
    properties = ET.SubElement(suite, "properties")
    for name, value in (
        ("verdict", verdict.verdict),
        ("candidate", verdict.candidate.digest),
        ("baseline", verdict.baseline.digest),
        ("policy", verdict.policy.sha256),
        ("frames", str(verdict.frames)),
        ("frames_needed", "unknown" if verdict.frames_needed is None else str(verdict.frames_needed)),
    ):
        ET.SubElement(properties, "property", name=name, value=value)
    for name, group, kind, text in cases:
        case = ET.SubElement(suite, "testcase", name=_xml(name), classname=f"regress.{group}", time="0")
        if kind == "skipped":
            ET.SubElement(case, kind, message=_xml(text))
        elif kind:
            ET.SubElement(case, kind, message=_xml(text), type="inconclusive" if kind == "error" else "fail")
    ET.SubElement(suite, "system-out").text = _xml(regression_text(verdict))
    ET.SubElement(suite, "system-err")
    ET.indent(suite)
    return ET.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def _xml(text: str) -> str:
    """Return a text without the control characters that XML forbids."""
    return "".join(c if c in "\t\n" or ord(c) >= 32 else "\N{REPLACEMENT CHARACTER}" for c in text)


def regression_html(ground: Ground, outcome: RegressionOutcome, identity: str) -> str:
    """The report of a regression as one HTML file."""
    from reports.render import render_html

    return render_html(regression_report(ground, outcome, identity))


def regression_report(ground: Ground, outcome: RegressionOutcome, identity: str) -> RegressionReport:
    """The report of a regression as a value."""
    judged = [one for one in outcome.passes if one.state == JUDGED]
    troubled = [one for one in outcome.passes if one.state != JUDGED]
    sources = sorted(
        {str(name) for one in judged if one.context for name in one.context.manifest.get("data_sources", ())}
    )
    return RegressionReport(
        title=f"{outcome.candidate.name} {outcome.candidate.version}".strip()
        + f" against {outcome.baseline.name} {outcome.baseline.version}".rstrip(),
        regression_id=identity,
        candidate=outcome.candidate.title,
        baseline=outcome.baseline.title,
        gates=tuple(_report_gate(gate) for gate in outcome.gates),
        candidate_passes=tuple(_regression_pass(one, "candidate") for one in judged),
        baseline_passes=tuple(_regression_pass(one, "baseline") for one in judged),
        changed_frames=tuple(changed_frames(ground, judged)),
        verdict=_verdict_text(outcome, troubled),
        verdict_level=outcome.verdict,
        evidence_level=weakest_evidence([one.context.evidence for one in judged if one.context]),
        headline=_headline(outcome),
        provenance={
            "candidate": outcome.candidate.digest,
            "baseline": outcome.baseline.digest,
            "policy": f"version {outcome.policy.policy.version}, {outcome.policy.sha256}",
            **{f"candidate, {key}": value for key, value in outcome.candidate.provenance},
            **{f"archive {one.name}": one.digest for one in outcome.passes if one.digest},
        },
        data_sources=tuple(sources),
        remarks=(
            *(f"{one.name}: {one.state}: {one.detail}" for one in troubled),
            *outcome.remarks,
            "A gate passes if the frames resolve the margin of the policy and the upper confidence bound of the "
            "degradation is within it. It fails if the degradation exceeds the margin by more than chance explains "
            "(paired by frame, one-sided Student's t with the autocorrelation of the frames, Holm's procedure over "
            "all gates). Otherwise it is inconclusive. "
            f"Confidence {outcome.policy.policy.confidence:g}, power {outcome.policy.policy.power:g}.",
        ),
    )


def changed_frames(ground: Ground, judged: list[PassVerdict]) -> list[ChangedFrame]:
    """The frames that changed most between the builds: most craters found by one and not by the other."""
    rows = []
    for one in judged:
        assert one.context and one.baseline_read and one.candidate_read
        old, new = one.baseline_read.frames, one.candidate_read.frames
        change = np.abs(new.hits - old.hits) + np.abs(new.alarms - old.alarms)
        moved = np.abs(new.shift_u_px - old.shift_u_px) + np.abs(new.shift_v_px - old.shift_v_px)
        rows += [
            (float(change[i]), float(moved[i]), one, int(i))
            for i in np.lexsort((-moved, -change))[:CHANGED_FRAMES]
            if change[i] + moved[i] > 0.0 and one.context.frame_names[i]
        ]
    rows.sort(key=lambda row: (-row[0], -row[1], row[2].name, row[3]))
    return [_changed_frame(ground, one, frame) for _, _, one, frame in rows[:CHANGED_FRAMES]]


def _changed_frame(ground: Ground, one: PassVerdict, frame: int) -> ChangedFrame:
    assert one.context and one.baseline_read and one.candidate_read
    context = one.context
    with ground.database.reading() as connection:
        archive = store.get_archive(connection, one.digest)
    files = store_of(ground)
    manifest = json.loads(files.get(archive.manifest_sha256))
    octets = files.get(manifest["files"][context.frame_names[frame]]["sha256"])
    image = read_image(octets, context.frame_names[frame])
    sides = [
        _side(context, read, frame, image, label)
        for read, label in ((one.baseline_read, "baseline"), (one.candidate_read, "candidate"))
    ]
    return ChangedFrame(one.name, sides[0], sides[1])


def _side(context: PassContext, read: ReadDownlink, frame: int, image: Any, label: str) -> GalleryFrame:
    detections = read.detections
    at = int(np.searchsorted(detections.frame_number, frame))
    present = at < len(detections) and detections.frame_number[at] == frame
    d = slice(int(detections.offsets[at]), int(detections.offsets[at + 1])) if present else slice(0, 0)
    utc = context.frame_utc_ns[frame : frame + 1]
    track = reference_states(context.reference, context.orientation, utc)
    rotations = context.viewing.camera_from_mcmf(utc, track.position_mcmf_m, track.mcmf_from_icrf)
    expected = expected_craters(context.catalogue, context.camera, track.position_mcmf_m, rotations)
    single = _one_frame(detections, d)
    matches = match_detections(single, expected)
    scored = np.isin(expected.size_class, (0, 1, 2))
    found = matches.detection_of_crater[scored] >= 0
    return GalleryFrame(
        frame_number=frame,
        utc_ns=int(utc[0]),
        image=image,
        detection_u_px=single.u_px,
        detection_v_px=single.v_px,
        detection_diameter_px=single.diameter_px,
        detection_class=single.size_class,
        catalogue_u_px=expected.u_px[scored],
        catalogue_v_px=expected.v_px[scored],
        catalogue_diameter_px=expected.diameter_px[scored],
        catalogue_class=expected.size_class[scored],
        detection_matched=matches.crater_of_detection >= 0,
        catalogue_matched=found,
        caption=f"{label}, {context.name}: {int(found.sum())} of {len(found)} craters of 5–30 km",
    )


def _one_frame(detections: Any, rows: slice) -> Any:
    from ground_service.passes.samples import DetectionSamples

    return DetectionSamples(
        np.zeros(1, dtype=np.int64),
        np.zeros(1, dtype=np.int64),
        np.ones(1, dtype=np.bool_),
        (),
        np.array([0, rows.stop - rows.start], dtype=np.int64),
        detections.u_px[rows],
        detections.v_px[rows],
        detections.diameter_px[rows],
        detections.score[rows],
        detections.size_class[rows],
    )


def _build(build: Any) -> dict[str, Any]:
    return {
        "name": build.name,
        "version": build.version,
        "digest": build.digest,
        "flight_code": build.flight_code or None,
        "provenance": dict(build.provenance),
    }


def _gate(gate: Gate) -> dict[str, Any]:
    return {
        "name": gate.name,
        "pass": gate.pass_name or None,
        "outcome": gate.outcome,
        "passed": gate.passed,
        "baseline": gate.baseline,
        "candidate": gate.candidate,
        "margin": gate.margin,
        "limit": gate.limit,
        "unit": gate.unit,
        "change_bounds": [gate.change_low, gate.change_high],
        "p_value": gate.p_value,
        "level": gate.level,
        "resolution": gate.resolution,
        "frames": gate.frames,
        "frames_needed": gate.frames_needed,
        "reason": gate.reason or None,
        "waived": gate.waived or None,
    }


def _pass(one: PassVerdict) -> dict[str, Any]:
    found: dict[str, Any] = {
        "name": one.name,
        "archive": one.digest,
        "state": one.state,
        "detail": one.detail,
    }
    for label, replay, read in (
        ("baseline", one.baseline, one.baseline_read),
        ("candidate", one.candidate, one.candidate_read),
    ):
        if replay is None:
            continue
        found[label] = {
            "outcome": replay.outcome,
            "detail": replay.detail,
            "cpu_s": replay.cpu_s,
            "wall_s": replay.wall_s,
            "peak_rss_mib": replay.peak_rss_mib,
            **(pass_figures(read.frames) if read is not None else {}),
        }
    if one.baseline_read is not None:
        found["frames"] = len(one.baseline_read.frames)
    return found


def _report_gate(gate: Gate) -> RegressionGate:
    return RegressionGate(
        name=gate.name,
        baseline=gate.baseline,
        candidate=gate.candidate,
        limit=gate.limit,
        outcome=gate.outcome,
        unit=gate.unit,
        pass_id=gate.pass_name,
        margin=gate.margin,
        resolution=gate.resolution,
        frames=gate.frames,
        frames_needed=gate.frames_needed,
        reason=gate.reason,
        waived=gate.waived,
    )


def _regression_pass(one: PassVerdict, side: str) -> RegressionPass:
    assert one.context and one.baseline_read and one.candidate_read
    frames = (one.candidate_read if side == "candidate" else one.baseline_read).frames
    hits, expected = float(frames.hits.sum()), float(frames.expected.sum())
    found = hits + float(frames.alarms.sum())
    return RegressionPass(
        pass_id=one.name,
        start_utc_ns=int(one.context.frame_utc_ns[0]),
        build=side,
        light=str(one.context.manifest.get("light", "")),
        frames_expected=len(frames),
        frames_processed=int(frames.answered.sum()),
        packets=int(frames.packets.sum()),
        precision=hits / found if found else float("nan"),
        recall=hits / expected if expected else float("nan"),
        localisation_px=float(frames.error_px.sum()) / hits if hits else float("nan"),
        navigation={name: _statistics(estimator) for name, estimator in frames.estimators.items()},
    )


def _statistics(estimator: Any) -> NavigationStatistics:
    along = np.column_stack(
        [estimator.error_m, np.zeros(len(estimator.error_m)), np.zeros(len(estimator.error_m))]
    )
    return navigation_statistics(
        along, np.zeros(len(estimator.error_m)), np.zeros(len(estimator.error_m), dtype=np.bool_)
    )


def _headline(outcome: RegressionOutcome) -> tuple[HeadlineFigure, ...]:
    wanted = (
        ("detector.recall", "Recall", 100.0, "%"),
        ("detector.precision", "Precision", 100.0, "%"),
        ("navigation.anchored.p50", "Median error, anchored", 1.0, "m"),
        ("navigation.anchored.p95", "95 % error, anchored", 1.0, "m"),
        ("latency.network", "Network, against baseline", 0.0, "%"),
    )
    by_name: Mapping[str, Gate] = {gate.name: gate for gate in outcome.gates if not gate.pass_name}
    figures = []
    for name, label, scale, unit in wanted:
        gate = by_name.get(name)
        if gate is None or (scale == 0.0 and not gate.baseline > 0.0):
            figures.append(HeadlineFigure(label, None, unit, "not gated"))
        elif scale == 0.0:
            figures.append(
                HeadlineFigure(label, 100.0 * (gate.candidate / gate.baseline - 1.0), unit, "CPU time")
            )
        else:
            figures.append(
                HeadlineFigure(
                    label, scale * gate.candidate, unit, f"baseline {scale * gate.baseline:.3g} {unit}"
                )
            )
    return tuple(figures)


def _verdict_text(outcome: RegressionOutcome, troubled: list[PassVerdict]) -> str:
    failed = [gate for gate in outcome.gates if gate.outcome == FAIL and not gate.waived]
    unresolved = [gate for gate in outcome.gates if gate.outcome == INCONCLUSIVE and not gate.waived]
    waived = [gate for gate in outcome.gates if gate.waived]
    parts = [outcome.verdict.capitalize() + "."]
    if failed:
        parts.append(f"{_counted(failed, 'failed')}.")
    if unresolved:
        parts.append(f"{_counted(unresolved, 'inconclusive')}.")
    unjudged = [gate for gate in outcome.gates if gate.outcome == NOT_JUDGED]
    if len(unjudged) == len(outcome.gates):
        parts.append("No gate was judged.")
    elif not failed and not unresolved:
        parts.append(f"{sum(gate.passed for gate in outcome.gates)} of {len(outcome.gates)} gates passed.")
    if unjudged:
        parts.append(f"{_counted(unjudged, 'not judged')}.")
    if waived:
        parts.append(f"{_counted(waived, 'waived')}.")
    needed = needed_text(verdict_document(outcome))
    if needed:
        parts.append(f"{needed}.")
    if troubled:
        parts.append(
            f"{len(troubled)} of {len(outcome.passes)} passes were not judged, or without frames: see the remarks."
        )
    return " ".join(parts)


def _counted(gates: Sequence[Gate], state: str) -> str:
    names = list(dict.fromkeys(gate.name for gate in gates))
    more = f" and {len(names) - 6} others" if len(names) > 6 else ""
    return f"{len(gates)} {'gate' if len(gates) == 1 else 'gates'} {state}: {', '.join(names[:6])}{more}"
