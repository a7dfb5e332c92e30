"""Trajectories as CSV and TUM text, read back with the csv module, numpy and SciPy."""

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lunar.constants import NS
from lunar.ephemeris import Ephemeris, ephemeris_from_states
from lunar.errors import EphemerisError
from lunar.frames import IauOrientation, rtn_from_inertial
from lunar.messages.stk import format_csv, format_tum
from lunar.timescales import parse_tai, parse_utc, utc_ns_from_tai_ns

START = parse_utc("2029-08-07T00:00:00")
ANGLE = np.arange(20)[:, None] * 0.3
POSITION_M = 1_768_180.0 * np.concatenate([np.cos(ANGLE), 0.6 * np.sin(ANGLE), 0.8 * np.sin(ANGLE)], 1)
VELOCITY_M_S = 1665.0 * np.concatenate([-np.sin(ANGLE), 0.6 * np.cos(ANGLE), 0.8 * np.cos(ANGLE)], 1)
EPHEMERIS = ephemeris_from_states(START + np.arange(20) * 300 * NS + 1, POSITION_M, VELOCITY_M_S)


def test_csv_holds_states_and_places_with_their_units():
    rows = list(csv.DictReader(io.StringIO(format_csv(EPHEMERIS, IauOrientation()))))
    assert len(rows) == 20
    assert rows[1]["utc"] == "2029-08-07T00:05:00.000000001Z"
    assert abs(float(rows[7]["y_km"]) * 1e3 - POSITION_M[7, 1]) < 1e-6
    assert all(0.0 <= float(row["longitude_deg"]) < 360.0 for row in rows)
    assert abs(float(rows[0]["altitude_km"]) - 30.78) < 1e-6


def test_tum_has_no_place_for_a_state_within_a_leap_second():
    one = EPHEMERIS.segments[0]
    moved = one.tai_ns - one.tai_ns[3] + parse_tai("2016-12-31T23:59:60.5")
    leap = replace(one, tai_ns=moved, utc_ns=utc_ns_from_tai_ns(moved))
    with pytest.raises(EphemerisError, match=r"outside of leap seconds, found 2016-12-31T23:59:60\.500Z"):
        format_tum(Ephemeris((leap,)))


def test_tum_holds_metres_and_the_attitude_of_the_rtn_axes_scalar_last():
    table = np.loadtxt(io.StringIO(format_tum(EPHEMERIS)))
    assert table.shape == (20, 8)
    assert table[3, 0] == START // NS + 900
    assert np.allclose(table[:, 1:4], POSITION_M, atol=1e-6, rtol=0)
    # SciPy keeps quaternions scalar last too; its matrix takes body axes to the world.
    theirs = Rotation.from_quat(table[:, 4:]).as_matrix()
    assert np.allclose(theirs, np.swapaxes(rtn_from_inertial(POSITION_M, VELOCITY_M_S), 1, 2), atol=1e-10)
