"""Gross failures of a candidate: differences beyond any noise, each told in one sentence, on one pass."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ground_service.regression.gates.samples import PassFrames, TimeTags

UNDECODABLE, TIMES, FRAMES = "telemetry.undecodable", "telemetry.times", "telemetry.frames_without_value"
WRONG_FIXES = "navigation.wrong_fixes"

DELAY_TOLERANCE_S = 1.0
"""Header times may lie this much outside the delays of the baseline: a step lasts less."""


@dataclass(frozen=True, slots=True)
class Count:
    """Number of faulty items of both builds on a pass, NaN where unknown; `text` states those of the candidate."""

    baseline: float
    candidate: float
    text: str = ""


def counts(before: PassFrames, after: PassFrames) -> dict[str, Count]:
    """Return the faults of each kind on one pass."""
    return {
        UNDECODABLE: Count(
            before.undecodable, after.undecodable, f"{after.undecodable} packets cannot be decoded"
        ),
        TIMES: _times(before.times, after.times),
        FRAMES: _frames(before, after),
        WRONG_FIXES: _wrong_fixes(before, after),
    }


def identical(before: Mapping[str, PassFrames], after: Mapping[str, PassFrames]) -> bool:
    """Return whether both builds sent the same packets, octet by octet, on every pass."""
    return all(
        bool(one.digests)
        and one.digests == after[name].digests
        and one.undecodable == after[name].undecodable
        for name, one in before.items()
    )


def first_difference(before: PassFrames, after: PassFrames) -> int | None:
    """Return the row of the first frame with different packets (0 also for packets before it); None: no such frame."""
    pairs = zip(before.digests, after.digests, strict=True)
    return next((max(row - 1, 0) for row, (a, b) in enumerate(pairs) if a != b), None)


def _times(before: TimeTags, after: TimeTags) -> Count:
    parts, faulty = [], 0
    for name, unknown in after.unknown_images.items():
        if unknown > before.unknown_images.get(name, 0):
            faulty += unknown
            parts.append(
                f"{unknown} of {after.packets[name]} {name} packets name a time at which no image was taken"
            )
    late, packets, worst = 0, 0, 0.0
    usual = [delays for delays in before.delays_s.values() if len(delays)]
    for name, delays in after.delays_s.items():
        known = before.delays_s.get(name)
        expected = known if known is not None and len(known) else np.concatenate([*usual, [0.0]])
        low, high = expected.min() - DELAY_TOLERANCE_S, expected.max() + DELAY_TOLERANCE_S
        off = np.maximum(delays - high, low - delays)
        late += int(np.count_nonzero(off > 0.0))
        packets += len(delays)
        worst = max(worst, float(np.max(off, initial=0.0)) + DELAY_TOLERANCE_S)
    if late:
        parts.append(
            f"the header times of {late} of {packets} packets contradict the image or step that they report, by up to "
            f"{worst:.1f} s"
        )
    disordered = after.backwards - before.backwards
    if disordered > 0:
        parts.append(f"{disordered} packets more than in the baseline are out of order in time")
    total = faulty + late + max(disordered, 0)
    return Count(0, total, "; ".join(parts))


def _frames(before: PassFrames, after: PassFrames) -> Count:
    """Count the frames on which the baseline has a report, and the candidate does not."""
    lost = before.answered & ~after.answered
    parts = [f"no detections in {np.count_nonzero(lost)}"] if lost.any() else []
    for name, estimator in before.estimators.items():
        other = after.estimators.get(name)
        silent = estimator.stated if other is None else estimator.stated & ~other.stated
        if silent.any():
            parts.append(f"no state of the estimator {name} in {np.count_nonzero(silent)}")
        lost = lost | silent
    text = f"{' and '.join(parts)} of {len(before)} frames on which the baseline has one"
    return Count(0, int(np.count_nonzero(lost)), text)


def _wrong_fixes(before: PassFrames, after: PassFrames) -> Count:
    """Count the wrong fixes; NaN without a reference, which alone shows whether a fix is wrong."""
    sums = []
    for frames in (before, after):
        wrong = np.concatenate([*(one.wrong for one in frames.estimators.values()), np.zeros(0)])
        sums.append(float(np.nansum(wrong)) if np.isfinite(wrong).any() else math.nan)
    return Count(sums[0], sums[1], f"{sums[1]:.0f} fixes are wrong, against {sums[0]:.0f} of the baseline")
