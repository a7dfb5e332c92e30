"""Study of the number and choice of landmarks: navigation with successively smaller parts of a catalogue.

Every run is the same flight over the same craters with the same detector; only the on-board catalogue changes.
Landmarks are chosen at random, by size (largest first), or spread evenly over the ground (the largest of each cell of a
grid that is refined until there are enough). Simulated detections, level 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lunar.arrays import BoolArray, IntArray
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from studies.montecarlo import NavigationCase, fly

Mask = BoolArray

CHOICES = ("random", "largest", "spread")
# A run whose error has grown beyond this has lost its anchor: the size of a footprint.
BOUNDED_M = 5_000.0


@dataclass(frozen=True, slots=True)
class SizeScore:
    """Error of a run with a given number of craters on board.

    Attributes
    ----------
    craters
        In the whole catalogue; `per_footprint` of them lie in an image on average.
    fixed_share
        Of the frames with an image.
    bounded
        Whether the error stayed below 5 km.
    """

    choice: str
    craters: int
    per_footprint: float
    median_m: float
    p95_m: float
    largest_m: float
    fixed_share: float
    bounded: bool


def chosen_craters(craters: CraterCatalogue, count: int, choice: str, seed: int) -> Mask:
    """Return which craters are on board, shape (n,), `count` of them (or all)."""
    total = len(craters)
    mask = np.zeros(total, dtype=np.bool_)
    if count >= total:
        return ~mask
    rng = np.random.default_rng((seed, CHOICES.index(choice)))
    if choice == "random":
        order = rng.permutation(total)
    elif choice == "largest":
        order = np.argsort(-craters.diameter_m, kind="stable")
    else:
        order = _spread_order(craters)
    mask[order[:count]] = True
    return mask


def study_sizes(
    case: NavigationCase, shares: Sequence[float], seed: int, settle_frames: int = 40
) -> list[SizeScore]:
    """Return scores for shares of the catalogue of a case, each chosen in the three ways."""
    used = case.imaging & (np.arange(case.imaging.size) >= settle_frames)
    scores = []
    for share in shares:
        count = max(1, round(share * len(case.craters)))
        for choice in CHOICES if share < 1.0 else CHOICES[:1]:
            mask = chosen_craters(case.craters, count, choice, seed)
            run = fly(replace(case, on_board=mask), seed)
            error = run.error_m[used]
            scores.append(
                SizeScore(
                    choice,
                    count,
                    _per_footprint(count, float(np.median(run.altitude_m)), case),
                    float(np.median(error)),
                    float(np.percentile(error, 95.0)),
                    float(np.max(error)),
                    float(np.mean(run.fixed[used])),
                    bool(np.max(error) < BOUNDED_M),
                )
            )
    return scores


def _spread_order(craters: CraterCatalogue) -> IntArray:
    """Return craters in an order of which every beginning is spread: the largest of each cell, coarse cells first."""
    rank = np.full(len(craters), np.inf)
    sine, longitude = np.sin(craters.latitude_rad), np.mod(craters.longitude_rad, 2.0 * np.pi)
    by_size = np.argsort(-craters.diameter_m, kind="stable")
    for level in range(2, 12):
        side = 2**level
        cell = np.floor((sine + 1.0) * 0.5 * side * 0.999999) * 4 * side
        cell = cell + np.floor(longitude / (2.0 * np.pi) * 2 * side * 0.999999)
        _, first = np.unique(cell[by_size], return_index=True)
        best = by_size[first]
        rank[best] = np.minimum(rank[best], level)
    return np.lexsort((-craters.diameter_m, rank)).astype(np.int64)


def _per_footprint(count: int, altitude_m: float, case: NavigationCase) -> float:
    """Return how many craters an image holds on average, were they even over the sphere."""
    side_m = 2.0 * altitude_m * np.tan(0.5 * case.camera.fov_rad)
    return float(count * side_m**2 / (4.0 * np.pi * MOON_RADIUS_M**2))
