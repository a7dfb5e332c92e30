"""The simulated world of a scenario: its true flight, its terrain, its light, and what the payload's senses get."""

import functools
import itertools
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.camera import BrownCamera, PinholeCamera, pointed_camera_from_mcmf
from lunar.catalogue import CraterCatalogue
from lunar.comparison import check_pointing
from lunar.constants import MOON_RADIUS_M, NS
from lunar.datafolder import DataFolder
from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.errors import ImpactError
from lunar.frames import Orientation, rtn_from_inertial, spherical_from_mcmf
from lunar.gravity import GravityField
from lunar.maneuvers import Maneuver
from lunar.messages.ephemeris_files import load_orbit
from lunar.plausible import HEIGHT_M
from lunar.propagation import ForceModel
from lunar.timescales import format_utc, parse_utc, tdb_s_from_utc_ns, ticks_from_utc_ns, utc_ns_from_tdb_s
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import ReferenceSection, Scenario, WindowSection
from payload_emulator.session.world.external import ExternalFrames, external_scenario
from payload_emulator.session.world.orbit import force_model, propagate_from, propagate_to_impact
from payload_emulator.session.world.rims import rims_of, sources_of
from payload_emulator.sim.orbit.truth import (
    Crossing,
    TrueBurn,
    Truth,
    changed,
    executed,
    find_crossings,
    frame_times,
    require_above_ground,
    spliced,
    turned_state,
)
from payload_emulator.sim.terrain.opening import open_terrain
from payload_emulator.sim.terrain.raster import RasterTerrain
from payload_emulator.sim.terrain.registering import fitted
from payload_emulator.sim.terrain.registration import joined
from payload_emulator.sim.terrain.tiles import Terrain
from tmtc.packets.pus import TICKS_PER_SECOND

CHUNK_S = 86_400.0
"""Time that the orbit is propagated at once; another division gives other last digits."""

_TICKS_NS = 200_000
_EPHEMERIS_STEP_NS = 10 * NS
_EPHEMERIS_MARGIN_NS = 120 * NS
_BEFORE_JUMP_NS = 10_000
_EDGE_NS = 1_000
_SEARCH_CHUNK_DAYS = 15.0
_CATALOGUE_MARGIN_M = 15_000.0
REGISTRATION = "crater list "
"""Start of the name that says where the crater list is registered to the terrain."""
# Rims within this of the frames tell the registration where no product does: a 15 degree tile.
_REGISTERED_DEG = 7.5


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """The simulated world of a scenario: what is true in it, and when the payload looks.

    `external` holds frames that others took, which take the place of rendered ones. `ends` says where the orbit hits
    the Moon, if that is within the days searched.
    """

    scenario: Scenario
    truth: Truth
    terrain: Terrain
    model: ForceModel
    burns: tuple[TrueBurn, ...]
    frame_utc_ns: IntArray
    data_names: tuple[str, ...]
    external: ExternalFrames | None = None
    ends: str = ""

    @property
    def clock_utc_ns(self) -> int:
        """Time at which the error of the clock is its offset: as the scenario states it, else the first frame."""
        stated = self.scenario.clock.reference
        return _parsed_utc(stated) if stated else int(self.frame_utc_ns[0])

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
        return pointed_camera_from_mcmf(position_mcmf_m, np.radians(section.tilt_deg), np.radians(section.yaw_deg))


_parsed_utc = functools.lru_cache(maxsize=16)(parse_utc)


