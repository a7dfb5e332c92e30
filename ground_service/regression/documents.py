"""A verdict as documents: headline, JSON for scripts, JUnit XML for continuous integration, a page."""

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_service.evaluation.alignment import reference_states
from ground_service.evaluation.core import gallery_frame
from ground_service.evaluation.inputs import read_image
from ground_service.evaluation.recall import expected_craters, match_detections
from ground_service.evaluation.service import plain
from ground_service.ground import Ground
from ground_service.missions.model import weakest_evidence
from ground_service.regression import store
from ground_service.regression.archives import store_of
from ground_service.regression.gates.core import EXACT_METRICS, FAIL, IDENTICAL, INCONCLUSIVE, INFORMS, NOT_JUDGED, PASS
from ground_service.regression.gates.metrics import LATENCY, RUN, START, first_difference, metrics_of
from ground_service.regression.gates.samples import cell_places_deg
from ground_service.regression.model import UNUSABLE_STATES, Verdict
from ground_service.regression.outcome import JUDGED, JUDGED_STATES, PassVerdict, RegressionOutcome, pass_figures
from ground_service.regression.replay_samples import PassContext, ReadDownlink
from lunar.timescales import format_utc
from reports import values

SUSPICIOUS = 1.15
"""Ratio of the median position errors from which navigation may be affected."""

TIMES = (LATENCY, START, RUN)
NAMES = {
    "detector.recall": "recall",
    "detector.precision": "precision",
    "detector.localisation": "centre error",
    "navigation.anchored.fixes": "share of fixes",
    "navigation.anchored.p50": "median position error",
}


def headline(outcome: RegressionOutcome) -> str:
    """Return the verdict and its reason in one line; a pass without a judged processor time says so."""
    judged = any(gate.name in TIMES and gate.outcome != NOT_JUDGED for gate in outcome.gates)
    unknown = "" if judged or outcome.verdict != PASS else "; latency was not judged"
    return f"{outcome.verdict}: {_reason(outcome)}{unknown}"


def _reason(outcome: RegressionOutcome) -> str:
    gates = [gate for gate in outcome.gates if gate.outcome not in (INFORMS, NOT_JUDGED)]
    lost = [one for one in outcome.passes if one.state == "candidate failed"]
    if lost:
        more = f" and on {len(lost) - 1} more" if len(lost) > 1 else ""
        return f"{lost[0].detail}, on {lost[0].name}{more}"
    failed = [gate for gate in gates if gate.outcome == FAIL]
    if exact := [gate for gate in failed if gate.name in EXACT_METRICS]:
        return "; ".join(gate.reason for gate in exact)
    if failed:
        whole = [gate for gate in failed if not gate.pass_id] or failed[:1]
        failed.sort(key=lambda gate: -gate.change_low)
        places = list(dict.fromkeys(gate.pass_id for gate in failed if gate.pass_id))
        where = f", most on {', '.join(places[:3])}" if places else ""
        return f"{_changes(whole)}{where}, on {outcome.frames_judged} frames; {_navigation(outcome.gates)}"
    if outcome.verdict == INCONCLUSIVE:
        open_gates = [gate for gate in gates if gate.outcome == INCONCLUSIVE]
        troubled = [one for one in outcome.passes if one.state in UNUSABLE_STATES]
        troubled = troubled or [one for one in outcome.passes if one.detail and not open_gates]
        if troubled:
            return f"{troubled[0].name}: {troubled[0].detail}"
        if not open_gates:
            return "no gate was judged"
        needed = outcome.frames_needed
        more = f"; about {needed:,} frames decide, {outcome.frames_judged:,} were compared" if needed else ""
        message = "; ".join(f"{_name(gate)} {_figures(gate)}, {gate.reason}" for gate in open_gates[:2])
        return message + more
    if any(gate.reason.startswith(IDENTICAL) for gate in gates):
        return f"{IDENTICAL} on {outcome.frames_judged} frames"
    better = [gate for gate in gates if gate.outcome == PASS and gate.change_high < 0.0]
    if better:
        return f"better: {_changes(better)}, no loss beyond the margins; {_navigation(outcome.gates)}"
    return f"no loss beyond the margins on {outcome.frames_judged} frames; {_navigation(outcome.gates)}"


