"""The true orbit of a scenario: its forces, its first state, its propagation with or without burns, as an ephemeris."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.constants import NS
from lunar.datafolder import DataFolder, default_gravity, default_orientation
from lunar.elements import Elements, icrf_state_from_elements, state_from_elements
from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.errors import ImpactError
from lunar.frames import IauOrientation, Orientation, mci_from_icrf
from lunar.gravity import GravityField, builtin_gravity, load_gravity
from lunar.maneuvers import Maneuver, ManeuverRule, propagate_with_maneuvers
from lunar.propagation import ForceModel, SolarPressure, Trajectory, propagate
from lunar.timescales import tai_ns_from_utc_ns, tdb_minus_tt_s, tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import Scenario

_BEFORE_IMPACT_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ScenarioOrbit:
    """A propagated scenario."""

    trajectory: Trajectory
    maneuvers: tuple[Maneuver, ...]
    model: ForceModel
    epoch_utc_ns: int


def open_gravity(name: str, data: DataFolder) -> GravityField:
    """Open the field a scenario names: "auto" (the best available), "builtin", or a coefficient file."""
    if name == "auto":
        return default_gravity(data)
    return builtin_gravity() if name == "builtin" else load_gravity(Path(name))


def open_orientation(name: str, data: DataFolder) -> Orientation:
    """Open the lunar orientation a scenario names: "auto", "iau" or "de421"."""
    if name == "iau":
        return IauOrientation()
    if name == "de421" and data.orientation_bpc is None:
        raise ScenarioError(
            "dynamics.orientation 'de421' needs the binary orientation kernel of the data folder, found none; "
            "use 'auto' or 'iau'"
        )
    return default_orientation(data)


def force_model(scenario: Scenario, data: DataFolder) -> ForceModel:
    """Return the forces of a scenario; its degree is cut to what the available field holds."""
    dynamics = scenario.dynamics
    gravity = open_gravity(dynamics.gravity, data)
    orientation = open_orientation(dynamics.orientation, data)
    area_to_mass = dynamics.solar_area_to_mass_m2_kg
    return ForceModel(
        gravity,
        orientation,
        min(dynamics.degree, gravity.degree),
        earth=dynamics.earth,
        sun=dynamics.sun,
        solar_pressure=SolarPressure(area_to_mass, dynamics.solar_reflection) if area_to_mass > 0.0 else None,
    )


def initial_state_icrf(scenario: Scenario, gm_m3_s2: float) -> FloatArray:
    """Position (m) and velocity (m/s), shape (6,), Moon-centred ICRF axes, of a scenario's orbit at its epoch."""
    orbit = scenario.orbit
    if orbit.position_km:
        state = 1e3 * np.array([*orbit.position_km, *orbit.velocity_km_s])
        if orbit.frame == "ICRF":
            return state
        icrf_from_mci = np.asarray(mci_from_icrf(tdb_s_from_utc_ns(scenario.epoch_utc_ns))).T
        return np.concatenate([icrf_from_mci @ state[:3], icrf_from_mci @ state[3:]])
    elements = Elements(
        orbit.semi_major_axis_km * 1e3,
        orbit.eccentricity,
        *np.radians(
            [orbit.inclination_deg, orbit.raan_deg, orbit.argument_of_perilune_deg, orbit.true_anomaly_deg]
        ).tolist(),
    )
    if orbit.frame == "ICRF":
        return np.concatenate(state_from_elements(elements, gm_m3_s2))
    epoch_tdb_s = tdb_s_from_utc_ns(scenario.epoch_utc_ns)
    return np.concatenate(icrf_state_from_elements(elements, epoch_tdb_s, gm_m3_s2))


def propagate_scenario(scenario: Scenario, model: ForceModel, duration_s: float) -> ScenarioOrbit:
    """Propagate the orbit from the scenario's epoch on, with the burns of its rule where that is enabled.

    Raises
    ------
    ImpactError
        The orbit hits the Moon.
    ScenarioError
        The scenario flies an ephemeris file, so that there is nothing to propagate.
    """
    if scenario.orbit.oem:
        raise ScenarioError(
            f"scenario {scenario.name}: expected orbital elements or a state to propagate, "
            f"found the ephemeris {scenario.orbit.oem}"
        )
    state = initial_state_icrf(scenario, model.gm_m3_s2)
    return propagate_from(scenario, model, scenario.epoch_utc_ns, state, duration_s)


