"""Orbits of scenarios: which forces a scenario's keys switch on."""

import numpy as np

from lunar.datafolder import find_data
from lunar.propagation import SolarPressure
from payload_emulator.session.orbit import force_model, propagate_scenario
from payload_emulator.session.scenario import parse_scenario

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
