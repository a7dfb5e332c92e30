"""STK .e files: an example laid out as the format's documentation shows it, both ways, and faults with their line."""

import numpy as np
from pytest import mark, raises

from lunar.comparison import compare
from lunar.constants import NS
from lunar.ephemeris import Ephemeris, EphemerisSegment, ephemeris_from_states
from lunar.errors import DataFileError, EphemerisError, UnknownFrameError, UnknownTimeSystemError
from lunar.frames import icrf_from_j2000
from lunar.messages.ephemeris_files import load_ephemeris
from lunar.messages.stk import format_stk, parse_stk
from lunar.timescales import format_utc
from tests.lunar.messages.test_messages import rows_of
from tests.lunar.orbits import START, circle, times

EXAMPLE = """\
stk.v.11.0

# WrittenBy    STK_v11.2.0

BEGIN Ephemeris

    NumberOfEphemerisPoints  5
    ScenarioEpoch            7 Aug 2029 00:00:00.000000
    InterpolationMethod      Lagrange
    InterpolationSamplesM1   5
    CentralBody              Moon
    CoordinateSystem         J2000
    DistanceUnit             Kilometers

    BEGIN SegmentBoundaryTimes
        1.2000000000e+02
    END SegmentBoundaryTimes

    EphemerisTimePosVel

 0.00000000000000e+00  1.768e+03 0.000e+00 1.0e+01  0.0e+00 1.665e+00 1.0e-01
 6.00000000000000e+01  1.765e+03 9.980e+01 1.6e+01 -1.0e-01 1.662e+00 1.0e-01
 1.20000000000000e+02  1.757e+03 1.993e+02 2.2e+01 -2.0e-01 1.655e+00 1.0e-01
 1.20000000000000e+02  1.757e+03 1.993e+02 2.2e+01 -2.0e-01 1.660e+00 1.0e-01
 1.80000000000000e+02  1.743e+03 2.982e+02 2.8e+01 -3.0e-01 1.641e+00 1.0e-01

END Ephemeris
"""


def states(n, start_s=0.0):
    elapsed = start_s + np.arange(n) * 30.0
    return times(elapsed), *circle(elapsed)


def test_the_example_is_read_with_units_bias_and_segments():
    ephemeris = parse_stk(EXAMPLE)
    first, second = ephemeris.segments
    assert ephemeris.comments == ("WrittenBy    STK_v11.2.0",)
    assert [len(s.utc_ns) for s in ephemeris.segments] == [3, 2]
    assert format_utc(int(second.utc_ns[0])) == "2029-08-07T00:02:00.000Z"
    assert (first.interpolation, first.degree) == ("LAGRANGE", 5)
    assert np.allclose(first.position_m[1], icrf_from_j2000() @ [1765e3, 99.8e3, 16e3], atol=1e-6)
    assert np.allclose(ephemeris.at(START + 120 * NS)[1], icrf_from_j2000() @ [-200.0, 1660.0, 100.0], atol=1e-9)


def test_what_is_written_is_read_back_to_a_micrometre(tmp_path):
    ephemeris = ephemeris_from_states(*states(100))
    (tmp_path / "orbit.e").write_text(format_stk(ephemeris))
    back = load_ephemeris(tmp_path / "orbit.e")
    assert np.array_equal(back.utc_ns, ephemeris.utc_ns)
    assert compare(ephemeris, back).max_m < 2e-6
    assert back.segments[0].degree == 7


def test_segments_that_meet_are_written_with_their_boundary_and_those_with_a_gap_refused():
    first, second = EphemerisSegment(*states(20)), EphemerisSegment(*states(20, 570.0))
    text = format_stk(Ephemeris((first, second)))
    assert "BEGIN SegmentBoundaryTimes\n570.000000000\nEND" in text
    assert [len(s.utc_ns) for s in parse_stk(text).segments] == [20, 20]
    first, second = EphemerisSegment(*states(20)), EphemerisSegment(*states(20, 900.0))
    with raises(EphemerisError, match="found a gap"):
        format_stk(Ephemeris((first, second)))


