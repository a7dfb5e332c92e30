"""Study of wrong identifications on simulated detections of a real catalogue.

Detections are drawn from the craters in view with stated recall, precision and errors; no images are
rendered (evidence levels 1 and 2). Hostile frames have the same number of detections: only false detections,
mirror images, or images rotated by a right angle. A fix is wrong if at least half of its pairs are wrong and its
position is wrong.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue
from lunar.constants import GM_MOON_M3_S2, MOON_RADIUS_M
from lunar.frames import enu_from_mcmf, mcmf_from_spherical
from payload_emulator.flight.navigation import filter as kalman
from payload_emulator.flight.navigation.identification import IdentificationParameters, identify
from payload_emulator.flight.navigation.lost_in_space import (
    NADIR_NORTH_UP,
    LostFrame,
    LostParameters,
    Place,
    PlaceIndex,
    find_place,
    find_place_in_frames,
    place_index,
)
from payload_emulator.flight.navigation.sighting import LandmarkMap, Pose, in_view, landmark_map
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.sim.detector import SimulatedDetector
from tmtc.tables import CatalogueTable

# An estimate this far from the truth is another place, not an inaccurate one: ten times the error of a good fix.
WRONG_PLACE_M = 3_000.0
KINDS = ("true", "all_false", "mirrored", "rotated")
# Chi-square of 3 degrees of freedom at 1e-5: a correction beyond it is wrong, not unlucky.
_WRONG_NEES = 25.9
_FRAME_INTERVAL_S = 15.0
_CAMERA = PinholeCamera()
_IDENTIFICATION = IdentificationParameters()


STUDY_DETECTOR = SimulatedDetector(
    recall=(0.5, 0.5, 0.5, 0.5), recall_outside=0.5, precision=0.8, sigma_px=1.4, log_diameter_sigma=0.05
)
"""Detector of the study unless another one is given."""


@dataclass(frozen=True, slots=True, eq=False)
class StudyWorld:
    """True craters, and the catalogue on board with its errors; both in the same order."""

    true: LandmarkMap
    board: LandmarkMap
    name: str


@dataclass(frozen=True, slots=True, eq=False)
class StudyFrame:
    """A frame: true pose (MCMF stands in for ICRF), measured attitude, detections and the crater of each (-1: none)."""

    pose: Pose
    measured_camera_from_mcmf: FloatArray
    found: Detections
    crater: IntArray
    altitude_m: float

    @property
    def true_detections(self) -> int:
        return int(np.count_nonzero(self.crater >= 0))


@dataclass(frozen=True, slots=True)
class LostScore:
    """Outcome of searches without a prior over frames of one kind; times are process time."""

    kind: str
    frames: int
    correct: int
    wrong: int
    median_error_m: float
    p95_error_m: float
    median_cpu_s: float
    largest_cpu_s: float

    @property
    def correct_share(self) -> float:
        return self.correct / max(self.frames, 1)


@dataclass(frozen=True, slots=True)
class TrackingScore:
    """Outcome of tracking identification over frames of one kind.

    Attributes
    ----------
    fixed, pairs, wrong_pairs
        Frames with a believed set; its pairs, and those of them that are wrong.
    majority_wrong, wrong_fixes
        Frames where half of the pairs or more are wrong; of these, those whose fix contradicts the truth (1 in 1e5).
    findable, findable_fixed
        Frames with at least four detections of catalogued craters, and those of them that were fixed.
    """

    kind: str
    frames: int
    fixed: int
    pairs: int
    wrong_pairs: int
    majority_wrong: int
    wrong_fixes: int
    findable: int
    findable_fixed: int


def study_world(craters: CraterCatalogue, seed: int, name: str) -> StudyWorld:
    """Return a world of these craters, and a catalogue of it in error as a curated one (3 % of D, 90 m; 50 m up)."""
    rng = np.random.default_rng((seed, 1))
    count = len(craters)
    height = np.nan_to_num(craters.rim_height_m)
    exact = CatalogueTable(
        np.arange(count),
        craters.latitude_rad,
        craters.longitude_rad,
        craters.diameter_m,
        height,
        np.zeros((count, 3)),
    )
    centre_m = np.maximum(0.03 * craters.diameter_m, 90.0)
    sigma_m = np.stack([centre_m, centre_m, np.full(count, 50.0)], axis=1)
    error_m = sigma_m * rng.standard_normal((count, 3))
    board = replace(
        exact,
        latitude_rad=exact.latitude_rad + error_m[:, 1] / MOON_RADIUS_M,
        longitude_rad=exact.longitude_rad + error_m[:, 0] / (MOON_RADIUS_M * np.cos(exact.latitude_rad)),
        rim_height_m=height + error_m[:, 2],
        sigma_m=sigma_m,
    )
    return StudyWorld(landmark_map(exact), landmark_map(board), name)


def draw_frame(
    world: StudyWorld,
    position_mcmf_m: FloatArray,
    attitude_error_rad: FloatArray,
    model: SimulatedDetector,
    camera: PinholeCamera,
    rng: np.random.Generator,
    kind: str = "true",
) -> StudyFrame:
    """Return a frame of a camera that points as measured but for an error, image up to the north."""
    radius = float(np.linalg.norm(position_mcmf_m))
    latitude = math.asin(position_mcmf_m[2] / radius)
    longitude = math.atan2(position_mcmf_m[1], position_mcmf_m[0])
    measured = NADIR_NORTH_UP @ enu_from_mcmf(latitude, longitude)
    x, y, z = attitude_error_rad
    turned = measured - np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ measured
    left, _, right = np.linalg.svd(turned)
    nothing = np.zeros(3)
    pose = Pose(position_mcmf_m, left @ right, np.eye(3), nothing, np.zeros(2), nothing)
    seen = in_view(world.true, pose, camera, 0.0)
    seen = seen.select(model.found(world.true.diameter_m[seen.index], rng))
    corner = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    uv, size = seen.uv_px, seen.diameter_px
    if len(seen):  # a frame without craters has no false detections either: it is drawn again
        uv, size = model.detect(uv, size, corner, rng)
    false = size.size - len(seen)
    crater = np.concatenate([world.true.ids[seen.index], np.full(false, -1)])
    if kind == "all_false":
        uv = rng.uniform(size=uv.shape) * corner
    elif kind == "mirrored":
        uv[:, 0] = corner[0] - uv[:, 0]
    elif kind == "rotated":
        uv = np.stack([corner[0] - uv[:, 1], uv[:, 0]], axis=1)
    if kind != "true":
        crater[:] = -1
    total = crater.size
    found = Detections(
        uv[:, 0], uv[:, 1], size, rng.uniform(0.3, 1.0, total), np.full(total, model.stated_sigma_px)
    )
    return StudyFrame(pose, measured, found, crater.astype(np.int64), radius - MOON_RADIUS_M)


def study_lost(
    world: StudyWorld,
    frames: int,
    seed: int,
    *,
    kind: str = "true",
    model: SimulatedDetector = STUDY_DETECTOR,
    attitude_rad: float = math.radians(0.5),
    altitudes_m: tuple[float, float] = (14e3, 50e3),
    least_detections: int = 6,
    parameters: LostParameters | None = None,
    camera: PinholeCamera = _CAMERA,
) -> LostScore:
    """Return the score of single frames; those with fewer true detections than asked for are drawn again."""
    rng = np.random.default_rng((seed, 2, KINDS.index(kind)))
    index = place_index(world.board)
    rules = parameters or LostParameters(attitude_sigma_rad=attitude_rad)
    return _lost_score(
        kind,
        (
            _timed(frame, index, rules, camera)
            for frame in _frames(
                world, frames, rng, kind, model, attitude_rad, altitudes_m, least_detections, camera
            )
        ),
    )


def study_lost_in_frames(
    world: StudyWorld,
    sets: int,
    seed: int,
    *,
    combined: int = 4,
    model: SimulatedDetector = STUDY_DETECTOR,
    attitude_rad: float = math.radians(0.5),
    altitudes_m: tuple[float, float] = (14e3, 50e3),
    least_detections: int = 6,
    camera: PinholeCamera = _CAMERA,
) -> LostScore:
    """Return the score of sets of consecutive frames 15 s apart, each with enough true detections."""
    rng = np.random.default_rng((seed, 3))
    index = place_index(world.board)
    rules = LostParameters(attitude_sigma_rad=attitude_rad)
    results: list[tuple[float | None, float]] = []
    while len(results) < sets:
        group = _consecutive(world, combined, rng, model, attitude_rad, altitudes_m, least_detections, camera)
        if group is None:
            continue
        started = time.process_time()
        places = find_place_in_frames(
            [LostFrame(f.found, f.found.sigma_px, k * _FRAME_INTERVAL_S) for k, f in enumerate(group)],
            index,
            camera,
            rules,
        )
        spent = time.process_time() - started
        if places is None:
            results.append((None, spent))
        else:
            # Each place belongs to one of the frames: the nearest.
            error = max(
                min(float(np.linalg.norm(place.position_mcmf_m - f.pose.position_icrf_m)) for f in group)
                for place in places
            )
            results.append((error, spent))
    return _lost_score(f"{combined} frames", results)


def study_tracking(
    world: StudyWorld,
    frames: int,
    seed: int,
    *,
    kind: str = "true",
    model: SimulatedDetector = STUDY_DETECTOR,
    prior_m: tuple[float, float] = (30.0, 1_400.0),
    attitude_noise_rad: float = math.radians(0.01),
    altitudes_m: tuple[float, float] = (14e3, 50e3),
    parameters: IdentificationParameters = _IDENTIFICATION,
    camera: PinholeCamera = _CAMERA,
) -> TrackingScore:
    """Return the score of identification around predictions whose error is drawn from a known sigma (log-uniform)."""
    rng = np.random.default_rng((seed, 4, KINDS.index(kind)))
    errors = kalman.CommonErrors(attitude_noise_rad=attitude_noise_rad)
    counts = dict.fromkeys(TrackingScore.__slots__[2:], 0)
    for frame in _frames(world, frames, rng, kind, model, attitude_noise_rad, altitudes_m, 0, camera):
        sigma_m = math.exp(rng.uniform(*np.log(prior_m)))
        prior = _prior(frame, sigma_m, errors, rng)
        findable = frame.true_detections >= 4
        counts["findable"] += findable
        pairs = _tracked(frame, prior, world.board, errors, parameters, camera)
        if pairs is None:
            continue
        detection, crater = pairs
        wrong = int(np.count_nonzero(frame.crater[detection] != world.board.ids[crater]))
        counts["fixed"] += 1
        counts["findable_fixed"] += findable
        counts["pairs"] += detection.size
        counts["wrong_pairs"] += wrong
        if 2 * wrong >= detection.size:
            counts["majority_wrong"] += 1
            counts["wrong_fixes"] += _contradicts_truth(
                frame, prior, world.board, detection, crater, errors, camera
            )
    return TrackingScore(kind, frames, **counts)


def _frames(
    world: StudyWorld,
    frames: int,
    rng: np.random.Generator,
    kind: str,
    model: SimulatedDetector,
    attitude_rad: float,
    altitudes_m: tuple[float, float],
    least_detections: int,
    camera: PinholeCamera,
) -> Iterator[StudyFrame]:
    """Yield frames over random craters of the map."""
    drawn = 0
    while drawn < frames:
        place = _place(world, rng, altitudes_m)
        frame = draw_frame(world, place, attitude_rad * rng.standard_normal(3), model, camera, rng, "true")
        if frame.true_detections < least_detections:
            continue
        if kind != "true":
            frame = draw_frame(world, place, attitude_rad * rng.standard_normal(3), model, camera, rng, kind)
        drawn += 1
        yield frame


def _place(world: StudyWorld, rng: np.random.Generator, altitudes_m: tuple[float, float]) -> FloatArray:
    """Return a place below 62 degrees of latitude, uniform over the part of the sphere that the map covers."""
    position = world.true.position_mcmf_m
    while True:
        near = position[rng.integers(len(world.true))]
        latitude = math.asin(near[2] / float(np.linalg.norm(near))) + rng.uniform(-0.05, 0.05)
        longitude = math.atan2(near[1], near[0]) + rng.uniform(-0.05, 0.05) / math.cos(latitude)
        if abs(latitude) < math.radians(62.0):
            altitude = rng.uniform(*altitudes_m)
            return np.asarray(mcmf_from_spherical(latitude, longitude, altitude), dtype=np.float64)


def _consecutive(
    world: StudyWorld,
    combined: int,
    rng: np.random.Generator,
    model: SimulatedDetector,
    attitude_rad: float,
    altitudes_m: tuple[float, float],
    least_detections: int,
    camera: PinholeCamera,
) -> list[StudyFrame] | None:
    """Return frames along a near-polar orbit, None where one of them has too few true detections."""
    start = _place(world, rng, altitudes_m)
    radius = float(np.linalg.norm(start))
    latitude, longitude = math.asin(start[2] / radius), math.atan2(start[1], start[0])
    east, north, up = enu_from_mcmf(latitude, longitude)
    heading = math.radians(rng.uniform(-5.0, 5.0)) + (math.pi if rng.uniform() < 0.5 else 0.0)
    along = math.sin(heading) * east + math.cos(heading) * north
    climb_m_s = rng.uniform(-10.0, 10.0)
    group = []
    for k in range(combined):
        time_s = k * _FRAME_INTERVAL_S
        angle = math.sqrt(GM_MOON_M3_S2 / radius**3) * time_s
        place = (radius + climb_m_s * time_s) * (math.cos(angle) * up + math.sin(angle) * along)
        frame = draw_frame(world, place, attitude_rad * rng.standard_normal(3), model, camera, rng)
        if frame.true_detections < least_detections:
            return None
        group.append(frame)
    return group


def _timed(
    frame: StudyFrame, index: PlaceIndex, rules: LostParameters, camera: PinholeCamera
) -> tuple[float | None, float]:
    """Return the error of the place found (None: no fix) and the time it took."""
    started = time.process_time()
    place: Place | None = find_place(frame.found, frame.found.sigma_px, index, camera, rules)
    spent = time.process_time() - started
    if place is None:
        return None, spent
    return float(np.linalg.norm(place.position_mcmf_m - frame.pose.position_icrf_m)), spent


def _lost_score(
    kind: str, results: Iterator[tuple[float | None, float]] | Sequence[tuple[float | None, float]]
) -> LostScore:
    rows = list(results)
    errors = np.array([error for error, _ in rows if error is not None])
    # What is found in a hostile frame is wrong wherever it is.
    right = errors[errors < WRONG_PLACE_M] if kind not in KINDS[1:] else errors[:0]
    # The first search compiles.
    spent = np.array([time_s for _, time_s in rows[1:]] or [math.nan])
    return LostScore(
        kind,
        len(rows),
        int(right.size),
        int(errors.size - right.size),
        float(np.median(right)) if right.size else math.nan,
        float(np.percentile(right, 95.0)) if right.size else math.nan,
        float(np.median(spent)),
        float(np.max(spent)),
    )


def _prior(
    frame: StudyFrame, sigma_m: float, errors: kalman.CommonErrors, rng: np.random.Generator
) -> kalman.FilterState:
    position = frame.pose.position_icrf_m + sigma_m * rng.standard_normal(3)
    return kalman.initial_filter_state(0, position, np.zeros(3), sigma_m, 1.0, (1e-6, 1e-6, 1e-6), errors)


def _tracked(
    frame: StudyFrame,
    prior: kalman.FilterState,
    board: LandmarkMap,
    errors: kalman.CommonErrors,
    parameters: IdentificationParameters,
    camera: PinholeCamera,
) -> tuple[IntArray, IntArray] | None:
    """Return believed pairs of detections and craters (indices into the map), None without any."""
    pose = kalman.pose_of(prior, frame.measured_camera_from_mcmf, np.eye(3))
    altitude_m = max(float(np.linalg.norm(prior.mean[:3])) - MOON_RADIUS_M, 1_000.0)
    margin_px = min(3.5 * prior.position_sigma_m / altitude_m * camera.focal_px, 200.0)
    sighting = in_view(board, pose, camera, margin_px)
    count = len(sighting)
    if not count or not len(frame.found):
        return None
    design = kalman.design_matrix(sighting, prior).reshape(2 * count, prior.mean.size)
    tilt = sighting.by_attitude.reshape(2 * count, 3) * errors.attitude_noise_rad
    spread = (design @ prior.covariance @ design.T + tilt @ tilt.T).reshape(count, 2, count, 2)
    scaled = sighting.by_offset * board.sigma_m[sighting.index][:, None, :]
    result = identify(
        frame.found,
        sighting,
        spread,
        scaled @ np.swapaxes(scaled, 1, 2),
        frame.found.sigma_px**2,
        float(camera.width_px * camera.height_px),
        parameters,
        sighting.by_position @ prior.covariance[:3, :3] @ np.swapaxes(sighting.by_position, 1, 2),
    )
    return (result.detection, sighting.index[result.sighted]) if result.believed else None


def _contradicts_truth(
    frame: StudyFrame,
    prior: kalman.FilterState,
    board: LandmarkMap,
    detection: IntArray,
    crater: IntArray,
    errors: kalman.CommonErrors,
    camera: PinholeCamera,
) -> bool:
    """Return whether the fix of these pairs claims what the truth rules out."""
    updated = kalman.update(
        prior.with_craters(crater, board.sigma_m[crater]),
        frame.measured_camera_from_mcmf,
        np.eye(3),
        board,
        crater,
        np.stack([frame.found.u_px, frame.found.v_px], axis=1)[detection],
        frame.found.sigma_px[detection] ** 2,
        camera,
        errors,
    )
    if updated is None:
        return False
    error = updated.state.mean[:3] - frame.pose.position_icrf_m
    return bool(error @ np.linalg.solve(updated.state.covariance[:3, :3], error) > _WRONG_NEES)
