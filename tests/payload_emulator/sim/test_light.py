import math

import numpy as np
import pytest

from payload_emulator.sim.render.light import paper_light, sun_angles, sun_direction_mcmf


def test_the_papers_light_stays_within_its_span_and_fills_it():
    elevation, azimuth = np.degrees([paper_light(7, frame) for frame in range(2000)]).T
    # Paper, section V-B.4: elevation 5 to 15 degrees, azimuth -45 to 45.
    assert elevation.min() >= 5.0 and elevation.max() <= 15.0
    assert azimuth.min() >= -45.0 and azimuth.max() <= 45.0
    # 2000 uniform draws: the means are good to 0.07 and 0.6 degrees (1 sigma).
    assert abs(elevation.mean() - 10.0) < 0.4
    assert abs(azimuth.mean()) < 3.0


def test_a_frames_light_does_not_depend_on_which_frames_came_before():
    forward = [paper_light(3, frame) for frame in range(5)]
    backward = [paper_light(3, frame) for frame in reversed(range(5))]
    assert forward == backward[::-1]
    assert paper_light(3, 0) != paper_light(4, 0)


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