def build_world(scenario: Scenario, data: DataFolder, external: ExternalFrames | None = None) -> World:
    """Build the world of a scenario, flown as far as its observation windows reach.

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
    truth, burns, windows, ends = _fly_to_windows(scenario, model, terrain)
    interval_ns = round(scenario.camera.frame_interval_s * NS)
    band_rad = _band_rad(scenario)
    frames = [frame_times(truth, start, stop, interval_ns, band_rad) for start, stop in windows]
    frame_utc_ns = np.concatenate(frames) if frames else np.zeros(0, dtype=np.int64)
    # An arc ends where the latitude limit interrupts the frames.
    arc = np.cumsum(np.diff(frame_utc_ns, prepend=frame_utc_ns[:1]) > interval_ns)
    frame_utc_ns = frame_utc_ns[arc % scenario.window.arc_interval == 0]
    if frame_utc_ns.size == 0:
        raise ScenarioError(
            f"scenario {scenario.name}: the observation window holds no frame between latitudes "
            f"{_degrees(scenario.window.latitude_band_deg)}"
        )
    truth, burns = _disturbed(scenario, truth, burns, int(frame_utc_ns[0]), model)
    _register(terrain, truth, frame_utc_ns)
    require_above_ground(truth, frame_utc_ns, terrain.height_m, HEIGHT_M.high)
    names = _names(terrain, model, truth, frame_utc_ns)
    return World(scenario, truth, terrain, model, burns, frame_utc_ns, names, ends=ends)


def _external_world(scenario: Scenario, external: ExternalFrames, terrain: Terrain, model: ForceModel) -> World:
    """Return the world of external frames."""
    ephemeris = load_orbit(external.ephemeris)
    truth = _truth_of_ephemeris(ephemeris, model.orientation)
    first, last = int(external.utc_ns[0]), int(external.utc_ns[-1])
    if first < truth.start_utc_ns or last > truth.stop_utc_ns:
        raise ScenarioError(
            f"{external.ephemeris}: expected states from {format_utc(first)} to {format_utc(last)}, found "
            f"{format_utc(truth.start_utc_ns)} to {format_utc(truth.stop_utc_ns)}"
        )
    if external.attitude_utc_ns.size:
        check_pointing(ephemeris, external.attitude_utc_ns, external.q_wxyz)
    _register(terrain, truth, external.utc_ns)
    require_above_ground(truth, external.utc_ns, terrain.height_m, HEIGHT_M.high)
    names = (
        f"external images {external.files[0].parent.name} ({external.words}), orbit of {ephemeris.words}",
        *_names(terrain, model, truth, external.utc_ns),
    )
    return World(scenario, truth, terrain, model, (), external.utc_ns, names, external)


def open_world(scenario: Scenario, data: DataFolder, *, is_declared: bool = False) -> World:
    """Return the world of a scenario from its epoch on, flown a day at a time, whatever its windows.

    Parameters
    ----------
    is_declared
        Whether the scenario comes from a mission description, whose clock without a reference counts from the epoch.

    Raises
    ------
    ScenarioError
        The scenario flies an ephemeris file or has disturbances that belong to one arc, or has no window.
    """
    section = scenario.disturbances
    if scenario.orbit.oem or section.kidnap_distance_km > 0.0 or section.burn_delta_v_m_s != 0.0:
        found = "orbit.oem" if scenario.orbit.oem else "a kidnap or a burn in [disturbances]"
        raise ScenarioError(f"scenario {scenario.name}: expected an orbit to propagate without end, found {found}")
    world = build_world(scenario, data)
    truth, burns, _ = _propagate(scenario, world.model, CHUNK_S / 86_400.0)
    reference = scenario.epoch_utc_ns if is_declared else world.clock_utc_ns
    if not scenario.clock.reference:
        scenario = replace(scenario, clock=replace(scenario.clock, reference=format_utc(reference, 9)))
    return replace(world, scenario=scenario, truth=truth, burns=burns)


def scenario_terrain(scenario: Scenario, data: DataFolder) -> Terrain:
    """Return the terrain of a scenario."""
    section = scenario.terrain
    terrain = open_terrain(
        section.source,
        data,
        scenario.seed,
        registration_north_east_m=section.registration_north_east_m,
        photographs=section.photographs,
        heights=section.heights,
    )
    terrain.sources = sources_of(scenario, data)
    return terrain


def _register(terrain: Terrain, truth: Truth, frame_utc_ns: IntArray) -> None:
    """Register the catalogue to rasters where no product holds beneath the frames, from the rims near them."""
    latitude, longitude, _ = spherical_from_mcmf(truth.positions_mcmf(frame_utc_ns))
    known = terrain.registration
    missing = slice(None) if known is None else np.isnan(known.at(latitude, longitude)[1])
    latitude, longitude = latitude[missing], longitude[missing]
    if not isinstance(terrain, RasterTerrain) or not latitude.size:
        return
    craters, reach_m = terrain.listed, math.radians(_REGISTERED_DEG) * MOON_RADIUS_M
    every = max(1, latitude.size // 200)
    near = [
        craters.near(float(north), float(east), reach_m)
        for north, east in zip(latitude[::every], longitude[::every], strict=True)
    ]
    found = fitted(craters.select(np.unique(np.concatenate(near))), terrain.height_files)
    if found is not None:
        terrain.register(found if known is None else joined(known, found))


def registered_share(terrain: Terrain, truth: Truth, frame_utc_ns: IntArray) -> float:
    """Return the share of frames beneath which the crater list is registered to the terrain."""
    if terrain.registration is None:
        return 0.0
    latitude, longitude, _ = spherical_from_mcmf(truth.positions_mcmf(frame_utc_ns))
    return float(np.isfinite(terrain.registration.at(latitude, longitude)[1]).mean())


def _registration_name(terrain: Terrain, truth: Truth, frame_utc_ns: IntArray) -> tuple[str, ...]:
    if not terrain.is_real:
        return ()
    share = registered_share(terrain, truth, frame_utc_ns)
    if not share:
        return (f"{REGISTRATION}not registered to the terrain",)
    return (f"{REGISTRATION}registered to the terrain in {100.0 * share:.0f} % of the frames",)


def _names(terrain: Terrain, model: ForceModel, truth: Truth, frame_utc_ns: IntArray) -> tuple[str, ...]:
    """Data that a world is made of."""
    return (
        *terrain.data_names,
        *_registration_name(terrain, truth, frame_utc_ns),
        f"gravity {model.gravity.name} to degree {model.degree}",
        f"orientation {model.orientation.name}",
    )


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
        joint_utc_ns + round(duration_s * NS),
        truth.orientation,
        (*truth.breaks_utc_ns, *(burn.utc_ns for burn in burns)),
    )
    return longer, burns


def _disturbed(
    scenario: Scenario, truth: Truth, burns: tuple[TrueBurn, ...], first_utc_ns: int, model: ForceModel
) -> tuple[Truth, tuple[TrueBurn, ...]]:
    """Return the flight with the disturbances of the scenario, and all its burns."""
    section = scenario.disturbances
    if section.burn_delta_v_m_s != 0.0:
        utc_ns = first_utc_ns + round(section.burn_at_s * NS)
        velocity = truth.states(utc_ns)[1][0]
        done = section.burn_delta_v_m_s * velocity / np.linalg.norm(velocity)
        burn = executed(utc_ns, done, scenario.maneuvers.execution_error_fraction, (scenario.seed, 2**36))
        truth = changed(truth, utc_ns, lambda state: state + np.concatenate([np.zeros(3), done]), model)
        burns = (*burns, replace(burn, declared=section.burn_declared))
    if section.kidnap_distance_km > 0.0:
        heading = np.random.default_rng((scenario.seed, 2**37)).uniform(0.0, 2.0 * np.pi)
        truth = changed(
            truth,
            first_utc_ns + round(section.kidnap_at_s * NS),
            lambda state: turned_state(state, 1e3 * section.kidnap_distance_km, heading),
            model,
        )
    return truth, burns


def clock_ticks(world: World, utc_ns: int) -> int:
    """Return the on-board clock's reading: ideal ticks, an offset, and a drift since the reference of the clock."""
    clock = world.scenario.clock
    elapsed_s = (utc_ns - world.clock_utc_ns) / NS
    error_s = clock.offset_s + clock.drift_ppm * 1e-6 * elapsed_s
    return int(ticks_from_utc_ns(utc_ns)) + round(error_s * TICKS_PER_SECOND)


