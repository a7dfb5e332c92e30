"""A verdict written down: JSON for scripts, JUnit XML for continuous integration, a page for people."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any

import numpy as np

from ground_service.processing.alignment import reference_states
from ground_service.processing.drift import navigation_statistics
from ground_service.processing.recall import expected_craters, match_detections
from ground_service.processing.regression_gates import Gate
from ground_service.services.ground import Ground
from ground_service.services.pass_data import read_image
from ground_service.services.regression_archives import store_of
from ground_service.services.regression_samples import PassContext, ReadDownlink
from ground_service.services.regressions import PassVerdict, RegressionOutcome, pass_figures
from ground_service.services.reports import plain
from ground_service.store import repository
from reports.values import (
    CampaignPass,
    ChangedFrame,
    GalleryFrame,
    HeadlineFigure,
    NavigationStatistics,
    RegressionGate,
    RegressionReport,
)

CHANGED_FRAMES = 4
"""Frames shown side by side: those that changed most."""


def regression_json(outcome: RegressionOutcome) -> dict[str, Any]:
    """The verdict for a script; NaN and infinities are null."""
    result: dict[str, Any] = plain(
        {
            "verdict": outcome.verdict,
            "baseline": _build(outcome.baseline),
            "candidate": _build(outcome.candidate),
            "policy": {
                "version": outcome.policy.policy.version,
                "sha256": outcome.policy.sha256,
                "alpha": outcome.policy.policy.alpha,
            },
            "gates": [_gate(gate) for gate in outcome.gates],
            "passes": [_pass(one) for one in outcome.passes],
            "remarks": list(outcome.remarks),
        }
    )
    return result


def regression_text(outcome: RegressionOutcome) -> str:
    """A few lines for a terminal: the verdict, what failed, what could not be judged."""
    lines = [f"{outcome.candidate.title} against {outcome.baseline.title}: {outcome.verdict}"]
    for one in outcome.passes:
        if one.state != "judged":
            lines.append(f"  {one.name}: {one.state}: {one.detail}")
    failed = [gate for gate in outcome.gates if not gate.passed]
    for gate in failed:
        where = f" on {gate.pass_name}" if gate.pass_name else ""
        state = f"waived: {gate.waived}" if gate.waived else "failed"
        lines.append(
            f"  {gate.name}{where}: {gate.baseline:.4g} -> {gate.candidate:.4g} {gate.unit}, "
            f"limit {gate.limit:.4g}: {state}"
        )
    lines.append(
        f"  {len(outcome.gates) - len(failed)} of {len(outcome.gates)} gates passed over "
        f"{sum(one.state == 'judged' for one in outcome.passes)} of {len(outcome.passes)} passes"
    )
    lines += [f"  {remark}" for remark in outcome.remarks]
    return "\n".join(lines)


def regression_junit(outcome: RegressionOutcome) -> str:
    """JUnit XML: a case for every gate and for every pass."""
    cases = [
        (f"pass {one.name}", "passes", "" if one.state == "judged" else one.detail, one.state)
        for one in outcome.passes
    ]
    for gate in outcome.gates:
        told = f"{gate.baseline:.6g} -> {gate.candidate:.6g} {gate.unit}, limit {gate.limit:.6g}"
        name = f"{gate.name} ({gate.pass_name or 'suite'})"
        cases.append((name, "gates", "" if gate.passed else told, "waived" if gate.waived else "failed"))
    suite = ET.Element("testsuite", name="linna regress", tests=str(len(cases)))
    failures = errors = skipped = 0
    for name, kind, message, state in cases:
        case = ET.SubElement(suite, "testcase", name=name, classname=f"regress.{kind}")
        if not message:
            continue
        if state == "waived":
            ET.SubElement(case, "skipped", message=message)
            skipped += 1
        elif state in ("unusable", "baseline failed"):
            ET.SubElement(case, "error", message=message, type=state)
            errors += 1
        else:
            ET.SubElement(case, "failure", message=message, type=state)
            failures += 1
    suite.set("failures", str(failures))
    suite.set("errors", str(errors))
    suite.set("skipped", str(skipped))
    ET.indent(suite)
    return ET.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def regression_html(ground: Ground, outcome: RegressionOutcome, identity: str) -> str:
    """The report of a regression as one HTML file."""
    from reports.render import render_html

    return render_html(regression_report(ground, outcome, identity))


def regression_report(ground: Ground, outcome: RegressionOutcome, identity: str) -> RegressionReport:
    """The report of a regression as a value."""
    judged = [one for one in outcome.passes if one.state == "judged"]
    failed = [gate for gate in outcome.gates if not gate.counts_as_passed]
    troubled = [one for one in outcome.passes if one.state != "judged"]
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
        candidate_passes=tuple(_campaign_pass(one, "candidate") for one in judged),
        baseline_passes=tuple(_campaign_pass(one, "baseline") for one in judged),
        changed_frames=tuple(changed_frames(ground, judged)),
        verdict=_verdict_text(outcome, failed, troubled),
        verdict_level={"pass": "good", "fail": "bad", "incomplete": "caution"}[outcome.verdict],
        evidence_rung=_rung(sources),
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
            "A gate fails when the worsening exceeds what the policy tolerates by more than chance explains: one-sided "
            "t on a bootstrap over blocks of "
            f"{outcome.policy.policy.block_frames} frames, both builds resampled together, Holm's procedure over the "
            f"gates of the suite and over those of single passes, {outcome.policy.policy.alpha:g} in all.",
            *_coarse(outcome),
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
        row = repository.get(connection, repository.REGRESSION_ARCHIVES, one.digest, "archive")
    import json

    files = store_of(ground)
    manifest = json.loads(files.get(row["manifest_sha256"]))
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
    expected = expected_craters(context.catalogue, context.camera, track.position_mcmf_m)
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
    from ground_service.processing.samples import DetectionSamples

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
        "baseline": gate.baseline,
        "candidate": gate.candidate,
        "limit": gate.limit,
        "passed": gate.passed,
        "unit": gate.unit,
        "change_95": [gate.low, gate.high],
        "p_value": gate.p_value,
        "level": gate.level,
        "resolution": gate.resolution,
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
    name = f"{gate.name} (waived)" if gate.waived and not gate.passed else gate.name
    return RegressionGate(
        name, gate.baseline, gate.candidate, gate.limit, gate.counts_as_passed, gate.unit, gate.pass_name
    )


def _campaign_pass(one: PassVerdict, side: str) -> CampaignPass:
    assert one.context and one.baseline_read and one.candidate_read
    frames = (one.candidate_read if side == "candidate" else one.baseline_read).frames
    hits, expected = float(frames.hits.sum()), float(frames.expected.sum())
    found = hits + float(frames.alarms.sum())
    return CampaignPass(
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


def _verdict_text(outcome: RegressionOutcome, failed: list[Gate], troubled: list[PassVerdict]) -> str:
    parts = []
    if failed:
        names = list(dict.fromkeys(gate.name for gate in failed))
        parts.append(
            f"{len(failed)} gates failed: {', '.join(names[:6])}{' and others' if len(names) > 6 else ''}."
        )
    else:
        parts.append(f"All {len(outcome.gates)} gates passed.")
    if troubled:
        parts.append(f"{len(troubled)} of {len(outcome.passes)} passes were not judged: see the remarks.")
    return " ".join(parts)


def _coarse(outcome: RegressionOutcome) -> list[str]:
    """What the passes were too few to see."""
    gate = next((g for g in outcome.gates if g.name == "detector.recall" and not g.pass_name), None)
    if gate is None or not np.isfinite(gate.resolution):
        return []
    return [
        f"These passes show a loss of recall of {gate.resolution:.3f} or more with a probability of nine in ten."
    ]


def _rung(sources: list[str]) -> str:
    return "2" if any("procedural" in name for name in sources) else "3" if sources else ""
