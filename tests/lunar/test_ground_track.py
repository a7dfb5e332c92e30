"""Ground tracks of an orbit in closed form: altitude, period, speed and passes."""

import math

import numpy as np
import pytest

from lunar.constants import GM_MOON_M3_S2, MOON_RADIUS_M
from lunar.ephemeris import ephemeris_from_states
from lunar.frames import IauOrientation
from lunar.ground_track import even_epochs, ground_track, track_statistics
from lunar.timescales import NS, parse_utc

START = parse_utc("2029-08-07T00:00:00")
SEMI_MAJOR_AXIS_M = 1_768_180.0


@pytest.fixture(scope="module")
def day():
    """A circular polar orbit of the paper's semi-major axis, one day in 15 s steps."""
    rate = math.sqrt(GM_MOON_M3_S2 / SEMI_MAJOR_AXIS_M**3)
    elapsed = np.arange(0.0, 86_400.0, 15.0)
    # In the plane of the Moon's pole, started at the equator.
    pole = IauOrientation().mcmf_from_icrf(9.34e8)[2]
    node = np.cross([0.0, 0.0, 1.0], pole)
    node /= np.linalg.norm(node)
    angle = (rate * elapsed)[:, None]
    position = SEMI_MAJOR_AXIS_M * (np.cos(angle) * node + np.sin(angle) * pole)
    velocity = SEMI_MAJOR_AXIS_M * rate * (np.cos(angle) * pole - np.sin(angle) * node)
    return ephemeris_from_states(START + np.rint(elapsed * NS).astype(np.int64), position, velocity)


def test_a_day_in_the_papers_orbit_has_the_period_speeds_and_passes_of_the_mission(day):
    numbers = track_statistics(day, ground_track(day, IauOrientation()))
    # Kepler's third law: 111.20 min, 1.665 km/s, 1.636 km/s over ground.
    assert f"{numbers.period_s / 60:.2f}" == "111.20"
    assert f"{numbers.speed_mean_m_s / 1e3:.3f}" == "1.665"
    assert f"{numbers.ground_speed_mean_m_s / 1e3:.3f}" == "1.636"
    assert numbers.altitude_mean_m == pytest.approx(SEMI_MAJOR_AXIS_M - MOON_RADIUS_M, abs=1e-3)
    # About 3,834 frames of 15 s within 60 degrees in 27 passes, of which this day starts within one.
    assert numbers.share_inside * numbers.states == pytest.approx(3834, abs=20)
    assert numbers.passes in (26, 27)


def test_a_pass_within_sixty_degrees_lasts_37_minutes(day):
    track = ground_track(day, IauOrientation())
    inside = np.abs(track.latitude_rad) <= math.radians(60)
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    lengths = (
        np.diff(edges)[0::2] * 15.0 / 60.0 if not inside[edges[0]] else np.diff(edges)[1::2] * 15.0 / 60.0
    )
    assert np.mean(lengths) == pytest.approx(111.20 / 3, abs=0.1)


def test_epochs_and_steps_can_be_chosen(day):
    epochs = even_epochs(day, 60.0)
    assert np.all(np.diff(epochs) == 60 * NS)
    track = ground_track(day, IauOrientation(), epochs)
    assert len(track.utc_ns) == 1440
    assert np.all((track.longitude_rad >= 0.0) & (track.longitude_rad < 2 * np.pi))


def test_too_short_a_track_has_no_period(day):
    track = ground_track(day, IauOrientation(), day.utc_ns[:10])
    assert math.isnan(track_statistics(day, track).period_s)
    assert track_statistics(day, ground_track(day, IauOrientation(), day.utc_ns[:1])).passes == 1
