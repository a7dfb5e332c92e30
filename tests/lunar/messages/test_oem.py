"""CCSDS OEM both ways against the independent `oem` package, all versions, and every fault with its line."""

import numpy as np
import pytest
from numpy import allclose, array_equal, cos, diag, sin
from numpy.testing import assert_allclose
from pytest import approx, raises

from lunar.constants import NS
from lunar.ephemeris import Covariance, Ephemeris, EphemerisSegment
from lunar.errors import DataFileError, UnknownFrameError, UnknownTimeSystemError
from lunar.frames import icrf_from_j2000
from lunar.messages.ephemeris_files import load_ephemeris
from lunar.messages.oem import format_oem, parse_oem, save_oem
from lunar.messages.oem_xml import format_oem_xml, parse_oem_xml
from lunar.timescales import TIME_SYSTEMS, format_utc, parse_tai, parse_utc, utc_ns_from_tai_ns
from tests.lunar.messages.test_messages import assert_same, rows_of
from tests.lunar.orbits import circle

# The independent package keeps time with ERFA, which warns of UTC more than five years after its own release.
START = parse_utc("2029-08-07T00:00:00")

VERSION_1 = """\
CCSDS_OEM_VERS = 1.0
COMMENT as the Blue Book of 2004 lays it out
CREATION_DATE = 2029-08-01T10:00:00
ORIGINATOR = ESA

META_START
OBJECT_NAME          = SELENITA
OBJECT_ID            = 2029-123A
CENTER_NAME          = MOON
REF_FRAME            = EME2000
TIME_SYSTEM          = UTC
START_TIME           = 2029-08-07T00:00:00.000
USEABLE_START_TIME   = 2029-08-07T00:01:00.000
USEABLE_STOP_TIME    = 2029-08-07T00:03:00.000
STOP_TIME            = 2029-08-07T00:04:00.000
INTERPOLATION        = HERMITE
INTERPOLATION_DEGREE = 5
META_STOP
COMMENT propagated with the plan of week 31
2029-08-07T00:00:00.000   1768.0     0.0    10.0  0.0  1.665 0.1
2029-08-07T00:01:00.000   1765.2    99.8    16.0 -0.1  1.662 0.1
2029-219T00:02:00.000     1756.7   199.3    22.0 -0.2  1.655 0.1
2029-08-07T00:03:00.000Z  1742.7   298.2    28.0 -0.3  1.641 0.1
2029-08-07T00:04:00.000   1723.1   396.1    34.0 -0.4  1.623 0.1
"""

VERSION_3 = """\
CCSDS_OEM_VERS = 3.0
COMMENT two segments, accelerations, covariances
CLASSIFICATION = public
CREATION_DATE = 2029-213T10:00:00.5
ORIGINATOR = LINNA
MESSAGE_ID = OEM 17
META_START
COMMENT before the burn
OBJECT_NAME = SELENITA
OBJECT_ID = 2029-123A
CENTER_NAME = Moon
REF_FRAME = ICRF
TIME_SYSTEM = TDB
START_TIME = 2029-08-07T00:01:09.184
STOP_TIME = 2029-08-07T00:02:09.184
META_STOP
2029-08-07T00:01:09.184 1768.0 0.0 10.0 0.0 1.665 0.1 0.001 0.0 0.0
2029-08-07T00:02:09.184 1765.2 99.8 16.0 -0.1 1.662 0.1 0.001 0.0 0.0
COVARIANCE_START
EPOCH = 2029-08-07T00:01:09.184
COV_REF_FRAME = RTN
1e-6
0 2e-6
0 0 3e-6
0 0 0 1e-12
1e-10 0 0 0 2e-12
0 0 0 0 0 3e-12
EPOCH = 2029-08-07T00:02:09.184
4e-6
0 4e-6
0 0 4e-6
0 0 0 4e-12
0 0 0 0 4e-12
0 0 0 0 0 4e-12
COVARIANCE_STOP
META_START
OBJECT_NAME = SELENITA
OBJECT_ID = 2029-123A
CENTER_NAME = MOON
REF_FRAME = ICRF
TIME_SYSTEM = TDB
START_TIME = 2029-08-07T00:02:09.184
STOP_TIME = 2029-08-07T00:03:09.184
INTERPOLATION = LAGRANGE
INTERPOLATION_DEGREE = 1
META_STOP
2029-08-07T00:02:09.184 1765.2 99.8 16.0 -0.1 1.665 0.1
2029-08-07T00:03:09.184 1756.7 199.3 22.0 -0.2 1.655 0.1
"""


