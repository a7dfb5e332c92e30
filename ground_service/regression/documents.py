"""A verdict written down: JSON for scripts, JUnit XML for continuous integration, a page for people."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import asdict, fields
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
from ground_service.regression.gates.core import FAIL, INCONCLUSIVE, INFORMS, NOT_JUDGED, PASS, Gate
from ground_service.regression.gates.metrics import metrics_of
from ground_service.regression.gates.samples import PassFrames
from ground_service.regression.headline import headline
from ground_service.regression.model import Verdict
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

PASS_METRICS = (("precision", "precision"), ("recall", "recall"), ("localisation_px", "localisation"))
"""Fields of a pass in the report, and the metrics of the detector."""

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
                    "fail_level": outcome.policy.policy.fail_level,
                    "inconclusive": outcome.policy.policy.inconclusive,
                },
                "headline": headline(outcome),
                "frames": outcome.frames_judged,
                "frames_needed": outcome.frames_needed,
                "gates": [_gate(gate) for gate in outcome.gates],
                "passes": [_pass(one) for one in outcome.passes],
                "remarks": outcome.remarks,
            }
        )
    )


def regression_text(verdict: Verdict) -> str:
    """Return one screen for a terminal: the headline, then a line for each fact."""
    lines = [f"{verdict.headline}", f"  {verdict.candidate.title} against {verdict.baseline.title}"]
    for one in verdict.passes:
        if one.state != "judged":
            lines.append(f"  {one.name}: {one.state}: {one.detail}")
    order = (FAIL, INCONCLUSIVE, NOT_JUDGED, PASS)
    deciding = [gate for gate in verdict.gates if gate.outcome in order]
    for gate in sorted(deciding, key=lambda gate: order.index(gate.outcome)):
        if gate.waived:
            lines.append(f"  waived ({gate.outcome}): {gate.waived}: {gate.text}")
        elif not gate.passed:
            lines.append(f"  {gate.outcome}: {gate.text}")
    lines += [
        f"  informs: {gate.text}"
        for gate in verdict.gates
        if gate.outcome == INFORMS and (gate.reason or "").startswith(("worse", "better"))
    ]
    counts = {name: sum(gate.outcome == name for gate in deciding) for name in order}
    lines.append(
        f"  {counts[PASS]} of {len(deciding)} gates passed, {counts[FAIL]} failed, "
        f"{counts[INCONCLUSIVE]} inconclusive, {counts[NOT_JUDGED]} not judged, over "
        f"{sum(one.state in JUDGED_STATES for one in verdict.passes)} of {len(verdict.passes)} passes "
        f"({verdict.frames} frames)"
    )
    lines += [f"  {remark}" for remark in verdict.remarks]
    return "\n".join(lines)


def regression_junit(verdict: Verdict, finished_utc_ns: int) -> str:
    """Return JUnit XML with a test case for every pass and every deciding gate.

    Elements, their order and their attributes are valid in the schema of the Jenkins xUnit plugin (junit-10.xsd) and in
    the stricter one of Apache Ant (JUnit.xsd). A pass that the candidate did not finish is one failure. What is
    inconclusive is a failure or skipped, as the policy says; a waived case is skipped with its reason. The time of a
    pass is that of the candidate's replay.
    """
    open_kind = "skipped" if verdict.policy.inconclusive == "skip" else "failure"
    cases: list[tuple[str, str, str, str, float]] = []
    for one in verdict.passes:
        kind = {"candidate failed": "failure", NOT_JUDGED: "skipped"}.get(one.state, "error")
        if one.state in JUDGED_STATES:
            kind = ""
        seconds = one.candidate.wall_s if one.candidate else 0.0
        cases.append((one.name, "passes", kind, one.detail and f"{one.state}: {one.detail}", seconds))
    for gate in verdict.gates:
        if gate.outcome == INFORMS:
            continue
        kind = {PASS: "", FAIL: "failure", INCONCLUSIVE: open_kind, NOT_JUDGED: "skipped"}[gate.outcome]
        text = f"{gate.outcome}: {gate.text}"
        if gate.waived:
            kind, text = "skipped", f"waived: {gate.waived}; {text}"
        cases.append((" on ".join(filter(None, (gate.name, gate.pass_name))), "gates", kind, text, 0.0))
    if not verdict.gates and all(one.state != "candidate failed" for one in verdict.passes):
        cases.append(("gates", "gates", open_kind, "inconclusive: no gate was judged", 0.0))
    kinds = [kind for _, _, kind, _, _ in cases]
    suite = ET.Element(
        "testsuite",
        name=_xml(f"linna regress {verdict.candidate.name} {verdict.candidate.version}".rstrip()),
        # The schema of Apache Ant permits neither fractions of a second nor a time zone: this is UTC.
        timestamp=format_utc(finished_utc_ns)[:19],
        hostname="localhost",
        tests=str(len(cases)),
        failures=str(kinds.count("failure")),
        errors=str(kinds.count("error")),
        skipped=str(kinds.count("skipped")),
        time=f"{sum(seconds for *_, seconds in cases):.3f}",
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
    for name, group, kind, text, seconds in cases:
        case = ET.SubElement(
            suite, "testcase", name=_xml(name), classname=f"linna.regress.{group}", time=f"{seconds:.3f}"
        )
        if kind == "skipped":
            ET.SubElement(case, kind, message=_xml(text))
        elif kind:
            ET.SubElement(case, kind, message=_xml(text), type=text.split(":")[0])
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
        gates=tuple(_report_gate(gate) for gate in outcome.gates if gate.outcome != INFORMS),
        candidate_passes=tuple(_regression_pass(one, "candidate") for one in judged),
        baseline_passes=tuple(_regression_pass(one, "baseline") for one in judged),
        changed_frames=tuple(changed_frames(ground, judged)),
        verdict=headline(outcome).capitalize() + ".",
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
            "A gate fails if the lower bound of the loss is above what is material, at a level of "
            f"{outcome.policy.policy.fail_level:g} for all gates together. It passes if the upper 95 % bound is below "
            "the margin. Otherwise it is inconclusive. Units: tracks of craters, ground cells, blocks of frames, "
            "passes. Claims are on these passes.",
        ),
    )


def changed_frames(ground: Ground, judged: list[PassVerdict]) -> list[ChangedFrame]:
    """The frames that changed most between the builds: most craters found by one and not by the other."""
    rows = []
    for one in judged:
        assert one.context and one.baseline_read and one.candidate_read
        change, moved = (
            np.abs(new - old)
            for old, new in zip(
                *(_seen(read.frames) for read in (one.baseline_read, one.candidate_read)), strict=True
            )
        )
        rows += [
            (float(change[i]), float(moved[i]), one, int(i))
            for i in np.lexsort((-moved, -change))[:CHANGED_FRAMES]
            if change[i] + moved[i] > 0.0 and one.context.frame_names[i]
        ]
    rows.sort(key=lambda row: (-row[0], -row[1], row[2].name, row[3]))
    return [_changed_frame(ground, one, frame) for _, _, one, frame in rows[:CHANGED_FRAMES]]


def _seen(frames: PassFrames) -> tuple[Any, Any]:
    """Return the hits less the false detections, and the sum of the shifts of the centres, of each frame (n,)."""
    craters, found, n = frames.craters, frames.detections, len(frames)
    explained = np.bincount(found.frame, weights=np.where(found.true, 1.0, -1.0), minlength=n)
    shift = np.bincount(craters.frame, weights=np.nan_to_num(craters.du_px + craters.dv_px), minlength=n)
    return explained, shift


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
    row = asdict(gate)
    bounds = [row.pop("change_low"), row.pop("change_high")]
    texts = {
        "pass": row.pop("pass_name") or None,
        "reason": gate.reason or None,
        "waived": gate.waived or None,
    }
    return {**row, **texts, "passed": gate.passed, "change_bounds": bounds}


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
    names = [field.name for field in fields(RegressionGate) if field.name != "pass_id"]
    return RegressionGate(pass_id=gate.pass_name, **{name: getattr(gate, name) for name in names})


def _regression_pass(one: PassVerdict, side: str) -> RegressionPass:
    assert one.context and one.baseline_read and one.candidate_read
    frames = (one.candidate_read if side == "candidate" else one.baseline_read).frames
    metrics = {metric.name: metric for metric in metrics_of([frames])}
    return RegressionPass(
        pass_id=one.name,
        start_utc_ns=int(one.context.frame_utc_ns[0]),
        build=side,
        light=str(one.context.manifest.get("light", "")),
        frames_expected=len(frames),
        frames_processed=int(frames.answered.sum()),
        packets=int(frames.packets.sum()),
        **{field: metrics[f"detector.{name}"].value(frames) for field, name in PASS_METRICS},
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
    )
    by_name: Mapping[str, Gate] = {gate.name: gate for gate in outcome.gates if not gate.pass_name}
    figures = []
    for name, label, scale, unit in wanted:
        gate = by_name.get(name)
        if gate is None:
            figures.append(HeadlineFigure(label, None, unit, "not measured"))
        else:
            told = f"baseline {scale * gate.baseline:.3g} {unit}"
            figures.append(HeadlineFigure(label, scale * gate.candidate, unit, told))
    return tuple(figures)
