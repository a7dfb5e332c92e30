"""The simulated world of a scenario: its true flight, its terrain, its light, and what the payload's senses get."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder
from lunar.ephemeris import Ephemeris, ephemeris_from_states
from lunar.frames import Orientation, rtn_from_inertial, spherical_from_mcmf
from lunar.gravity import GravityField
from lunar.maneuvers import Maneuver
from lunar.oem import load_oem
from lunar.propagation import ForceModel
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import parse_utc, tdb_s_from_utc_ns, ticks_from_utc_ns, utc_ns_from_tdb_s
from payload_emulator.errors import ScenarioError
from payload_emulator.orbit import force_model, propagate_scenario
from payload_emulator.scenario import Scenario
from payload_emulator.sim.light import sun_direction_mcmf
from payload_emulator.sim.renderer import render
from payload_emulator.sim.sensor import SensorModel, expose
from payload_emulator.sim.terrain.opening import open_terrain
from payload_emulator.sim.terrain.tiles import TiledTerrain
from payload_emulator.sim.truth import (
    Truth,
    attitude_message,
    find_windows,
    frame_times,
    perturbed,
    require_above_ground,
)

_NS = 1_000_000_000
_EPHEMERIS_STEP_NS = 10 * _NS
_EPHEMERIS_MARGIN_NS = 120 * _NS
_SEARCH_CHUNK_DAYS = 15.0
_CATALOGUE_MARGIN_M = 15_000.0

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """The simulated world of a scenario: what is true in it, and when the payload looks."""

    scenario: Scenario
    truth: Truth
    terrain: TiledTerrain
    gravity: GravityField
    maneuvers: tuple[Maneuver, ...]
    frame_utc_ns: IntArray
    data_names: tuple[str, ...]

    @property
    def camera(self) -> PinholeCamera:
        section = self.scenario.camera
        return PinholeCamera(section.width_px, section.height_px, np.radians(section.fov_deg))


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """One frame as the payload receives it, and the truth it was taken from (which stays here)."""

    utc_ns: int
    image: NDArray[np.uint8]
    attitude: FloatArray
    clock_ticks: int


def build_world(scenario: Scenario, data: DataFolder) -> World:
    """The world of a scenario, flown as far as its observation windows reach.

    Raises
    ------
    ScenarioError
        No window over the terrain within the days searched, or a trajectory below the ground.
    """
    terrain = open_terrain(scenario.terrain.source, data, scenario.seed)
    model = force_model(scenario, data)
    gravity = model.gravity
    truth, maneuvers, windows = _fly_to_windows(scenario, model, terrain)
    interval_ns = round(scenario.camera.frame_interval_s * _NS)
    limit_rad = np.radians(scenario.window.latitude_limit_deg)
    frames = [frame_times(truth, start, stop, interval_ns, limit_rad) for start, stop in windows]
    frame_utc_ns = np.concatenate(frames) if frames else np.zeros(0, dtype=np.int64)
    if frame_utc_ns.size == 0:
        raise ScenarioError(
            f"scenario {scenario.name}: the observation window holds no frame within "
            f"{scenario.window.latitude_limit_deg} deg of latitude"
        )
    require_above_ground(truth, frame_utc_ns, terrain.height_m)
    names = (
        *terrain.data_names,
        f"gravity {gravity.name} to degree {model.degree}",
        f"orientation {model.orientation.name}",
    )
    return World(scenario, truth, terrain, gravity, maneuvers, frame_utc_ns, names)


def exposures(world: World) -> Iterator[Exposure]:
    """The frames of a world in time order, the next ones rendered while the payload works on this one."""
    with ThreadPoolExecutor(max_workers=1) as renderer:
        pending = [renderer.submit(expose_frame, world, 0)]
        for number in range(world.frame_utc_ns.size):
            if number + 1 < world.frame_utc_ns.size:
                pending.append(renderer.submit(expose_frame, world, number + 1))
            yield pending.pop(0).result()


def expose_frame(world: World, number: int) -> Exposure:
    """What the camera, the ADCS and the clock deliver for one frame. Every draw depends on (seed, frame) alone."""
    scenario = world.scenario
    utc_ns = int(world.frame_utc_ns[number])
    rng = np.random.default_rng((scenario.seed, number))
    position = world.truth.positions_mcmf(utc_ns)[0]
    tdb_s = float(tdb_s_from_utc_ns(utc_ns))
    sun = true_sun_direction(world, position, utc_ns, rng)
    attitude = scenario.attitude
    pointing = np.radians(attitude.pointing_error_deg) * rng.standard_normal(3)
    camera_from_mcmf = perturbed(nadir_camera_from_mcmf(position), pointing)
    camera_from_icrf = camera_from_mcmf @ world.truth.orientation.mcmf_from_icrf(tdb_s)
    rendering = render(world.terrain, world.camera, position, camera_from_mcmf, sun)
    image = expose(rendering.radiance, SensorModel(), rng)
    bias = np.radians(attitude.knowledge_bias_deg) * np.random.default_rng(
        (scenario.seed, 2**32)
    ).standard_normal(3)
    noise = np.radians(attitude.knowledge_noise_deg) * rng.standard_normal(3)
    known = perturbed(camera_from_icrf, bias + noise)
    return Exposure(
        utc_ns,
        image,
        attitude_message(known, known @ camera_from_icrf.T @ camera_from_mcmf @ sun),
        _clock_ticks(world, utc_ns),
    )


def true_sun_direction(
    world: World, position_mcmf_m: FloatArray, utc_ns: int, rng: np.random.Generator
) -> FloatArray:
    """Direction to the Sun in MCMF, unit (3,): drawn near the spacecraft as in the paper, or from the ephemeris."""
    light = world.scenario.light
    if light.mode == "paper":
        elevation = np.radians(rng.uniform(light.elevation_min_deg, light.elevation_max_deg))
        azimuth = np.radians(rng.uniform(light.azimuth_min_deg, light.azimuth_max_deg))
        latitude, longitude, _ = spherical_from_mcmf(position_mcmf_m)
        return sun_direction_mcmf(elevation, azimuth, float(latitude), float(longitude))
    tdb_s = float(tdb_s_from_utc_ns(utc_ns))
    from_moon = sun_position_icrf_m(tdb_s) - world.truth.states(utc_ns)[0][0]
    return world.truth.orientation.mcmf_from_icrf(tdb_s) @ (from_moon / np.linalg.norm(from_moon))


def _clock_ticks(world: World, utc_ns: int) -> int:
    """The on-board clock's reading: ideal ticks, an offset, and a drift since the first frame."""
    clock = world.scenario.clock
    elapsed_s = (utc_ns - int(world.frame_utc_ns[0])) / _NS
    error_s = clock.offset_s + clock.drift_ppm * 1e-6 * elapsed_s
    return int(ticks_from_utc_ns(utc_ns)) + round(error_s * 65_536)


