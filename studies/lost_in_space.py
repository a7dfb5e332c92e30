"""Lost in space on rendered frames: images along a scenario, the detector that flies, a map with a catalogue's errors.

Frames are taken in sets of consecutive ones, spread over the scenario, the camera pointed as well as the ADCS holds
nadir and heading. Each is searched alone and each set as a whole, over all craters of the terrain's catalogue that
are large enough, wherever they lie. Truth is used to judge: which detections are craters of the map, and how far the
reported place is off.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera, project_mcmf
from lunar.constants import MOON_RADIUS_M
from payload_emulator.flight.navigation.lost_in_space import (
    LostParameters,
    Place,
    believed_place,
    candidate_places,
    place_index,
)
from payload_emulator.flight.navigation.sighting import LandmarkMap, landmark_map
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.session.camera import expose
from payload_emulator.session.loading import onboard_catalogue
from payload_emulator.session.scenario import DisturbancesSection, Scenario
from payload_emulator.session.world import World
from studies.lost_frames import FRAMES_COMBINED, LostFrame, place_of_frames

Progress = Callable[[Iterable[Any], int], Iterator[Any]]

WRONG_PLACE_M = 2_000.0
"""A place reported this far from the true one is wrong."""

ALTITUDE_LIMITS_KM = (20.0, 30.0, 40.0)
"""Scores are also given between these altitudes."""

_NS = 1_000_000_000
# A detection is a crater of the map if that truly lies within this: six pixels, or a quarter of its diameter.
_RIGHT_PX, _RIGHT_OF_DIAMETER, _LOG_DIAMETER_GATE = 6.0, 0.25, 0.4
# As the anchored mode takes them: sigma of a detection where the detector gives none, and the smallest believed.
_SIGMA_PX, _SIGMA_FLOOR_PX = 1.5, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class SeenFrames:
    """What the detector found in frames of a scenario.

    Attributes
    ----------
    number
        Frame of the scenario of each, shape (n,); sets of `FRAMES_COMBINED` consecutive ones, set after set.
    camera_from_mcmf
        True attitude, shape (n, 3, 3).
    owner
        Row of the frame of each detection, ascending.
    found
        All detections, frame after frame.
    """

    number: IntArray
    camera_from_mcmf: FloatArray
    owner: IntArray
    found: Detections

    def of(self, row: int) -> Detections:
        """Return the detections of a frame."""
        low, high = np.searchsorted(self.owner, [row, row + 1])
        return self.found.select(np.arange(low, high))


@dataclass(frozen=True, slots=True)
class LostRow:
    """A search: how many detections were craters of the map, what came of it and the time it took.

    Attributes
    ----------
    catalogued
        Of the poorest frame, for several.
    error_m
        Of the reported place, the worst of several; NaN where there was no fix.
    """

    altitude_m: float
    detections: int
    catalogued: int
    error_m: float
    cpu_s: float


@dataclass(frozen=True, slots=True)
class HostileSearches:
    """Searches of changed detections, none of which has a place: how many ended with a fix, each of them wrong.

    Attributes
    ----------
    least_log10_false
        Decimal logarithm of the smallest probability that chance was said to have of making up the best place.
    """

    kind: str
    searches: int
    fixes: int
    least_log10_false: float


@dataclass(frozen=True, slots=True)
class Share:
    """Searches of one kind: how many, how many right and how many wrong."""

    searches: int
    correct: int
    wrong: int

    @property
    def correct_share(self) -> float:
        return self.correct / self.searches if self.searches else math.nan


def frames_in_sets(world: World, sets: int) -> IntArray:
    """Return frames in sets of consecutive ones that a scenario's cadence links, spread evenly over the scenario."""
    utc_ns, size = world.frame_utc_ns, FRAMES_COMBINED
    interval_ns = round(world.scenario.camera.frame_interval_s * _NS)
    linked = utc_ns[size - 1 :] - utc_ns[: 1 - size] == (size - 1) * interval_ns
    first = np.flatnonzero(linked)
    # Sets that do not overlap, as many as there are.
    kept: list[int] = []
    for start in first.tolist():
        if not kept or start >= kept[-1] + size:
            kept.append(start)
    chosen = np.asarray(kept, dtype=np.int64)
    if len(kept) > sets:
        chosen = chosen[np.linspace(0, len(kept) - 1, sets, dtype=np.int64)]
    return (chosen[:, None] + np.arange(size)).reshape(-1)


def pointed(scenario: Scenario, attitude_deg: float) -> Scenario:
    """Return the scenario with a camera that points as well as this, 1 sigma per axis, and no disturbances."""
    attitude = replace(scenario.attitude, pointing_error_deg=attitude_deg)
    return replace(scenario, attitude=attitude, disturbances=DisturbancesSection())