def example_ephemeris(n=50, covariances=()):
    angle = np.arange(n) * 30.0 * 2 * np.pi / 6672.0
    position = 1_768_180.0 * np.stack([cos(angle), 0.6 * sin(angle), 0.8 * sin(angle)], -1)
    velocity = 1665.0 * np.stack([-sin(angle), 0.6 * cos(angle), 0.8 * cos(angle)], -1)
    utc_ns = START + np.arange(n) * 30 * NS
    later = utc_ns + (n - 1) * 30 * NS
    first = EphemerisSegment(utc_ns, position, velocity, comments=("first", "of two"), covariances=covariances)
    second = EphemerisSegment(later, position, velocity, degree=5, useable_stop_utc_ns=int(later[-3]))
    return Ephemeris((first, second), comments=("whole file",))


def test_version_1_is_read_with_units_frame_bias_comments_and_useable_interval():
    ephemeris = parse_oem(VERSION_1)
    (segment,) = ephemeris.segments
    assert (ephemeris.originator, segment.object_id, segment.degree) == ("ESA", "2029-123A", 5)
    assert ephemeris.comments == ("as the Blue Book of 2004 lays it out",)
    assert segment.comments == ("propagated with the plan of week 31",)
    assert format_utc(ephemeris.start_utc_ns) == "2029-08-07T00:01:00.000Z"
    assert format_utc(ephemeris.stop_utc_ns) == "2029-08-07T00:03:00.000Z"
    assert len(segment.utc_ns) == 5
    assert allclose(segment.position_m[1], icrf_from_j2000() @ [1765.2e3, 99.8e3, 16e3], atol=1e-6)
    # 23 mas: a fifth of a metre at this distance, and not to be lost.
    assert 0.1 < np.linalg.norm(segment.position_m[1] - [1765.2e3, 99.8e3, 16e3]) < 0.3


def test_version_3_is_read_with_time_system_covariances_and_segments():
    first, second = parse_oem(VERSION_3).segments
    # TDB is ahead of UTC by 69.184 s; TDB - TT is some -0.9 ms in August.
    assert abs(int(first.utc_ns[0]) - START) < 2_000_000
    assert abs(int(first.utc_ns[0]) - START) > 100_000
    assert second.interpolation == "LAGRANGE"
    one, two = first.covariances
    assert (one.frame, two.frame) == ("RTN", "RTN")
    assert one.matrix[2, 2] == approx(3.0)  # 3e-6 km2
    assert one.matrix[4, 0] == one.matrix[0, 4] == approx(1e-4)
    assert two.matrix[5, 5] == approx(4e-6)
    assert array_equal(first.velocity_m_s[:, 1], [1665.0, 1662.0])


def test_what_is_written_is_read_back_to_a_micrometre_with_everything_else_the_same():
    ephemeris = example_ephemeris(covariances=(Covariance(START, "RTN", diag([1.0, 4.0, 9.0, 1e-6, 4e-6, 9e-6])),))
    back = parse_oem(format_oem(ephemeris))
    assert_same(back, ephemeris)
    for was, now in zip(ephemeris.segments, back.segments, strict=True):
        assert array_equal(was.utc_ns, now.utc_ns)
        assert was.useable_stop_utc_ns == now.useable_stop_utc_ns
    assert format_oem(back) == format_oem(parse_oem(format_oem(back)))


