"""Orbits of scenarios: which forces a scenario's keys switch on."""

import numpy as np
import pytest

from lunar.datafolder import find_data
from lunar.frames import mci_from_icrf
from lunar.propagation import SolarPressure
from lunar.timescales import tdb_s_from_utc_ns
from payload_emulator.session.scenario import format_scenario, parse_scenario
from payload_emulator.session.world.orbit import (
    force_model,
    initial_state_icrf,
    propagate_scenario,
    propagate_to_impact,
    sample,
)

BARE = 'name = "x"\n[maneuvers]\nenabled = false\n[dynamics]\ngravity = "builtin"\norientation = "iau"\n'


def test_sunlight_pushes_only_the_scenarios_that_ask_for_it() -> None:
    data = find_data(None)
    assert force_model(parse_scenario(BARE), data).solar_pressure is None
    lit = parse_scenario(BARE + "solar_area_to_mass_m2_kg = 0.02\nsolar_reflection = 1.4\n")
    assert force_model(lit, data).solar_pressure == SolarPressure(0.02, 1.4)


def test_a_revolution_in_sunlight_moves_the_orbit_by_metres_at_the_most() -> None:
    data = find_data(None)
    ends = []
    for extra in ("", "solar_area_to_mass_m2_kg = 0.02\n"):
        scenario = parse_scenario(BARE + extra)
        orbit = propagate_scenario(scenario, force_model(scenario, data), 7_200.0)
        ends.append(orbit.trajectory.state_after(7_200.0)[:3])
    # 4.5e-6 Pa x 0.02 m2/kg x 1.3 = 1.2e-7 m/s^2; over a revolution it moves the orbit by metres at the most.
    assert 0.01 < np.linalg.norm(ends[1] - ends[0]) < 10.0  # m


def test_a_cartesian_state_flies_the_orbit_of_the_elements_it_came_from() -> None:
    data = find_data(None)
    elements = parse_scenario(BARE)
    gm_m3_s2 = force_model(elements, data).gm_m3_s2
    icrf = initial_state_icrf(elements, gm_m3_s2)
    mci_from_icrf_now = np.asarray(mci_from_icrf(tdb_s_from_utc_ns(elements.epoch_utc_ns)))
    mci = np.concatenate([mci_from_icrf_now @ icrf[:3], mci_from_icrf_now @ icrf[3:]])
    for frame, state in (("ICRF", icrf), ("MCI", mci)):
        position, velocity = (state[:3] / 1e3).tolist(), (state[3:] / 1e3).tolist()
        text = f'{BARE}[orbit]\nframe = "{frame}"\nposition_km = {position}\nvelocity_km_s = {velocity}\n'
        scenario = parse_scenario(text)
        # Doubles of 1.8e6 m carry 2e-10 m; the factor of 1000 costs one rounding.
        np.testing.assert_allclose(initial_state_icrf(scenario, gm_m3_s2), icrf, atol=1e-8)
        assert parse_scenario(format_scenario(scenario)) == scenario
        ends = [
            propagate_scenario(one, force_model(one, data), 600.0).trajectory.state_after(600.0)
            for one in (elements, scenario)
        ]
        np.testing.assert_allclose(ends[0][:3], ends[1][:3], atol=1e-5)  # m


def test_an_orbit_into_the_ground_is_propagated_until_then() -> None:
    low = parse_scenario(
        'name = "x"\n[orbit]\nsemi_major_axis_km = 1745.0\neccentricity = 0.004\n[dynamics]\ndegree = 8\n'
        'gravity = "builtin"\n[maneuvers]\nenabled = false'
    )
    model = force_model(low, find_data(None))
    orbit, impact = propagate_to_impact(low, model, 30 * 86_400.0)
    assert impact is not None
    lived_s = (impact.utc_ns - low.epoch_utc_ns) / 1e9
    assert orbit.trajectory.elapsed_s[-1] == pytest.approx(lived_s - 1.0, abs=1e-3)
    ephemeris, _ = sample(orbit, 60.0)
    assert impact.utc_ns - 61_000_000_000 < ephemeris.stop_utc_ns < impact.utc_ns
    assert propagate_to_impact(low, model, 0.5 * lived_s)[1] is None
