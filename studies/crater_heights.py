"""Height at which a network sees the centres of craters, from recordings of navigation windows with true positions.

A crater whose seen centre lies below the mean height of its rim appears nearer to the image centre, which a navigator
takes for a larger altitude. All detections of known craters are compared with the projections of their craters, and
one height is fitted by weighted least squares together with a shift of each window to the east and to the north (what
the registration of list and terrain leaves).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical
from payload_emulator.errors import RecordError
from payload_emulator.flight.vision.detections import Detections
from studies.navigation_windows import CAMERA_FOV_RAD, CAMERA_PX, Recording, arcs

LEAST_DIAMETER_M, MOST_DIAMETER_M = 3_000.0, 30_000.0
# Detections below are left out: recordings of all networks are compared at the on-board threshold of the shipped one.
LEAST_SCORE = 0.44
_STEP_M = 50.0
_LARGEST_DIAMETER_RATIO = 1.35
_NEAR_RADII, _NEAR_PX = 0.25, 2.0
_OUTLIER_SIGMAS = 3.5
_ROUNDS = 5
_REACH_RAD = math.radians(8.0)


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Detections of known craters, a row each.

    Attributes
    ----------
    crater, window
        Crater by id and window by number, shape (n,).
    residual_px
        Detection minus projection of the crater at the mean height of its rim (right, down), shape (n, 2).
    east, north, up
        Displacement in the image (pixels) for one metre of the crater, shape (n, 2) each.
    weight
        Inverse variance of the detection per axis, 1/px², shape (n,).
    depth_ratio
        Depth over diameter of the crater, shape (n,); NaN where unknown.
    altitude_m
        Distance of the camera from the sphere of the maps, shape (n,).
    """

    crater: IntArray
    window: IntArray
    residual_px: FloatArray
    east: FloatArray
    north: FloatArray
    up: FloatArray
    weight: FloatArray
    depth_ratio: FloatArray
    altitude_m: FloatArray

    def chosen(self, rows: BoolArray) -> Sightings:
        """Return some of the rows."""
        return Sightings(*(getattr(self, name)[rows] for name in self.__slots__))


@dataclass(frozen=True, slots=True)
class HeightFit:
    """Height (m) of the seen centres above the mean rim, its standard deviation, and what they rest on.

    The standard deviation takes all errors of one crater as one. Both are NaN where the detections do not tell them.
    """

    height_m: float
    sigma_m: float
    craters: int
    detections: int


def sightings(recordings: Sequence[Recording]) -> Sightings:
    """Return the detections of catalogued craters of 3 to 30 km; windows are numbered over all recordings."""
    parts, windows = [], 0
    for recording in recordings:
        for part in arcs(recording):
            parts += [_of_frame(recording, number, windows) for number in range(part.start, part.stop)]
            windows += 1
    kept = [part for part in parts if part is not None]
    if not kept:
        raise RecordError("height of craters: expected detections of known craters, found none")
    return Sightings(
        *(np.concatenate([getattr(part, name) for part in kept]) for name in Sightings.__slots__)
    )


def fit_height(seen: Sightings) -> HeightFit:
    """Return the height that fits the detections best; outliers are left out, errors of one crater count as one."""
    rows = np.ones(seen.crater.size, dtype=bool)
    for _ in range(_ROUNDS):
        part = seen.chosen(rows)
        if not _is_determined(part):
            return HeightFit(math.nan, math.nan, int(np.unique(part.crater).size), int(part.crater.size))
        solution, covariance = _solve(part)
        left = seen.residual_px - _predicted(seen, solution, np.unique(part.window))
        size = np.sqrt(seen.weight) * np.linalg.norm(left, axis=1)
        scale = np.median(size[rows]) / math.sqrt(2.0 * math.log(2.0))  # of a Rayleigh distribution
        kept = size <= _OUTLIER_SIGMAS * scale
        if np.array_equal(kept, rows):
            break
        rows = kept
    return HeightFit(
        float(solution[0]),
        float(np.sqrt(covariance[0, 0])),
        int(np.unique(part.crater).size),
        int(part.crater.size),
    )