def first_utc_ns(world: World, ticks: int) -> int:
    """Return the first time at which the clock of a scenario reads `ticks`."""
    utc_ns = world.clock_utc_ns
    for _ in range(4):
        utc_ns += round((ticks - clock_ticks(world, utc_ns)) * NS / TICKS_PER_SECOND)
    # The reading rises by one tick in 15 us; from a time within some ticks of it, the first is found by bisection.
    low, high = utc_ns - _TICKS_NS, utc_ns + _TICKS_NS
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if clock_ticks(world, middle) >= ticks else (middle, high)
    return high


def frame_utc_ns(world: World, ticks: int) -> int:
    """Return the time of an image whose on-board time is `ticks`: a frame of the scenario, else the first instant."""
    first = first_utc_ns(world, ticks)
    number = int(np.searchsorted(world.frame_utc_ns, first))
    if number < world.frame_utc_ns.size and clock_ticks(world, int(world.frame_utc_ns[number])) == ticks:
        return int(world.frame_utc_ns[number])
    return first


def _fly_to_windows(
    scenario: Scenario, model: ForceModel, terrain: Terrain
) -> tuple[Truth, tuple[TrueBurn, ...], list[tuple[int, int]], str]:
    """Propagate in chunks until the wanted windows are found; truth, burns on the way, windows, end of the orbit."""
    window = scenario.window
    not_before = parse_utc(window.start) if window.start else scenario.epoch_utc_ns
    if scenario.orbit.oem:
        truth = _truth_of_ephemeris(load_orbit(Path(scenario.orbit.oem)), model.orientation)
        return truth, (), _windows(scenario, truth, terrain, max(not_before, truth.start_utc_ns)), ""
    reach_days = min(_SEARCH_CHUNK_DAYS, window.search_days)
    if window.search == "none":
        reach_days = (not_before - scenario.epoch_utc_ns) / NS / 86_400.0 + window.duration_s / 86_400.0 + 0.01
    while True:
        truth, burns, impact = _propagate(scenario, model, reach_days)
        ends = "" if impact is None else str(impact)
        if window.search == "none":
            if impact is not None and truth.stop_utc_ns < not_before + round(window.duration_s * NS):
                raise impact
            return truth, burns, _windows(scenario, truth, terrain, not_before), ends
        crossings = _crossings(scenario, truth, terrain, not_before)
        found = [(one.start_utc_ns, one.stop_utc_ns) for one in crossings if one.observable]
        if len(found) >= window.passes:
            return truth, burns, found[: window.passes], ends
        if ends or reach_days >= window.search_days:
            raise ScenarioError(
                f"scenario {scenario.name}: window.search expected {window.passes} {window.direction} window(s) over "
                f"{terrain.name} within {window.search_days} days (window.search_days), found {len(found)}; "
                f"{ends or _no_band(crossings, window)}"
            )
        reach_days = min(2.0 * reach_days, window.search_days)


