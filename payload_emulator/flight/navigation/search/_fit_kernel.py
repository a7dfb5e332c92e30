"""Compiled fit of a camera's place to craters and detections, for the search without a prior.

Places are in MCMF, offsets in the local axes east, north, up of the place; lengths in m, images in pixels.
"""

import math
from typing import NamedTuple

import numpy as np

from kernels.compiled import njit
from lunar.arrays import FloatArray, IntArray

_ROUNDS = 9
"""Rounds of choosing pairs and solving; the last only chooses."""

_WIDE_ROUNDS, _SHRINK = 6, 0.6
"""Rounds in which pairs may be farther apart than their gate, by a tolerance that shrinks by this factor a round."""

_MARGIN_PX = 12.0
"""Craters this far outside the image may still be detected at its edge."""

_RECALLS = (0.15, 0.4, 0.8)
"""Shares of the craters in the image that a detector may find; which is not known, so that their mean counts."""

_LARGEST_SHARE = 0.9
"""Largest share of the detections of a size that are taken to be craters of the map."""


class Image(NamedTuple):
    """Focal length, centre (2,) and half width and height (2,) of the image."""

    focal_px: float
    centre_px: FloatArray
    half_px: FloatArray


class DetectedCraters(NamedTuple):
    """Detections: centres (k, 2), logarithms of diameters, variances of the centres per axis and scores, each (k,)."""

    uv_px: FloatArray
    log_diameter: FloatArray
    variance_px2: FloatArray
    score: FloatArray


class Craters(NamedTuple):
    """Craters in order of latitude: places (n, 3), diameters and horizontal sigmas (n,)."""

    latitude: FloatArray
    position: FloatArray
    diameter: FloatArray
    sigma_m: FloatArray


class Gates(NamedTuple):
    """Limits of pairs.

    Attributes
    ----------
    tolerance_px
        Distance within which pairs are accepted in the first round.
    chi_square
        Of two degrees of freedom, within which a crater explains a detection.
    log_diameter
        Largest difference of the logarithms of diameters.
    log_diameter_sigma
        Standard deviation of the difference of a true pair.
    """

    tolerance_px: float
    chi_square: float
    log_diameter: float
    log_diameter_sigma: float


class Seen(NamedTuple):
    """Predicted craters: centres (m, 2), logarithms of diameters (m,), offsets (m, 3), variances (m,).

    The logarithm is minus infinity outside the image, where nothing resembles a crater.
    """

    uv: FloatArray
    log_diameter: FloatArray
    enu: FloatArray
    variance: FloatArray


@njit
def fit_place(
    start: FloatArray,
    camera_from_enu: FloatArray,
    image: Image,
    found: DetectedCraters,
    craters: Craters,
    attitude_sigma: float,
    gates: Gates,
    radius_m: float,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, float]:
    """Return place, attitude, their normal matrix, the crater of each detection (-1: none) and the evidence.

    Least squares on the pairs of detections and craters that are each other's nearest, over place (east, north, up)
    and a small rotation of the camera whose size is known; pairs are chosen again in every round, ever closer.

    Parameters
    ----------
    start
        Place of the camera (MCMF), shape (3,).
    attitude_sigma
        Standard deviation of the rotation per axis.

    Returns
    -------
    evidence
        See `log_evidence`.
    """
    count = found.uv_px.shape[0]
    place, theta = start.copy(), np.zeros(3)
    nearest, normal, evidence = np.full(count, -1), np.zeros((6, 6)), 0.0
    around = _in_reach(place, image, craters, radius_m)
    members = around.size
    seen = Seen(np.empty((members, 2)), np.empty(members), np.empty((members, 3)), np.empty(members))
    for step in range(_ROUNDS):
        enu = _local_axes(place)
        rotation = _turned(camera_from_enu, theta)
        _project(seen, place, enu, rotation, image, craters, around)
        tolerance2 = (gates.tolerance_px * _SHRINK**step) ** 2 if step < _WIDE_ROUNDS else 0.0
        pairs = _choose(nearest, seen, found, gates, tolerance2)
        if pairs < 3:
            break
        if step == _ROUNDS - 1:
            evidence = log_evidence(nearest, seen, found, image, gates.log_diameter_sigma)
            break
        right = _normal_equations(normal, place, theta, rotation, seen, found, nearest, attitude_sigma, image.focal_px)
        change = _solved(normal, right)
        for a in range(3):
            place[a] += enu[0, a] * change[0] + enu[1, a] * change[1] + enu[2, a] * change[2]
            theta[a] += change[3 + a]
        if not math.isfinite(place[0] + place[1] + place[2]) or math.hypot(place[0], place[1]) < 1.0:
            for i in range(count):
                nearest[i] = -1
            return start, np.zeros(3), np.zeros((6, 6)), nearest, 0.0
    pair = np.full(count, -1)
    for i in range(count):
        if nearest[i] >= 0:
            pair[i] = around[nearest[i]]
    return place, theta, normal, pair, evidence


