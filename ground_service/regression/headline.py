"""First line of a verdict: what changed, by how much, where, and whether it matters for navigation."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ground_service.regression.gates.core import (
    EXACT_METRICS,
    FAIL,
    IDENTICAL,
    INCONCLUSIVE,
    INFORMS,
    NOT_JUDGED,
    PASS,
    Gate,
)
from ground_service.regression.gates.metrics import LATENCY, RUN, START
from ground_service.regression.model import UNUSABLE_STATES
from ground_service.regression.outcome import RegressionOutcome

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
        whole = [gate for gate in failed if not gate.pass_name] or failed[:1]
        failed.sort(key=lambda gate: -gate.change_low)
        places = list(dict.fromkeys(gate.pass_name for gate in failed if gate.pass_name))
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
        told = "; ".join(f"{_name(gate)} {_figures(gate)}, {gate.reason}" for gate in open_gates[:2])
        return told + more
    if any(gate.reason.startswith(IDENTICAL) for gate in gates):
        return f"{IDENTICAL} on {outcome.frames_judged} frames"
    better = [gate for gate in gates if gate.outcome == PASS and gate.change_high < 0.0]
    if better:
        return f"better: {_changes(better)}, no loss beyond the margins; {_navigation(outcome.gates)}"
    return f"no loss beyond the margins on {outcome.frames_judged} frames; {_navigation(outcome.gates)}"


def _changes(gates: Sequence[Gate]) -> str:
    return ", ".join(f"{_name(gate)} {_figures(gate)}" for gate in gates)


def _name(gate: Gate) -> str:
    return NAMES.get(gate.name, gate.name)


def _figures(gate: Gate) -> str:
    change = gate.candidate - gate.baseline
    size = f"{abs(change):.3g} {gate.unit}".rstrip()
    return f"{'rises' if change > 0.0 else 'falls'} by {size} ({gate.baseline:.3g} to {gate.candidate:.3g})"


def _navigation(gates: Sequence[Gate]) -> str:
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