def test_a_boundary_at_a_state_also_a_rounded_one_splits_there_and_accelerations_are_passed_over():
    text = EXAMPLE.replace("Points  5", "Points  4").replace(EXAMPLE.splitlines(keepends=True)[23], "")
    assert [len(s.utc_ns) for s in parse_stk(text).segments] == [3, 2]
    boundary = "1.2000000000e+02"
    rounded = text.replace(boundary, f"{float(boundary) + 4e-7:.9f}")
    assert [len(s.utc_ns) for s in parse_stk(rounded).segments] == [3, 2]
    with raises(DataFileError, match=r"SegmentBoundaryTimes: expected times of states, found .*Z, at which there"):
        parse_stk(text.replace(boundary, f"{float(boundary) - 7.0:.3f}"))
    text = EXAMPLE.replace("EphemerisTimePosVel", "EphemerisTimePosVelAcc").replace("1.0e-01\n", "1.0e-01 0 0 0\n")
    assert len(parse_stk(text).utc_ns) == 4


def test_elapsed_seconds_run_through_a_leap_second():
    text = EXAMPLE.replace("7 Aug 2029 00:00:00", "31 Dec 2016 23:59:30")
    # 60 s after 23:59:30 it is 00:00:29, because the minute had 61 s.
    assert format_utc(int(parse_stk(text).utc_ns[1])) == "2017-01-01T00:00:29.000Z"


def replaced(old, new):
    old = old.replace("¶", "\n")
    assert old in EXAMPLE
    return EXAMPLE.replace(old, new)


FAULTS = """
BEGIN Ephemeris | BEGIN Attitude | line 5: expected BEGIN Ephemeris, found 'BEGIN Attitude'
END Ephemeris |  | expected END Ephemeris, found the end of the file: it is cut short
EphemerisTimePosVel | EphemerisTimePos | expected EphemerisTimePosVel, EphemerisTimePosVelAcc
ScenarioEpoch            7 Aug | ScenarioEpoch  7 Ogs | line 8: expected an epoch like
7 Aug 2029 | 31 Feb 2029 | line 8: expected an epoch that exists
CentralBody              Moon | CentralBody Mars | line 11: expected CentralBody Moon, found 'Mars'
    CentralBody              Moon¶ |  | expected CentralBody Moon, found none, which means Earth
Kilometers | Furlongs | line 13: expected DistanceUnit Meters or Kilometers
Points  5 | Points  6 | line 7: expected NumberOfEphemerisPoints 5, found 6
Lagrange | Spline | line 9: expected InterpolationMethod
1.765e+03 | 1.765e+o3 | line 22: expected a number, found '1.765e+o3'
1.765e+03 | nan | line 22: expected finite numbers
1.765e+03 9.980e+01 | 1.765e+03 | line 22: expected a time and 6 numbers, found 6 values
 6.00000000000000e+01 |  6.00000000000000e+03 | line 23: expected a time after the one before
"""


@mark.parametrize("text, message", [
    *((replaced(old, new), message) for old, new, message in rows_of(FAULTS)),
    ("", "line 1: expected stk.v.<version>, found nothing"),
    (EXAMPLE.partition("EphemerisTimePosVel")[0], "expected EphemerisTimePosVel, found the end of the file"),
])  # fmt: skip
def test_a_faulty_file_is_refused_in_one_line_with_its_place(tmp_path, text, message):
    path = tmp_path / "faulty.e"
    with raises(DataFileError) as caught:
        parse_stk(text, source=str(path))
    assert str(caught.value).startswith(str(path)) and message in str(caught.value)


def test_axes_and_time_formats_that_cannot_be_converted_are_refused():
    with raises(UnknownFrameError, match=r"line 12: expected .*ICRF.* found 'Fixed'"):
        parse_stk(replaced("CoordinateSystem         J2000", "CoordinateSystem Fixed"))
    with raises(UnknownTimeSystemError, match=r"TimeFormat: expected .*EpSec, found 'ISO-YMD'"):
        parse_stk(replaced("    CentralBody", "    TimeFormat ISO-YMD\n    CentralBody"))
