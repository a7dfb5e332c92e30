"""Compiled parts of the search without a prior: the vote over places and altitudes, and the fit of a place.

Directions at the camera are east, north, up of the point below it; angles in rad, lengths in m. Places are in MCMF.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lunar._compile import njit
from lunar.arrays import FloatArray, IntArray

_LISTED = 20_000


@njit
def vote(
    distance_m: float,
    radius_m: float,
    off_nadir: FloatArray,
    azimuth: FloatArray,
    log_size: FloatArray,
    gate: float,
    bin_start: IntArray,
    bin_height: FloatArray,
    log_diameter: FloatArray,
    latitude_rad: FloatArray,
    tangent: FloatArray,
    longitude: FloatArray,
    extent: FloatArray,
    cell: float,
    rows: int,
    columns: int,
    work: NDArray[np.uint16],
    weight_limit: float,
    listed: FloatArray,
    kept: int,
) -> int:
    """Vote for places below a camera at one distance from the Moon's centre; return how many places are listed.

    A crater seen under a known angle from a known altitude puts the camera on one place of the sphere. Each pair of
    a detection and a crater whose size fits adds the detection's weight to the four overlapping blocks about that
    place, once per detection. The weight is the logarithm of how much rarer a chance vote is than a true one.

    Parameters
    ----------
    off_nadir, azimuth
        Directions of the detections, the latter from north over east, shape (k,).
    log_size
        Logarithm of crater diameter over depth, shape (k,).
    bin_start, bin_height
        Craters are sorted by bins of rim height and by diameter inside them: first of each bin (b + 1,), height (b,).
    latitude_rad, tangent
        Latitude of the craters and its tangent.
    extent
        South, north, west, east and area (sr) of the map; longitudes of the craters are west to west + 2 pi.
    cell
        Edge of a quarter block in rad.
    work
        Work space of at least rows times columns, cleared here: score times 256 plus the detection that voted last.
    listed
        Places found so far: score, row, column, distance; shape (n, 4). The best `kept` are kept.
    """
    board = work[: rows * columns].reshape(rows, columns)
    board[:] = 255
    south, west, area = extent[0], extent[2], extent[4]
    at = np.empty((_LISTED, 2), dtype=np.int64)
    # Columns to a radian of longitude, per row.
    columns_per_rad = np.empty(rows)
    for r in range(rows):
        columns_per_rad[r] = math.cos(south + (r + 1.0) * cell) / cell
    count, threshold = 0, 6
    if int(listed[0, 0]) == kept:
        threshold = max(threshold, int(listed[kept, 0]) + 1)
    for i in range(off_nadir.size):
        sine = math.sin(off_nadir[i])
        # How many votes this detection casts sets the weight of each.
        votes = 0
        for b in range(bin_height.size):
            ratio = distance_m / (radius_m + bin_height[b])
            if ratio * sine >= 0.98 or ratio <= 1.0:
                continue
            gamma = math.asin(ratio * sine) - off_nadir[i]
            depth = distance_m - (radius_m + bin_height[b]) * math.cos(gamma)
            wanted = log_size[i] + math.log(depth)
            piece = log_diameter[bin_start[b] : bin_start[b + 1]]
            votes += np.searchsorted(piece, wanted + gate) - np.searchsorted(piece, wanted - gate)
        expected = votes * 4.0 * cell * cell / area
        weight = round(2.0 * min(math.log(0.5 / max(expected, 1e-9)), weight_limit))
        if votes == 0 or weight < 1:
            continue
        for b in range(bin_height.size):
            ratio = distance_m / (radius_m + bin_height[b])
            if ratio * sine >= 0.98 or ratio <= 1.0:
                continue
            gamma = math.asin(ratio * sine) - off_nadir[i]
            depth = distance_m - (radius_m + bin_height[b]) * math.cos(gamma)
            wanted = log_size[i] + math.log(depth)
            piece = log_diameter[bin_start[b] : bin_start[b + 1]]
            first = bin_start[b] + np.searchsorted(piece, wanted - gate)
            stop = bin_start[b] + np.searchsorted(piece, wanted + gate)
            north = math.sin(gamma) * math.cos(azimuth[i])
            east = math.sin(gamma) * math.sin(azimuth[i])
            length = math.sqrt(math.cos(gamma) ** 2 + north * north)
            turn = math.atan2(north, math.cos(gamma))
            longer = 1.0 / length - 1.0
            for j in range(first, stop):
                t = east * math.sqrt(1.0 + tangent[j] * tangent[j])
                # Series of both arcs: they are off by less than 1e-4 rad, a tenth of a cell.
                if abs(tangent[j]) < 4.0 and abs(t) < 0.2:
                    latitude = latitude_rad[j] + tangent[j] * longer - turn
                    aside = t + t * t * t / 6.0
                else:
                    s = math.sin(latitude_rad[j]) / length
                    if abs(s) >= 1.0 or abs(t) >= 1.0:
                        continue
                    latitude, aside = math.asin(s) - turn, math.asin(t)
                y = (latitude - south) / cell
                row = math.floor(y)
                if row < 1 or row >= rows:
                    continue
                away = longitude[j] - aside - west
                for r in range(row - 1, row + 1):
                    x = away * columns_per_rad[r]
                    column = math.floor(x)
                    if column < 1 or column >= columns:
                        continue
                    for c in range(column - 1, column + 1):
                        cell_value = int(board[r, c])
                        if cell_value & 255 == i:
                            continue
                        before = cell_value >> 8
                        now = min(before + weight, 255)
                        board[r, c] = (now << 8) | i
                        if before < threshold <= now and count < _LISTED:
                            at[count, 0], at[count, 1] = r, c
                            count += 1
                            if count == _LISTED:
                                # Too many: raise the bar and keep those above it.
                                threshold += 3
                                left = 0
                                for k in range(count):
                                    if int(board[at[k, 0], at[k, 1]]) >> 8 >= threshold:
                                        at[left] = at[k]
                                        left += 1
                                count = left
    total = int(listed[0, 0])
    for k in range(count):
        value = float(int(board[at[k, 0], at[k, 1]]) >> 8)
        total = _insert(listed, total, kept, value, float(at[k, 0]), float(at[k, 1]), distance_m)
    listed[0, 0] = total
    return total


@njit
def _insert(
    listed: FloatArray, total: int, kept: int, value: float, row: float, column: float, distance_m: float
) -> int:
    """Keep a list of the best places, rows 1 to `kept`, best first; neighbours on the same level count once."""
    if total == kept and value <= listed[total, 0]:
        return total
    for k in range(1, total + 1):
        if listed[k, 3] == distance_m and abs(listed[k, 1] - row) <= 2 and abs(listed[k, 2] - column) <= 2:
            if listed[k, 0] >= value:
                return total
            # The better neighbour takes the place of the worse.
            for m in range(k, total):
                listed[m] = listed[m + 1]
            total -= 1
            break
    k = min(total + 1, kept)
    while k > 1 and listed[k - 1, 0] < value:
        listed[k] = listed[k - 1]
        k -= 1
    listed[k, 0], listed[k, 1], listed[k, 2], listed[k, 3] = value, row, column, distance_m
    return min(total + 1, kept)


@njit
def _solved(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of symmetric positive definite equations by Cholesky's factors; NaN where they are not definite.

    Numba's own linear algebra would ask for SciPy, which does not fly.
    """
    n = right.size
    factor = np.zeros((n, n))
    result = right.copy()
    for i in range(n):
        for j in range(i + 1):
            total = normal[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > 0.0:
                factor[i, i] = math.sqrt(total)
            else:
                return np.full(n, math.nan)
    for i in range(n):
        for k in range(i):
            result[i] -= factor[i, k] * result[k]
        result[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            result[i] -= factor[k, i] * result[k]
        result[i] /= factor[i, i]
    return result


@njit
def fit_place(
    start: FloatArray,
    camera_from_enu: FloatArray,
    focal_px: float,
    centre_px: FloatArray,
    half_px: FloatArray,
    uv: FloatArray,
    size_px: FloatArray,
    variance_px2: FloatArray,
    latitude: FloatArray,
    position: FloatArray,
    diameter: FloatArray,
    sigma_m: FloatArray,
    attitude_sigma: float,
    first_tolerance_px: float,
    gate: float,
    log_gate: float,
    radius_m: float,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, FloatArray]:
    """Return place, attitude, their covariance, the crater of each detection (-1: none) and what chance would give.

    Least squares on the pairs of detections and craters that are each other's nearest, over place (east, north, up)
    and a small rotation of the camera whose size is known; pairs are chosen again in every round, ever closer.

    Parameters
    ----------
    start
        Place of the camera (MCMF), shape (3,).
    latitude, position, diameter, sigma_m
        Craters in order of latitude; sigma_m horizontal, shape (n,).
    gate
        Chi-square (2 degrees of freedom) within which a crater explains a detection.

    Returns
    -------
    chance
        Expected number of detections that craters would explain if detections lay anywhere; per detection, (k,).
    """
    count = uv.shape[0]
    place, theta = start.copy(), np.zeros(3)
    nearest, distance = np.full(count, -1), np.full(count, np.inf)
    chance = np.zeros(count)
    normal = np.zeros((6, 6))
    distance_m = math.sqrt(place[0] ** 2 + place[1] ** 2 + place[2] ** 2)
    # Craters that can be in the image: those above the horizon and within the farthest ray.
    corner = math.atan(1.1 * math.hypot(half_px[0], half_px[1]) / focal_px)
    sine = distance_m / radius_m * math.sin(corner)
    horizon = math.acos(min(1.0, radius_m / distance_m))
    reach = 1.15 * (horizon if sine >= 1.0 else min(math.asin(sine) - corner, horizon)) + 0.002
    up = place / distance_m
    low = np.searchsorted(latitude, math.asin(up[2]) - reach)
    high = np.searchsorted(latitude, math.asin(up[2]) + reach)
    around = np.empty(high - low, dtype=np.int64)
    members = 0
    for j in range(low, high):
        along = position[j, 0] * up[0] + position[j, 1] * up[1] + position[j, 2] * up[2]
        length = math.sqrt(position[j, 0] ** 2 + position[j, 1] ** 2 + position[j, 2] ** 2)
        if along > length * math.cos(reach):
            around[members] = j
            members += 1
    around = around[:members]
    seen_uv, seen_size = np.empty((members, 2)), np.empty(members)
    seen_enu, own = np.empty((members, 3)), np.empty(members)
    taken_by = np.empty(members, dtype=np.int64)
    enu = np.empty((3, 3))
    rotation = np.empty((3, 3))
    for step in range(9):
        distance_m = math.sqrt(place[0] ** 2 + place[1] ** 2 + place[2] ** 2)
        flat = math.hypot(place[0], place[1])
        cl, sl, cp, sp = place[0] / flat, place[1] / flat, flat / distance_m, place[2] / distance_m
        enu[0, 0], enu[0, 1], enu[0, 2] = -sl, cl, 0.0
        enu[1, 0], enu[1, 1], enu[1, 2] = -sp * cl, -sp * sl, cp
        enu[2, 0], enu[2, 1], enu[2, 2] = cp * cl, cp * sl, sp
        # camera_from_enu with the estimated rotation: (1 - [theta x]) C.
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            for k in range(3):
                rotation[a, k] = (
                    camera_from_enu[a, k]
                    + theta[c] * camera_from_enu[b, k]
                    - theta[b] * camera_from_enu[c, k]
                )
        tolerance2 = (first_tolerance_px * 0.6**step) ** 2 if step < 6 else 0.0
        for m in range(members):
            j = around[m]
            taken_by[m] = -1
            seen_size[m] = -1.0
            dx, dy, dz = position[j, 0] - place[0], position[j, 1] - place[1], position[j, 2] - place[2]
            for a in range(3):
                seen_enu[m, a] = enu[a, 0] * dx + enu[a, 1] * dy + enu[a, 2] * dz
            e, n, u = seen_enu[m, 0], seen_enu[m, 1], seen_enu[m, 2]
            depth = rotation[2, 0] * e + rotation[2, 1] * n + rotation[2, 2] * u
            if depth <= 0.0:
                continue
            x = focal_px * (rotation[0, 0] * e + rotation[0, 1] * n + rotation[0, 2] * u) / depth
            y = focal_px * (rotation[1, 0] * e + rotation[1, 1] * n + rotation[1, 2] * u) / depth
            if abs(x) > half_px[0] + 12.0 or abs(y) > half_px[1] + 12.0:
                continue
            seen_uv[m, 0], seen_uv[m, 1] = centre_px[0] + x, centre_px[1] + y
            seen_size[m] = diameter[j] * focal_px / depth
            own[m] = (sigma_m[j] * focal_px / depth) ** 2
        final = step == 8
        for i in range(count):
            nearest[i], distance[i], chance[i] = -1, np.inf, 0.0
            for m in range(members):
                if seen_size[m] <= 0.0 or abs(math.log(size_px[i] / seen_size[m])) > log_gate:
                    continue
                spread = variance_px2[i] + own[m]
                limit = max(gate * spread, tolerance2)
                if final:
                    chance[i] += math.pi * limit / (4.0 * half_px[0] * half_px[1])
                away = (uv[i, 0] - seen_uv[m, 0]) ** 2 + (uv[i, 1] - seen_uv[m, 1]) ** 2
                if away < limit and away < distance[i]:
                    nearest[i], distance[i] = m, away
        for i in range(count):
            m = nearest[i]
            if m >= 0 and (taken_by[m] < 0 or distance[taken_by[m]] > distance[i]):
                taken_by[m] = i
        pairs = 0
        for i in range(count):
            if nearest[i] >= 0 and taken_by[nearest[i]] == i:
                pairs += 1
            else:
                nearest[i] = -1
        if final or pairs < 3:
            break
        normal[:] = 0.0
        right = np.zeros(6)
        row = np.zeros((2, 6))
        for a in range(3):
            normal[3 + a, 3 + a] = 1.0 / attitude_sigma**2
            right[3 + a] = -theta[a] / attitude_sigma**2
        tangent = sp / cp
        for i in range(count):
            m = nearest[i]
            if m < 0:
                continue
            dx, dy, dz = seen_enu[m, 0], seen_enu[m, 1], seen_enu[m, 2]
            # The local axes turn as the place moves, and the camera with them.
            shifts = np.empty((3, 3))
            shifts[0, 0], shifts[0, 1], shifts[0, 2] = (
                -1.0 - (dz - tangent * dy) / distance_m,
                -tangent * dx / distance_m,
                dx / distance_m,
            )
            shifts[1, 0], shifts[1, 1], shifts[1, 2] = 0.0, -1.0 - dz / distance_m, dy / distance_m
            shifts[2, 0], shifts[2, 1], shifts[2, 2] = 0.0, 0.0, -1.0
            s0 = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz
            s1 = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz
            s2 = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz
            for k in range(6):
                if k < 3:
                    g0 = (
                        rotation[0, 0] * shifts[k, 0]
                        + rotation[0, 1] * shifts[k, 1]
                        + rotation[0, 2] * shifts[k, 2]
                    )
                    g1 = (
                        rotation[1, 0] * shifts[k, 0]
                        + rotation[1, 1] * shifts[k, 1]
                        + rotation[1, 2] * shifts[k, 2]
                    )
                    g2 = (
                        rotation[2, 0] * shifts[k, 0]
                        + rotation[2, 1] * shifts[k, 1]
                        + rotation[2, 2] * shifts[k, 2]
                    )
                elif k == 3:
                    g0, g1, g2 = 0.0, s2, -s1
                elif k == 4:
                    g0, g1, g2 = -s2, 0.0, s0
                else:
                    g0, g1, g2 = s1, -s0, 0.0
                row[0, k] = focal_px * (g0 - s0 * g2 / s2) / s2
                row[1, k] = focal_px * (g1 - s1 * g2 / s2) / s2
            weight = 1.0 / (variance_px2[i] + own[m])
            for axis in range(2):
                residual = uv[i, axis] - seen_uv[m, axis]
                for k in range(6):
                    right[k] += weight * row[axis, k] * residual
                    for q in range(6):
                        normal[k, q] += weight * row[axis, k] * row[axis, q]
        change = _solved(normal, right)
        for a in range(3):
            place[a] += enu[0, a] * change[0] + enu[1, a] * change[1] + enu[2, a] * change[2]
            theta[a] += change[3 + a]
        if not math.isfinite(place[0] + place[1] + place[2]) or math.hypot(place[0], place[1]) < 1.0:
            for i in range(count):
                nearest[i] = -1
            return start, np.zeros(3), np.zeros((6, 6)), nearest, chance
    pair = np.full(count, -1)
    for i in range(count):
        if nearest[i] >= 0:
            pair[i] = around[nearest[i]]
    return place, theta, normal, pair, chance