def _changes(gates: Sequence[values.Gate]) -> str:
    return ", ".join(f"{_name(gate)} {_figures(gate)}" for gate in gates)


def _name(gate: values.Gate) -> str:
    return NAMES.get(gate.name, gate.name)


def _figures(gate: values.Gate) -> str:
    change = gate.candidate - gate.baseline
    size = f"{abs(change):.3g} {gate.unit}".rstrip()
    return f"{'rises' if change > 0.0 else 'falls'} by {size} ({gate.baseline:.3g} to {gate.candidate:.3g})"


def _navigation(gates: Sequence[values.Gate]) -> str:
    """Return whether fixes and position errors are affected."""
    known = [
        gate
        for gate in gates
        if gate.name in NAMES and gate.name.startswith("navigation.") and math.isfinite(gate.baseline)
    ]
    if not known:
        return "the effect on navigation is unknown"
    figures = ", ".join(
        f"{_name(gate)} {gate.baseline:.3g} to {gate.candidate:.3g} {gate.unit}".rstrip() for gate in known
    )
    worse = [gate for gate in known if gate.unit and gate.candidate > SUSPICIOUS * gate.baseline]
    state = "may be affected" if worse else "holds"
    if any(gate.outcome == FAIL for gate in known):
        state = "is affected"
    return f"navigation {state}: {figures}"


PASS_METRICS = ("detector.recall", "detector.precision", "navigation.anchored.p50")
"""Metrics in the table of the passes."""

CHANGED_TRACKS = 10
CROP_PX = 160
"""Tracks shown side by side, and the side of their images."""

DARKEST_BRIGHTEST = (1.0, 99.5)
"""Percentiles of a shown image that become black and white."""

SCREEN_LINES = 18
"""Greatest number of lines of facts in a terminal, before the counts and the remarks."""


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
                **({} if outcome.noise is None else {"noise": [one.model_dump() for one in outcome.noise]}),
            }
        )
    )


def regression_text(verdict: Verdict) -> str:
    """Return one screen for a terminal: the headline, then a line for each fact."""
    lines = [verdict.headline, "{} against {}".format(*_names(verdict))]
    lines += [f"{one.name}: {one.state}: {one.detail}" for one in verdict.passes if one.state != JUDGED]
    order = (FAIL, INCONCLUSIVE, NOT_JUDGED, PASS)
    deciding = [gate for gate in verdict.gates if gate.outcome in order]
    whole = {gate.name for gate in deciding if gate.outcome == FAIL and not gate.pass_id}
    for gate in sorted(deciding, key=lambda gate: order.index(gate.outcome)):
        if not gate.passed and not (gate.pass_id and gate.name in whole):
            # The headline names the passes on which a metric fails that fails over all of them.
            lines.append(f"{gate.outcome}: {gate.text}")
    words = ("worse", "better")
    informing = [gate for gate in verdict.gates if gate.outcome == INFORMS]
    lines += [f"informs: {gate.text}" for gate in informing if (gate.reason or "").startswith(words)]
    if len(lines) > SCREEN_LINES:
        lines[SCREEN_LINES:] = [f"and {len(lines) - SCREEN_LINES} further facts in the JSON document"]
    counts = {name: sum(gate.outcome == name for gate in deciding) for name in order}
    lines.append(
        f"{counts[PASS]} of {len(deciding)} gates passed, {counts[FAIL]} failed, {counts[INCONCLUSIVE]} inconclusive, "
        f"{counts[NOT_JUDGED]} not judged, over {sum(one.state in JUDGED_STATES for one in verdict.passes)} of "
        f"{len(verdict.passes)} passes ({verdict.frames} frames)"
    )
    return "\n".join(filter(None, ("\n  ".join([*lines, *verdict.remarks]), printed_text(verdict))))


