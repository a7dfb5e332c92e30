"""Places on the ground of detections that no catalogued crater explains.

The detections of a pass are put on the ground with the reference ephemeris and the attitude of each frame, not with the
estimate of the payload: a position that the payload derived from its catalogue would hand its errors on to the new
craters. Detections of one place in several frames are triangulated.

Catalogued craters of the same pass are triangulated in the same way. Their median offset from the catalogue is the
common error of reference, attitude and clock in this pass; it is removed. Their scatter scales the uncertainty. A pass
with few of them keeps its offset, and the declared errors of reference and attitude are added instead.

Frames: mean-Earth (MCMF), and east, north, up at the place.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ground_service.evaluation.recall import ExpectedCraters, Matches
from ground_service.telemetry.samples import DetectionSamples
from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera, above_horizon, intersect_sphere
from lunar.catalogue import NAVIGATION_MINIMUM_M, CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.frames import enu_from_mcmf, mcmf_from_spherical, spherical_from_mcmf

CENTRE_SIGMA_PX = 2.0
"""Error of a detected centre before the catalogued craters of the pass scale it."""

HEIGHT_SIGMA_M = 800.0
"""Error of the local height, taken from the rims of catalogued craters; sightings with parallax improve it."""

HEIGHT_REACH_M = 60_000.0
ATTITUDE_SIGMA_RAD = math.radians(0.1)
"""Pointing error of a pass without enough catalogued craters."""

REGISTRATION_SIGMA_M = 20.0
"""Error of the catalogue as a whole: no number of passes reduces it."""

PERSISTENT_SHARE = 0.3
"""Share of the variance of a place that is the same on every pass: the detector repeats its error on the same crater.

The on-board filter uses the same share (`detection_persistence`, docs/navigation.md).
"""

CONTROLS_NEEDED = 5
EXPLAINED_RADII = 0.7
EXPLAINED_PX = 4.0
REACH = 0.5
"""Detections within this share of the diameter are of one place; terrain heights move them from frame to frame."""

SIZE_RATIO = 1.4
OUTLIER_SIGMAS = 4.0
PASSES_NEEDED, SIGHTINGS_NEEDED, SHARE_NEEDED = 2, 4, 0.25
"""A landmark is proposed from so many passes and sightings on, in this share of the frames that look at it."""


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Camera, and its true position (f, 3) and rotation (f, 3, 3) from MCMF in each frame; NaN if unknown."""

    camera: PinholeCamera
    position_mcmf_m: FloatArray
    camera_from_mcmf: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkFix:
    """A place that a pass has seen; `sigma_m` east, north, up; `rows` are the detections, `looks` frames in view."""

    latitude_rad: float
    longitude_rad: float
    height_m: float
    sigma_m: tuple[float, float, float]
    diameter_m: float
    diameter_sigma_m: float
    score: float
    rows: IntArray
    looks: int


@dataclass(frozen=True, slots=True, eq=False)
class PassPlaces:
    """Places of a pass, and the catalogued craters that calibrate them.

    Attributes
    ----------
    unmatched
        Number of detections that no catalogued crater explains.
    controls
        Number of triangulated catalogued craters.
    offset_m
        Their median offset from the catalogue, east, north, up, that was removed; NaN if nothing was removed.
    """

    places: tuple[LandmarkFix, ...]
    unmatched: int
    controls: int
    offset_m: tuple[float, float, float]