def _fly_to_windows(
    scenario: Scenario, model: ForceModel, terrain: TiledTerrain
) -> tuple[Truth, tuple[Maneuver, ...], list[tuple[int, int]]]:
    """Propagate in chunks until the wanted windows are found; truth, burns on the way, windows."""
    window = scenario.window
    not_before = parse_utc(window.start) if window.start else scenario.epoch_utc_ns
    if scenario.orbit.oem:
        ephemeris = load_oem(Path(scenario.orbit.oem))
        truth, maneuvers = _truth_of_ephemeris(ephemeris, model.orientation), ()
        return truth, maneuvers, _windows(scenario, truth, terrain, max(not_before, truth.start_utc_ns))
    reach_days = min(_SEARCH_CHUNK_DAYS, window.search_days)
    if window.search == "none":
        reach_days = (
            (not_before - scenario.epoch_utc_ns) / _NS / 86_400.0 + window.duration_s / 86_400.0 + 0.01
        )
    while True:
        truth, maneuvers = _propagate(scenario, model, reach_days)
        found = _windows(scenario, truth, terrain, not_before)
        if len(found) >= (1 if window.search == "none" else window.passes):
            return truth, maneuvers, found
        if reach_days >= window.search_days:
            raise ScenarioError(
                f"scenario {scenario.name}: window.search expected {window.passes} {window.direction} window(s) over "
                f"{terrain.name} within {window.search_days} days, found {len(found)}"
            )
        reach_days = min(2.0 * reach_days, window.search_days)