def _of_frame(recording: Recording, number: int, window: int) -> Sightings | None:
    """Return the detections of known craters in a frame; a crater and a detection that choose each other are a pair."""
    found = recording.found(number)
    if found is None or not len(found):
        return None
    catalogue = recording.catalogue
    position = recording.mcmf_from_icrf[number] @ recording.truth[number, :3]
    ground = catalogue.position_mcmf_m
    near = ground @ position > np.linalg.norm(position) * np.linalg.norm(ground, axis=1) * math.cos(
        _REACH_RAD
    )
    sized = (catalogue.diameter_m >= LEAST_DIAMETER_M) & (catalogue.diameter_m <= MOST_DIAMETER_M)
    craters = catalogue.select(near & sized & np.isfinite(catalogue.rim_height_m))
    if not len(craters):
        return None
    camera = PinholeCamera(CAMERA_PX, CAMERA_PX, CAMERA_FOV_RAD)
    rotation = recording.camera_from_mcmf[number]
    local = (craters.position_mcmf_m - position) @ rotation.T
    projected = camera.project(local)
    diameter_px = camera.focal_px * craters.diameter_m / local[:, 2]
    pairs = _pairs(found, projected, diameter_px)
    if not len(pairs):
        return None
    of_found, of_crater = pairs.T
    east, north, up = (
        (camera.project((moved - position) @ rotation.T) - projected[of_crater]) / _STEP_M
        for moved in _moves(craters, of_crater)
    )
    count = len(pairs)
    with np.errstate(invalid="ignore"):
        ratio = craters.depth_m[of_crater] / craters.diameter_m[of_crater]
    return Sightings(
        np.asarray(craters.ids[of_crater], dtype=np.int64),
        np.full(count, window, dtype=np.int64),
        np.stack([found.u_px, found.v_px], axis=1)[of_found] - projected[of_crater],
        east,
        north,
        up,
        1.0 / np.maximum(found.sigma_px[of_found], 0.3) ** 2,
        np.asarray(ratio, dtype=np.float64),
        np.full(count, np.linalg.norm(position) - MOON_RADIUS_M),
    )


def _pairs(found: Detections, projected: FloatArray, diameter_px: FloatArray) -> IntArray:
    """Return pairs of detection and crater, (n, 2), that are nearest to each other and of similar size."""
    usable = (found.score >= LEAST_SCORE) & np.isfinite(found.sigma_px)
    offset = np.stack([found.u_px, found.v_px], axis=1)[:, None] - projected[None]
    away = np.linalg.norm(offset, axis=2)
    larger = np.abs(np.log(found.diameter_px[:, None] / diameter_px[None]))
    fits = (
        usable[:, None]
        & (away <= np.maximum(_NEAR_PX, 0.5 * _NEAR_RADII * diameter_px[None]))
        & (larger <= math.log(_LARGEST_DIAMETER_RATIO))
    )
    away = np.where(fits, away, np.inf)
    best_crater, best_found = away.argmin(axis=1), away.argmin(axis=0)
    every = np.arange(len(best_crater))
    mutual = np.isfinite(away[every, best_crater]) & (best_found[best_crater] == every)
    return np.stack([every[mutual], best_crater[mutual]], axis=1)


def _moves(craters: CraterCatalogue, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the places (n, 3) of craters moved by one step to the east, to the north and upward."""
    latitude, longitude = craters.latitude_rad[rows], craters.longitude_rad[rows]
    height, place = craters.rim_height_m[rows], craters.position_mcmf_m[rows]
    east = np.stack([-np.sin(longitude), np.cos(longitude), np.zeros_like(longitude)], axis=1)
    up = place / np.linalg.norm(place, axis=1, keepdims=True)
    return (
        place + _STEP_M * east,
        place + _STEP_M * np.cross(up, east),
        np.asarray(mcmf_from_spherical(latitude, longitude, height + _STEP_M)),
    )


def _design(seen: Sightings, windows: IntArray) -> FloatArray:
    """Return the derivatives of the residuals by height and by the shift of each window, (n, 2, 1 + 2 w)."""
    count = seen.crater.size
    design = np.zeros((count, 2, 1 + 2 * windows.size))
    design[:, :, 0] = seen.up
    known = np.isin(seen.window, windows)
    column = 1 + 2 * np.searchsorted(windows, seen.window[known])
    rows = np.flatnonzero(known)
    design[rows, :, column] = seen.east[rows]
    design[rows, :, column + 1] = seen.north[rows]
    return design


def _predicted(seen: Sightings, solution: FloatArray, windows: IntArray) -> FloatArray:
    return np.asarray(_design(seen, windows) @ solution)


def _is_determined(seen: Sightings) -> bool:
    """Return whether the detections tell the height and the shifts of their windows apart."""
    windows = np.unique(seen.window)
    unknowns = 1 + 2 * windows.size
    design = _design(seen, windows).reshape(2 * seen.crater.size, unknowns)
    return seen.crater.size > unknowns and int(np.linalg.matrix_rank(design)) == unknowns


def _solve(seen: Sightings) -> tuple[FloatArray, FloatArray]:
    """Return the least-squares solution and its covariance with the errors of one crater as one error."""
    design = _design(seen, np.unique(seen.window))
    normal = np.einsum("nai,n,naj->ij", design, seen.weight, design)
    right = np.einsum("nai,n,na->i", design, seen.weight, seen.residual_px)
    inverse = np.linalg.pinv(normal)
    solution = inverse @ right
    left = seen.residual_px - design @ solution
    score = np.einsum("nai,n,na->ni", design, seen.weight, left)
    _, group = np.unique(seen.crater, return_inverse=True)
    together = np.zeros((group.max() + 1, score.shape[1]))
    np.add.at(together, group, score)
    return np.asarray(solution), np.asarray(inverse @ (together.T @ together) @ inverse)