def places_of_pass(
    detections: DetectionSamples,
    expected: ExpectedCraters,
    matches: Matches,
    catalogue: CraterCatalogue,
    frames: Frames,
    reference_sigma_m: float,
) -> PassPlaces:
    """Return the places that at least two frames of a pass have seen and that the catalogue lacks.

    Parameters
    ----------
    reference_sigma_m
        Declared error of the reference on the ground.
    """
    owner = np.repeat(np.arange(len(detections)), np.diff(detections.offsets))
    usable = detections.usable[owner] & np.isfinite(frames.position_mcmf_m[owner, 0])
    usable &= np.isfinite(frames.camera_from_mcmf[owner, 0, 0])
    controls = _controls(detections, expected, matches, catalogue, frames, owner, usable)
    free = np.flatnonzero(usable & ~_explained(detections, expected, matches))
    points, depth_m = _ground_points(detections, frames, owner, free, catalogue)
    known = np.isfinite(points[:, 0])
    free, points, depth_m = free[known], points[known], depth_m[known]
    diameter_m = detections.diameter_px[free] * depth_m / frames.camera.focal_px
    found = []
    for group in _groups(points, diameter_m, detections.score[free], owner[free]):
        place = _triangulated(detections, frames, owner, free[group], points[group], diameter_m[group])
        if place is not None and place.diameter_m >= NAVIGATION_MINIMUM_M:
            found.append(place)
    offset, scale, error_m, size, size_sigma = _calibration(controls, reference_sigma_m, frames)
    moved = [_calibrated(one, offset, scale, error_m, size, size_sigma) for one in found]
    return PassPlaces(
        tuple(
            # A place at the edge may be seen in a frame outside which its mean lies.
            replace(one, looks=len(np.union1d(np.flatnonzero(in_view(one, frames)), owner[one.rows])))
            for one in moved
        ),
        len(free),
        len(controls),
        offset,
    )


def in_view(place: LandmarkFix, frames: Frames) -> BoolArray:
    """Return in which frames (f,) a place is inside the image."""
    point = mcmf_from_spherical(place.latitude_rad, place.longitude_rad, place.height_m)
    line = np.einsum("fij,fj->fi", frames.camera_from_mcmf, point - frames.position_mcmf_m)
    with np.errstate(invalid="ignore"):
        inside = frames.camera.contains(frames.camera.project(line)) & (line[:, 2] > 0.0)
    near = above_horizon(frames.position_mcmf_m, np.broadcast_to(point, frames.position_mcmf_m.shape))
    return np.asarray(inside & near)


def same_place(one: LandmarkFix, other: LandmarkFix) -> bool:
    """Return whether two passes have seen one crater."""
    reach = max(
        0.5 * REACH * min(one.diameter_m, other.diameter_m),
        min(3.0 * math.hypot(*one.sigma_m[:2], *other.sigma_m[:2]), REACH * one.diameter_m),
    )
    alike = abs(math.log(one.diameter_m / other.diameter_m)) < math.log(SIZE_RATIO)
    return alike and distance_m(one, other) < reach


def is_listed(place: LandmarkFix, catalogue: CraterCatalogue) -> bool:
    near = catalogue.near(place.latitude_rad, place.longitude_rad, REACH * place.diameter_m)
    columns = (catalogue.latitude_rad[near], catalogue.longitude_rad[near], catalogue.diameter_m[near])
    return any(
        same_place(place, replace(place, latitude_rad=lat, longitude_rad=lon, diameter_m=size, sigma_m=(0.0, 0.0, 0.0)))
        for lat, lon, size in zip(*(one.tolist() for one in columns), strict=True)
    )


def distance_m(one: LandmarkFix, other: LandmarkFix) -> float:
    """Return the distance of two places on the sphere."""
    first = np.asarray(mcmf_from_spherical(one.latitude_rad, one.longitude_rad, 0.0))
    last = np.asarray(mcmf_from_spherical(other.latitude_rad, other.longitude_rad, 0.0))
    return float(np.linalg.norm(first - last))