def see_frames(
    world: World, detector: OnnxDetector, numbers: IntArray, progress: Progress | None = None
) -> SeenFrames:
    """Return what the detector finds in the given frames; the next is rendered while it works on this one."""
    attitudes, owners, found = [], [], []
    world.terrain.release_thread()
    with ThreadPoolExecutor(max_workers=1) as renderer:
        # No more than a few frames lie ready at a time.
        waiting = [renderer.submit(expose, world, int(world.frame_utc_ns[number])) for number in numbers[:2]]
        rows = range(numbers.size)
        for row in progress(rows, numbers.size) if progress else rows:
            exposure = waiting.pop(0).result()
            if row + 2 < numbers.size:
                waiting.append(renderer.submit(expose, world, int(world.frame_utc_ns[numbers[row + 2]])))
            seen = detector.detect(exposure.image, exposure.attitude[4:7])
            attitudes.append(exposure.camera_from_mcmf)
            owners.append(np.full(len(seen), row))
            found.append(seen)
    world.terrain.release_thread()
    return SeenFrames(
        numbers,
        np.array(attitudes).reshape(-1, 3, 3),
        np.concatenate(owners or [np.empty(0, dtype=np.int64)]).astype(np.int64),
        _joined(found),
    )


def search_map(world: World, numbers: IntArray, smallest_m: float) -> tuple[LandmarkMap, LandmarkMap]:
    """Return the true craters, and the map on board with a catalogue's errors: the same craters.

    All craters of the terrain's catalogue from `smallest_m` on take part, wherever they lie. The rims of those that
    the frames may see are measured; of all others only the place is known, and their heights are those of the sphere.
    """
    catalogue, navigation = world.terrain.catalogue, world.scenario.navigation
    sized = (catalogue.diameter_m >= smallest_m) & (
        catalogue.diameter_m <= 1e3 * navigation.catalogue_max_diameter_km
    )
    position = world.truth.positions_mcmf(world.frame_utc_ns[numbers])
    near = np.zeros(len(catalogue), dtype=bool)
    for place in position:
        radius = float(np.linalg.norm(place))
        reach_m = min(3.0 * (radius - MOON_RADIUS_M), 0.1 * MOON_RADIUS_M) + 15_000.0
        latitude, longitude = math.asin(place[2] / radius), math.atan2(place[1], place[0])
        near[catalogue.near(latitude, longitude, reach_m)] = True
    measured = world.terrain.measured(np.flatnonzero(sized & near))
    height, depth = catalogue.rim_height_m.copy(), catalogue.depth_m.copy()
    height[sized & near], depth[sized & near] = measured.rim_height_m, measured.depth_m
    whole = replace(catalogue, rim_height_m=np.nan_to_num(height), depth_m=depth).select(
        np.flatnonzero(sized)
    )
    table = onboard_catalogue(world.scenario, whole)
    order = np.argsort(whole.ids)
    kept = whole.select(order[np.searchsorted(whole.ids[order], table.ids)])
    exact = replace(
        table,
        latitude_rad=kept.latitude_rad,
        longitude_rad=kept.longitude_rad,
        rim_height_m=kept.rim_height_m,
    )
    return landmark_map(exact), landmark_map(table)


def search_frames(
    world: World,
    seen: SeenFrames,
    true: LandmarkMap,
    board: LandmarkMap,
    parameters: LostParameters,
    progress: Progress | None = None,
) -> tuple[list[LostRow], list[LostRow]]:
    """Return the searches of single frames, and those of sets."""
    index, camera = place_index(board), world.camera
    utc_ns = world.frame_utc_ns[seen.number]
    position = world.truth.positions_mcmf(utc_ns)
    true_places = true.position_mcmf_m
    single: list[LostRow] = []
    candidates: list[list[Place]] = []
    rows = range(seen.number.size)
    # The first search compiles.
    candidate_places(seen.of(0), _sigma_px(seen.of(0)), index, camera, parameters)
    for row in progress(rows, len(rows)) if progress else rows:
        found, place = seen.of(row), position[row]
        started = time.process_time()
        places = candidate_places(found, _sigma_px(found), index, camera, parameters)
        best = believed_place(places, parameters)
        spent = time.process_time() - started
        candidates.append(places)
        radius = float(np.linalg.norm(place))
        near = true.near(place / radius, 4.0 * (radius - MOON_RADIUS_M) / MOON_RADIUS_M + 0.02)
        known = _known(
            found, true_places[near], true.diameter_m[near], camera, seen.camera_from_mcmf[row], place
        )
        error = math.nan if best is None else float(np.linalg.norm(best.position_mcmf_m - place))
        single.append(LostRow(radius - MOON_RADIUS_M, len(found), known, error, spent))
    sets = []
    for first in range(0, seen.number.size, FRAMES_COMBINED):
        mine = range(first, first + FRAMES_COMBINED)
        frames = [
            LostFrame(seen.of(row), _sigma_px(seen.of(row)), float(utc_ns[row] - utc_ns[first]) / _NS)
            for row in mine
        ]
        started = time.process_time()
        together = place_of_frames([candidates[row] for row in mine], frames, parameters)
        spent = time.process_time() - started + sum(single[row].cpu_s for row in mine)
        error = math.nan
        if together is not None:
            # Each place belongs to one of the frames: the nearest.
            error = max(
                min(float(np.linalg.norm(place.position_mcmf_m - position[row])) for row in mine)
                for place in together
            )
        sets.append(
            LostRow(
                single[first].altitude_m,
                min(single[row].detections for row in mine),
                min(single[row].catalogued for row in mine),
                error,
                spent,
            )
        )
    return single, sets