@pytest.mark.parametrize("system", ["UTC", "TAI", "TT", "TDB", "GPS"])
def test_every_time_system_keeps_the_epochs_to_the_nanosecond(system):
    utc_ns = START + np.array([0, 1, 123_456_789, 30 * NS])
    states = np.arange(12.0).reshape(4, 3) + 1.0
    ephemeris = Ephemeris((EphemerisSegment(utc_ns, states, states),))
    assert array_equal(parse_oem(format_oem(ephemeris, time_system=system)).utc_ns, utc_ns)


@pytest.mark.filterwarnings("ignore:.*dubious year:erfa.ErfaWarning")
def test_the_independent_reader_reads_what_we_write_and_interpolates_to_the_same_states(tmp_path):
    import oem as independent
    from astropy.time import Time

    path = tmp_path / "ours.oem"
    covariance = Covariance(START, "RTN", diag([1.0, 4.0, 9.0, 1e-6, 4e-6, 9e-6]))
    ephemeris = example_ephemeris(covariances=(covariance,))
    save_oem(ephemeris, path)
    theirs = independent.OrbitEphemerisMessage.open(path)
    assert theirs.version == "2.0"
    assert len(theirs.segments) == 2
    for ours, segment in zip(ephemeris.segments, theirs.segments, strict=True):
        assert segment.metadata["CENTER_NAME"] == "MOON"
        assert int(segment.metadata["INTERPOLATION_DEGREE"]) == ours.degree
        states = list(segment.states)
        assert len(states) == len(ours.utc_ns)
        for k in (0, 17, -1):
            state = states[k]
            assert state.epoch.isot == format_utc(int(ours.utc_ns[k]), 6).rstrip("Z")
            assert allclose(1e3 * np.array(state.position), ours.position_m[k], atol=1e-6, rtol=0)
            assert allclose(1e3 * np.array(state.velocity), ours.velocity_m_s[k], atol=1e-9, rtol=0)
    (block,) = theirs.segments[0].covariances
    assert block.frame == "RTN"
    assert allclose(block.matrix * 1e6, covariance.matrix, rtol=1e-12)
    for seconds in (100, 731, 1400):
        state = theirs(Time(format_utc(START + seconds * NS).rstrip("Z"), scale="utc"))
        # The writer's micrometre, and two interpolators' ways of dealing with rounding.
        position, velocity = ephemeris.at(START + seconds * NS)
        assert allclose(1e3 * np.array(state.position), position, atol=1e-4, rtol=0)
        assert allclose(1e3 * np.array(state.velocity), velocity, atol=1e-6, rtol=0)


@pytest.mark.filterwarnings("ignore:.*dubious year:erfa.ErfaWarning")
def test_we_read_what_the_independent_writer_writes(tmp_path):
    import oem as independent

    ours, theirs = tmp_path / "ours.oem", tmp_path / "theirs.oem"
    ephemeris = example_ephemeris()
    save_oem(ephemeris, ours)
    independent.OrbitEphemerisMessage.open(ours).save_as(theirs)
    back = load_ephemeris(theirs)
    assert array_equal(back.utc_ns, ephemeris.utc_ns)
    for was, now in zip(ephemeris.segments, back.segments, strict=True):
        assert allclose(was.position_m, now.position_m, atol=1e-3, rtol=0)
        assert (was.degree, was.useable_stop_utc_ns) == (now.degree, now.useable_stop_utc_ns)


def test_the_same_ephemeris_gives_the_same_octets(tmp_path):
    save_oem(example_ephemeris(), tmp_path / "a.oem")
    save_oem(example_ephemeris(), tmp_path / "b.oem")
    assert (tmp_path / "a.oem").read_bytes() == (tmp_path / "b.oem").read_bytes()
    stamped = format_oem(example_ephemeris(), creation_utc_ns=parse_utc("2030-01-01"))
    assert "CREATION_DATE = 2030-01-01T00:00:00.000" in stamped