def printed_text(verdict: Verdict | RegressionOutcome) -> str:
    """Return the last lines of the programs that failed, each text once."""
    found: dict[str, str] = {}
    for one in verdict.passes:
        for label, replay in (("candidate", one.candidate), ("baseline", one.baseline)):
            if replay is not None and replay.printed:
                found.setdefault(replay.printed, f"last lines of the {label} on {one.name}:")
    return "\n".join(f"{title}\n{text}" for text, title in found.items())


def _names(one: Verdict | RegressionOutcome) -> tuple[str, str]:
    """Return the names of candidate and baseline; only equal ones have the beginnings of the identities."""
    candidate, baseline = (f"{b.name} {b.version}".rstrip() for b in (one.candidate, one.baseline))
    return (candidate, baseline) if candidate != baseline else (one.candidate.title, one.baseline.title)


def regression_junit(verdict: Verdict, finished_utc_ns: int) -> str:
    """Return JUnit XML with a test case for every pass and every deciding gate.

    Elements, their order and their attributes are valid in the schema of the Jenkins xUnit plugin (junit-10.xsd) and in
    the stricter one of Apache Ant (JUnit.xsd). A pass that the candidate did not finish is one failure. What is
    inconclusive is a failure or skipped, as the policy says. The time of a pass is that of the candidate's replay.
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
        cases.append((" on ".join(filter(None, (gate.name, gate.pass_id))), "gates", kind, text, 0.0))
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
    ET.SubElement(suite, "system-err").text = _xml(printed_text(verdict)) or None
    ET.indent(suite)
    return ET.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def _xml(text: str) -> str:
    """Return a text without the control characters that XML forbids."""
    return "".join(c if c in "\t\n" or ord(c) >= 32 else "\N{REPLACEMENT CHARACTER}" for c in text)


def regression_html(ground: Ground, outcome: RegressionOutcome, identity: str) -> str:
    """The report of a regression as one HTML file."""
    from reports.render import render_html

    return render_html(regression_report(ground, outcome, identity))


def regression_report(ground: Ground, outcome: RegressionOutcome, identity: str) -> values.RegressionReport:
    """The report of a regression as a value."""
    judged = [one for one in outcome.passes if one.state == JUDGED]
    troubled = [one for one in outcome.passes if one.state != JUDGED]
    sources = sorted(
        {str(name) for one in judged if one.context for name in one.context.manifest.get("data_sources", ())}
    )
    candidate, baseline = _names(outcome)
    return values.RegressionReport(
        title=f"{candidate} against {baseline}",
        regression_id=identity,
        candidate=candidate,
        baseline=baseline,
        gates=tuple(gate for gate in outcome.gates if gate.outcome != INFORMS),
        passes=tuple(_regression_pass(one) for one in judged),
        craters=changed_craters(judged),
        changed_tracks=tuple(changed_tracks(ground, judged)),
        verdict=f"{outcome.verdict.capitalize()}{headline(outcome).removeprefix(outcome.verdict)}.",
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
            *filter(None, (printed_text(outcome),)),
            *outcome.remarks,
            "A gate fails if the lower bound of the loss is above what is material, at a level of "
            f"{outcome.policy.policy.fail_level:g} for all gates together. It passes if the upper 95 % bound is below "
            "the margin. Otherwise it is inconclusive. Units: tracks of craters, ground cells, blocks of frames, "
            "passes. Claims are on these passes.",
        ),
    )


def changed_tracks(ground: Ground, judged: Sequence[PassVerdict]) -> list[values.ChangedTrack]:
    """Return the tracks of craters that changed most: in the frames lost, then in those gained, then in the centres."""
    rows: list[tuple[float, str, int, PassVerdict]] = []
    for one in judged:
        assert one.context and one.baseline_read and one.candidate_read
        old, new = one.baseline_read.frames.craters, one.candidate_read.frames.craters
        moved_px = np.nan_to_num(np.hypot(new.du_px - old.du_px, new.dv_px - old.dv_px))
        # A frame lost outweighs all frames gained of a track, and a frame gained all shifts of its centres.
        change = 1e6 * (old.hit & ~new.hit) + 1e3 * (new.hit & ~old.hit) + moved_px
        total = np.bincount(old.track, weights=change)
        for track in np.argsort(-total, kind="stable")[:CHANGED_TRACKS].tolist():
            row = int(np.argmax(np.where(old.track == track, change, -1.0)))
            if total[track] > 0.0 and one.context.frame_names[old.frame[row]]:
                rows.append((-float(total[track]), one.name, row, one))
    rows.sort(key=lambda row: row[:3])
    return [_changed_track(ground, one, row) for *_, row, one in rows[:CHANGED_TRACKS]]


def _changed_track(ground: Ground, one: PassVerdict, row: int) -> values.ChangedTrack:
    assert one.context and one.baseline_read and one.candidate_read
    context, old, new = one.context, one.baseline_read.frames.craters, one.candidate_read.frames.craters
    archive = ground.read(store.get_archive, one.digest)
    files = store_of(ground)
    manifest = json.loads(files.get(archive.manifest_sha256))
    frame, crater = int(old.frame[row]), int(old.crater[row])
    octets = files.get(manifest["files"][context.frame_names[frame]]["sha256"])
    image = read_image(octets, context.frame_names[frame])
    baseline, candidate = (
        _side(context, read, frame, crater, image, label)
        for read, label in ((one.baseline_read, "baseline"), (one.candidate_read, "candidate"))
    )
    same = old.track == old.track[row]
    return values.ChangedTrack(
        one.name,
        math.degrees(context.catalogue.latitude_rad[crater]),
        math.degrees(context.catalogue.longitude_rad[crater]),
        float(context.catalogue.diameter_m[crater]) / 1e3,
        int(same.sum()),
        int((same & old.hit & ~new.hit).sum()),
        int((same & new.hit & ~old.hit).sum()),
        baseline,
        candidate,
    )


def changed_craters(judged: Sequence[PassVerdict]) -> values.ChangedCraters:
    """Return the tracks of all passes by place with their change, and the ground cells of new false detections."""
    tracks, cells = [np.zeros((3, 0))], [np.zeros(0, np.int64)]
    for one in judged:
        assert one.context and one.baseline_read and one.candidate_read
        old, new = one.baseline_read.frames, one.candidate_read.frames
        rows, catalogue = old.craters, one.context.catalogue
        crater = rows.crater[np.unique(rows.track, return_index=True)[1]]
        places = np.degrees((catalogue.latitude_rad[crater], catalogue.longitude_rad[crater]))
        change = np.bincount(rows.track, weights=1.0 * new.craters.hit - rows.hit)
        tracks.append(np.vstack((places, change)))
        here, before = (one.detections.cell[~one.detections.true] for one in (new, old))
        cells.append(np.setdiff1d(here, before))
    latitude, longitude, changes = np.concatenate(tracks, axis=1)
    false_latitude, false_longitude = cell_places_deg(np.concatenate(cells))
    west = longitude[:1].sum() - 180.0  # a pass over 0 or 180 degrees is one strip
    longitude, false_longitude = ((one - west) % 360.0 + west for one in (longitude, false_longitude))
    return values.ChangedCraters(latitude, longitude, changes, false_latitude, false_longitude)


def _side(
    context: PassContext, read: ReadDownlink, frame: int, crater: int, image: Any, label: str
) -> values.GalleryFrame:
    """Return what a build found in a frame, cut out around a crater."""
    all_frames, utc = read.detections, context.frame_utc_ns[frame : frame + 1]
    chosen = np.flatnonzero(all_frames.frame_number == frame)
    rows = slice(0, 0)
    if len(chosen):
        rows = slice(*all_frames.offsets[chosen[0] : chosen[0] + 2].tolist())
    items = ("u_px", "v_px", "diameter_px", "score", "size_class")
    detections = replace(
        all_frames,
        frame_number=np.array([frame]),
        utc_ns=utc,
        offsets=np.array([0, rows.stop - rows.start]),
        **{name: getattr(all_frames, name)[rows] for name in items},
    )
    track = reference_states(context.reference, context.orientation, utc)
    rotations = context.viewing.camera_from_mcmf(utc, track.position_mcmf_m, track.mcmf_from_icrf)
    expected = expected_craters(context.catalogue, context.camera, track.position_mcmf_m, rotations)
    matches = match_detections(detections, expected)
    row = int(np.flatnonzero(expected.index == crater)[0])
    top, left = (
        int(np.clip(round(centre) - CROP_PX // 2, 0, max(size - CROP_PX, 0)))
        for centre, size in zip((expected.v_px[row], expected.u_px[row]), image.shape[:2], strict=True)
    )
    part = stretched(image[top : top + CROP_PX, left : left + CROP_PX])
    shown = gallery_frame(detections, expected, matches, 0, part)
    return replace(
        shown,
        detection_u_px=shown.detection_u_px - left,
        detection_v_px=shown.detection_v_px - top,
        catalogue_u_px=shown.catalogue_u_px - left,
        catalogue_v_px=shown.catalogue_v_px - top,
        caption=f"{label}: {'detected' if matches.detection_of_crater[row] >= 0 else 'not detected'}",
    )


def stretched(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image with full contrast: frames with a low Sun are dark."""
    low, high = np.percentile(image, DARKEST_BRIGHTEST)
    return np.asarray(np.clip((image - low) / max(high - low, 1.0) * 255.0, 0.0, 255.0), dtype=np.uint8)


