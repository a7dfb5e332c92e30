"""Frames of a world: what camera, attitude control and clock deliver, rendered ahead while the payload works."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray
from lunar.camera import project_mcmf
from lunar.constants import MOON_RADIUS_M, NS
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import format_utc, tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError, TerrainError
from payload_emulator.flight.vision.detections import Detections, no_detections
from payload_emulator.flight.vision.preprocess import ImageQuality
from payload_emulator.session.world.world import World, clock_ticks
from payload_emulator.sim.detector import SimulatedDetector
from payload_emulator.sim.orbit.truth import attitude_message, perturbed
from payload_emulator.sim.render.light import sun_direction_mcmf
from payload_emulator.sim.render.photometry import Photometry
from payload_emulator.sim.render.renderer import highest_latitude_rad, render
from payload_emulator.sim.render.sensor import Picture, take_picture
from payload_emulator.sim.terrain.tiles import POLE_LIMIT_RAD

_MS = 1_000_000
# What stands for an image where none is rendered, and for one that the camera does not give.
_REDUCED_PX = 8
NO_PICTURE: Picture = np.empty((0, 0, 3), dtype=np.uint8)
# With the Sun this far below the horizon of the sub-satellite point no ground in view is lit, mountains included.
_NIGHT_RAD = np.radians(12.0)
# Shadows come from ground of up to 75 km beyond a picture, whose corners lie beyond its edges.
_SHADOW_RAD = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """One frame as the payload receives it, and the truth it was taken from (which stays here).

    Attributes
    ----------
    camera_from_mcmf
        True attitude, shape (3, 3).
    fault
        Why the camera gives no image of ground that cannot be rendered; empty without such a fault.
    """

    utc_ns: int
    image: Picture
    attitude: FloatArray
    clock_ticks: int
    camera_from_mcmf: FloatArray
    fault: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """Scene before the camera at one frame, and its generator of random draws.

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


@dataclass(slots=True, eq=False)
class Camera:
    """Takes the frames of a spacecraft in order of time.

    One thread renders, because a terrain serves one thread; a second lets the sensor take the picture of what the first
    has rendered. Ground that cannot be rendered gives no image.

    Attributes
    ----------
    overlay
        Called in the thread of the terrain with world, time and true attitude of each frame; `shown` is its result.
    """

    world: World
    overlay: Callable[[World, int, FloatArray], Any] | None = None
    shown: Any = None
    _renderer: ThreadPoolExecutor = field(init=False)
    _sensor: ThreadPoolExecutor = field(init=False)
    _ahead: tuple[int, Future[Exposure]] | None = None

    def __post_init__(self) -> None:
        self.world.terrain.release_thread()
        self._renderer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="render")
        self._sensor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="sensor")

    def take(self, utc_ns: int, next_utc_ns: int | None = None) -> Exposure:
        """Return the frame of a time, and begin to render the one that probably follows."""
        if self._ahead is None or self._ahead[0] != utc_ns:
            self._prepare(utc_ns)
        assert self._ahead is not None
        try:
            exposure = self._ahead[1].result()
        except TerrainError as error:
            exposure = replace(expose(self.world, utc_ns, NO_PICTURE), fault=str(error))
        self.shown = None
        if self.overlay is not None:
            shown = self._renderer.submit(self.overlay, self.world, utc_ns, exposure.camera_from_mcmf)
            self.shown = shown.result()
        self._ahead = None
        if next_utc_ns is not None:
            self._prepare(next_utc_ns)
        return exposure

    def release_ground(self) -> None:
        """Drop the ground of the frames so far; the next frame makes its own."""
        self._renderer.submit(self.world.terrain.release_ground)

    def close(self) -> None:
        """End the threads, after which another one may ask the terrain for ground."""
        self._renderer.shutdown(cancel_futures=True)
        self._sensor.shutdown(cancel_futures=True)
        self.world.terrain.release_thread()

    def _prepare(self, utc_ns: int) -> None:
        if self._ahead is not None:
            self._ahead[1].cancel()
        world = self.world
        scene = self._renderer.submit(_scene, world, utc_ns)
        self._ahead = utc_ns, self._sensor.submit(lambda: _exposed(world, scene.result()))


def expose(world: World, utc_ns: int, picture: Picture | None = None) -> Exposure:
    """Return what the camera, the ADCS and the clock deliver at a time; `picture` stands in for the rendered one.

    Every draw depends on the seed and, at a frame of the scenario, on its number, else on the time.

    Raises
    ------
    TerrainError
        The ground in view cannot be rendered.
    """
    return _exposed(world, _scene(world, utc_ns, picture))