def replaced(old, new):
    old = old.replace("¶", "\n")
    assert old in VERSION_1
    return VERSION_1.replace(old, new.replace("¶", "\n"))


# What is replaced | by what | what the message says; ¶ is the end of a line.
FAULTS = """
VERS = 1.0 | VERS = 4.0 | line 1: expected an OEM version out of 1.0, 2.0, 3.0, found '4.0'
ORIGINATOR = ESA |  | expected ORIGINATOR in the header
OBJECT_ID            = 2029-123A¶ |  | line 17: expected OBJECT_ID before META_STOP, found none
= EME2000¶ | = EME2000¶REF_FRAME = ICRF¶ | line 11: expected REF_FRAME once
= MOON | = EARTH | line 9: expected CENTER_NAME = MOON, found 'EARTH'
= HERMITE | = SPLINE | line 16: expected an INTERPOLATION out of
INTERPOLATION_DEGREE = 5 | INTERPOLATION_DEGREE = x | line 17: expected an INTERPOLATION_DEGREE
INTERPOLATION_DEGREE = 5¶ |  | line 16: expected INTERPOLATION_DEGREE with INTERPOLATION
START_TIME           = 2029-08-07 | START_TIME           = 2029-08-32 | expected an epoch like
OBJECT_NAME   | OBJEKT_NAME   | line 7: expected one of OBJECT_NAME
1765.2    99.8 | 1765.2    ninety | line 21: expected a number, found 'ninety'
1765.2    99.8 | 1765.2    nan | line 21: expected finite numbers
99.8    16.0 -0.1 | 99.8    16.0 | line 21: expected 7 values as in the line before, found 6 values
00:01:00.000   1765.2 | 00:00:00.000   1765.2 | line 21: expected an epoch after
2029-219T00:02:00 | 2029-219T00:62:00 | line 22: expected an epoch like
USEABLE_STOP_TIME    = 2029-08-07 | USEABLE_STOP_TIME    = 2029-08-06 | expected a useable interval within
STOP_TIME            = 2029-08-07T00:04 | STOP_TIME = 2029-08-07T00:03 | line 24: expected an epoch within
623 0.1¶ | 623¶ | line 24: expected 7 values as in the line before, found 6
623 0.1¶ | 623 0.1¶COVARIANCE_START¶EPOCH = 2029-08-07T00:00:00¶1¶1¶ | line 28: expected 2 numbers of row 2
623 0.1¶ | 623 0.1¶COVARIANCE_START¶EPOCH = 2029-08-07T00:00:00¶1¶ | expected more lines, found the end of the file
623 0.1¶ | 623 0.1¶what now¶ | line 25: expected META_START, found 'what now'
"""
CUT = """
CCSDS | first line: expected CCSDS_OEM_VERS
2029-08-07T00:03:00.000Z | line 22: expected a last state at STOP_TIME
COMMENT propagated | expected a state: epoch x y z vx vy vz, found the end
META_STOP | expected more lines, found the end of the file
META_START | expected META_START, found the end of the file
"""
TWICE = VERSION_1 + VERSION_1[VERSION_1.index("META_START") :]


@pytest.mark.parametrize("text, message", [
    *((replaced(old, new), message) for old, new, message in rows_of(FAULTS)),
    *((VERSION_1[: VERSION_1.index(mark)], message) for mark, message in rows_of(CUT)),
    (TWICE, "segment 2: expected a start at or after"),
])  # fmt: skip
def test_a_faulty_file_is_refused_in_one_line_with_its_place(tmp_path, text, message):
    path = tmp_path / "faulty.oem"
    path.write_text(text)
    with raises(DataFileError) as caught:
        load_ephemeris(path)
    found = str(caught.value)
    assert found.startswith(str(path)) and message in found and "\n" not in found


