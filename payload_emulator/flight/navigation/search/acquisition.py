"""Search for the camera if the prediction is wrong by up to tens of kilometres: votes over position and height.

Attitude is known to the ADCS's accuracy. A detection and a crater, taken as a pair, put the camera on the line of
sight through the crater; at an assumed altitude that is one point. True pairs agree on the point, chance pairs
scatter. Altitudes are tried in steps, votes are counted on a grid, the best places are fitted to all detections they
explain, and the result must be better than chance and than every other place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from payload_emulator.flight.navigation.search.identification import minimum_members
from payload_emulator.flight.navigation.sighting import DESIGN_ALTITUDE_M, LandmarkMap, Pose, in_view
from payload_emulator.flight.vision.detections import Detections

# The ground falls away from a plane: towards the corners of the image depth exceeds altitude by up to a tenth at 50 km.
# Half of the logarithm of the ratio.
_SMALLEST_SAG = 0.05
# Two solutions farther apart than this many tolerances of a detection on the ground are different places.
_SEPARATE_TOLERANCES = 3.0
# Angle off nadir up to which craters are searched: beyond it ground and horizon are close, and the distance diverges.
_LARGEST_CORNER_RAD = float(np.radians(70.0))
# Factor by which the tolerance of a pair shrinks with every round of the fit.
_SHRINK = 0.6

SEARCHABLE_DETECTIONS = 3
"""Fewer detections than this can fix no place and altitude beyond what chance gives."""


@dataclass(frozen=True, slots=True)
class AcquisitionParameters:
    """Search by votes.

    Attributes
    ----------
    prior_sigmas
        Half width of the search in standard deviations of the prediction.
    tolerance_px
        Coarse agreement in the vote; also sets the steps of place and altitude.
    log_diameter_gate
        Largest difference of the logarithms of measured and catalogued diameter.
    minimum_altitude_m, maximum_altitude_m
        Altitudes searched at all.
    false_fix_limit
        Expected number of false fixes per search that chance may make up.
    places
        Best places of the vote that are fitted.
    agreement_sigmas
        A detection is explained if it lies this close to a crater after the fit.
    """

    prior_sigmas: float = 3.5
    tolerance_px: float = 8.0
    log_diameter_gate: float = 0.45
    minimum_altitude_m: float = 8_000.0
    maximum_altitude_m: float = 250_000.0
    false_fix_limit: float = 1e-5
    places: int = 12
    agreement_sigmas: float = 3.5


@dataclass(frozen=True, slots=True, eq=False)
class Acquisition:
    """Pairs of detections and craters (indices into both), and the pose that explains them."""

    detection: IntArray
    index: IntArray
    pose: Pose
    candidates: int
    needed: int


def acquire(
    found: Detections,
    landmarks: LandmarkMap,
    pose: Pose,
    camera: PinholeCamera,
    sigma_m: float,
    sigma_px: FloatArray,
    attitude_sigma_rad: float,
    parameters: AcquisitionParameters,
) -> Acquisition | None:
    """Return the place that explains the detections, None where no place does so safely.

    Parameters
    ----------
    pose
        The prediction; its attitude is used, its position is the centre of the search.
    sigma_m
        Standard deviation of the predicted position, each axis.
    sigma_px
        Standard deviation of each detection.
    """
    if len(found) < SEARCHABLE_DETECTIONS:
        return None
    votes = _Votes.of(found, landmarks, pose, camera, sigma_m, parameters)
    if votes is None:
        return None
    fitted = [
        _fit(place, found, landmarks, pose, camera, sigma_px, attitude_sigma_rad, parameters)
        for place in votes.places(parameters)
    ]
    solutions = sorted((fit for fit in fitted if fit is not None), key=lambda fit: -fit.detection.size)
    if not solutions:
        return None
    best = solutions[0]
    reach = parameters.prior_sigmas * sigma_m
    tight_px = parameters.agreement_sigmas * float(np.median(sigma_px)) + camera.focal_px * attitude_sigma_rad
    needed = _needed(votes, best, landmarks, camera, found, reach, tight_px, parameters)
    if best.detection.size < needed:
        return None
    separation_m = _SEPARATE_TOLERANCES * tight_px * votes.altitude_m / camera.focal_px
    for other in solutions[1:]:
        apart = float(np.linalg.norm(other.pose.position_icrf_m - best.pose.position_icrf_m))
        if apart > separation_m and other.detection.size >= best.detection.size - 1:
            return None
    return replace(best, candidates=votes.pairs, needed=needed)


@dataclass(frozen=True, slots=True, eq=False)
class _Votes:
    """All pairs with the lines of sight they stand for, in MCMF.

    Attributes
    ----------
    crater, sight
        Place of the crater of each pair and direction from camera to crater, shape (k, 3).
    detection
        Detection of each pair.
    log_depth
        Logarithm of the depth at which the crater has the detected size.
    centre, east, north
        Centre of the search and its horizontal axes.
    altitudes_m
        Altitudes tried.
    cell_m
        Edge of a cell of the vote.
    sag
        Half of the logarithm of the largest depth of the ground in the image over the altitude.
    """

    crater: FloatArray
    sight: FloatArray
    detection: IntArray
    log_depth: FloatArray
    centre: FloatArray
    east: FloatArray
    north: FloatArray
    altitudes_m: FloatArray
    altitude_m: float
    cell_m: float
    reach_m: float
    sag: float

    @property
    def pairs(self) -> int:
        return int(self.detection.size)

    @classmethod
    def of(
        cls,
        found: Detections,
        landmarks: LandmarkMap,
        pose: Pose,
        camera: PinholeCamera,
        sigma_m: float,
        parameters: AcquisitionParameters,
    ) -> _Votes | None:
        position = pose.mcmf_from_icrf @ pose.position_icrf_m
        radius = float(np.linalg.norm(position))
        up = position / radius
        altitude = float(np.clip(radius - MOON_RADIUS_M, parameters.minimum_altitude_m, parameters.maximum_altitude_m))
        reach = parameters.prior_sigmas * sigma_m
        low = max(altitude - reach, parameters.minimum_altitude_m)
        high = min(altitude + reach, parameters.maximum_altitude_m)
        # A step of altitude moves craters at the edge of the image by the tolerance.
        edge_px = 0.5 * np.hypot(camera.width_px, camera.height_px)
        steps = int(np.ceil(np.log(high / low) / np.log1p(parameters.tolerance_px / edge_px))) + 1
        altitudes = np.geomspace(low, high, max(steps, 1))
        corner = np.arctan(edge_px / camera.focal_px)
        ground = high * np.tan(min(corner, _LARGEST_CORNER_RAD))
        index = landmarks.near(up, (ground + reach) / MOON_RADIUS_M)
        rays = camera.rays(np.stack([found.u_px, found.v_px], axis=1))
        sight = rays @ pose.camera_from_icrf @ pose.mcmf_from_icrf.T
        # Diameter over the line of sight: depth lies between the lowest and the highest altitude tried.
        with np.errstate(divide="ignore", invalid="ignore"):
            size = np.log(landmarks.diameter_m[index][None, :] * camera.focal_px / found.diameter_px[:, None])
        gate, sag = parameters.log_diameter_gate, _sag(altitude, float(corner))
        rows, columns = np.nonzero((size > np.log(low) - gate) & (size < np.log(high) + gate + 2.0 * sag))
        if not rows.size:
            return None
        east = np.cross(np.array([0.0, 0.0, 1.0]), up)
        east = east / max(float(np.linalg.norm(east)), 1e-9)
        return cls(
            crater=landmarks.position_mcmf_m[index[columns]],
            sight=sight[rows],
            detection=rows.astype(np.int64),
            log_depth=size[rows, columns],
            centre=up,
            east=east,
            north=np.cross(up, east),
            altitudes_m=altitudes,
            altitude_m=altitude,
            cell_m=parameters.tolerance_px / camera.focal_px * altitude,
            reach_m=reach,
            sag=sag,
        )

    def places(self, parameters: AcquisitionParameters) -> list[FloatArray]:
        """Return the best camera positions (MCMF) of the vote, best first."""
        along = np.einsum("ij,ij->i", self.crater, self.sight)
        beyond = along**2 - np.einsum("ij,ij->i", self.crater, self.crater)
        size = 2 * int(np.ceil(self.reach_m / self.cell_m)) + 3
        found: list[tuple[float, float, float, float]] = []
        for altitude in self.altitudes_m:
            root = beyond + (MOON_RADIUS_M + altitude) ** 2
            distance = along + np.sqrt(np.maximum(root, 0.0))
            camera = self.crater - distance[:, None] * self.sight
            x = np.floor((camera @ self.east) / self.cell_m).astype(np.int64) + size // 2
            y = np.floor((camera @ self.north) / self.cell_m).astype(np.int64) + size // 2
            inside = (x >= 0) & (x < size) & (y >= 0) & (y < size) & (root > 0.0)
            inside &= np.abs(self.log_depth - np.log(altitude) - self.sag) < parameters.log_diameter_gate + self.sag
            cells = np.unique((x[inside] * size + y[inside]) * 4096 + self.detection[inside]) // 4096
            grid = np.bincount(cells, minlength=size * size).reshape(size, size).astype(np.float64)
            wide = np.pad(grid, 1)
            blocks = wide[:-1, :-1] + wide[1:, :-1] + wide[:-1, 1:] + wide[1:, 1:]
            for flat in np.argpartition(blocks.reshape(-1), -3)[-3:]:
                i, j = divmod(int(flat), blocks.shape[1])
                found.append((float(blocks[i, j]), float(i - size // 2), float(j - size // 2), float(altitude)))
        found.sort(key=lambda item: -item[0])
        return [
            (self.centre * (MOON_RADIUS_M + altitude) + (self.east * i + self.north * j) * self.cell_m)
            for _, i, j, altitude in found[: parameters.places]
        ]


def _sag(altitude_m: float, corner_rad: float) -> float:
    """Return half of the logarithm of depth over altitude in the corners of the image, or at the horizon in them.

    The ray at an angle a from nadir meets the sphere of radius R from the distance r = R + altitude after
    t = r cos a - sqrt(R^2 - r^2 sin^2 a), at the depth t cos a.
    """
    if altitude_m <= DESIGN_ALTITUDE_M:
        return _SMALLEST_SAG
    distance = MOON_RADIUS_M + altitude_m
    sine = min(np.sin(corner_rad), MOON_RADIUS_M / distance)
    cosine = np.sqrt(1.0 - sine**2)
    ray = distance * cosine - np.sqrt(max(MOON_RADIUS_M**2 - (distance * sine) ** 2, 0.0))
    return max(_SMALLEST_SAG, 0.5 * float(np.log(ray * cosine / altitude_m)))


def _fit(
    place_mcmf_m: FloatArray,
    found: Detections,
    landmarks: LandmarkMap,
    pose: Pose,
    camera: PinholeCamera,
    sigma_px: FloatArray,
    attitude_sigma_rad: float,
    parameters: AcquisitionParameters,
) -> Acquisition | None:
    """Return the place refined by least squares on the detections it explains, None where it explains too few."""
    uv = np.stack([found.u_px, found.v_px], axis=1)
    current = replace(pose, position_icrf_m=pose.mcmf_from_icrf.T @ place_mcmf_m)
    tolerance = 2.0 * parameters.tolerance_px
    detection = index = np.empty(0, dtype=np.int64)
    for _ in range(6):
        sighting = in_view(landmarks, current, camera, tolerance)
        if len(sighting) < 2:
            return None
        away = np.linalg.norm(uv[:, None] - sighting.uv_px[None], axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.abs(np.log(found.diameter_px[:, None] / sighting.diameter_px[None]))
        away = np.where(ratio < parameters.log_diameter_gate, away, np.inf)
        mine, theirs = np.argmin(away, axis=1), np.argmin(away, axis=0)
        rows = np.arange(len(found))
        limit = np.maximum(tolerance, parameters.agreement_sigmas * sigma_px)
        mutual = (theirs[mine] == rows) & (away[rows, mine] < limit)
        detection, chosen = rows[mutual], mine[mutual]
        index = sighting.index[chosen]
        if detection.size < 3:
            return None
        picked = sighting.select(chosen)
        weight = 1.0 / sigma_px[detection]
        design = np.concatenate([picked.by_position, picked.by_attitude], axis=2) * weight[:, None, None]
        residual = (uv[detection] - picked.uv_px) * weight[:, None]
        normal = np.einsum("nij,nik->jk", design, design)
        normal += np.diag([0.0, 0.0, 0.0] + [1.0 / attitude_sigma_rad**2] * 3)
        right = np.einsum("nij,ni->j", design, residual)
        right[3:] -= (current.attitude_rad - pose.attitude_rad) / attitude_sigma_rad**2
        try:
            change = np.linalg.solve(normal, right)
        except np.linalg.LinAlgError:
            return None
        current = replace(
            current,
            position_icrf_m=current.position_icrf_m + change[:3],
            attitude_rad=current.attitude_rad + change[3:],
        )
        tolerance = max(_SHRINK * tolerance, parameters.agreement_sigmas * float(np.median(sigma_px)))
    return Acquisition(detection.astype(np.int64), index, current, 0, 0)


def _needed(
    votes: _Votes,
    best: Acquisition,
    landmarks: LandmarkMap,
    camera: PinholeCamera,
    found: Detections,
    reach_m: float,
    tight_px: float,
    parameters: AcquisitionParameters,
) -> int:
    """Return how many explained detections a fix of this search needs.

    A fit has three free numbers, so beyond the pair that fixes the place the second only fixes the altitude: the
    number of independent places is that of the cells of the search at the final tolerance, times altitude steps.
    """
    sighting = in_view(landmarks, best.pose, camera, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(np.log(found.diameter_px[:, None] / sighting.diameter_px[None]))
    alike = float(np.count_nonzero(ratio < parameters.log_diameter_gate))
    per_place = alike * np.pi * tight_px**2 / (camera.width_px * camera.height_px)
    ground_m = tight_px * votes.altitude_m / camera.focal_px
    edge_px = 0.5 * np.hypot(camera.width_px, camera.height_px)
    span = float(np.log(votes.altitudes_m[-1] / votes.altitudes_m[0]))
    places = max(1.0, (2.0 * reach_m / ground_m) ** 2 / np.pi) * max(1.0, span * edge_px / tight_px)
    return max(3, minimum_members(places * per_place, per_place, parameters.false_fix_limit))