@njit
def log_evidence(
    nearest: IntArray, seen: Seen, found: DetectedCraters, image: Image, log_diameter_sigma: float
) -> float:
    """Return how much likelier the detections are with the camera at a place than scattered, as a logarithm.

    Given the sizes and scores of all detections, each lies anywhere in the image if it is scattered. At the right place
    it is, with a probability that follows from its score and from the numbers of craters and of detections of about its
    size, one of the craters, each of which is as likely as its size agrees. A detection without a pair counts as
    scattered although craters may be near, and the positions of pairs have a normal distribution. So the mean ratio of
    scattered detections is at most one, and chance exceeds a ratio r with a probability of at most 1 / r (Markov's
    inequality).

    Parameters
    ----------
    nearest
        Predicted crater of each detection, -1 for none, shape (k,); none twice.
    """
    count, members = nearest.size, seen.log_diameter.size
    area_px2 = 4.0 * image.half_px[0] * image.half_px[1]
    ratio, share = np.zeros(count), np.zeros(count)
    for i in range(count):
        of_craters, of_detections = 0.0, 0.0
        for m in range(members):
            of_craters += _density(found.log_diameter[i] - seen.log_diameter[m], log_diameter_sigma)
        for k in range(count):
            alike = _density(found.log_diameter[i] - found.log_diameter[k], log_diameter_sigma)
            of_detections += found.score[k] * alike
        share[i] = found.score[i] * of_craters / of_detections
        m = nearest[i]
        if m < 0 or of_craters <= 0.0:
            continue
        variance = found.variance_px2[i] + seen.variance[m]
        away = (found.uv_px[i, 0] - seen.uv[m, 0]) ** 2 + (found.uv_px[i, 1] - seen.uv[m, 1]) ** 2
        alike = _density(found.log_diameter[i] - seen.log_diameter[m], log_diameter_sigma) / of_craters
        ratio[i] = area_px2 * alike * math.exp(-0.5 * away / variance) / (2.0 * math.pi * variance)
    best = -math.inf
    totals = np.zeros(len(_RECALLS))
    for r in range(len(_RECALLS)):
        for i in range(count):
            totals[r] += math.log1p(min(_RECALLS[r] * share[i], _LARGEST_SHARE) * (ratio[i] - 1.0))
        best = max(best, totals[r])
    mean = 0.0
    for r in range(len(_RECALLS)):
        mean += math.exp(totals[r] - best) / len(_RECALLS)
    return best + math.log(mean)


@njit
def _density(difference: float, sigma: float) -> float:
    """Return the normal density."""
    return math.exp(-0.5 * (difference / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi))


@njit
def _length(vector: FloatArray) -> float:
    return math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


@njit
def _in_reach(place: FloatArray, image: Image, craters: Craters, radius_m: float) -> IntArray:
    """Return the craters that can be in the image: those above the horizon and within the farthest ray."""
    position = craters.position
    distance_m = _length(place)
    corner = math.atan(1.1 * math.hypot(image.half_px[0], image.half_px[1]) / image.focal_px)
    sine = distance_m / radius_m * math.sin(corner)
    horizon = math.acos(min(1.0, radius_m / distance_m))
    reach = 1.15 * (horizon if sine >= 1.0 else min(math.asin(sine) - corner, horizon)) + 0.002
    up = place / distance_m
    low = np.searchsorted(craters.latitude, math.asin(up[2]) - reach)
    high = np.searchsorted(craters.latitude, math.asin(up[2]) + reach)
    around = np.empty(high - low, dtype=np.int64)
    members = 0
    for j in range(low, high):
        along = position[j, 0] * up[0] + position[j, 1] * up[1] + position[j, 2] * up[2]
        if along > _length(position[j]) * math.cos(reach):
            around[members] = j
            members += 1
    return around[:members]


@njit
def _local_axes(place: FloatArray) -> FloatArray:
    """Return the axes east, north, up at a place, rows in MCMF."""
    distance_m, flat = _length(place), math.hypot(place[0], place[1])
    cl, sl, cp, sp = place[0] / flat, place[1] / flat, flat / distance_m, place[2] / distance_m
    enu = np.empty((3, 3))
    enu[0, 0], enu[0, 1], enu[0, 2] = -sl, cl, 0.0
    enu[1, 0], enu[1, 1], enu[1, 2] = -sp * cl, -sp * sl, cp
    enu[2, 0], enu[2, 1], enu[2, 2] = cp * cl, cp * sl, sp
    return enu


@njit
def _turned(camera_from_enu: FloatArray, theta: FloatArray) -> FloatArray:
    """Return camera_from_enu with the estimated rotation: (1 - [theta x]) C."""
    rotation = np.empty((3, 3))
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        for k in range(3):
            rotation[a, k] = camera_from_enu[a, k] + theta[c] * camera_from_enu[b, k] - theta[b] * camera_from_enu[c, k]
    return rotation


