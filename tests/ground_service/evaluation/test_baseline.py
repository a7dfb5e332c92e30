"""The start state flown on, against the circle of two bodies and against SciPy's integration of J2, Earth and Sun."""

import math

import numpy as np
from numpy.testing import assert_allclose
from pytest import mark, raises
from scipy.integrate import solve_ivp

from ground_service.evaluation.smoother import BASELINE_DEGREE, StartState, propagated_positions
from lunar.errors import ImpactError
from lunar.gravity import GravityField
from lunar.third_bodies import earth_position_icrf_m, sun_position_icrf_m
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from tests.ground_service.evaluation.still import Still

EPOCH = parse_utc("2029-08-07T00:00:00Z")
MOON_M, GM, J2 = 1_738_000.0, 4.9028e12, 2.0e-4
RADIUS_M = 1_800_000.0
SPEED_M_S = math.sqrt(GM / RADIUS_M)
SECONDS = np.array([0.0, 600.0, 1800.0, 5400.0])
TIMES = EPOCH + (SECONDS * 1e9).astype(np.int64)


def oblate(degree=2):
    """J2 alone: the fully normalised C20 is -J2 over root five."""
    c = np.zeros((degree + 1, degree + 1))
    c[0, 0] = 1.0
    if degree >= 2:
        c[2, 0] = -J2 / math.sqrt(5.0)
    return GravityField("oblate", GM, MOON_M, c, np.zeros_like(c))


INCLINED = np.array([0.0, math.cos(1.0), math.sin(1.0)])
START = StartState(EPOCH, np.array([RADIUS_M, 0.0, 0.0]), SPEED_M_S * INCLINED)


def flown(degree, field=None, **more):
    return propagated_positions(START, TIMES, field or oblate(), degree, Still(), **more)


def circle():
    angle = SPEED_M_S / RADIUS_M * SECONDS[:, None]
    return np.array(RADIUS_M * (np.cos(angle) * np.array([1.0, 0.0, 0.0]) + np.sin(angle) * INCLINED))


EARTH = (3.986004355e14, lambda tdb_s: np.asarray(earth_position_icrf_m(tdb_s)))
SUN = (1.32712440041e20, lambda tdb_s: np.asarray(sun_position_icrf_m(tdb_s)))


def integrated(j2=J2, bodies=()):
    """The same orbit with the accelerations written out (Vallado, 4th edition, equations 8-28 and 8-34)."""
    epoch_s = float(tdb_s_from_utc_ns(EPOCH))

    def rate(seconds, state):
        x, y, z = state[:3]
        r = math.sqrt(x * x + y * y + z * z)
        factor = -1.5 * j2 * GM * MOON_M**2 / r**5
        pull = -GM * state[:3] / r**3
        pull = pull + factor * state[:3] * (np.array([1.0, 1.0, 3.0]) - 5.0 * (z / r) ** 2)
        for gm, place in bodies:
            body = place(epoch_s + seconds)
            apart = body - state[:3]
            pull = pull + gm * (apart / np.linalg.norm(apart) ** 3 - body / np.linalg.norm(body) ** 3)
        return np.concatenate([state[3:], pull])

    start = np.concatenate([START.position_icrf_m, START.velocity_icrf_m_s])
    found = solve_ivp(rate, (0.0, SECONDS[-1]), start, "DOP853", SECONDS, rtol=1e-12, atol=1e-6)
    return np.array(found.y[:3].T)


@mark.parametrize("degree", [0, 1])
def test_a_field_is_not_flown_past_the_degree_that_is_asked_for(degree):
    assert_allclose(flown(degree, third_bodies=False), circle(), atol=0.01)


@mark.parametrize("degree", [2, 50])
def test_a_field_is_flown_to_the_degree_that_it_has(degree):
    found = flown(degree, third_bodies=False)
    assert_allclose(found, integrated(), atol=0.05)
    assert np.linalg.norm(found[-1] - circle()[-1]) > 1_000.0


def test_earth_and_sun_pull_unless_they_are_left_out():
    """Each pulls by its GM (DE440): the Earth moves the orbit by tens of metres, the Sun by some tenths of a metre."""
    moved = [integrated(0.0, bodies) for bodies in ((), (EARTH,), (EARTH, SUN))]
    assert np.linalg.norm(moved[1][-1] - moved[0][-1]) > 10.0
    assert np.linalg.norm(moved[2][-1] - moved[1][-1]) > 0.1
    assert_allclose(flown(0, oblate(0)), moved[2], atol=0.02)


def test_samples_before_the_start_have_no_position_and_an_orbit_that_meets_the_ground_is_refused():
    early = np.concatenate([[EPOCH - 1], TIMES])
    found = propagated_positions(START, early, oblate(), 0, Still(), third_bodies=False)
    assert np.isnan(found[0]).all() and found[1].tolist() == START.position_icrf_m.tolist()
    assert_allclose(found[1:], circle(), atol=0.01)
    none = propagated_positions(START, TIMES - 10**13, oblate(), 0, Still())
    assert none.shape == (4, 3) and np.isnan(none).all()
    falling = StartState(EPOCH, START.position_icrf_m, 0.9 * START.velocity_icrf_m_s)
    with raises(ImpactError):
        propagated_positions(falling, TIMES, oblate(), 0, Still(), third_bodies=False)


def test_the_baseline_is_flown_to_degree_fifty():
    assert BASELINE_DEGREE == 50
