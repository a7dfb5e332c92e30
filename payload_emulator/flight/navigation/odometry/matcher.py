"""Frame-to-frame matching of anonymous craters by their common ground shift (section VI-A of the paper).

Craters carry no identity, only a place and a size class. All true correspondences between two frames
share one ground shift; pairs of unrelated craters scatter. The matcher forms every same-class pair whose
shift the orbit allows, finds the densest cluster of shifts and assigns its pairs one to one.

Places are metres east and north of the sub-satellite point of their own frame. The shift of a pair is the
motion of the spacecraft that explains it: place in the earlier frame minus place in the later frame.
"""

from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray, IntArray

# A cluster count compares every candidate with every other; this many rows are compared at a time (memory
# bound).
_ROWS_AT_A_TIME = 512


@dataclass(frozen=True, slots=True)
class MatcherParameters:
    """Orbital prior and cluster rule; the values are the paper's, stated for 30 s between frames.

    Bounds and tolerance scale linearly with the interval between the two frames. The paper's north bounds are
    for motion to the north; on a descending pass they are mirrored.
    """

    reference_interval_s: float = 30.0
    east_bound_m: float = 2_500.0
    north_minimum_m: float = 35_000.0
    north_maximum_m: float = 65_000.0
    tolerance_m: float = 4_000.0
    minimum_pairs: int = 2


@dataclass(frozen=True, slots=True, eq=False)
class GroundFeatures:
    """Craters of one frame: metres east and north of the sub-satellite point, and size class."""

    east_m: FloatArray
    north_m: FloatArray
    size_class: IntArray

    def __len__(self) -> int:
        return int(self.east_m.shape[0])


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Pairs of indices (earlier frame, later frame) that agree on one shift; no pair at all is a valid
    answer.

    Attributes
    ----------
    earlier, later
        Indices into the two frames, same length, each index at most once.
    candidate_pairs
        Number of same-class pairs inside the motion bounds, before clustering.
    from_cluster
        True where the pairs come from the densest cluster, False for the singleton fall-back.
    """

    earlier: IntArray
    later: IntArray
    candidate_pairs: int
    from_cluster: bool

    def __len__(self) -> int:
        return int(self.earlier.shape[0])


def match_frames(
    earlier: GroundFeatures,
    later: GroundFeatures,
    interval_s: float,
    direction: int,
    parameters: MatcherParameters = MatcherParameters(),
) -> Match:
    """Return the pairs of craters common to two frames.

    Parameters
    ----------
    interval_s
        Time between the frames; motion bounds and tolerance scale with it.
    direction
        +1 where the pass moves north, -1 where it moves south.

    Notes
    -----
    Two points the paper leaves open are settled so: among equally dense clusters the tightest wins, and the
    minimum number of agreeing pairs is counted after the one-to-one assignment, since two pairs that share a
    crater are one piece of evidence.
    """
    scale = interval_s / parameters.reference_interval_s
    east, north, rows, columns = _candidate_pairs(earlier, later, scale, direction, parameters)
    candidates = int(rows.size)
    if candidates:
        centre = _densest(east, north, parameters.tolerance_m * scale)
        distance = np.hypot(east - east[centre], north - north[centre])
        first, second = _assign_one_to_one(rows, columns, distance, parameters.tolerance_m * scale)
        if first.size >= parameters.minimum_pairs:
            return Match(first, second, candidates, from_cluster=True)
    first, second = _singletons(earlier, later, rows, columns, east, north, scale, direction, parameters)
    return Match(first, second, candidates, from_cluster=False)


def _candidate_pairs(
    earlier: GroundFeatures, later: GroundFeatures, scale: float, direction: int, parameters: MatcherParameters
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """Return shift east, shift north and both indices of every same-class pair inside the bounds."""
    east = earlier.east_m[:, None] - later.east_m[None, :]
    north = earlier.north_m[:, None] - later.north_m[None, :]
    forward = north * direction
    allowed = (
        (earlier.size_class[:, None] == later.size_class[None, :])
        & (earlier.size_class[:, None] >= 0)
        & (np.abs(east) < parameters.east_bound_m * scale)
        & (forward > parameters.north_minimum_m * scale)
        & (forward < parameters.north_maximum_m * scale)
    )
    rows, columns = np.nonzero(allowed)
    return east[rows, columns], north[rows, columns], rows.astype(np.int64), columns.astype(np.int64)


def _densest(east: FloatArray, north: FloatArray, tolerance_m: float) -> int:
    """Return the candidate with most candidates within the tolerance, the tightest of several such."""
    count = np.empty(east.size, dtype=np.int64)
    spread = np.empty(east.size)
    for start in range(0, east.size, _ROWS_AT_A_TIME):
        rows = slice(start, start + _ROWS_AT_A_TIME)
        distance = np.hypot(east[rows, None] - east[None, :], north[rows, None] - north[None, :])
        near = distance < tolerance_m
        count[rows] = near.sum(axis=1)
        spread[rows] = np.where(near, distance, 0.0).sum(axis=1)
    return int(np.lexsort((spread, -count))[0])


def _assign_one_to_one(
    rows: IntArray, columns: IntArray, distance: FloatArray, tolerance_m: float
) -> tuple[IntArray, IntArray]:
    """Return the pairs nearer than the tolerance, nearest first, no crater used twice."""
    first: list[int] = []
    second: list[int] = []
    for k in np.argsort(distance, kind="stable"):
        if distance[k] >= tolerance_m:
            break
        row, column = int(rows[k]), int(columns[k])
        if row not in first and column not in second:
            first.append(row)
            second.append(column)
    return np.array(first, dtype=np.int64), np.array(second, dtype=np.int64)


def _singletons(
    earlier: GroundFeatures,
    later: GroundFeatures,
    rows: IntArray,
    columns: IntArray,
    east: FloatArray,
    north: FloatArray,
    scale: float,
    direction: int,
    parameters: MatcherParameters,
) -> tuple[IntArray, IntArray]:
    """Return at most one pair: of a class with exactly one detection in each frame, inside the motion bounds.

    Several classes may offer such a pair. They disagree with each other (a pair of them would have formed a
    cluster), so at most one is true: the one nearest the middle of the orbital prior is kept.
    """
    lone = np.array(
        [
            np.count_nonzero(earlier.size_class == earlier.size_class[row]) == 1
            and np.count_nonzero(later.size_class == earlier.size_class[row]) == 1
            for row in rows
        ],
        dtype=bool,
    )
    if not lone.any():
        nothing = np.empty(0, dtype=np.int64)
        return nothing, nothing
    middle = 0.5 * (parameters.north_minimum_m + parameters.north_maximum_m) * scale * direction
    best = int(np.argmin(np.where(lone, np.hypot(east, north - middle), np.inf)))
    return rows[best : best + 1], columns[best : best + 1]