def combined(places: Sequence[LandmarkFix]) -> LandmarkFix:
    """Return one place from those of several passes, at least one, that have seen it.

    The weighted mean. If the passes scatter more than they claim, its uncertainty grows by as much. The error of the
    catalogue as a whole and the part of the detector's error that persists are common to all passes and remain.
    """
    origin = places[0]
    enu = np.array([_enu_m(origin, one) for one in places])
    variance = np.maximum(np.array([one.sigma_m for one in places]) ** 2 - REGISTRATION_SIGMA_M**2, 1.0)
    weight = 1.0 / variance
    mean = (enu * weight).sum(axis=0) / weight.sum(axis=0)
    left = 1.0 / weight.sum(axis=0)
    if len(places) > 1:
        chi2 = ((enu - mean) ** 2 * weight).sum(axis=0) / (len(places) - 1)
        left = left * np.maximum(chi2, 1.0)
    # Passes of equal weight: (1 + p (n - 1)) / n of the variance of one, not 1 / n.
    left = left + PERSISTENT_SHARE * (len(places) - 1) / weight.sum(axis=0)
    sigma = np.sqrt(left + REGISTRATION_SIGMA_M**2)
    sightings = np.array([len(one.rows) for one in places], dtype=np.float64)
    logs = np.log([one.diameter_m for one in places])
    size_weight = sightings / sightings.sum()
    diameter_m = float(np.exp((logs * size_weight).sum()))
    scatter = float(np.std(logs)) * diameter_m if len(places) > 1 else 0.0
    size_sigma = math.hypot(min(one.diameter_sigma_m for one in places), scatter)
    latitude = origin.latitude_rad + mean[1] / MOON_RADIUS_M
    return LandmarkFix(
        float(latitude),
        float(origin.longitude_rad + mean[0] / (MOON_RADIUS_M * math.cos(origin.latitude_rad))),
        float(origin.height_m + mean[2]),
        (float(sigma[0]), float(sigma[1]), float(sigma[2])),
        diameter_m,
        size_sigma,
        float((np.array([one.score for one in places]) * size_weight).sum()),
        np.zeros(0, dtype=np.int64),
        sum(one.looks for one in places),
    )


def is_persistent(passes: int, sightings: int, looks: int) -> bool:
    """Return whether a landmark was seen often enough to be proposed."""
    return passes >= PASSES_NEEDED and sightings >= SIGHTINGS_NEEDED and sightings >= SHARE_NEEDED * max(looks, 1)