def _windows(
    scenario: Scenario, truth: Truth, terrain: TiledTerrain, not_before_utc_ns: int
) -> list[tuple[int, int]]:
    window = scenario.window
    if window.search == "none":
        return [
            (not_before_utc_ns, min(not_before_utc_ns + round(window.duration_s * _NS), truth.stop_utc_ns))
        ]
    west_deg, width_deg = window.longitude_min_deg, window.longitude_max_deg - window.longitude_min_deg

    def observable(latitude_rad: FloatArray, longitude_rad: FloatArray) -> NDArray[np.bool_]:
        return terrain.covers(latitude_rad, longitude_rad) & (
            (np.degrees(longitude_rad) - west_deg) % 360.0 <= width_deg
        )

    return find_windows(
        truth,
        observable,
        not_before_utc_ns=not_before_utc_ns,
        latitude_limit_rad=np.radians(window.latitude_limit_deg),
        direction=window.direction,
        half_fov_rad=np.radians(scenario.camera.fov_deg) / 2.0,
        count=window.passes,
    )


def _propagate(scenario: Scenario, model: ForceModel, days: float) -> tuple[Truth, tuple[Maneuver, ...]]:
    duration_s = days * 86_400.0
    orbit = propagate_scenario(scenario, model, duration_s)
    stop_utc_ns = scenario.epoch_utc_ns + round(duration_s * _NS)
    return Truth(
        orbit.trajectory.state, scenario.epoch_utc_ns, stop_utc_ns, model.orientation
    ), orbit.maneuvers


def _truth_of_ephemeris(ephemeris: Ephemeris, orientation: Orientation) -> Truth:
    def state(tdb_s: FloatArray) -> FloatArray:
        position, velocity = ephemeris.at(utc_ns_from_tdb_s(tdb_s))
        return np.concatenate([position, velocity], axis=1)

    return Truth(state, ephemeris.start_utc_ns, ephemeris.stop_utc_ns, orientation)


def sample_truth(truth: Truth, frame_utc_ns: IntArray) -> Ephemeris:
    """The true trajectory over the frames and a margin, as an ephemeris with a state each ten seconds."""
    start = max(int(frame_utc_ns[0]) - _EPHEMERIS_MARGIN_NS, truth.start_utc_ns)
    stop = min(int(frame_utc_ns[-1]) + _EPHEMERIS_MARGIN_NS, truth.stop_utc_ns)
    times = np.append(np.arange(start, stop, _EPHEMERIS_STEP_NS, dtype=np.int64), stop)
    position, velocity = truth.states(times)
    return ephemeris_from_states(times, position, velocity)


def with_reference_error(ephemeris: Ephemeris, sigma_m: float, seed: int) -> Ephemeris:
    """The ephemeris displaced by one constant offset in RTN: what orbit determination leaves to the ground."""
    if sigma_m == 0.0:
        return ephemeris
    segment = ephemeris.segments[0]
    offset = sigma_m * np.random.default_rng((seed, 2**33)).standard_normal(3)
    rtn_from_icrf = rtn_from_inertial(segment.position_m, segment.velocity_m_s)
    displaced = segment.position_m + np.einsum("nji,j->ni", rtn_from_icrf, offset)
    return ephemeris_from_states(segment.utc_ns, displaced, segment.velocity_m_s)


def catalogue_near_track(world: World) -> CraterCatalogue:
    """The craters of 3 to 30 km that any frame could see, with the heights of their rims."""
    positions = world.truth.positions_mcmf(world.frame_utc_ns)
    latitude, longitude, altitude = spherical_from_mcmf(positions)
    half_diagonal = np.sqrt(2.0) * np.tan(np.radians(world.scenario.camera.fov_deg) / 2.0)
    near = [
        world.terrain.catalogue.near(
            float(latitude[i]),
            float(longitude[i]),
            float(min(half_diagonal * altitude[i], 0.1 * MOON_RADIUS_M)) + _CATALOGUE_MARGIN_M,
        )
        for i in range(latitude.size)
    ]
    chosen = np.unique(np.concatenate(near))
    diameter_m = world.terrain.catalogue.diameter_m[chosen]
    navigation = world.scenario.navigation
    useful = (diameter_m >= 1e3 * navigation.catalogue_min_diameter_km) & (
        diameter_m <= 1e3 * navigation.catalogue_max_diameter_km
    )
    return world.terrain.measured(chosen[useful])
