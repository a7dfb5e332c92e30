"""The simulated world of a scenario: its true flight, its terrain, its light, and what the payload's senses get."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder
from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.frames import Orientation, rtn_from_inertial, spherical_from_mcmf
from lunar.gravity import GravityField
from lunar.lens import BrownCamera, pointed_camera_from_mcmf
from lunar.maneuvers import Maneuver
from lunar.messages.oem import load_oem
from lunar.propagation import ForceModel
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import (
    format_utc,
    parse_utc,
    tdb_s_from_utc_ns,
    ticks_from_utc_ns,
    utc_ns_from_tdb_s,
)
from payload_emulator.errors import ScenarioError
from payload_emulator.session.external import ExternalFrames, external_scenario
from payload_emulator.session.orbit import force_model, propagate_from, propagate_scenario
from payload_emulator.session.scenario import ReferenceSection, Scenario, WindowSection
from payload_emulator.sim.orbit.disturbances import TrueBurn, changed, executed, turned_state
from payload_emulator.sim.orbit.truth import (
    Crossing,
    Truth,
    attitude_message,
    find_crossings,
    frame_times,
    perturbed,
    require_above_ground,
    spliced,
)
from payload_emulator.sim.render.light import sun_direction_mcmf
from payload_emulator.sim.render.photometry import Photometry
from payload_emulator.sim.render.renderer import render
from payload_emulator.sim.render.sensor import Picture, take_picture
from payload_emulator.sim.terrain.opening import open_terrain
from payload_emulator.sim.terrain.raster import RasterTerrain
from payload_emulator.sim.terrain.registering import fitted
from payload_emulator.sim.terrain.tiles import TiledTerrain
from tmtc.cuc import TICKS_PER_SECOND
from tmtc.dictionary import DICTIONARY

Samples = Mapping[str, FloatArray]
"""Samples of each instrument by its name: rows, the on-board time first."""

NO_SAMPLES: Samples = MappingProxyType({})
_NS = 1_000_000_000
_MS = 1_000_000
_TICKS_NS = 200_000
_EPHEMERIS_STEP_NS = 10 * _NS
_EPHEMERIS_MARGIN_NS = 120 * _NS
_BEFORE_JUMP_NS = 10_000
_EDGE_NS = 1_000
_SEARCH_CHUNK_DAYS = 15.0
_CATALOGUE_MARGIN_M = 15_000.0
# Rims within this of the frames tell the registration where no product does: a 15 degree tile.
_REGISTERED_DEG = 7.5
# What stands for an image where none is rendered.
_REDUCED_PX = 8
# No ground of the Moon reaches so far above the sphere of the maps: its highest point lies at 10.8 km (LOLA).
_HIGHEST_GROUND_M = 12_000.0
# With the Sun this far below the horizon of the sub-satellite point no ground in view is lit, mountains included.
_NIGHT_RAD = np.radians(12.0)


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """The simulated world of a scenario: what is true in it, and when the payload looks.

    `external` holds frames that others took, which take the place of rendered ones.
    """

    scenario: Scenario
    truth: Truth
    terrain: TiledTerrain
    model: ForceModel
    burns: tuple[TrueBurn, ...]
    frame_utc_ns: IntArray
    data_names: tuple[str, ...]
    external: ExternalFrames | None = None

    @property
    def gravity(self) -> GravityField:
        """Gravity field of the true flight."""
        return self.model.gravity

    @property
    def camera(self) -> PinholeCamera:
        """The camera as flight and ground know it."""
        section = self.scenario.camera
        return PinholeCamera(section.width_px, section.height_px, np.radians(section.fov_deg))

    @property
    def true_camera(self) -> PinholeCamera:
        """The camera that takes the pictures: with the distortion of its lens, where it has some."""
        section, ideal = self.scenario.camera, self.camera
        distortion = (section.k1, section.k2, section.k3, section.p1, section.p2)
        if not any(distortion):
            return ideal
        return BrownCamera(ideal.width_px, ideal.height_px, ideal.fov_rad, *distortion)

    def camera_from_mcmf(self, position_mcmf_m: FloatArray) -> FloatArray:
        """Rotation (3, 3) to the camera as it is meant to point from a position (3,)."""
        section = self.scenario.camera
        return pointed_camera_from_mcmf(
            position_mcmf_m, np.radians(section.tilt_deg), np.radians(section.yaw_deg)
        )


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """One frame as the payload receives it, and the truth it was taken from (which stays here).

    Attributes
    ----------
    camera_from_mcmf
        True attitude, shape (3, 3).
    instruments
        Samples since the frame before.
    """

    utc_ns: int
    image: Picture
    attitude: FloatArray
    clock_ticks: int
    camera_from_mcmf: FloatArray
    instruments: Samples = field(default_factory=dict)


def build_world(scenario: Scenario, data: DataFolder, external: ExternalFrames | None = None) -> World:
    """The world of a scenario, flown as far as its observation windows reach.

    With external frames, their ephemeris is the flight and their times are the frames.

    Raises
    ------
    ScenarioError
        No window over the terrain within the days searched, or a trajectory below the ground.
    """
    terrain = scenario_terrain(scenario, data)
    model = force_model(scenario, data)
    if external is not None:
        return _external_world(external_scenario(scenario, external), external, terrain, model)
    truth, burns, windows = _fly_to_windows(scenario, model, terrain)
    interval_ns = round(scenario.camera.frame_interval_s * _NS)
    band_rad = _band_rad(scenario)
    frames = [frame_times(truth, start, stop, interval_ns, band_rad) for start, stop in windows]
    frame_utc_ns = np.concatenate(frames) if frames else np.zeros(0, dtype=np.int64)
    frame_utc_ns = _one_arc_of(scenario.window.arc_interval, frame_utc_ns, interval_ns)
    if frame_utc_ns.size == 0:
        raise ScenarioError(
            f"scenario {scenario.name}: the observation window holds no frame between latitudes "
            f"{_degrees(scenario.window.latitude_band_deg)}"
        )
    truth, burns = _disturbed(scenario, truth, burns, int(frame_utc_ns[0]), model)
    _register(terrain, truth, frame_utc_ns)
    require_above_ground(truth, frame_utc_ns, terrain.height_m, _HIGHEST_GROUND_M)
    return World(scenario, truth, terrain, model, burns, frame_utc_ns, _names(terrain, model))


def _external_world(
    scenario: Scenario, external: ExternalFrames, terrain: TiledTerrain, model: ForceModel
) -> World:
    """Return the world of external frames."""
    truth = _truth_of_ephemeris(load_oem(external.ephemeris), model.orientation)
    first, last = int(external.utc_ns[0]), int(external.utc_ns[-1])
    if first < truth.start_utc_ns or last > truth.stop_utc_ns:
        raise ScenarioError(
            f"{external.ephemeris}: expected states from {format_utc(first)} to {format_utc(last)}, found "
            f"{format_utc(truth.start_utc_ns)} to {format_utc(truth.stop_utc_ns)}"
        )
    _register(terrain, truth, external.utc_ns)
    require_above_ground(truth, external.utc_ns, terrain.height_m, _HIGHEST_GROUND_M)
    names = (f"external images {external.files[0].parent.name}", *_names(terrain, model))
    return World(scenario, truth, terrain, model, (), external.utc_ns, names, external)


def open_world(scenario: Scenario, data: DataFolder, duration_s: float) -> World:
    """Return the world of a scenario from its epoch on, whatever its windows: no frames but the clock's first instant.

    Raises
    ------
    ScenarioError
        The scenario flies an ephemeris file or has disturbances that belong to one arc.
    """
    section = scenario.disturbances
    if scenario.orbit.oem or section.kidnap_distance_km > 0.0 or section.burn_delta_v_m_s != 0.0:
        found = "orbit.oem" if scenario.orbit.oem else "a kidnap or a burn in [disturbances]"
        raise ScenarioError(
            f"scenario {scenario.name}: expected an orbit to propagate without end, found {found}"
        )
    terrain = scenario_terrain(scenario, data)
    model = force_model(scenario, data)
    truth, burns = _propagate(scenario, model, duration_s / 86_400.0)
    first = np.array([scenario.epoch_utc_ns], dtype=np.int64)
    return World(scenario, truth, terrain, model, burns, first, _names(terrain, model))


def scenario_terrain(scenario: Scenario, data: DataFolder) -> TiledTerrain:
    """Return the terrain of a scenario."""
    section = scenario.terrain
    return open_terrain(
        section.source,
        data,
        scenario.seed,
        registration_north_east_m=section.registration_north_east_m,
        photographs=section.photographs,
        heights=section.heights,
    )


def _register(terrain: TiledTerrain, truth: Truth, frame_utc_ns: IntArray) -> None:
    """Register the catalogue to rasters for which no product was made, from the rims near the frames."""
    if not isinstance(terrain, RasterTerrain) or terrain.registration is not None:
        return
    latitude, longitude, _ = spherical_from_mcmf(truth.positions_mcmf(frame_utc_ns))
    craters, reach_m = terrain.catalogue, math.radians(_REGISTERED_DEG) * MOON_RADIUS_M
    every = max(1, latitude.size // 200)
    near = [
        craters.near(float(north), float(east), reach_m)
        for north, east in zip(latitude[::every], longitude[::every], strict=True)
    ]
    registration = fitted(craters.select(np.unique(np.concatenate(near))), terrain.height_files)
    if registration is not None:
        terrain.register(registration)


def _names(terrain: TiledTerrain, model: ForceModel) -> tuple[str, ...]:
    """Data that a world is made of."""
    return (
        *terrain.data_names,
        f"gravity {model.gravity.name} to degree {model.degree}",
        f"orientation {model.orientation.name}",
    )


def continued(world: World, duration_s: float) -> World | None:
    """Return the world flown on beyond its trajectory, with the frames of the added time; None for an OEM file.

    The window's band of latitudes and its search still decide where frames are taken; its number of passes and its
    duration do not. Frames begin two intervals after the last, so that they form a separate arc.

    Raises
    ------
    ImpactError
        The orbit hits the Moon.
    ScenarioError
        The trajectory dips below the ground at a new frame.
    """
    scenario = world.scenario
    if scenario.orbit.oem:
        return None
    longer, burns = extended_flight(world, duration_s)
    stop_utc_ns = longer.stop_utc_ns
    interval_ns = round(scenario.camera.frame_interval_s * _NS)
    begin_utc_ns = int(world.frame_utc_ns[-1]) + 2 * interval_ns
    windows = [(begin_utc_ns, stop_utc_ns)]
    if scenario.window.search == "terrain":
        crossings = _crossings(scenario, longer, world.terrain, begin_utc_ns)
        windows = [(one.start_utc_ns, one.stop_utc_ns) for one in crossings if one.observable]
    added = [
        frame_times(longer, max(first, begin_utc_ns), last, interval_ns, _band_rad(scenario))
        for first, last in windows
    ]
    frames = np.concatenate([world.frame_utc_ns, *added])
    require_above_ground(
        longer, frames[world.frame_utc_ns.size - 1 :], world.terrain.height_m, _HIGHEST_GROUND_M
    )
    return replace(world, truth=longer, burns=(*world.burns, *burns), frame_utc_ns=frames)


def extended_flight(world: World, duration_s: float) -> tuple[Truth, tuple[TrueBurn, ...]]:
    """Return the flight with `duration_s` added to its end, and the burns in the added time.

    Raises
    ------
    ImpactError
        The orbit hits the Moon.
    """
    truth, joint_utc_ns = world.truth, world.truth.stop_utc_ns
    state = np.concatenate([part[0] for part in truth.states(joint_utc_ns)])
    orbit = propagate_from(world.scenario, world.model, joint_utc_ns, state, duration_s)
    burns = _executed(world.scenario, orbit.maneuvers)
    longer = Truth(
        spliced(truth.state_icrf, float(tdb_s_from_utc_ns(joint_utc_ns)), orbit.trajectory.state),
        truth.start_utc_ns,
        joint_utc_ns + round(duration_s * _NS),
        truth.orientation,
        (*truth.breaks_utc_ns, *(burn.utc_ns for burn in burns)),
    )
    return longer, burns


def _one_arc_of(interval: int, frame_utc_ns: IntArray, step_ns: int) -> IntArray:
    """Return the frames of every n-th arc; an arc ends where the latitude limit interrupts the frames."""
    arc = np.cumsum(np.diff(frame_utc_ns, prepend=frame_utc_ns[:1]) > step_ns)
    return np.asarray(frame_utc_ns[arc % interval == 0])


def _disturbed(
    scenario: Scenario, truth: Truth, burns: tuple[TrueBurn, ...], first_utc_ns: int, model: ForceModel
) -> tuple[Truth, tuple[TrueBurn, ...]]:
    """The flight with the disturbances of the scenario, and all its burns."""
    section = scenario.disturbances
    if section.burn_delta_v_m_s != 0.0:
        utc_ns = first_utc_ns + round(section.burn_at_s * _NS)
        velocity = truth.states(utc_ns)[1][0]
        done = section.burn_delta_v_m_s * velocity / np.linalg.norm(velocity)
        burn = executed(utc_ns, done, scenario.maneuvers.execution_error_fraction, (scenario.seed, 2**36))
        truth = changed(truth, utc_ns, lambda state: state + np.concatenate([np.zeros(3), done]), model)
        burns = (*burns, replace(burn, declared=section.burn_declared))
    if section.kidnap_distance_km > 0.0:
        heading = np.random.default_rng((scenario.seed, 2**37)).uniform(0.0, 2.0 * np.pi)
        truth = changed(
            truth,
            first_utc_ns + round(section.kidnap_at_s * _NS),
            lambda state: turned_state(state, 1e3 * section.kidnap_distance_km, heading),
            model,
        )
    return truth, burns


def no_instruments(utc_ns: int, camera_from_mcmf: FloatArray) -> Samples:
    """Return no samples."""
    return NO_SAMPLES


def exposures(
    world: World, sample: Callable[[int, FloatArray], Samples] = no_instruments, first: int = 0
) -> Generator[Exposure]:
    """Yield the frames of a world from the `first` on in time order, rendered ahead while the payload works.

    One thread renders and samples the instruments, because a terrain serves one thread; a second lets the sensor take
    the picture of what the first has rendered.

    Parameters
    ----------
    sample
        From time and true attitude of a frame to the samples before it; called in order of time.
    """
    world.terrain.release_thread()
    try:
        with ThreadPoolExecutor(max_workers=1) as renderer, ThreadPoolExecutor(max_workers=1) as sensor:

            def begin(number: int) -> Future[Exposure]:
                def prepared() -> tuple[_Scene, Samples]:
                    scene = _scene(world, int(world.frame_utc_ns[number]), number)
                    return scene, sample(scene.utc_ns, scene.camera_from_mcmf)

                scene = renderer.submit(prepared)
                return sensor.submit(lambda: _exposed(world, *scene.result()))

            pending = [begin(first)]
            for number in range(first, world.frame_utc_ns.size):
                if number + 1 < world.frame_utc_ns.size:
                    pending.append(begin(number + 1))
                yield pending.pop(0).result()
    finally:
        world.terrain.release_thread()


def orders_before(world: World, number: int) -> bytes:
    """Telecommands that reach the payload with a frame: after a told kidnap, to trust its estimate less."""
    section = world.scenario.disturbances
    if not (section.kidnap_told and section.kidnap_distance_km > 0.0):
        return b""
    moved_utc_ns = int(world.frame_utc_ns[0]) + round(section.kidnap_at_s * _NS)
    if int(world.frame_utc_ns[number]) < moved_utc_ns or (
        number and int(world.frame_utc_ns[number - 1]) >= moved_utc_ns
    ):
        return b""
    distance_m = 1e3 * section.kidnap_distance_km
    return DICTIONARY.pack_command(
        "perform_function",
        # A jump of place on an orbit comes with one of velocity: 1e-3 rad/s times the distance.
        {"function_id": "widen_estimate", "argument_1": distance_m, "argument_2": 1e-3 * distance_m},
        sequence_count=0,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What lies before the camera at one frame, and the draws that are still to come.

    Attributes
    ----------
    radiance
        None where the camera gives no picture of the ground; `picture` is what it gives instead.
    """

    utc_ns: int
    camera_from_mcmf: FloatArray
    camera_from_icrf: FloatArray
    sun_mcmf: FloatArray
    radiance: NDArray[np.float32] | None
    picture: Picture | None
    rng: np.random.Generator


