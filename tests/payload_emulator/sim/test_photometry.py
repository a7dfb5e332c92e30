import math

import numpy as np
import pytest

from payload_emulator.errors import PayloadError
from payload_emulator.sim.photometry import LAWS, TABLE_SIZE, Photometry


def entry(table, phase_deg):
    return table[:, round((math.cos(math.radians(phase_deg)) + 1.0) * TABLE_SIZE / 2)]


@pytest.mark.parametrize("law", LAWS)
def test_every_law_gives_the_albedo_when_sun_and_camera_stand_overhead(law):
    seeliger, lambert, multiple = entry(Photometry(law).tables(), 0.0)
    h_one = 3.0 / (1.0 + 2.0 * math.sqrt(1.0 - 0.21))
    normal = 0.5 * seeliger + lambert + 0.5 * multiple * h_one**2
    assert normal == pytest.approx(1.0, abs=2e-3)


def test_lunar_lambert_shares_follow_mcewen():
    # McEwen 1996 (LPSC 27, 841): L(30 deg) = 1 - 0.57 + 0.2178 - 0.03942 = 0.60838.
    seeliger, lambert, _ = entry(Photometry("lunar-lambert", phase_slope_per_rad=0.0).tables(), 30.0)
    assert seeliger / 2.0 == pytest.approx(0.608, abs=0.004)
    assert lambert == pytest.approx(0.392, abs=0.004)


@pytest.mark.parametrize("law", LAWS)
def test_brightness_falls_with_phase(law):
    table = Photometry(law).tables()
    whole = [float(entry(table, phase)[:2].sum()) for phase in (5, 30, 60, 90, 110)]
    assert np.all(np.diff(whole) < 0.0)


def test_an_unknown_law_is_refused_by_name():
    with pytest.raises(PayloadError, match="lunar-lambert, lambert, hapke, found 'phong'"):
        Photometry("phong")