def propagate_to_impact(
    scenario: Scenario, model: ForceModel, duration_s: float
) -> tuple[ScenarioOrbit, ImpactError | None]:
    """Return the orbit from the scenario's epoch on as far as it lives, and the impact that ends it before.

    Raises
    ------
    ImpactError
        The orbit hits the Moon within seconds.
    """
    try:
        return propagate_scenario(scenario, model, duration_s), None
    except ImpactError as impact:
        lived_s = (impact.utc_ns - scenario.epoch_utc_ns) / NS - _BEFORE_IMPACT_S
        if lived_s <= 0.0:
            raise
        return propagate_scenario(scenario, model, lived_s), impact


def propagate_from(
    scenario: Scenario, model: ForceModel, epoch_utc_ns: int, state_icrf: FloatArray, duration_s: float
) -> ScenarioOrbit:
    """Return the orbit from a state (6,) in m and m/s, with the burns of a scenario.

    Raises
    ------
    ImpactError
        The orbit hits the Moon.
    """
    epoch_tdb_s, state = tdb_s_from_utc_ns(epoch_utc_ns), state_icrf
    rule = scenario.maneuvers
    maneuvers: tuple[Maneuver, ...] = ()
    if rule.enabled:
        trajectory, maneuvers = propagate_with_maneuvers(
            epoch_tdb_s,
            state[:3],
            state[3:],
            duration_s,
            model,
            ManeuverRule(rule.periselene_altitude_km * 1e3, rule.semi_major_axis_km * 1e3, rule.eccentricity),
        )
    else:
        trajectory = propagate(epoch_tdb_s, state[:3], state[3:], duration_s, model)
    return ScenarioOrbit(trajectory, maneuvers, model, epoch_utc_ns)


def sample(orbit: ScenarioOrbit, step_s: float, object_name: str = "SELENITA") -> tuple[Ephemeris, FloatArray]:
    """Return the ephemeris on a regular grid, a segment with states at its ends between burns; its states (n, 6)."""
    last_s = float(orbit.trajectory.elapsed_s[-1])
    steps = int(np.floor(last_s / step_s + 1e-9))
    grid = orbit.epoch_utc_ns + np.rint(np.arange(steps + 1) * (step_s * NS)).astype(np.int64)
    elapsed = np.minimum(_elapsed_s(grid, orbit.epoch_utc_ns), last_s)
    edges = [int(grid[0]), *(burn.utc_ns for burn in orbit.maneuvers), int(grid[-1])]
    segments = []
    for arc, start, stop in zip(orbit.trajectory.arcs(), edges[:-1], edges[1:], strict=True):
        inside = grid[(grid > start) & (grid < stop)]
        utc_ns = np.unique(np.concatenate([[start], inside, [stop]]))
        at = np.clip(_elapsed_s(utc_ns, orbit.epoch_utc_ns), arc.elapsed_s[0], arc.elapsed_s[-1])
        states = arc.state_after(at)
        segments.append(
            EphemerisSegment(
                utc_ns,
                states[:, :3],
                states[:, 3:],
                object_name=object_name,
                object_id=object_name,
                degree=min(7, 2 * len(utc_ns) - 1),
            )
        )
    return Ephemeris(tuple(segments)), orbit.trajectory.state_after(elapsed)


def _elapsed_s(utc_ns: IntArray, epoch_utc_ns: int) -> FloatArray:
    """Return TDB seconds since an epoch; differences of integers first, so that nothing is lost to the size of TDB."""
    tai_s = (tai_ns_from_utc_ns(utc_ns) - tai_ns_from_utc_ns(epoch_utc_ns)) / NS
    start_s = tdb_s_from_utc_ns(epoch_utc_ns)
    return np.asarray(tai_s + tdb_minus_tt_s(start_s + tai_s) - tdb_minus_tt_s(start_s), dtype=np.float64)
