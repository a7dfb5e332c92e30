import math

import numpy as np
import pytest

from payload_emulator.sim.render.light import sun_angles, sun_direction_mcmf


@pytest.mark.parametrize("latitude_deg", [-60.0, 0.0, 45.0])
@pytest.mark.parametrize("azimuth_deg", [-170.0, -45.0, 0.0, 90.0])
def test_sun_direction_and_angles_are_inverse(latitude_deg, azimuth_deg):
    place = math.radians(latitude_deg), math.radians(300.0)
    sun = sun_direction_mcmf(math.radians(12.0), math.radians(azimuth_deg), *place)
    assert np.linalg.norm(sun) == pytest.approx(1.0, abs=1e-12)
    elevation, azimuth = sun_angles(sun, *place)
    assert math.degrees(elevation) == pytest.approx(12.0, abs=1e-9)
    assert math.degrees(azimuth) == pytest.approx(azimuth_deg, abs=1e-9)


def test_a_sun_in_the_north_points_along_the_moons_axis_at_the_equator():
    sun = sun_direction_mcmf(0.0, 0.0, 0.0, 1.0)
    np.testing.assert_allclose(sun, [0.0, 0.0, 1.0], atol=1e-12)