def _no_band(crossings: list[Crossing], window: WindowSection) -> str:
    """Return the latitudes that lack terrain on the crossing that lacks the least."""
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


def _windows(scenario: Scenario, truth: Truth, terrain: Terrain, not_before_utc_ns: int) -> list[tuple[int, int]]:
    window = scenario.window
    if window.search == "none":
        stop_utc_ns = not_before_utc_ns + round(window.duration_s * NS)
        return [(not_before_utc_ns, min(stop_utc_ns, truth.stop_utc_ns))]
    crossings = _crossings(scenario, truth, terrain, not_before_utc_ns)
    return [(one.start_utc_ns, one.stop_utc_ns) for one in crossings if one.observable][: window.passes]


def _crossings(scenario: Scenario, truth: Truth, terrain: Terrain, not_before_utc_ns: int) -> list[Crossing]:
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


def _propagate(
    scenario: Scenario, model: ForceModel, days: float
) -> tuple[Truth, tuple[TrueBurn, ...], ImpactError | None]:
    """Return the flight over some days, or up to the impact that ends it before."""
    orbit, impact = propagate_to_impact(scenario, model, days * 86_400.0)
    stop_utc_ns = scenario.epoch_utc_ns + round(days * 86_400.0 * NS)
    if impact is not None:
        stop_utc_ns = scenario.epoch_utc_ns + math.floor(orbit.trajectory.elapsed_s[-1] * NS)
    burns = _executed(scenario, orbit.maneuvers)
    truth = Truth(
        orbit.trajectory.state,
        scenario.epoch_utc_ns,
        stop_utc_ns,
        model.orientation,
        tuple(burn.utc_ns for burn in burns),
    )
    return truth, burns, impact


def _executed(scenario: Scenario, maneuvers: tuple[Maneuver, ...]) -> tuple[TrueBurn, ...]:
    share, seed = scenario.maneuvers.execution_error_fraction, (scenario.seed, 2**36)
    return tuple(executed(burn.utc_ns, burn.delta_v_icrf_m_s, share, seed) for burn in maneuvers)


def _truth_of_ephemeris(ephemeris: Ephemeris, orientation: Orientation) -> Truth:
    breaks_utc_ns = tuple(one.start_utc_ns for one in ephemeris.segments[1:])
    edges = np.array([ephemeris.start_utc_ns, *breaks_utc_ns, ephemeris.stop_utc_ns], dtype=np.int64)

    def state(tdb_s: FloatArray) -> FloatArray:
        utc_ns = utc_ns_from_tdb_s(tdb_s)
        # TDB seconds resolve some tens of nanoseconds: an instant at an edge may come back on its other side.
        edge = edges[np.maximum(np.searchsorted(edges, utc_ns + _EDGE_NS, side="right") - 1, 0)]
        return np.concatenate(ephemeris.at(np.where(np.abs(utc_ns - edge) <= _EDGE_NS, edge, utc_ns)), axis=1)

    return Truth(state, ephemeris.start_utc_ns, ephemeris.stop_utc_ns, orientation, breaks_utc_ns)


def sample_truth(truth: Truth, frame_utc_ns: IntArray, object_name: str = "SELENITA") -> Ephemeris:
    """Sample the true trajectory over the frames and a margin: a state each ten seconds, a segment between jumps."""
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
        position += velocity * ((times - asked) / NS)[:, None]
        segments.append(
            EphemerisSegment(
                times,
                position,
                velocity,
                object_name=object_name,
                object_id=object_name,
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
        u = rate * (segment.utc_ns - ephemeris.start_utc_ns) / NS
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
    """Return the craters of 3 to 30 km that any frame could see, with the heights of their rims."""
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
    return rims_of(world.scenario, world.terrain, np.unique(np.concatenate(near)))