def test_a_line_of_more_than_64_kib_is_refused_before_it_is_parsed(tmp_path):
    path = tmp_path / "long.oem"
    path.write_text(replaced("EME2000", "E" * (1 << 17)))
    with raises(DataFileError, match=r"expected at most 65536 octets in a line, found more$"):
        load_ephemeris(path)


def test_comments_between_states_are_passed():
    text = replaced("2029-08-07T00:03:00.000Z", "COMMENT CENTER_NAME = EARTH\n2029-08-07T00:03:00.000Z")
    assert array_equal(parse_oem(text).segments[0].position_m, parse_oem(VERSION_1).segments[0].position_m)


def test_an_unknown_frame_and_an_unknown_time_system_are_refused_with_what_is_known(tmp_path):
    path = tmp_path / "faulty.oem"
    for old, new, error, message in (
        ("EME2000", "MOON_TOD", UnknownFrameError, "10: expected .*ICRF"),
        ("= UTC", "= LTC", UnknownTimeSystemError, "11: expected .*TDB"),
    ):
        path.write_text(replaced(old, new))
        with raises(error, match=rf"faulty\.oem: line {message}.*, found '{new.strip('= ')}'"):
            load_ephemeris(path)


# Leap seconds


def over_the_leap_second(step_s, time_system="UTC"):
    """States of a circle from 2016-12-31T23:50:00 UTC on, and the seconds since then."""
    elapsed = np.arange(0, 1200 if step_s > 1 else 620, step_s)
    tai_ns = parse_tai("2016-12-31T23:50:00") + elapsed * NS
    fields = {"tai_ns": tai_ns, "time_system": time_system}
    return Ephemeris((EphemerisSegment(utc_ns_from_tai_ns(tai_ns), *circle(elapsed.astype(float)), **fields),))


@pytest.mark.parametrize("step_s", [1, 60])
@pytest.mark.parametrize("system", TIME_SYSTEMS)
def test_states_across_a_leap_second_are_read_as_written_and_interpolated_on_tai(system, step_s):
    given = over_the_leap_second(step_s, system)
    text = format_oem(given)
    assert ("2016-12-31T23:59:60.000" in text) == (system == "UTC")
    for found in (parse_oem(text), parse_oem_xml(format_oem_xml(given).encode())):
        assert np.abs(found.segments[0].tai_ns - given.segments[0].tai_ns).max() <= (system == "TDB")
        for clock, elapsed in (("2016-12-31T23:59:55", 595.0), ("2016-12-31T23:59:60.5", 600.5),
                               ("2017-01-01T00:00:00.5", 601.5), ("2017-01-01T00:00:05", 606.0)):  # fmt: skip
            position, _ = found.at_tai(parse_tai(clock))
            assert_allclose(position, circle(elapsed)[0], rtol=0, atol=1e-5)


def test_epochs_within_a_leap_second_that_have_no_place_are_refused_with_that_reason():
    text = format_oem(over_the_leap_second(60)).replace(
        "STOP_TIME", "USEABLE_STOP_TIME = 2016-12-31T23:59:60.5\nSTOP_TIME"
    )
    with raises(DataFileError, match="line 12: expected a UTC epoch outside of a leap second"):
        parse_oem(text)


@pytest.mark.parametrize("name", ["ICRS", "GCRF"])
def test_other_names_of_icrf_axes_are_read(name):
    assert parse_oem(VERSION_3.replace("REF_FRAME = ICRF", f"REF_FRAME = {name}", 1)).segments[0].frame == "ICRF"


@pytest.mark.parametrize("fault", ["2029-13-07T00:00:00", "9noon"])
def test_an_epoch_that_is_none_among_a_thousand_is_named_with_its_line(fault):
    """Numpy ends the process by a segmentation fault where it refuses one of more than 500 texts."""
    lines = format_oem(over_the_leap_second(1)).splitlines()
    lines[-20] = fault + lines[-20][19:]
    with raises(DataFileError, match=f"line {len(lines) - 19}: expected an epoch like .*, found '{fault}"):
        parse_oem("\n".join(lines))