@njit
def _project(
    seen: Seen,
    place: FloatArray,
    enu: FloatArray,
    rotation: FloatArray,
    image: Image,
    craters: Craters,
    around: IntArray,
) -> None:
    """Fill `seen` with the craters around."""
    position, focal_px = craters.position, image.focal_px
    for m in range(around.size):
        j = around[m]
        seen.log_diameter[m] = -math.inf
        dx, dy, dz = position[j, 0] - place[0], position[j, 1] - place[1], position[j, 2] - place[2]
        for a in range(3):
            seen.enu[m, a] = enu[a, 0] * dx + enu[a, 1] * dy + enu[a, 2] * dz
        e, n, u = seen.enu[m, 0], seen.enu[m, 1], seen.enu[m, 2]
        depth = rotation[2, 0] * e + rotation[2, 1] * n + rotation[2, 2] * u
        if depth <= 0.0:
            continue
        x = focal_px * (rotation[0, 0] * e + rotation[0, 1] * n + rotation[0, 2] * u) / depth
        y = focal_px * (rotation[1, 0] * e + rotation[1, 1] * n + rotation[1, 2] * u) / depth
        if abs(x) > image.half_px[0] + _MARGIN_PX or abs(y) > image.half_px[1] + _MARGIN_PX:
            continue
        seen.uv[m, 0], seen.uv[m, 1] = image.centre_px[0] + x, image.centre_px[1] + y
        seen.log_diameter[m] = math.log(craters.diameter[j] * focal_px / depth)
        seen.variance[m] = (craters.sigma_m[j] * focal_px / depth) ** 2


@njit
def _choose(nearest: IntArray, seen: Seen, found: DetectedCraters, gates: Gates, tolerance2: float) -> int:
    """Fill the crater of each detection with mutual nearest ones and return their number."""
    count, members = nearest.size, seen.log_diameter.size
    distance = np.full(count, np.inf)
    taken_by = np.full(members, -1)
    for i in range(count):
        nearest[i] = -1
        for m in range(members):
            if abs(found.log_diameter[i] - seen.log_diameter[m]) > gates.log_diameter:
                continue
            limit = max(gates.chi_square * (found.variance_px2[i] + seen.variance[m]), tolerance2)
            away = (found.uv_px[i, 0] - seen.uv[m, 0]) ** 2 + (found.uv_px[i, 1] - seen.uv[m, 1]) ** 2
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
    return pairs


@njit
def _normal_equations(
    normal: FloatArray,
    place: FloatArray,
    theta: FloatArray,
    rotation: FloatArray,
    seen: Seen,
    found: DetectedCraters,
    nearest: IntArray,
    attitude_sigma: float,
    focal_px: float,
) -> FloatArray:
    """Fill the normal matrix (6, 6) over place and rotation, and return the right side (6,)."""
    distance_m, flat = _length(place), math.hypot(place[0], place[1])
    tangent = place[2] / distance_m / (flat / distance_m)
    normal[:] = 0.0
    right = np.zeros(6)
    row = np.zeros((2, 6))
    for a in range(3):
        normal[3 + a, 3 + a] = 1.0 / attitude_sigma**2
        right[3 + a] = -theta[a] / attitude_sigma**2
    for i in range(nearest.size):
        m = nearest[i]
        if m < 0:
            continue
        _derivatives(row, seen.enu[m], rotation, distance_m, tangent, focal_px)
        weight = 1.0 / (found.variance_px2[i] + seen.variance[m])
        for axis in range(2):
            residual = found.uv_px[i, axis] - seen.uv[m, axis]
            for k in range(6):
                right[k] += weight * row[axis, k] * residual
                for q in range(6):
                    normal[k, q] += weight * row[axis, k] * row[axis, q]
    return right


@njit
def _derivatives(
    row: FloatArray, offset: FloatArray, rotation: FloatArray, distance_m: float, tangent: float, focal_px: float
) -> None:
    """Fill the derivatives (2, 6) of a crater's pixel by place and rotation.

    The local axes turn as the place moves, and the camera with them; ``tangent`` is that of the latitude.
    """
    dx, dy, dz = offset[0], offset[1], offset[2]
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
            x, y, z = shifts[k, 0], shifts[k, 1], shifts[k, 2]
            g0 = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
            g1 = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
            g2 = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        elif k == 3:
            g0, g1, g2 = 0.0, s2, -s1
        elif k == 4:
            g0, g1, g2 = -s2, 0.0, s0
        else:
            g0, g1, g2 = s1, -s0, 0.0
        row[0, k] = focal_px * (g0 - s0 * g2 / s2) / s2
        row[1, k] = focal_px * (g1 - s1 * g2 / s2) / s2


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