def _build(build: Any) -> dict[str, Any]:
    return {
        "name": build.name,
        "version": build.version,
        "digest": build.digest,
        "flight_code": build.flight_code or None,
        "provenance": dict(build.provenance),
    }


def _gate(gate: values.Gate) -> dict[str, Any]:
    row = asdict(gate)
    bounds = [row.pop("change_low"), row.pop("change_high")]
    texts = {"pass": row.pop("pass_id") or None, "reason": gate.reason or None}
    return {**row, **texts, "passed": gate.passed, "change_bounds": bounds}


def _pass(one: PassVerdict) -> dict[str, Any]:
    found: dict[str, Any] = {"name": one.name, "archive": one.digest, "state": one.state, "detail": one.detail}
    costs = {"outcome", "detail", "cpu_s", "wall_s", "peak_rss_mib", "printed"}
    for label, replay, read in (
        ("baseline", one.baseline, one.baseline_read),
        ("candidate", one.candidate, one.candidate_read),
    ):
        if replay is not None:
            found[label] = replay.model_dump(include=costs) | (pass_figures(read.frames) if read else {})
    if one.baseline_read is not None:
        found["frames"] = len(one.baseline_read.frames)
    return found


def _regression_pass(one: PassVerdict) -> values.RegressionPass:
    assert one.baseline_read and one.candidate_read
    sides = (one.baseline_read.frames, one.candidate_read.frames)
    figures = [{metric.name: metric.value(frames) for metric in metrics_of([frames])} for frames in sides]
    recall, precision, median = (
        (figures[0].get(name, math.nan), figures[1].get(name, math.nan)) for name in PASS_METRICS
    )
    return values.RegressionPass(one.name, len(sides[0]), first_difference(*sides), recall, precision, median)


def _headline(outcome: RegressionOutcome) -> tuple[values.HeadlineFigure, ...]:
    return tuple(
        values.HeadlineFigure(
            NAMES[gate.name].capitalize(), gate.candidate, gate.unit, f"baseline {gate.baseline:.3g} {gate.unit}"
        )
        for gate in outcome.gates
        if gate.name in NAMES and not gate.pass_id
    )