def hostile_detections(
    found: Detections, camera: PinholeCamera, rng: np.random.Generator
) -> dict[str, Detections]:
    """Return detections mirrored, turned by a quarter and by half, and scattered over the image, by kind."""
    right, bottom = camera.width_px - 1.0, camera.height_px - 1.0
    u, v = found.u_px, found.v_px
    scattered = rng.uniform(0.0, right, u.size), rng.uniform(0.0, bottom, v.size)
    kinds = {
        "mirrored": (right - u, v),
        "turned by a quarter": (v * right / bottom, bottom - u * bottom / right),
        "turned by half": (right - u, bottom - v),
        "scattered": scattered,
    }
    return {kind: replace(found, u_px=place[0], v_px=place[1]) for kind, place in kinds.items()}


def search_hostile(
    seen: SeenFrames,
    board: LandmarkMap,
    camera: PinholeCamera,
    parameters: LostParameters,
    seed: int,
    progress: Progress | None = None,
) -> list[HostileSearches]:
    """Return the searches of every frame with its detections changed in each way."""
    index, rng = place_index(board), np.random.default_rng(seed)
    fixes: dict[str, list[bool]] = {}
    log_false: dict[str, list[float]] = {}
    rows = range(seen.number.size)
    for row in progress(rows, len(rows)) if progress else rows:
        for kind, found in hostile_detections(seen.of(row), camera, rng).items():
            places = candidate_places(found, _sigma_px(found), index, camera, parameters)
            fixes.setdefault(kind, []).append(believed_place(places, parameters) is not None)
            log_false.setdefault(kind, []).append(places[0].log_false if places else math.inf)
    return [
        HostileSearches(kind, len(found), sum(found), min(log_false[kind]) / math.log(10.0))
        for kind, found in fixes.items()
    ]


def share(rows: Sequence[LostRow], least_catalogued: int = 0) -> Share:
    """Return the outcomes of searches, of frames with at least a number of detections of craters of the map."""
    errors = np.array([row.error_m for row in rows if row.catalogued >= least_catalogued])
    right = errors <= WRONG_PLACE_M
    return Share(
        int(errors.size), int(np.count_nonzero(right)), int(np.count_nonzero(errors > WRONG_PLACE_M))
    )


def by_altitude(rows: Sequence[LostRow], least_catalogued: int) -> list[tuple[float, float, Share]]:
    """Return scores between altitudes (km)."""
    edges = [0.0, *ALTITUDE_LIMITS_KM, math.inf]
    return [
        (low, high, share([row for row in rows if low <= row.altitude_m / 1e3 < high], least_catalogued))
        for low, high in pairwise(edges)
    ]


def _sigma_px(found: Detections) -> FloatArray:
    sigma = np.where(np.isfinite(found.sigma_px), found.sigma_px, _SIGMA_PX)
    return np.maximum(sigma, _SIGMA_FLOOR_PX)


def _known(
    found: Detections,
    craters_mcmf_m: FloatArray,
    diameter_m: FloatArray,
    camera: PinholeCamera,
    camera_from_mcmf: FloatArray,
    position_mcmf_m: FloatArray,
) -> int:
    """Return how many detections are craters of the map."""
    if not len(found) or not diameter_m.size:
        return 0
    uv = project_mcmf(camera, camera_from_mcmf, position_mcmf_m, craters_mcmf_m)
    depth_m = (craters_mcmf_m - position_mcmf_m) @ camera_from_mcmf[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        size = diameter_m * camera.focal_px / np.where(depth_m > 0.0, depth_m, np.nan)
        alike = np.abs(np.log(found.diameter_px[:, None] / size[None])) < _LOG_DIAMETER_GATE
        away = np.hypot(found.u_px[:, None] - uv[None, :, 0], found.v_px[:, None] - uv[None, :, 1])
        limit = np.maximum(_RIGHT_PX, _RIGHT_OF_DIAMETER * found.diameter_px)
        return int(np.count_nonzero(np.any(alike & (away < limit[:, None]), axis=1)))


def _joined(parts: Sequence[Detections]) -> Detections:
    def column(name: str) -> FloatArray:
        return np.concatenate([np.empty(0), *(getattr(part, name) for part in parts)])

    return Detections(
        column("u_px"), column("v_px"), column("diameter_px"), column("score"), column("sigma_px")
    )
