"""Compiled vote over places and altitudes of the search without a prior.

Directions at the camera are east, north, up of the point below it; angles in rad, lengths in m.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kernels.compiled import njit
from lunar.arrays import FloatArray, IntArray

_LISTED = 20_000
"""Places whose score may pass the threshold at one altitude before the threshold is raised."""

_LOWEST_THRESHOLD = 6
_RAISE = 3
_FULL_SCORE = 255
"""Largest score of a place, and the detection that no place has had a vote of: both are eight bits."""

CHANCE_LIMIT = 0.38
"""Largest number of chance votes of a detection on a block: of more, the detection does not vote."""

_LARGEST_SINE = 0.98
"""Craters under a larger sine are too close to the limb for their depth to be known."""

_LARGEST_TANGENT, _LARGEST_ARC = 4.0, 0.2
"""Bounds of tangent and arc within which the series of both arcs are off by less than 1e-4 rad, a tenth of a cell."""

# Columns of the list of places: score, row and column of the block, distance from the Moon's centre. Row 0 holds the
# number of places in the first column.
SCORE, ROW, COLUMN, DISTANCE = range(4)

# Columns of the turn from the ground that a detection sees to the camera: sine of the arc to the east, arc to the north
# in the plane of the meridian, 1 / length - 1 and length of the projection into that plane.
EAST, TURN, LONGER, LENGTH = range(4)


class Directions(NamedTuple):
    """Directions of detections (k,): off nadir, azimuth from north over east, logarithm of diameter over depth."""

    off_nadir: FloatArray
    azimuth: FloatArray
    log_size: FloatArray


class SortedCraters(NamedTuple):
    """Craters sorted by tiles of the map, by bins of rim height inside a tile, and by diameter inside a bin.

    Votes of neighbouring craters go to neighbouring blocks. Tile by tile they stay within the cache of the processor.

    Attributes
    ----------
    tile_start
        First bin of each tile and the end of the last, (t + 1,).
    bin_start, bin_height
        First crater of each bin and the end of the last (b + 1,), and the number of its height (b,).
    height
        Heights of the bins, each once (h,).
    tangent
        Of the latitude.
    longitude
        West of the map to west + 2 pi.
    """

    tile_start: IntArray
    bin_start: IntArray
    bin_height: IntArray
    height: FloatArray
    log_diameter: FloatArray
    latitude: FloatArray
    tangent: FloatArray
    longitude: FloatArray


class Blocks(NamedTuple):
    """Blocks over which votes are counted: south and west edge, area (sr), edge of a quarter block, rows, columns."""

    south: float
    west: float
    area: float
    cell: float
    rows: int
    columns: int


@njit
def vote(
    distance_m: float,
    radius_m: float,
    seen: Directions,
    gate: float,
    craters: SortedCraters,
    blocks: Blocks,
    work: NDArray[np.uint16],
    weight_limit: float,
    listed: FloatArray,
    kept: int,
) -> int:
    """Vote for places below a camera at one distance from the Moon's centre; return how many places are listed.

    A crater seen under a known angle from a known altitude puts the camera on one place of the sphere. Each pair of
    a detection and a crater whose size fits adds the detection's weight to the four overlapping blocks about that
    place, once per detection and tile: near the edge of a tile one detection may count twice. The weight is the
    logarithm of how much rarer a chance vote is than a true one.

    Parameters
    ----------
    gate
        Largest difference of the logarithms of diameters.
    work
        Work space of at least rows times columns with any content: score times 256 plus the detection that voted last.
    listed
        Places found so far, columns `SCORE` to `DISTANCE`, shape (n, 4). The best `kept` are kept.
    """
    board = work[: blocks.rows * blocks.columns].reshape(blocks.rows, blocks.columns)
    cleared = 0
    at = np.empty((_LISTED, 2), dtype=np.int64)
    columns_per_rad = np.empty(blocks.rows)
    for r in range(blocks.rows):
        columns_per_rad[r] = math.cos(blocks.south + (r + 1.0) * blocks.cell) / blocks.cell
    count, threshold = 0, _LOWEST_THRESHOLD
    if int(listed[0, SCORE]) == kept:
        threshold = max(threshold, int(listed[kept, SCORE]) + 1)
    turned, pieces, votes, reach = _pieces(distance_m, radius_m, seen, gate, craters)
    for t in range(craters.tile_start.size - 1):
        # Rows are cleared only before the first tile that can vote for them, so that they are still in the cache.
        north = _northmost(craters, t) + reach
        needed = min(max(math.ceil((north - blocks.south) / blocks.cell) + 1, cleared), blocks.rows)
        board[cleared:needed] = _FULL_SCORE
        cleared = needed
        for i in range(votes.size):
            weight = _weight(votes[i], blocks, weight_limit)
            if weight < 1:
                continue
            for b in range(craters.tile_start[t], craters.tile_start[t + 1]):
                first, stop = pieces[i, b]
                if first < stop:
                    count, threshold = _cast(
                        board[:cleared], at, count, threshold, weight, i, turned[i, craters.bin_height[b]], first, stop,
                        craters, blocks, columns_per_rad,
                    )  # fmt: skip
    values = np.empty(count)
    for k in range(count):
        values[k] = float(int(board[at[k, 0], at[k, 1]]) >> 8)
    total = int(listed[0, SCORE])
    # From the best on: once the list is full of better places, no other enters it.
    for k in np.argsort(-values, kind="mergesort"):
        if total == kept and values[k] <= listed[total, SCORE]:
            break
        total = _insert(listed, total, kept, values[k], float(at[k, 0]), float(at[k, 1]), distance_m)
    listed[0, SCORE] = total
    return total


@njit
def _below_ground(distance_m: float, radius_m: float, seen: Directions, i: int) -> tuple[float, float]:
    """Return the arc from nadir to the ground a detection sees and the logarithm of its diameter there; -1 for none.

    With the angle off nadir a, the distance d and the radius r: gamma = asin(d / r sin a) - a, depth = d - r cos gamma.
    """
    ratio = distance_m / radius_m
    sine = math.sin(seen.off_nadir[i])
    if ratio * sine >= _LARGEST_SINE or ratio <= 1.0:
        return -1.0, 0.0
    gamma = math.asin(ratio * sine) - seen.off_nadir[i]
    depth = distance_m - radius_m * math.cos(gamma)
    return gamma, seen.log_size[i] + math.log(depth)


@njit
def _pieces(
    distance_m: float, radius_m: float, seen: Directions, gate: float, craters: SortedCraters
) -> tuple[FloatArray, IntArray, IntArray, float]:
    """Return how detections turn to the camera, the craters that fit each in size, how many these are, and the reach.

    Turns have a row for each height and the columns `EAST` to `LENGTH`, (k, h, 4). Of each bin the first crater that
    fits and the end are given, (k, b, 2), equal where none fits. The numbers of craters have the shape (k,). The reach
    is the largest arc from the camera to a crater that a detection sees.
    """
    detections, heights, bins = seen.off_nadir.size, craters.height.size, craters.bin_height.size
    turned, wanted = np.zeros((detections, heights, 4)), np.empty((detections, heights))
    pieces, votes = np.zeros((detections, bins, 2), dtype=np.int64), np.zeros(detections, dtype=np.int64)
    reach = 0.0
    for i in range(detections):
        for h in range(heights):
            gamma, size = _below_ground(distance_m, radius_m + craters.height[h], seen, i)
            wanted[i, h] = size if gamma >= 0.0 else math.nan
            reach = max(reach, gamma)
            north = math.sin(gamma) * math.cos(seen.azimuth[i])
            turned[i, h, EAST] = math.sin(gamma) * math.sin(seen.azimuth[i])
            turned[i, h, TURN] = math.atan2(north, math.cos(gamma))
            turned[i, h, LENGTH] = math.sqrt(math.cos(gamma) ** 2 + north * north)
            turned[i, h, LONGER] = 1.0 / turned[i, h, LENGTH] - 1.0
        for b in range(bins):
            size = wanted[i, craters.bin_height[b]]
            if math.isnan(size):
                continue
            start = craters.bin_start[b]
            piece = craters.log_diameter[start : craters.bin_start[b + 1]]
            pieces[i, b, 0] = start + np.searchsorted(piece, size - gate)
            pieces[i, b, 1] = start + np.searchsorted(piece, size + gate)
            votes[i] += pieces[i, b, 1] - pieces[i, b, 0]
    return turned, pieces, votes, reach


@njit
def _northmost(craters: SortedCraters, tile: int) -> float:
    """Return the largest latitude of the craters of a tile."""
    first = craters.bin_start[craters.tile_start[tile]]
    stop = craters.bin_start[craters.tile_start[tile + 1]]
    return float(craters.latitude[first:stop].max())


@njit
def _weight(votes: int, blocks: Blocks, weight_limit: float) -> int:
    """Return the weight of each vote of a detection, from how many votes it casts; 0 where it casts none."""
    expected = votes * 4.0 * blocks.cell * blocks.cell / blocks.area
    if votes == 0 or expected > CHANCE_LIMIT:
        return 0
    return round(2.0 * min(math.log(0.5 / max(expected, 1e-9)), weight_limit))


@njit
def _cast(
    board: NDArray[np.uint16],
    at: IntArray,
    count: int,
    threshold: int,
    weight: int,
    i: int,
    turned: FloatArray,
    first: int,
    stop: int,
    craters: SortedCraters,
    blocks: Blocks,
    columns_per_rad: FloatArray,
) -> tuple[int, int]:
    """Cast the votes of a detection for some craters; return the number of listed blocks and the threshold."""
    east, turn, longer, length = turned
    for j in range(first, stop):
        tangent = craters.tangent[j]
        t = east * math.sqrt(1.0 + tangent * tangent)
        if abs(tangent) < _LARGEST_TANGENT and abs(t) < _LARGEST_ARC:
            latitude = craters.latitude[j] + tangent * longer - turn
            aside = t + t * t * t / 6.0
        else:
            s = math.sin(craters.latitude[j]) / length
            if abs(s) >= 1.0 or abs(t) >= 1.0:
                continue
            latitude, aside = math.asin(s) - turn, math.asin(t)
        row = math.floor((latitude - blocks.south) / blocks.cell)
        if row < 1 or row >= board.shape[0]:
            continue
        away = craters.longitude[j] - aside - blocks.west
        for r in range(row - 1, row + 1):
            column = math.floor(away * columns_per_rad[r])
            if column < 1 or column >= blocks.columns:
                continue
            for c in range(column - 1, column + 1):
                value = int(board[r, c])
                if value & 255 == i:
                    continue
                before = value >> 8
                now = min(before + weight, _FULL_SCORE)
                board[r, c] = (now << 8) | i
                if before < threshold <= now and count < _LISTED:
                    at[count, 0], at[count, 1] = r, c
                    count += 1
                    if count == _LISTED:
                        threshold += _RAISE
                        count = _above(board, at, threshold)
    return count, threshold


@njit
def _above(board: NDArray[np.uint16], at: IntArray, threshold: int) -> int:
    """Keep the listed blocks whose score reaches a threshold; return their number."""
    left = 0
    for k in range(_LISTED):
        if int(board[at[k, 0], at[k, 1]]) >> 8 >= threshold:
            at[left] = at[k]
            left += 1
    return left


@njit
def _insert(
    listed: FloatArray, total: int, kept: int, value: float, row: float, column: float, distance_m: float
) -> int:
    """Add a place to the best, rows 1 to `kept`, best first, unless a neighbour at the same distance is among them."""
    for k in range(1, total + 1):
        if (
            listed[k, DISTANCE] == distance_m
            and abs(listed[k, ROW] - row) <= 2
            and abs(listed[k, COLUMN] - column) <= 2
        ):
            return total
    k = min(total + 1, kept)
    while k > 1 and listed[k - 1, SCORE] < value:
        listed[k] = listed[k - 1]
        k -= 1
    listed[k, SCORE], listed[k, ROW], listed[k, COLUMN], listed[k, DISTANCE] = value, row, column, distance_m
    return min(total + 1, kept)