def _scene(world: World, utc_ns: int, picture: Picture | None = None) -> _Scene:
    rng, position, camera_from_mcmf, sun = _pose(world, utc_ns)
    tdb_s = float(tdb_s_from_utc_ns(utc_ns))
    mcmf_from_icrf = world.truth.orientation.mcmf_from_icrf(tdb_s)
    camera_from_icrf = camera_from_mcmf @ mcmf_from_icrf
    measured = None if world.external is None else world.external.camera_from_icrf(utc_ns)
    if measured is not None:
        camera_from_icrf, camera_from_mcmf = measured, measured @ mcmf_from_icrf.T
    radiance = None
    if picture is None:
        radiance, picture = _seen(world, utc_ns, position, camera_from_mcmf, sun)
    return _Scene(utc_ns, camera_from_mcmf, camera_from_icrf, sun, radiance, picture, rng)


def _pose(world: World, utc_ns: int) -> tuple[np.random.Generator, FloatArray, FloatArray, FloatArray]:
    """Return the draws still to come, position (3,), attitude (3, 3) and direction to the Sun (3,), MCMF, at a time."""
    scenario = world.scenario
    number = int(np.searchsorted(world.frame_utc_ns, utc_ns))
    is_listed = number < world.frame_utc_ns.size and int(world.frame_utc_ns[number]) == utc_ns
    rng = np.random.default_rng((scenario.seed, number if is_listed else utc_ns // _MS))
    position = world.truth.positions_mcmf(utc_ns)[0]
    sun = true_sun_direction(world, position, utc_ns, rng)
    pointing = np.radians(scenario.attitude.pointing_error_deg) * rng.standard_normal(3)
    return rng, position, perturbed(world.camera_from_mcmf(position), pointing), sun


def require_renderable(world: World) -> None:
    """Refuse a flight over ground nearer to a pole than terrain can be had, by its first such frame.

    Raises
    ------
    ScenarioError
        A picture needs ground beyond the limit of latitude.
    """
    scenario, times = world.scenario, world.frame_utc_ns
    latitude, _, altitude = spherical_from_mcmf(world.truth.positions_mcmf(times))
    latitude = np.abs(latitude)
    in_view = latitude + np.arccos(MOON_RADIUS_M / (MOON_RADIUS_M + altitude)) + _SHADOW_RAD >= POLE_LIMIT_RAD
    if scenario.camera.images == "reduced" or world.external is not None:
        in_view[:] = False
    for number in np.flatnonzero(in_view):
        _, position, camera_from_mcmf, sun = _pose(world, int(times[number]))
        needed = float(latitude[number])
        if not _is_night(position, sun):
            needed = max(needed, highest_latitude_rad(world.true_camera, position, camera_from_mcmf, sun))
        if needed >= POLE_LIMIT_RAD:
            raise ScenarioError(
                f"scenario {scenario.name}: expected ground within {np.degrees(POLE_LIMIT_RAD):.0f} deg of latitude "
                f"({world.terrain.name}), found {np.degrees(needed):.2f} deg needed by frame {number + 1} of "
                f"{times.size} at {format_utc(int(times[number]), 0)}; see window.latitude_limit_deg"
            )


def _is_night(position_mcmf_m: FloatArray, sun_mcmf: FloatArray) -> bool:
    return bool(position_mcmf_m @ sun_mcmf < -np.sin(_NIGHT_RAD) * np.linalg.norm(position_mcmf_m))


def _exposed(world: World, scene: _Scene) -> Exposure:
    scenario, rng = world.scenario, scene.rng
    image = scene.picture
    if scene.radiance is not None:
        image = take_picture(scene.radiance, scenario.sensor, rng)
    assert image is not None
    attitude = scenario.attitude
    bias = np.radians(attitude.knowledge_bias_deg) * np.random.default_rng((scenario.seed, 2**32)).standard_normal(3)
    noise = np.radians(attitude.knowledge_noise_deg) * rng.standard_normal(3)
    known = perturbed(scene.camera_from_icrf, bias + noise)
    sun_in_camera = known @ scene.camera_from_icrf.T @ scene.camera_from_mcmf @ scene.sun_mcmf
    message = attitude_message(known, sun_in_camera)
    ticks = clock_ticks(world, scene.utc_ns)
    return Exposure(scene.utc_ns, image, message, ticks, scene.camera_from_mcmf)


def _seen(
    world: World, utc_ns: int, position_mcmf_m: FloatArray, camera_from_mcmf: FloatArray, sun_mcmf: FloatArray
) -> tuple[NDArray[np.float32] | None, Picture | None]:
    """Return the light on the sensor, none of it in deep night; in an outage no light but a picture without pixels."""
    section, camera = world.scenario.disturbances, world.true_camera
    elapsed_s = (utc_ns - int(world.frame_utc_ns[0])) / NS
    if section.outage_at_s <= elapsed_s < section.outage_at_s + section.outage_duration_s:
        return None, NO_PICTURE
    if world.external is not None:
        return None, world.external.image(utc_ns)
    if world.scenario.camera.images == "reduced":
        return None, np.full((_REDUCED_PX, _REDUCED_PX, 3), 128, dtype=np.uint8)
    if _is_night(position_mcmf_m, sun_mcmf):
        return np.zeros((camera.height_px, camera.width_px), dtype=np.float32), None
    law = Photometry(world.scenario.light.photometry)
    return render(world.terrain, camera, position_mcmf_m, camera_from_mcmf, sun_mcmf, law).radiance, None


def true_sun_direction(world: World, position_mcmf_m: FloatArray, utc_ns: int, rng: np.random.Generator) -> FloatArray:
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


# A detector as the one that flies, roughly: what is drawn where no image is rendered.
_REDUCED_RECALL, _SMALLEST_PX = 0.7, 5.0
_REDUCED_DETECTOR = SimulatedDetector(precision=1.0, sigma_px=0.6, log_diameter_sigma=0.0)


@dataclass(slots=True, eq=False)
class CatalogueDetector:
    """In place of the network where no images are rendered: the craters in view, some missed, all a little off."""

    seed: int
    _rng: np.random.Generator = field(init=False)
    _next: Detections = field(default_factory=no_detections)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng((self.seed, 2**43))

    def show(self, world: World, exposure: Exposure) -> None:
        """Prepare what is found in the next frame."""
        _, uv, diameter_px = craters_in_view(world, exposure, _SMALLEST_PX)
        seen = self._rng.random(diameter_px.size) < _REDUCED_RECALL
        camera = world.camera
        corner = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
        places, sizes = _REDUCED_DETECTOR.detect(uv[seen], diameter_px[seen], corner, self._rng)
        sigma = np.full(sizes.size, _REDUCED_DETECTOR.stated_sigma_px)
        self._next = Detections(places[:, 0], places[:, 1], sizes, np.full(sizes.size, 0.9), sigma)

    def examine(self, image: NDArray[Any], sun_in_camera: FloatArray | None = None) -> tuple[ImageQuality, Detections]:
        found, self._next = self._next, no_detections()
        if not image.size:
            return ImageQuality.INVALID, no_detections()
        if not image.any():
            return ImageQuality.DARK, no_detections()
        if image.min() == 255:
            return ImageQuality.SATURATED, no_detections()
        return ImageQuality.OK, found


def craters_in_view(world: World, exposure: Exposure, smallest_px: float) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the craters in an image: index, place (n, 2) and diameter (n,) in pixels; unknown heights are 0."""
    position = world.truth.positions_mcmf(exposure.utc_ns)[0]
    latitude, longitude, altitude = (float(value) for value in spherical_from_mcmf(position))
    craters, camera = world.terrain.catalogue, world.true_camera
    reach_m = min(2.5 * altitude * np.tan(camera.fov_rad / 2.0), 0.1 * MOON_RADIUS_M)
    near = craters.near(latitude, longitude, reach_m)
    height_m = np.nan_to_num(craters.rim_height_m[near], nan=0.0)
    points = mcmf_from_spherical(craters.latitude_rad[near], craters.longitude_rad[near], height_m)
    uv = project_mcmf(camera, exposure.camera_from_mcmf, position, points)
    depth_m = (points - position) @ exposure.camera_from_mcmf[2]
    with np.errstate(invalid="ignore", divide="ignore"):
        diameter_px = camera.focal_px * craters.diameter_m[near] / depth_m
        inside = np.all((uv > 0.0) & (uv < np.array([camera.width_px, camera.height_px]) - 1), axis=1)
        seen = np.flatnonzero(inside & (diameter_px > smallest_px))
    return near[seen], uv[seen], diameter_px[seen]
