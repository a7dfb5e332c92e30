"""Errors of the reference: their sizes, their dynamics, and that shipped scenarios have them."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lunar.ephemeris import Ephemeris, EphemerisSegment, ephemeris_from_states
from lunar.frames import IauOrientation, rtn_from_inertial
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import SHIPPED, ReferenceSection, load_scenario, parse_scenario
from payload_emulator.session.world.world import _truth_of_ephemeris, sample_truth, with_reference_error

GM = 4.9028e12
RADIUS_M = 1_767_400.0
RATE = math.sqrt(GM / RADIUS_M**3)
PERIOD_S = 2.0 * math.pi / RATE
SECTION = ReferenceSection(radial_m=10.0, transverse_m=30.0, normal_m=15.0)
TIMES_NS = np.arange(0, round(PERIOD_S) + 1, 30, dtype=np.int64) * 1_000_000_000


def circle():
    u = RATE * TIMES_NS / 1e9
    zero = np.zeros_like(u)
    position = RADIUS_M * np.stack([np.cos(u), np.sin(u), zero], axis=1)
    velocity = RATE * RADIUS_M * np.stack([-np.sin(u), np.cos(u), zero], axis=1)
    return ephemeris_from_states(TIMES_NS, position, velocity)


def errors_rtn_m(section: ReferenceSection, seed: int) -> np.ndarray:
    truth = circle()
    wrong = with_reference_error(truth, section, seed).segments[0]
    own = truth.segments[0]
    rtn = rtn_from_inertial(own.position_m, own.velocity_m_s)
    return np.einsum("nij,nj->ni", rtn, wrong.position_m - own.position_m)


def test_errors_have_the_declared_sizes() -> None:
    """300 draws of a root mean square: its own standard error is 4 %, so that 13 % is three of them."""
    squares = [np.mean(errors_rtn_m(SECTION, seed) ** 2, axis=0) for seed in range(300)]
    np.testing.assert_allclose(np.sqrt(np.mean(squares, axis=0)), SECTION.sigma_rtn_m, rtol=0.13)


def test_the_wrong_orbit_is_an_orbit() -> None:
    """Its first state, flown for a revolution in a point mass's field, stays on it to the squares left out (1 mm)."""
    wrong = with_reference_error(circle(), SECTION, 3).segments[0]
    state = np.concatenate([wrong.position_m[0], wrong.velocity_m_s[0]])

    def slope(s: np.ndarray) -> np.ndarray:
        return np.concatenate([s[3:], -GM * s[:3] / np.linalg.norm(s[:3]) ** 3])

    worst = 0.0
    for k in range(1, len(TIMES_NS)):
        for _ in range(3):  # Runge-Kutta of fourth order, steps of 10 s
            h = 10.0
            k1 = slope(state)
            k2 = slope(state + 0.5 * h * k1)
            k3 = slope(state + 0.5 * h * k2)
            k4 = slope(state + h * k3)
            state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        worst = max(worst, float(np.linalg.norm(state[:3] - wrong.position_m[k])))
    assert np.abs(errors_rtn_m(SECTION, 3)).max() > 5.0
    assert worst < 0.02


def test_the_same_seed_gives_the_same_errors_and_none_gives_the_truth() -> None:
    np.testing.assert_array_equal(errors_rtn_m(SECTION, 1), errors_rtn_m(SECTION, 1))
    assert np.abs(errors_rtn_m(SECTION, 1) - errors_rtn_m(SECTION, 2)).max() > 1.0
    truth = circle()
    assert with_reference_error(truth, ReferenceSection(), 1) is truth


def test_a_constant_offset_adds_in_squares() -> None:
    section = ReferenceSection(position_error_m=40.0, radial_m=30.0, transverse_m=60.0)
    assert section.sigma_rtn_m == pytest.approx((50.0, math.hypot(40.0, 60.0), 40.0))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("radial_m = 10.0", "reference.transverse_m must be at least twice reference.radial_m, found 0.0"),
        ("normal_m = -1.0", "reference.normal_m must be zero or more, found -1.0"),
    ],
)
def test_errors_that_no_orbit_has_are_refused(line: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        parse_scenario(f'name = "x"\n[reference]\n{line}\n')


@pytest.mark.parametrize(
    "path", sorted([*SHIPPED.glob("*.toml"), *SHIPPED.glob("suite/*.toml")]), ids=lambda path: path.stem
)
def test_the_reference_of_a_shipped_scenario_is_not_the_truth(path: Path) -> None:
    text = path.read_text()
    if "[dataset" in text:
        return
    sigma = load_scenario(path).reference.sigma_rtn_m
    assert 10.0 <= math.hypot(*sigma) <= 100.0


def test_the_arcs_of_a_flown_ephemeris_are_those_of_the_reference() -> None:
    """The second orbit solution is 10 km higher; the state at its start is its own, 20 ns of TDB notwithstanding."""
    one = circle().segments[0]
    first = replace(one, utc_ns=one.utc_ns[:60], tai_ns=None, **states_of(one, slice(None, 60), 1.0))
    second = replace(one, utc_ns=one.utc_ns[59:], tai_ns=None, **states_of(one, slice(59, None), 1.00565))
    flown = Ephemeris((first, second))
    found = sample_truth(_truth_of_ephemeris(flown, IauOrientation()), TIMES_NS[[30, 90]])
    assert found.segments[0].stop_utc_ns == found.segments[1].start_utc_ns == TIMES_NS[59]
    radii = np.linalg.norm([found.segments[0].position_m[-1], found.segments[1].position_m[0]], axis=1)
    np.testing.assert_allclose(radii, [RADIUS_M, 1.00565 * RADIUS_M], atol=1.0)


def states_of(one: EphemerisSegment, part: slice, scale: float) -> dict[str, np.ndarray]:
    return {"position_m": scale * one.position_m[part], "velocity_m_s": one.velocity_m_s[part]}
