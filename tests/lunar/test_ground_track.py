"""Ground tracks of an orbit in closed form: altitude, period, speed and passes."""

import math

import numpy as np
import pytest

from lunar.frames import IauOrientation
from lunar.ground_track import even_epochs, ground_track
from lunar.timescales import NS
from tests.lunar.orbits import polar_orbit


@pytest.fixture(scope="module")
def day():
    """A circular polar orbit of the paper's semi-major axis, one day in 15 s steps."""
    return polar_orbit(23.999, 15.0)


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
