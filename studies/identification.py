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
from payload_emulator.flight.navigation.lost_in_space import (
    NADIR_NORTH_UP,
    LostFrame,
    LostParameters,
    Place,
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
_FRAME_INTERVAL_S = 15.0
CAMERA = PinholeCamera()
ALTITUDES_M = (14e3, 50e3)
LEAST_DETECTIONS = 6
"""True detections that a frame of a search without a prior must have."""

_COMBINED = 4

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
    """A frame: true pose (MCMF stands in for ICRF), detections and the crater of each (-1: none)."""

    pose: Pose
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
    seen = in_view(world.true, pose, CAMERA, 0.0)
    seen = seen.select(model.found(world.true.diameter_m[seen.index], rng))
    corner = np.array([CAMERA.width_px - 1.0, CAMERA.height_px - 1.0])
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
    return StudyFrame(pose, found, crater.astype(np.int64), radius - MOON_RADIUS_M)


def study_lost(
    world: StudyWorld,
    frames: int,
    seed: int,
    *,
    kind: str = "true",
    model: SimulatedDetector = STUDY_DETECTOR,
    attitude_rad: float = math.radians(0.5),
) -> LostScore:
    """Return the score of single frames; those with too few true detections are drawn again."""
    rng = np.random.default_rng((seed, 2, KINDS.index(kind)))
    index, rules = place_index(world.board), LostParameters(attitude_sigma_rad=attitude_rad)
    results = []
    for frame in _frames(world, frames, rng, kind, model, attitude_rad, LEAST_DETECTIONS):
        started = time.process_time()
        place = find_place(frame.found, frame.found.sigma_px, index, CAMERA, rules)
        places = () if place is None else (place,)
        results.append((_error_m(places, [frame]), time.process_time() - started))
    return _lost_score(kind, results)


def study_lost_in_frames(
    world: StudyWorld,
    sets: int,
    seed: int,
    *,
    model: SimulatedDetector = STUDY_DETECTOR,
    attitude_rad: float = math.radians(0.5),
) -> LostScore:
    """Return the score of sets of consecutive frames 15 s apart, each with enough true detections."""
    rng = np.random.default_rng((seed, 3))
    index, rules = place_index(world.board), LostParameters(attitude_sigma_rad=attitude_rad)
    results: list[tuple[float | None, float]] = []
    while len(results) < sets:
        group = _consecutive(world, rng, model, attitude_rad)
        if group is None:
            continue
        started = time.process_time()
        frames = [LostFrame(f.found, f.found.sigma_px, k * _FRAME_INTERVAL_S) for k, f in enumerate(group)]
        places = find_place_in_frames(frames, index, CAMERA, rules)
        results.append((_error_m(places or (), group), time.process_time() - started))
    return _lost_score(f"{_COMBINED} frames", results)


def _error_m(places: Sequence[Place], frames: Sequence[StudyFrame]) -> float | None:
    """Return the greatest error of places, each of which belongs to the nearest frame; None without a place."""
    true = [frame.pose.position_icrf_m for frame in frames]
    errors = [min(float(np.linalg.norm(one.position_mcmf_m - at)) for at in true) for one in places]
    return max(errors, default=None)


def _frames(
    world: StudyWorld,
    frames: int,
    rng: np.random.Generator,
    kind: str,
    model: SimulatedDetector,
    attitude_rad: float,
    least_detections: int,
) -> Iterator[StudyFrame]:
    """Yield frames over random craters of the map."""
    drawn = 0
    while drawn < frames:
        place = _place(world, rng)
        frame = draw_frame(world, place, attitude_rad * rng.standard_normal(3), model, rng)
        if frame.true_detections < least_detections:
            continue
        if kind != "true":
            frame = draw_frame(world, place, attitude_rad * rng.standard_normal(3), model, rng, kind)
        drawn += 1
        yield frame


def _place(world: StudyWorld, rng: np.random.Generator) -> FloatArray:
    """Return a place below 62 degrees of latitude, uniform over the part of the sphere that the map covers."""
    position = world.true.position_mcmf_m
    while True:
        near = position[rng.integers(len(world.true))]
        latitude = math.asin(near[2] / float(np.linalg.norm(near))) + rng.uniform(-0.05, 0.05)
        longitude = math.atan2(near[1], near[0]) + rng.uniform(-0.05, 0.05) / math.cos(latitude)
        if abs(latitude) < math.radians(62.0):
            altitude = rng.uniform(*ALTITUDES_M)
            return np.asarray(mcmf_from_spherical(latitude, longitude, altitude), dtype=np.float64)


def _consecutive(
    world: StudyWorld, rng: np.random.Generator, model: SimulatedDetector, attitude_rad: float
) -> list[StudyFrame] | None:
    """Return frames along a near-polar orbit, None where one of them has too few true detections."""
    start = _place(world, rng)
    radius = float(np.linalg.norm(start))
    latitude, longitude = math.asin(start[2] / radius), math.atan2(start[1], start[0])
    east, north, up = enu_from_mcmf(latitude, longitude)
    heading = math.radians(rng.uniform(-5.0, 5.0)) + (math.pi if rng.uniform() < 0.5 else 0.0)
    along = math.sin(heading) * east + math.cos(heading) * north
    climb_m_s = rng.uniform(-10.0, 10.0)
    group = []
    for k in range(_COMBINED):
        time_s = k * _FRAME_INTERVAL_S
        angle = math.sqrt(GM_MOON_M3_S2 / radius**3) * time_s
        place = (radius + climb_m_s * time_s) * (math.cos(angle) * up + math.sin(angle) * along)
        frame = draw_frame(world, place, attitude_rad * rng.standard_normal(3), model, rng)
        if frame.true_detections < LEAST_DETECTIONS:
            return None
        group.append(frame)
    return group


def _lost_score(kind: str, rows: Sequence[tuple[float | None, float]]) -> LostScore:
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
