"""Kidnaps and burns of the true flight."""

from __future__ import annotations

import numpy as np
import pytest

from lunar.elements import Elements, icrf_state_from_elements
from lunar.frames import IauOrientation
from lunar.gravity import builtin_gravity
from lunar.propagation import ForceModel, propagate
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.sim.orbit.disturbances import changed, executed, turned_state
from payload_emulator.sim.orbit.truth import Truth

EPOCH = parse_utc("2029-08-07T00:00:00Z")
MODEL = ForceModel(builtin_gravity(), IauOrientation(), 8)
JUMP = EPOCH + 600 * 10**9


@pytest.fixture(scope="module")
def truth() -> Truth:
    epoch_s = float(tdb_s_from_utc_ns(EPOCH))
    position, velocity = icrf_state_from_elements(
        Elements(1_768_180.0, 0.006908, *np.radians([89.076, 3.164, 333.604, 8.882])),
        epoch_s,
        builtin_gravity().gm_m3_s2,
    )
    flown = propagate(epoch_s, position, velocity, 1_900.0, MODEL)
    return Truth(flown.state, EPOCH, EPOCH + 1_800 * 10**9, IauOrientation())


@pytest.mark.parametrize("heading_rad", [0.0, 1.0, 4.0])
def test_a_kidnap_moves_by_its_distance_on_the_sphere_and_keeps_the_shape_of_the_orbit(
    truth: Truth, heading_rad: float
) -> None:
    before = np.concatenate([part[0] for part in truth.states(JUMP)])
    after = turned_state(before, 20e3, heading_rad)
    radius = np.linalg.norm(before[:3])
    angle = np.arccos(before[:3] @ after[:3] / radius**2)
    assert radius * angle == pytest.approx(20e3, rel=1e-6)
    assert np.linalg.norm(after[:3]) == pytest.approx(radius, rel=1e-12)
    assert after[:3] @ after[3:] == pytest.approx(before[:3] @ before[3:], abs=1e-3)


def test_before_a_change_the_flight_is_the_old_one_and_after_it_goes_on_from_the_new_state(
    truth: Truth,
) -> None:
    kick = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 5.0])
    burnt = changed(truth, JUMP, lambda state: state + kick, MODEL)
    times = EPOCH + np.array([0, 599, 600, 601, 1_700]) * 10**9
    old, new = np.concatenate(truth.states(times), axis=1), np.concatenate(burnt.states(times), axis=1)
    np.testing.assert_array_equal(new[:2], old[:2])
    np.testing.assert_allclose(new[2], old[2] + kick, atol=1e-6)
    # A second later the place differs by the kick's length, half an hour later by more than the kick times the time.
    assert np.linalg.norm(new[3, :3] - old[3, :3]) == pytest.approx(5.0, rel=1e-3)
    assert np.linalg.norm(new[4, :3] - old[4, :3]) > 2_000.0
    assert burnt.breaks_utc_ns == (JUMP,)


def test_plans_differ_from_burns_by_the_declared_share() -> None:
    done = np.array([3.0, -4.0, 0.0])
    burns = [executed(EPOCH + k, done, 0.02, (1, 2)) for k in range(400)]
    errors = np.array([burn.planned_m_s - burn.done_m_s for burn in burns])
    np.testing.assert_allclose([burn.sigma_m_s for burn in burns], 0.1, rtol=1e-12)
    # 1,200 draws: the standard deviation is known to 2 %.
    assert errors.std() == pytest.approx(0.1, rel=0.1)
    again = executed(EPOCH, done, 0.02, (1, 2))
    np.testing.assert_array_equal(again.planned_m_s, burns[0].planned_m_s)


def test_a_scenario_cannot_move_the_spacecraft_and_maintain_its_orbit_at_once() -> None:
    text = 'name = "x"\n[disturbances]\nkidnap_distance_km = 5.0\n'
    with pytest.raises(ScenarioError, match=r"maneuvers.enabled must be false.*where \[disturbances\]"):
        parse_scenario(text)
    assert parse_scenario(text + "[maneuvers]\nenabled = false\n").disturbances.kidnap_distance_km == 5.0
