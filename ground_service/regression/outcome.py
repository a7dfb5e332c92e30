"""Outcome of a regression: replays, passes and the verdict."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ground_service.regression.builds import Build
from ground_service.regression.gates.core import FAIL, INCONCLUSIVE, NOT_JUDGED, verdict_of
from ground_service.regression.gates.metrics import outcome_shares
from ground_service.regression.gates.policy import PolicyFile
from ground_service.regression.gates.samples import PassFrames
from ground_service.regression.model import KeptReplay, Noise
from ground_service.regression.replay_samples import PassContext, ReadDownlink
from reports.values import Gate

JUDGED, TELEMETRY_JUDGED = "judged", "telemetry judged"
JUDGED_STATES = (JUDGED, TELEMETRY_JUDGED)


@dataclass(frozen=True, slots=True, eq=False)
class PassVerdict:
    """One pass of a regression.

    Attributes
    ----------
    state
        "judged", "telemetry judged" (from the received detections, without frames), "not judged" (the archive has
        neither frames nor inputs of the payload), "candidate failed", "baseline failed" or "unusable" (the archive).
    detail
        The reason of the state; empty for a pass that was judged.
    """

    name: str
    digest: str
    state: str
    detail: str = ""
    baseline: KeptReplay | None = None
    candidate: KeptReplay | None = None
    context: PassContext | None = None
    baseline_read: ReadDownlink | None = None
    candidate_read: ReadDownlink | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RegressionOutcome:
    """The verdict on a candidate build."""

    baseline: Build
    candidate: Build
    policy: PolicyFile
    gates: tuple[Gate, ...]
    passes: tuple[PassVerdict, ...]
    remarks: tuple[str, ...] = field(default=())
    noise: tuple[Noise, ...] | None = None

    @property
    def verdict(self) -> str:
        """Pass, fail or inconclusive.

        "fail": a gate failed, or the candidate failed on a pass. "inconclusive": there is no gate, a gate is
        inconclusive, a pass could not be judged because of its archive or its baseline, or no pass has frames.
        """
        of_gates = verdict_of(self.gates)
        states = {one.state for one in self.passes}
        if of_gates == FAIL or "candidate failed" in states:
            return FAIL
        if JUDGED not in states or states - {*JUDGED_STATES, NOT_JUDGED}:
            return INCONCLUSIVE
        return of_gates

    @property
    def frames_judged(self) -> int:
        """Number of frames processed by both builds."""
        return sum(
            len(one.baseline_read.frames) for one in self.passes if one.state in JUDGED_STATES and one.baseline_read
        )

    @property
    def frames_needed(self) -> int | None:
        """Number of frames that decide the inconclusive gates; None if no gate states a number."""
        needed = [gate.frames_needed for gate in self.gates if gate.frames_needed is not None]
        return max(needed, default=None)


def pass_figures(frames: PassFrames) -> dict[str, Any]:
    """Return the additional values of a pass in a verdict: outcomes, costs in milliseconds, memory."""
    return {
        "outcome_shares": outcome_shares(frames),
        "stages_ms": {
            name: float(np.nanmedian(values)) for name, values in frames.latency_ms.items() if np.isfinite(values).any()
        },
        "memory_mib": frames.memory_mib,
        "undecodable": frames.undecodable,
    }
