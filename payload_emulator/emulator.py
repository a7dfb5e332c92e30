"""The emulator: flies a scenario, shows the payload what its camera would see, writes the pass archive.

Truth (trajectory, terrain, light) stays on this side of `Payload.step`; what the payload says comes back as space
packets, becomes CADUs, and goes through the link model into `downlink.cadu`.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import CraterCatalogue, save_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder, default_gravity, default_orientation
from lunar.elements import Elements, icrf_state_from_elements, state_from_elements
from lunar.ephemeris import Ephemeris, ephemeris_from_states
from lunar.frames import IauOrientation, Orientation, rtn_from_inertial, spherical_from_mcmf
from lunar.gravity import GravityField, builtin_gravity, load_gravity
from lunar.maneuvers import Maneuver, ManeuverRule, propagate_with_maneuvers
from lunar.oem import load_oem, save_oem
from lunar.propagation import ForceModel, propagate
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import format_utc, parse_utc, tdb_s_from_utc_ns, ticks_from_utc_ns, utc_ns_from_tdb_s
from payload_emulator.errors import ScenarioError
from payload_emulator.loading import LoadedPayload, load_payload
from payload_emulator.scenario import Scenario, format_scenario
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
from tmtc.downlink import encode_cadus

SPACECRAFT_ID = 0x4C
_NS = 1_000_000_000
_EPHEMERIS_STEP_NS = 10 * _NS
_EPHEMERIS_MARGIN_NS = 120 * _NS
_SEARCH_CHUNK_DAYS = 15.0
_CATALOGUE_MARGIN_M = 15_000.0

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Progress = Callable[[Iterable[Any], int], Iterator[Any]]


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
    gravity = _gravity(scenario.dynamics.gravity, data)
    orientation = _orientation(scenario.dynamics.orientation, data)
    truth, maneuvers, windows = _fly_to_windows(scenario, gravity, orientation, terrain)
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
        f"gravity {gravity.name} to degree {min(gravity.degree, scenario.dynamics.degree)}",
        f"orientation {orientation.name}",
    )
    return World(scenario, truth, terrain, gravity, maneuvers, frame_utc_ns, names)


def emulate(
    scenario: Scenario,
    data: DataFolder,
    out: Path,
    *,
    frames_kept: int | None = 0,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Fly a scenario and write its pass archive into the folder `out`; the summary comes back.

    Parameters
    ----------
    frames_kept
        How many images, evenly spread, go into the archive; None keeps all.
    progress
        Wraps the iteration over frames (items, total), for a progress bar.

    Raises
    ------
    ScenarioError
        The scenario cannot be flown, or `out` holds something that is no pass archive.
    """
    started = time.monotonic()
    _require_replaceable(out)
    world = build_world(scenario, data)
    partial = out.with_name(f".{out.name}.partial-{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        summary = _emulate_into(world, data, partial, frames_kept, progress, started)
        if out.exists():
            shutil.rmtree(out)
        partial.rename(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return summary


def exposures(world: World) -> Iterator[Exposure]:
    """The frames of a world in time order, the next ones rendered while the payload works on this one."""
    with ThreadPoolExecutor(max_workers=1) as renderer:
        pending = [renderer.submit(_expose, world, 0)]
        for number in range(world.frame_utc_ns.size):
            if number + 1 < world.frame_utc_ns.size:
                pending.append(renderer.submit(_expose, world, number + 1))
            yield pending.pop(0).result()


def _emulate_into(
    world: World,
    data: DataFolder,
    folder: Path,
    frames_kept: int | None,
    progress: Progress | None,
    started: float,
) -> dict[str, Any]:
    scenario = world.scenario
    truth_ephemeris = _sample(world.truth, world.frame_utc_ns)
    reference = _with_error(truth_ephemeris, scenario.reference.position_error_m, scenario.seed)
    catalogue = _catalogue_near_track(world)
    loaded = load_payload(
        scenario,
        world.camera,
        reference,
        catalogue,
        world.truth.orientation,
        data,
        int(world.frame_utc_ns[0]),
    )
    total = int(world.frame_utc_ns.size)
    kept = (
        set(range(total))
        if frames_kept is None
        else set(np.linspace(0, total - 1, frames_kept + 2, dtype=int)[1:-1])
    )
    frames = exposures(world)
    packets: list[bytes] = []
    for number, frame in enumerate(progress(frames, total) if progress else frames):
        packets += loaded.payload.step(frame.image, frame.attitude, frame.clock_ticks, b"")
        if number in kept:
            _save_png(folder / "frames" / f"{number:06d}.png", frame.image)
    save_oem(truth_ephemeris, folder / "truth.oem")
    save_oem(reference, folder / "reference.oem")
    save_catalogue(catalogue, folder / "catalogue.csv")
    octets = encode_cadus(packets, spacecraft_id=SPACECRAFT_ID, coding=scenario.link.coding)
    (folder / "downlink.cadu").write_bytes(octets)
    summary = _summary(world, loaded, packets, len(octets), len(kept), time.monotonic() - started)
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    (folder / "manifest.json").write_text(json.dumps(_manifest(world, loaded, folder), indent=2) + "\n")
    return summary


def _summary(
    world: World, loaded: LoadedPayload, packets: list[bytes], octets: int, kept: int, wall_s: float
) -> dict[str, Any]:
    scenario = world.scenario
    total = int(world.frame_utc_ns.size)
    _, longitude, altitude = spherical_from_mcmf(world.truth.positions_mcmf(world.frame_utc_ns))
    return {
        "scenario": scenario.name,
        "seed": scenario.seed,
        "frames": total,
        "frames_kept": kept,
        "packets": len(packets),
        "downlink_octets": octets,
        "start_utc": format_utc(int(world.frame_utc_ns[0])),
        "stop_utc": format_utc(int(world.frame_utc_ns[-1])),
        "altitude_km": {
            "min": float(altitude.min()) / 1e3,
            "mean": float(altitude.mean()) / 1e3,
            "max": float(altitude.max()) / 1e3,
        },
        "longitude_deg": {
            "first": float(np.degrees(longitude[0])) % 360.0,
            "last": float(np.degrees(longitude[-1])) % 360.0,
        },
        "maneuvers": len(world.maneuvers),
        **loaded.payload.summary(),
        "data": list(world.data_names),
        "wall_s": round(wall_s, 3),
        "realtime_factor": round(total * scenario.camera.frame_interval_s / wall_s, 2),
    }


def _manifest(world: World, loaded: LoadedPayload, folder: Path) -> dict[str, Any]:
    """What the ground needs to know of a pass, with the hash of every file of the archive but itself."""
    scenario, camera = world.scenario, world.scenario.camera
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "manifest.json")
    return {
        "schema_version": 1,
        "pass_name": f"{scenario.name}-{format_utc(int(world.frame_utc_ns[0]), 0)}",
        "spacecraft_id": SPACECRAFT_ID,
        "scenario": scenario.name,
        "scenario_toml": format_scenario(scenario),
        "seed": scenario.seed,
        "build": loaded.build,
        "data_sources": list(world.data_names),
        "start_utc": format_utc(int(world.frame_utc_ns[0])),
        "stop_utc": format_utc(int(world.frame_utc_ns[-1])),
        "cadence_s": camera.frame_interval_s,
        "frames_expected": int(world.frame_utc_ns.size),
        "light": scenario.light.mode,
        "terrain": world.terrain.name,
        "camera": {"width_px": camera.width_px, "height_px": camera.height_px, "fov_deg": camera.fov_deg},
        "estimators": list(scenario.navigation.estimators),
        "start_state": loaded.start_state,
        "gravity": {
            "truth": world.gravity.name,
            "degree": min(world.gravity.degree, scenario.dynamics.degree),
            **loaded.gravity,
        },
        "tables": loaded.table_hashes,
        "files": {
            path.relative_to(folder).as_posix(): {
                "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
                "bytes": path.stat().st_size,
            }
            for path in files
        },
    }


def _expose(world: World, number: int) -> Exposure:
    """What the camera, the ADCS and the clock deliver for one frame. Every draw depends on (seed, frame) alone."""
    scenario = world.scenario
    utc_ns = int(world.frame_utc_ns[number])
    rng = np.random.default_rng((scenario.seed, number))
    position = world.truth.positions_mcmf(utc_ns)[0]
    tdb_s = float(tdb_s_from_utc_ns(utc_ns))
    sun = _sun_direction(world, position, tdb_s, rng)
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


def _sun_direction(
    world: World, position_mcmf_m: FloatArray, tdb_s: float, rng: np.random.Generator
) -> FloatArray:
    light = world.scenario.light
    if light.mode == "paper":
        elevation = np.radians(rng.uniform(light.elevation_min_deg, light.elevation_max_deg))
        azimuth = np.radians(rng.uniform(light.azimuth_min_deg, light.azimuth_max_deg))
        latitude, longitude, _ = spherical_from_mcmf(position_mcmf_m)
        return sun_direction_mcmf(elevation, azimuth, float(latitude), float(longitude))
    from_moon = sun_position_icrf_m(tdb_s) - world.truth.state_icrf(np.array([tdb_s]))[0, :3]
    return world.truth.orientation.mcmf_from_icrf(tdb_s) @ (from_moon / np.linalg.norm(from_moon))


def _clock_ticks(world: World, utc_ns: int) -> int:
    """The on-board clock's reading: ideal ticks, an offset, and a drift since the first frame."""
    clock = world.scenario.clock
    elapsed_s = (utc_ns - int(world.frame_utc_ns[0])) / _NS
    error_s = clock.offset_s + clock.drift_ppm * 1e-6 * elapsed_s
    return int(ticks_from_utc_ns(utc_ns)) + round(error_s * 65_536)


def _fly_to_windows(
    scenario: Scenario, gravity: GravityField, orientation: Orientation, terrain: TiledTerrain
) -> tuple[Truth, tuple[Maneuver, ...], list[tuple[int, int]]]:
    """Propagate in chunks until the wanted windows are found; truth, burns on the way, windows."""
    window = scenario.window
    not_before = parse_utc(window.start) if window.start else scenario.epoch_utc_ns
    if scenario.orbit.oem:
        ephemeris = load_oem(Path(scenario.orbit.oem))
        truth, maneuvers = _truth_of_ephemeris(ephemeris, orientation), ()
        return truth, maneuvers, _windows(scenario, truth, terrain, max(not_before, truth.start_utc_ns))
    reach_days = min(_SEARCH_CHUNK_DAYS, window.search_days)
    if window.search == "none":
        reach_days = (
            (not_before - scenario.epoch_utc_ns) / _NS / 86_400.0 + window.duration_s / 86_400.0 + 0.01
        )
    while True:
        truth, maneuvers = _propagate(scenario, gravity, orientation, reach_days)
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


def initial_state_icrf(scenario: Scenario, gravity: GravityField) -> FloatArray:
    """Position (m) and velocity (m/s), shape (6,), Moon-centred ICRF axes, of a scenario's elements at its epoch."""
    orbit = scenario.orbit
    elements = Elements(
        orbit.semi_major_axis_km * 1e3,
        orbit.eccentricity,
        np.radians(orbit.inclination_deg),
        np.radians(orbit.raan_deg),
        np.radians(orbit.argument_of_perilune_deg),
        np.radians(orbit.true_anomaly_deg),
    )
    if orbit.frame == "ICRF":
        return np.concatenate(state_from_elements(elements, gravity.gm_m3_s2))
    epoch_tdb_s = float(tdb_s_from_utc_ns(scenario.epoch_utc_ns))
    return np.concatenate(icrf_state_from_elements(elements, epoch_tdb_s, gravity.gm_m3_s2))


def _propagate(
    scenario: Scenario, gravity: GravityField, orientation: Orientation, days: float
) -> tuple[Truth, tuple[Maneuver, ...]]:
    dynamics, rule = scenario.dynamics, scenario.maneuvers
    model = ForceModel(
        gravity, orientation, min(dynamics.degree, gravity.degree), earth=dynamics.earth, sun=dynamics.sun
    )
    start_tdb_s = float(tdb_s_from_utc_ns(scenario.epoch_utc_ns))
    state = initial_state_icrf(scenario, gravity)
    duration_s = days * 86_400.0
    maneuvers: tuple[Maneuver, ...] = ()
    if rule.enabled:
        trajectory, maneuvers = propagate_with_maneuvers(
            start_tdb_s,
            state[:3],
            state[3:],
            duration_s,
            model,
            ManeuverRule(rule.periselene_altitude_km * 1e3, rule.semi_major_axis_km * 1e3, rule.eccentricity),
            integrator=dynamics.integrator,
        )
    else:
        trajectory = propagate(
            start_tdb_s, state[:3], state[3:], duration_s, model, integrator=dynamics.integrator
        )
    stop_utc_ns = scenario.epoch_utc_ns + round(duration_s * _NS)
    return Truth(trajectory.state, scenario.epoch_utc_ns, stop_utc_ns, orientation), maneuvers


def _truth_of_ephemeris(ephemeris: Ephemeris, orientation: Orientation) -> Truth:
    def state(tdb_s: FloatArray) -> FloatArray:
        position, velocity = ephemeris.at(utc_ns_from_tdb_s(tdb_s))
        return np.concatenate([position, velocity], axis=1)

    return Truth(state, ephemeris.start_utc_ns, ephemeris.stop_utc_ns, orientation)


def _sample(truth: Truth, frame_utc_ns: IntArray) -> Ephemeris:
    """The true trajectory over the frames and a margin, as an ephemeris with a state each ten seconds."""
    start = max(int(frame_utc_ns[0]) - _EPHEMERIS_MARGIN_NS, truth.start_utc_ns)
    stop = min(int(frame_utc_ns[-1]) + _EPHEMERIS_MARGIN_NS, truth.stop_utc_ns)
    times = np.append(np.arange(start, stop, _EPHEMERIS_STEP_NS, dtype=np.int64), stop)
    position, velocity = truth.states(times)
    return ephemeris_from_states(times, position, velocity)


def _with_error(ephemeris: Ephemeris, sigma_m: float, seed: int) -> Ephemeris:
    """The ephemeris displaced by one constant offset in RTN: what orbit determination leaves to the ground."""
    if sigma_m == 0.0:
        return ephemeris
    segment = ephemeris.segments[0]
    offset = sigma_m * np.random.default_rng((seed, 2**33)).standard_normal(3)
    rtn_from_icrf = rtn_from_inertial(segment.position_m, segment.velocity_m_s)
    displaced = segment.position_m + np.einsum("nji,j->ni", rtn_from_icrf, offset)
    return ephemeris_from_states(segment.utc_ns, displaced, segment.velocity_m_s)


def _catalogue_near_track(world: World) -> CraterCatalogue:
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


def _gravity(name: str, data: DataFolder) -> GravityField:
    if name == "auto":
        return default_gravity(data)
    return builtin_gravity() if name == "builtin" else load_gravity(Path(name))


def _orientation(name: str, data: DataFolder) -> Orientation:
    if name == "iau":
        return IauOrientation()
    if name == "de421" and data.orientation_bpc is None:
        raise ScenarioError(
            "dynamics.orientation 'de421' needs the binary orientation kernel of the data folder, "
            "found none; use 'auto' or 'iau'"
        )
    return default_orientation(data)


def _save_png(path: Path, image: NDArray[np.uint8]) -> None:
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    good, encoded = cv2.imencode(".png", image[..., ::-1])
    if not good:
        raise OSError(f"PNG encoder refused an image of shape {image.shape}")
    path.write_bytes(encoded.tobytes())


def _require_replaceable(out: Path) -> None:
    """Refuse to overwrite anything that is not a pass archive of an earlier run."""
    if out.exists() and not (out.is_dir() and (not any(out.iterdir()) or (out / "manifest.json").is_file())):
        raise ScenarioError(
            f"{out}: expected a new folder or an earlier pass archive, found something else; "
            "choose another --out"
        )
