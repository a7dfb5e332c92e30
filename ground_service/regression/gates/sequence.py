"""Sequential regressions: passes in an order fixed beforehand, and looks at them that spend the levels.

The look at the share t of the frames spends t^2 - u^2 of every level, u being the share of the look before (power
family of spending functions), so the last look keeps most of it. A look that is the last because the time is used
spends what is left: the clock does not depend on the outcome. The levels of the looks add up (Bonferroni's inequality),
whatever the dependence between them.

References
----------
K. K. G. Lan, D. L. DeMets, "Discrete sequential boundaries for clinical trials", Biometrika 70, 1983.
K. Kim, D. L. DeMets, "Design and analysis of group sequential tests based on the type I error spending rate function",
Biometrika 74, 1987.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ground_service.regression.gates.core import FAIL, FEWEST_PASSES, PASS, Look
from lunar.arrays import FloatArray

LOOKS = (0.25, 0.5, 1.0)
"""Shares of the frames of a plan at which the passes are judged."""

SPENDING = 2.0
"""Power of the share: 1 spends evenly; the looks here spend .06, .19 and .75."""


def informative_order(tracks: FloatArray, frames: Sequence[int]) -> list[int]:
    """Return the order of passes in which each adds most for its frames, given their crater tracks by kind of terrain.

    The benefit of tracks (n, k) falls with the number that is there, so that kinds of terrain alternate.
    """
    left, there, order = set(range(len(frames))), np.zeros(tracks.shape[1]), list[int]()
    while left:
        gain = {i: np.log1p(tracks[i] / (there + 1.0)).sum() / max(frames[i], 1) for i in left}
        best = max(sorted(left), key=lambda i: float(gain[i]))
        left.remove(best)
        order.append(best)
        there += tracks[best]
    return order


def planned_looks(frames: Sequence[int]) -> dict[int, Look]:
    """Return the looks at passes of so many frames, in this order, by the number of passes that each needs."""
    shares = np.cumsum(frames) / max(sum(frames), 1)
    ends = sorted({int(np.searchsorted(shares, share - 1e-9)) + 1 for share in LOOKS} if frames else set())
    spent = [0.0, *(float(shares[end - 1]) ** SPENDING for end in ends)]
    return {
        end: Look(now - before, sum(frames), len(frames), last=end == ends[-1])
        for end, (before, now) in zip(ends, itertools.pairwise(spent), strict=True)
    }


def is_clear(verdict: str, passes: int, look: Look) -> bool:
    """Return whether no further pass is needed; a plan that can judge position errors passes only with them."""
    return verdict == FAIL or (verdict == PASS and passes >= min(FEWEST_PASSES, look.passes))
