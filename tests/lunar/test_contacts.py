"""Shadow, night and occultation of a circular orbit against their closed forms."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lunar.constants import MOON_RADIUS_M, NS, SPEED_OF_LIGHT_M_S
from lunar.contacts import visibility_spans
from lunar.ephemeris import ephemeris_from_states
from lunar.errors import LunarError
from lunar.frames import IauOrientation
from lunar.third_bodies import earth_position_icrf_m, sun_position_icrf_m
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from lunar.visibility import GroundStation

START = parse_utc("2029-08-15T00:00:00")
RADIUS_M = 1_768_180.0
PERIOD_S = 6_672.0
NORMAL = np.array([0.6, -0.7, 0.2]) / np.linalg.norm([0.6, -0.7, 0.2])
REVOLUTIONS = 4
STATIONS = tuple(
    GroundStation(name, math.radians(latitude), math.radians(longitude), 0.0, 0.0)
    for name, latitude, longitude in (("here", 10.0, 20.0), ("antipode", -10.0, 200.0))
)


def circular_orbit(seconds):
    across = np.cross(NORMAL, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    other = np.cross(NORMAL, across)
    elapsed = np.arange(0.0, seconds + 1.0, 30.0)
    angle = (elapsed * 2 * math.pi / PERIOD_S)[:, None]
    speed = RADIUS_M * 2 * math.pi / PERIOD_S
    return ephemeris_from_states(
        START + np.rint(elapsed * NS).astype(np.int64),
        RADIUS_M * (np.cos(angle) * across + np.sin(angle) * other),
        speed * (np.cos(angle) * other - np.sin(angle) * across),
    )


@pytest.fixture(scope="module")
def found():
    return visibility_spans(circular_orbit(REVOLUTIONS * PERIOD_S), IauOrientation(), STATIONS)


def lasting_s(spans):
    return np.array([(stop - start) / NS for start, stop in spans])


def behind_s(target_icrf_m):
    """How long a revolution hides a far target: the arc inside a cylinder of the Moon's radius."""
    direction = target_icrf_m / np.linalg.norm(target_icrf_m)
    beta = math.asin(abs(float(direction @ NORMAL)))
    return PERIOD_S / math.pi * math.acos(math.sqrt(1 - (MOON_RADIUS_M / RADIUS_M) ** 2) / math.cos(beta))


def whole(spans, found):
    """Spans that neither begin with the ephemeris nor end with it."""
    return [span for span in spans if span[0] > found.start_utc_ns and span[1] < found.stop_utc_ns]


@pytest.mark.parametrize("name, target, atol", [
    # The Sun has moved by 0.3 deg at the end, edges are found to a second each.
    ("eclipse", sun_position_icrf_m, 8.0),
    # The Earth stands at 215 Moon radii, not at infinity, and has moved by 4 deg at the end: 1 % of 2,800 s.
    ("occultation", earth_position_icrf_m, 60.0),
])  # fmt: skip
def test_eclipses_and_occultations_last_as_long_as_the_shadow_is_wide(found, name, target, atol):
    durations = lasting_s(whole(getattr(found, name), found))
    assert len(durations) >= REVOLUTIONS - 1
    assert_allclose(durations, behind_s(target(tdb_s_from_utc_ns(START))), atol=atol)  # s


def test_half_of_every_revolution_is_over_the_night_side(found):
    assert_allclose(lasting_s(whole(found.night, found)), PERIOD_S / 2.0, atol=8.0)  # s


def test_stations_on_opposite_sides_of_the_earth_share_the_time_that_the_limb_leaves(found):
    total_s = sum(lasting_s(spans).sum() for spans in found.contacts.values())
    hidden_s = lasting_s(found.occultation).sum()
    # Parallax of the horizon (1 deg) hides a little from both.
    assert total_s == pytest.approx((found.stop_utc_ns - found.start_utc_ns) / NS - hidden_s, rel=0.05)


def test_light_time_is_range_over_the_speed_of_light(found):
    assert found.light_time_s[0] == pytest.approx(found.range_m[0] / SPEED_OF_LIGHT_M_S, abs=1e-9)  # s
    assert 3.5e8 < found.range_m[0] < found.range_m[1] < 4.1e8  # m, perigee to apogee


def test_a_step_that_goes_nowhere_is_refused():
    with pytest.raises(LunarError, match="a step and a tolerance above 0"):
        visibility_spans(circular_orbit(60.0), IauOrientation(), step_s=-1.0)
