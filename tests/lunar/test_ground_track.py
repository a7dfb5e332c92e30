"""Ground tracks of an orbit in closed form: altitude, period, speed and passes."""

import math

import numpy as np
import pytest

from lunar.constants import GM_MOON_M3_S2
from lunar.ephemeris import ephemeris_from_states
from lunar.frames import IauOrientation
from lunar.ground_track import even_epochs, ground_track
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