def _explained(detections: DetectionSamples, expected: ExpectedCraters, matches: Matches) -> BoolArray:
    """Return which detections (n,) lie on a catalogued crater, matched or of a similar place and size."""
    explained = matches.crater_of_detection >= 0
    for frame in range(len(detections)):
        d = slice(int(detections.offsets[frame]), int(detections.offsets[frame + 1]))
        c = slice(int(expected.offsets[frame]), int(expected.offsets[frame + 1]))
        if d.stop == d.start or c.stop == c.start:
            continue
        apart = np.hypot(
            detections.u_px[d, None] - expected.u_px[None, c], detections.v_px[d, None] - expected.v_px[None, c]
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            alike = np.abs(np.log2(detections.diameter_px[d, None] / expected.diameter_px[None, c])) < 1.0
        reach = np.maximum(EXPLAINED_RADII * expected.diameter_px[None, c] / 2.0, EXPLAINED_PX)
        explained[d] |= ((apart < reach) & alike).any(axis=1)
    return np.asarray(explained)


def _ground_points(
    detections: DetectionSamples, frames: Frames, owner: IntArray, rows: IntArray, catalogue: CraterCatalogue
) -> tuple[FloatArray, FloatArray]:
    """Return the points (n, 3) of detections on spheres of the local height, and their depths (n,)."""
    points, depth = np.full((len(rows), 3), np.nan), np.full(len(rows), np.nan)
    for k, row in enumerate(rows.tolist()):
        frame = int(owner[row])
        rotation, position = frames.camera_from_mcmf[frame], frames.position_mcmf_m[frame]
        ray = frames.camera.rays(np.array([detections.u_px[row], detections.v_px[row]])) @ rotation
        point = position + ray * intersect_sphere(position, ray)
        if not np.isfinite(point).all():
            continue
        point = position + ray * intersect_sphere(position, ray, MOON_RADIUS_M + _local_height_m(catalogue, point))
        points[k], depth[k] = point, (rotation @ (point - position))[2]
    return points, depth


def _local_height_m(catalogue: CraterCatalogue, point_mcmf_m: FloatArray) -> float:
    """Return the median rim height of the catalogued craters around a point; 0 if none is known."""
    latitude, longitude, _ = spherical_from_mcmf(point_mcmf_m)
    heights = catalogue.rim_height_m[catalogue.near(float(latitude), float(longitude), HEIGHT_REACH_M)]
    heights = heights[np.isfinite(heights)]
    return float(np.median(heights)) if heights.size else 0.0


def _groups(points: FloatArray, diameter_m: FloatArray, score: FloatArray, owner: IntArray) -> list[IntArray]:
    """Return the detections of each place, at most one per frame; the best detection left gathers its own."""
    free = np.ones(len(points), dtype=np.bool_)
    groups = []
    for first in np.argsort(-score, kind="stable").tolist():
        if not free[first]:
            continue
        apart = np.linalg.norm(points - points[first], axis=1)
        alike = np.abs(np.log(diameter_m / diameter_m[first])) < math.log(SIZE_RATIO)
        near = np.flatnonzero(free & alike & (apart < REACH * diameter_m[first]))
        near = near[np.argsort(apart[near], kind="stable")]
        _, one = np.unique(owner[near], return_index=True)
        chosen = near[np.sort(one)]
        free[chosen] = False
        free[first] = False
        if len(chosen) >= 2:
            groups.append(np.sort(chosen))
    return groups


def _triangulated(
    detections: DetectionSamples,
    frames: Frames,
    owner: IntArray,
    rows: IntArray,
    points: FloatArray,
    diameter_m: FloatArray,
) -> LandmarkFix | None:
    """Return the place nearest to the rays of its detections, with its formal uncertainty; None without two of them."""
    keep = np.ones(len(rows), dtype=np.bool_)
    position = frames.position_mcmf_m[owner[rows]]
    uv = np.column_stack([detections.u_px[rows], detections.v_px[rows]])
    rays = np.einsum("nji,nj->ni", frames.camera_from_mcmf[owner[rows]], frames.camera.rays(uv))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    start = points.mean(axis=0)
    range_m = np.linalg.norm(start - position, axis=1)
    sigma_m = CENTRE_SIGMA_PX / frames.camera.focal_px * range_m
    up = start / np.linalg.norm(start)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    for _ in range(2):
        weight = keep / sigma_m**2
        normal = np.einsum("n,nij->ij", weight, across) + np.outer(up, up) / HEIGHT_SIGMA_M**2
        right = np.einsum("n,nij,nj->i", weight, across, position) + up * (up @ start) / HEIGHT_SIGMA_M**2
        covariance = np.linalg.inv(normal)
        point = covariance @ right
        miss = np.linalg.norm(np.einsum("nij,nj->ni", across, point - position), axis=1) / sigma_m
        keep = keep & (miss < OUTLIER_SIGMAS)
        if np.count_nonzero(keep) < 2:
            return None
    latitude, longitude, height = (float(one) for one in spherical_from_mcmf(point))
    enu = np.asarray(enu_from_mcmf(latitude, longitude))
    sigma = np.sqrt(np.diag(enu @ covariance @ enu.T))
    size = diameter_m[keep]
    return LandmarkFix(
        latitude,
        longitude,
        height,
        (float(sigma[0]), float(sigma[1]), float(sigma[2])),
        float(np.median(size)),
        float(np.std(size)) / math.sqrt(len(size)),
        float(detections.score[rows[keep]].mean()),
        rows[keep],
        0,
    )


def _controls(
    detections: DetectionSamples,
    expected: ExpectedCraters,
    matches: Matches,
    catalogue: CraterCatalogue,
    frames: Frames,
    owner: IntArray,
    usable: BoolArray,
) -> list[tuple[LandmarkFix, FloatArray, float]]:
    """Return catalogued craters triangulated like new ones: place, offset from the catalogue, ratio of diameters."""
    rows = np.flatnonzero(usable & (matches.crater_of_detection >= 0))
    crater = expected.index[matches.crater_of_detection[rows]]
    found = []
    for one in np.unique(crater).tolist():
        mine = rows[crater == one]
        if len(mine) < 2:
            continue
        direction = np.asarray(mcmf_from_spherical(catalogue.latitude_rad[one], catalogue.longitude_rad[one]))
        direction /= MOON_RADIUS_M
        # from the same height as a new crater, not from the catalogued one
        radius_m = MOON_RADIUS_M + _local_height_m(catalogue, direction)
        known = np.isfinite(catalogue.rim_height_m[one])
        centre = catalogue.position_mcmf_m[one] if known else direction * radius_m
        position = frames.position_mcmf_m[owner[mine]]
        depth = np.einsum("nij,nj->ni", frames.camera_from_mcmf[owner[mine]], centre - position)[:, 2]
        diameter_m = detections.diameter_px[mine] * depth / frames.camera.focal_px
        start = np.broadcast_to(direction * radius_m, (len(mine), 3))
        place = _triangulated(detections, frames, owner, mine, start, diameter_m)
        if place is None:
            continue
        turn = np.asarray(enu_from_mcmf(place.latitude_rad, place.longitude_rad))
        point = np.asarray(mcmf_from_spherical(place.latitude_rad, place.longitude_rad, place.height_m))
        offset = turn @ (point - centre)
        if not known:
            offset[2] = np.nan
        found.append((place, offset, place.diameter_m / float(catalogue.diameter_m[one])))
    return found


def _calibration(
    controls: Sequence[tuple[LandmarkFix, FloatArray, float]], reference_sigma_m: float, frames: Frames
) -> tuple[tuple[float, float, float], FloatArray, FloatArray, float, float]:
    """Return offset, factors (3,) of the formal uncertainty, its further part (3,), ratio and scatter of diameters."""
    nan = float("nan")
    if len(controls) < CONTROLS_NEEDED:
        height = np.linalg.norm(frames.position_mcmf_m, axis=1) - MOON_RADIUS_M
        range_m = float(np.nanmedian(height)) if np.isfinite(height).any() else 0.0
        error = math.hypot(reference_sigma_m, ATTITUDE_SIGMA_RAD * range_m)
        return (nan, nan, nan), np.ones(3), np.full(3, error), 1.0, 0.1
    offsets = np.array([one[1] for one in controls])
    formal = np.array([one[0].sigma_m for one in controls])
    heights = np.isfinite(offsets[:, 2])
    middle = np.median(offsets, axis=0)
    if np.count_nonzero(heights) < CONTROLS_NEEDED:
        middle[2] = 0.0
    else:
        middle[2] = np.median(offsets[heights, 2])
    left = offsets - middle
    # The scatter decides, also below the formal uncertainty; that of few craters may be small by chance. It is bounded,
    # because a crater is matched within half its radius.
    ratio = (left / formal) ** 2
    level = np.full(3, float(np.mean(ratio[:, :2])))
    if np.count_nonzero(heights) >= CONTROLS_NEEDED:
        level[2] = float(np.mean(ratio[heights, 2]))
    scale = np.sqrt(level * (1.0 + CONTROLS_NEEDED / len(controls)))
    scatter = 1.4826 * np.median(np.abs(left[:, :2]), axis=0)
    up = 1.4826 * float(np.median(np.abs(left[heights, 2]))) if heights.any() else HEIGHT_SIGMA_M
    error_m = np.array([*scatter, up]) * 1.2533 / math.sqrt(len(controls))  # of a median
    sizes = np.log([one[2] for one in controls])
    size = float(np.exp(np.median(sizes)))
    size_sigma = 1.4826 * float(np.median(np.abs(sizes - np.median(sizes))))
    return (float(middle[0]), float(middle[1]), float(middle[2])), scale, error_m, size, size_sigma


def _calibrated(
    place: LandmarkFix,
    offset_m: tuple[float, float, float],
    scale: FloatArray,
    error_m: FloatArray,
    size: float,
    size_sigma: float,
) -> LandmarkFix:
    """Return a place without the common offset of its pass, and with the uncertainty that the pass has shown."""
    east, north, up = np.nan_to_num(offset_m).tolist()
    sigma = np.sqrt((scale * np.array(place.sigma_m)) ** 2 + error_m**2 + REGISTRATION_SIGMA_M**2)
    diameter_m = place.diameter_m / size
    return replace(
        place,
        latitude_rad=place.latitude_rad - north / MOON_RADIUS_M,
        longitude_rad=place.longitude_rad - east / (MOON_RADIUS_M * math.cos(place.latitude_rad)),
        height_m=place.height_m - up,
        sigma_m=(float(sigma[0]), float(sigma[1]), float(sigma[2])),
        diameter_m=diameter_m,
        diameter_sigma_m=math.hypot(place.diameter_sigma_m / size, size_sigma * diameter_m),
    )


def _enu_m(origin: LandmarkFix, place: LandmarkFix) -> tuple[float, float, float]:
    turn = math.remainder(place.longitude_rad - origin.longitude_rad, 2.0 * math.pi)
    return (
        MOON_RADIUS_M * turn * math.cos(origin.latitude_rad),
        MOON_RADIUS_M * (place.latitude_rad - origin.latitude_rad),
        place.height_m - origin.height_m,
    )