def expose_frame(world: World, number: int) -> Exposure:
    """What the camera, the ADCS and the clock deliver for one frame. Every draw depends on (seed, frame) alone."""
    return _exposed(world, _scene(world, int(world.frame_utc_ns[number]), number))


def expose_at(
    world: World, utc_ns: int, sample: Callable[[int, FloatArray], Samples] = no_instruments
) -> Exposure:
    """Return what the camera, the ADCS and the clock deliver at any time; every draw depends on (seed, time) alone."""
    scene = _scene(world, utc_ns, utc_ns // _MS)
    return _exposed(world, scene, sample(utc_ns, scene.camera_from_mcmf))


def _scene(world: World, utc_ns: int, number: int) -> _Scene:
    scenario = world.scenario
    rng = np.random.default_rng((scenario.seed, number))
    position = world.truth.positions_mcmf(utc_ns)[0]
    tdb_s = float(tdb_s_from_utc_ns(utc_ns))
    sun = true_sun_direction(world, position, utc_ns, rng)
    pointing = np.radians(scenario.attitude.pointing_error_deg) * rng.standard_normal(3)
    camera_from_mcmf = perturbed(world.camera_from_mcmf(position), pointing)
    mcmf_from_icrf = world.truth.orientation.mcmf_from_icrf(tdb_s)
    camera_from_icrf = camera_from_mcmf @ mcmf_from_icrf
    measured = None if world.external is None else world.external.camera_from_icrf(utc_ns)
    if measured is not None:
        camera_from_icrf, camera_from_mcmf = measured, measured @ mcmf_from_icrf.T
    radiance, picture = _seen(world, utc_ns, position, camera_from_mcmf, sun)
    return _Scene(utc_ns, camera_from_mcmf, camera_from_icrf, sun, radiance, picture, rng)


def _exposed(world: World, scene: _Scene, instruments: Samples = NO_SAMPLES) -> Exposure:
    scenario, rng = world.scenario, scene.rng
    image = scene.picture
    if scene.radiance is not None:
        image = take_picture(scene.radiance, scenario.sensor, rng)
    assert image is not None
    attitude = scenario.attitude
    bias = np.radians(attitude.knowledge_bias_deg) * np.random.default_rng(
        (scenario.seed, 2**32)
    ).standard_normal(3)
    noise = np.radians(attitude.knowledge_noise_deg) * rng.standard_normal(3)
    known = perturbed(scene.camera_from_icrf, bias + noise)
    sun_in_camera = known @ scene.camera_from_icrf.T @ scene.camera_from_mcmf @ scene.sun_mcmf
    message = attitude_message(known, sun_in_camera)
    if scenario.instruments_give_attitude:
        message[:4] = np.nan
    return Exposure(
        scene.utc_ns,
        image,
        message,
        clock_ticks(world, scene.utc_ns),
        scene.camera_from_mcmf,
        instruments,
    )


def _seen(
    world: World, utc_ns: int, position_mcmf_m: FloatArray, camera_from_mcmf: FloatArray, sun_mcmf: FloatArray
) -> tuple[NDArray[np.float32] | None, Picture | None]:
    """The light on the sensor, none of it in deep night; in an outage no light but a picture without pixels."""
    section, camera = world.scenario.disturbances, world.true_camera
    elapsed_s = (utc_ns - int(world.frame_utc_ns[0])) / _NS
    if section.outage_at_s <= elapsed_s < section.outage_at_s + section.outage_duration_s:
        return None, np.empty((0, 0, 3), dtype=np.uint8)
    if world.external is not None:
        return None, world.external.image(utc_ns)
    if world.scenario.camera.images == "reduced":
        return None, np.full((_REDUCED_PX, _REDUCED_PX, 3), 128, dtype=np.uint8)
    if position_mcmf_m @ sun_mcmf < -np.sin(_NIGHT_RAD) * np.linalg.norm(position_mcmf_m):
        return np.zeros((camera.height_px, camera.width_px), dtype=np.float32), None
    law = Photometry(world.scenario.light.photometry)
    return render(world.terrain, camera, position_mcmf_m, camera_from_mcmf, sun_mcmf, law).radiance, None


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
    return np.asarray(world.truth.orientation.mcmf_from_icrf(tdb_s) @ (from_moon / np.linalg.norm(from_moon)))


def clock_ticks(world: World, utc_ns: int) -> int:
    """The on-board clock's reading: ideal ticks, an offset, and a drift since the first frame."""
    clock = world.scenario.clock
    elapsed_s = (utc_ns - int(world.frame_utc_ns[0])) / _NS
    error_s = clock.offset_s + clock.drift_ppm * 1e-6 * elapsed_s
    return int(ticks_from_utc_ns(utc_ns)) + round(error_s * TICKS_PER_SECOND)


def first_utc_ns(world: World, ticks: int) -> int:
    """Return the first time at which the clock of a scenario reads `ticks`."""
    utc_ns = int(world.frame_utc_ns[0])
    for _ in range(4):
        utc_ns += round((ticks - clock_ticks(world, utc_ns)) * _NS / TICKS_PER_SECOND)
    # The reading rises by one tick in 15 us; from a time within some ticks of it, the first is found by bisection.
    low, high = utc_ns - _TICKS_NS, utc_ns + _TICKS_NS
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if clock_ticks(world, middle) >= ticks else (middle, high)
    return high


def _fly_to_windows(
    scenario: Scenario, model: ForceModel, terrain: TiledTerrain
) -> tuple[Truth, tuple[TrueBurn, ...], list[tuple[int, int]]]:
    """Propagate in chunks until the wanted windows are found; truth, burns on the way, windows."""
    window = scenario.window
    not_before = parse_utc(window.start) if window.start else scenario.epoch_utc_ns
    if scenario.orbit.oem:
        ephemeris = load_oem(Path(scenario.orbit.oem))
        truth = _truth_of_ephemeris(ephemeris, model.orientation)
        return truth, (), _windows(scenario, truth, terrain, max(not_before, truth.start_utc_ns))
    reach_days = min(_SEARCH_CHUNK_DAYS, window.search_days)
    if window.search == "none":
        reach_days = (
            (not_before - scenario.epoch_utc_ns) / _NS / 86_400.0 + window.duration_s / 86_400.0 + 0.01
        )
    while True:
        truth, burns = _propagate(scenario, model, reach_days)
        if window.search == "none":
            return truth, burns, _windows(scenario, truth, terrain, not_before)
        crossings = _crossings(scenario, truth, terrain, not_before)
        found = [(one.start_utc_ns, one.stop_utc_ns) for one in crossings if one.observable]
        if len(found) >= window.passes:
            return truth, burns, found[: window.passes]
        if reach_days >= window.search_days:
            raise ScenarioError(
                f"scenario {scenario.name}: window.search expected {window.passes} {window.direction} window(s) over "
                f"{terrain.name} within {window.search_days} days, found {len(found)}; {_no_band(crossings, window)}"
            )
        reach_days = min(2.0 * reach_days, window.search_days)


def _no_band(crossings: list[Crossing], window: WindowSection) -> str:
    """Which latitudes lack terrain on the crossing that lacks the least of it."""
    band = f"latitudes {_degrees(window.latitude_band_deg)}"
    near = [one for one in crossings if one.in_reach and one.missing_rad.size]
    if not near:
        reach = _degrees((window.longitude_min_deg, window.longitude_max_deg))
        return f"no further crossing of {band} keeps its swath within longitudes {reach}"
    best = min(near, key=lambda one: float((one.missing_rad[:, 1] - one.missing_rad[:, 0]).sum()))
    missing = ", ".join(_degrees(tuple(np.degrees(row))) for row in best.missing_rad)
    return (
        f"the best other crossing of {band}, at longitude {np.degrees(best.longitude_rad) % 360.0:.1f} deg on "
        f"{format_utc(best.start_utc_ns, 0)}, lacks terrain at latitudes {missing}"
    )


def _degrees(limits: tuple[float, ...]) -> str:
    return f"{limits[0]:.1f} to {limits[1]:.1f} deg"


def _band_rad(scenario: Scenario) -> tuple[float, float]:
    low_deg, high_deg = scenario.window.latitude_band_deg
    return float(np.radians(low_deg)), float(np.radians(high_deg))


def _windows(
    scenario: Scenario, truth: Truth, terrain: TiledTerrain, not_before_utc_ns: int
) -> list[tuple[int, int]]:
    window = scenario.window
    if window.search == "none":
        stop_utc_ns = not_before_utc_ns + round(window.duration_s * _NS)
        return [(not_before_utc_ns, min(stop_utc_ns, truth.stop_utc_ns))]
    crossings = _crossings(scenario, truth, terrain, not_before_utc_ns)
    return [(one.start_utc_ns, one.stop_utc_ns) for one in crossings if one.observable][: window.passes]


def _crossings(
    scenario: Scenario, truth: Truth, terrain: TiledTerrain, not_before_utc_ns: int
) -> list[Crossing]:
    window = scenario.window
    west_deg, width_deg = window.longitude_min_deg, window.longitude_max_deg - window.longitude_min_deg

    def in_reach(longitude_rad: FloatArray) -> BoolArray:
        return np.asarray((np.degrees(longitude_rad) - west_deg) % 360.0 <= width_deg)

    return find_crossings(
        truth,
        terrain.covers,
        in_reach,
        not_before_utc_ns=not_before_utc_ns,
        latitude_band_rad=_band_rad(scenario),
        direction=window.direction,
        half_fov_rad=np.radians(scenario.camera.fov_deg) / 2.0,
    )


def _propagate(scenario: Scenario, model: ForceModel, days: float) -> tuple[Truth, tuple[TrueBurn, ...]]:
    duration_s = days * 86_400.0
    orbit = propagate_scenario(scenario, model, duration_s)
    stop_utc_ns = scenario.epoch_utc_ns + round(duration_s * _NS)
    burns = _executed(scenario, orbit.maneuvers)
    return (
        Truth(
            orbit.trajectory.state,
            scenario.epoch_utc_ns,
            stop_utc_ns,
            model.orientation,
            tuple(burn.utc_ns for burn in burns),
        ),
        burns,
    )


def _executed(scenario: Scenario, maneuvers: tuple[Maneuver, ...]) -> tuple[TrueBurn, ...]:
    share, seed = scenario.maneuvers.execution_error_fraction, (scenario.seed, 2**36)
    return tuple(executed(burn.utc_ns, burn.delta_v_icrf_m_s, share, seed) for burn in maneuvers)


def _truth_of_ephemeris(ephemeris: Ephemeris, orientation: Orientation) -> Truth:
    def state(tdb_s: FloatArray) -> FloatArray:
        utc_ns = utc_ns_from_tdb_s(tdb_s)
        # TDB seconds resolve some tens of nanoseconds: an instant at the edge may come back just outside.
        inside = np.clip(utc_ns, ephemeris.start_utc_ns, ephemeris.stop_utc_ns)
        position, velocity = ephemeris.at(np.where(np.abs(utc_ns - inside) <= _EDGE_NS, inside, utc_ns))
        return np.concatenate([position, velocity], axis=1)

    return Truth(state, ephemeris.start_utc_ns, ephemeris.stop_utc_ns, orientation)


def sample_truth(truth: Truth, frame_utc_ns: IntArray) -> Ephemeris:
    """The true trajectory over the frames and a margin: a state each ten seconds, a segment between jumps."""
    start = max(int(frame_utc_ns[0]) - _EPHEMERIS_MARGIN_NS, truth.start_utc_ns)
    stop = min(int(frame_utc_ns[-1]) + _EPHEMERIS_MARGIN_NS, truth.stop_utc_ns)
    grid = np.append(np.arange(start, stop, _EPHEMERIS_STEP_NS, dtype=np.int64), stop)
    edges = [start, *(utc_ns for utc_ns in sorted(truth.breaks_utc_ns) if start < utc_ns < stop), stop]
    segments = []
    for first, last in itertools.pairwise(edges):
        times = np.unique(np.concatenate([[first], grid[(grid > first) & (grid < last)], [last]]))
        # The state at a jump is that after it; a segment that ends there takes the one before.
        asked = times.copy()
        asked[-1] -= _BEFORE_JUMP_NS if last != stop else 0
        position, velocity = truth.states(asked)
        position += velocity * ((times - asked) / _NS)[:, None]
        segments.append(
            EphemerisSegment(
                times,
                position,
                velocity,
                object_name="SELENITA",
                object_id="SELENITA",
                degree=min(7, 2 * times.size - 1),
            )
        )
    return Ephemeris(tuple(segments))


def with_reference_error(ephemeris: Ephemeris, section: ReferenceSection, seed: int) -> Ephemeris:
    """Return the ephemeris with simulated orbit determination errors.

    The errors follow the Clohessy-Wiltshire solution of equal period about a circular orbit: with the angle u since the
    start, x = a cos u + b sin u, y = c - 2 a sin u + 2 b cos u, z = d cos u + e sin u (radial, transverse, normal), all
    coefficients drawn once. Velocities are the derivatives of the displaced positions.

    References
    ----------
    Clohessy, Wiltshire (1960), Terminal guidance system for satellite rendezvous, equations 9.
    """
    if not any(section.sigma_rtn_m):
        return ephemeris
    draw = np.random.default_rng((seed, 2**33)).standard_normal(8)
    offset = section.position_error_m * draw[:3]
    a, b = section.radial_m * draw[3:5]
    c = np.sqrt(section.transverse_m**2 - 4.0 * section.radial_m**2) * draw[5]
    d, e = section.normal_m * draw[6:8]
    first = ephemeris.segments[0]
    radius = float(np.linalg.norm(first.position_m[0]))
    rate = float(np.linalg.norm(np.cross(first.position_m[0], first.velocity_m_s[0]))) / radius**2

    def displaced(segment: EphemerisSegment) -> EphemerisSegment:
        u = rate * (segment.utc_ns - ephemeris.start_utc_ns) / _NS
        cosine, sine = np.cos(u), np.sin(u)
        x, y = a * cosine + b * sine, c - 2.0 * a * sine + 2.0 * b * cosine
        z = d * cosine + e * sine
        error = np.stack([x, y, z], axis=1) + offset
        # The axes rotate with the orbit: derivative in these axes plus the rotation of the displacement about the
        # normal.
        slope = rate * np.stack(
            [-a * sine + b * cosine, -2.0 * a * cosine - 2.0 * b * sine, -d * sine + e * cosine], axis=1
        )
        slope += rate * np.stack([-error[:, 1], error[:, 0], np.zeros_like(u)], axis=1)
        rtn_from_icrf = rtn_from_inertial(segment.position_m, segment.velocity_m_s)
        return replace(
            segment,
            position_m=segment.position_m + np.einsum("nji,nj->ni", rtn_from_icrf, error),
            velocity_m_s=segment.velocity_m_s + np.einsum("nji,nj->ni", rtn_from_icrf, slope),
        )

    return Ephemeris(tuple(displaced(segment) for segment in ephemeris.segments))


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
    if world.scenario.camera.images == "reduced" and "anchored" not in navigation.estimators:
        # Nobody asks for the heights of rims: measuring them means making the ground of the whole track.
        return world.terrain.catalogue.select(chosen[useful])
    return world.terrain.measured(chosen[useful])
