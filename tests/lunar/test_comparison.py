"""Differences of ephemerides in radial, transverse and normal axes."""

import numpy as np
import pytest

from lunar.comparison import compare
from lunar.ephemeris import ephemeris_from_states
from lunar.errors import EphemerisCoverageError
from lunar.timescales import NS
from tests.lunar.orbits import POLAR, RADIUS_M, RATE_RAD_S, START, circle, times

ELAPSED_S = np.arange(200) * 30.0


def ephemeris(elapsed_s=ELAPSED_S, radius_m=RADIUS_M, late_s=0.0, shift_m=(0.0, 0.0, 0.0)):
    position, velocity = circle(elapsed_s - late_s, radius_m, north=POLAR)
    return ephemeris_from_states(times(elapsed_s), position + shift_m, velocity)


def test_an_ephemeris_does_not_differ_from_itself():
    difference = compare(ephemeris(), ephemeris())
    assert difference.samples == 200
    assert difference.max_m == difference.rms_m == 0.0


def test_a_larger_orbit_differs_radially_a_late_one_along_track_and_a_shifted_one_across():
    radial = compare(ephemeris(), ephemeris(radius_m=1_768_280.0))
    assert radial.rms_rtn_m == pytest.approx((100.0, 0.0, 0.0), abs=1e-6)
    late = compare(ephemeris(), ephemeris(late_s=0.1))
    # 0.1 s at 1.665 km/s, behind; the sagitta is 8 mm.
    assert late.position_rtn_m[:, 1] == pytest.approx(-1_768_180.0 * RATE_RAD_S * 0.1, abs=1e-3)
    assert late.rms_rtn_m[0] < 0.01
    # Normal of this orbit is x cross z = -y.
    across = compare(ephemeris(), ephemeris(shift_m=(0.0, 3.0, 0.0)))
    assert across.position_rtn_m[:, 2] == pytest.approx(-3.0, abs=1e-6)
    assert (across.max_m, across.rms_m) == pytest.approx((3.0, 3.0), abs=1e-6)


def test_only_common_epochs_count_and_other_steps_are_interpolated():
    other = ephemeris(np.arange(50) * 45.0)
    difference = compare(ephemeris(), other)
    assert difference.samples == 74  # 0 to 2205 s in steps of 30 s
    assert difference.max_m < 1e-3


def test_given_epochs_are_used():
    epochs = START + np.array([100, 200, 300]) * NS
    assert compare(ephemeris(), ephemeris(), epochs).samples == 3
    with pytest.raises(EphemerisCoverageError):
        compare(ephemeris(), ephemeris(), epochs + 86_400 * NS)


def test_ephemerides_that_share_no_epoch_are_refused():
    with pytest.raises(EphemerisCoverageError, match="comparison: expected an epoch within"):
        compare(ephemeris(), ephemeris(ELAPSED_S + 1e6))
