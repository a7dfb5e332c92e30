"""SPICE kernels, read back with SPICE itself."""

import builtins
import struct
from contextlib import contextmanager
from functools import partial

import numpy as np
import spiceypy
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, mark, raises

from lunar.camera import PinholeCamera
from lunar.constants import NS
from lunar.ephemeris import Ephemeris, EphemerisSegment
from lunar.errors import DataFileError, EphemerisError, MissingLibrary, UnknownFrameError
from lunar.frames import matrix_from_quaternion
from lunar.messages.spice import (
    ClockLine,
    camera_id,
    ck_octets,
    et_from_tai_ns,
    et_from_utc_ns,
    format_fk,
    format_ik,
    format_sclk,
    load_spk,
    spacecraft_id,
    spk_kernel,
    tai_ns_from_et,
)
from lunar.timescales import TICKS_PER_SECOND, parse_tai, parse_utc, ticks_from_utc_ns
from tests.lunar.spice_pool import kernels

START = parse_utc("2029-08-07T00:00:00")
near = partial(assert_allclose, rtol=0)
CRAFT = spacecraft_id(76)


def circular(seconds, turn=0.0):
    radius, rate = 1.768e6, 9.4e-4
    cos, sin = np.cos(rate * seconds + turn), np.sin(rate * seconds + turn)
    return radius * np.stack([cos, 0.6 * sin, 0.8 * sin], 1), radius * rate * np.stack([-sin, 0.6 * cos, 0.8 * cos], 1)


def segment_of(seconds, turn=0.0, **fields):
    return EphemerisSegment(START + seconds * NS, *circular(seconds.astype(float), turn), **fields)


def written(path, *segments, data_type=None):
    path.write_bytes(spk_kernel(Ephemeris(segments), CRAFT, data_type).octets)
    return path


def arc(first_s, last_s, step_s=60, **fields):
    return segment_of(np.arange(first_s, last_s + 1, step_s), **fields)


def test_ephemeris_time_is_that_of_spice_also_within_a_leap_second(tmp_path):
    texts = [f"2016-12-31T23:59:{second}" for second in (59.5, 59.75, 60.25)]
    texts += ["2017-01-01T00:00:00.25", "2029-08-07T12:34:56.789012", "2035-02-03T00:00:00"]
    with kernels(tmp_path) as spice:
        expected = np.array([spice.str2et(text) for text in texts])
    tai_ns = np.array([parse_tai(text) for text in texts])
    # One unit of a float64 of 1e9 s is 0.12 us.
    near(et_from_tai_ns(tai_ns), expected, atol=3e-7)
    assert np.abs(tai_ns_from_et(expected) - tai_ns).max() <= 300
    utc_ns = np.array([parse_utc(text) for text in texts if ":60" not in text])
    near(et_from_utc_ns(utc_ns), np.delete(expected, 2), atol=3e-7)


@mark.parametrize("data_type", [3, 13])
@mark.parametrize("interpolation, degree", [("HERMITE", 7), ("LAGRANGE", 9), ("LINEAR", 1)])
def test_spk_gives_the_states_of_the_ephemeris(tmp_path, interpolation, degree, data_type):
    ephemeris = Ephemeris((arc(0, 7200, interpolation=interpolation, degree=degree),))
    asked = START + np.arange(0, 7200 * NS, 13 * NS + 7_000_001)
    position, velocity = ephemeris.at(asked)
    with kernels(tmp_path, orbit=spk_kernel(ephemeris, CRAFT, data_type).octets) as spice:
        states = 1e3 * np.array([spice.spkgeo(CRAFT, et, "J2000", 301)[0] for et in et_from_utc_ns(asked)])
    # 0.3 us of a float64 of seconds at 1.7 km/s are 0.5 mm. Windows of SPICE may lie one state to the side.
    near(states[:, :3], position, atol=1e-3)
    near(states[:, 3:], velocity, atol=1e-5)


def test_spk_keeps_the_segments_and_their_useable_intervals(tmp_path):
    burn = START + 1800 * NS
    before = arc(0, 2400, useable_stop_utc_ns=burn)
    ephemeris = Ephemeris((before, segment_of(np.arange(1200, 3601, 60), 1e-3, useable_start_utc_ns=burn)))
    with kernels(tmp_path, orbit=spk_kernel(ephemeris, CRAFT).octets) as spice:
        for seconds_after in (-1, 1):
            epoch = burn + seconds_after * NS
            state, _ = spice.spkgeo(CRAFT, float(et_from_utc_ns(epoch)), "J2000", 301)
            near(1e3 * state[:3], ephemeris.at(epoch)[0], atol=1e-3)
        with raises(spiceypy.utils.exceptions.SpiceyError):
            spice.spkgeo(CRAFT, float(et_from_utc_ns(START + 3700 * NS)), "J2000", 301)


def test_spk_of_lone_states_is_refused():
    with raises(EphemerisError, match="expected a segment of at least two states, found none"):
        spk_kernel(Ephemeris((arc(0, 0),)), CRAFT)


@mark.parametrize("data_type", [3, 13])
def test_spk_is_read_as_the_ephemeris_it_came_from(tmp_path, data_type):
    ephemeris = Ephemeris((arc(0, 7200),))
    path = written(tmp_path / "orbit.bsp", *ephemeris.segments, data_type=data_type)
    read = load_spk(path)
    assert read.segments[0].object_name == str(CRAFT)
    inner = read.utc_ns[1:-1]
    for asked in (inner, inner[:-1] + 29 * NS):
        near(read.at(asked)[0], ephemeris.at(asked)[0], atol=2e-3)
    with raises(DataFileError, match=rf"expected body -5, found bodies {CRAFT}"):
        load_spk(path, -5)


def test_an_spk_is_of_polynomials_where_these_are_exact_and_states_their_error():
    smooth = spk_kernel(Ephemeris((arc(0, 7200),)), CRAFT)
    assert (smooth.data_type, smooth.states) == (3, 8)  # records of 16 minutes
    assert smooth.error_m is not None and smooth.error_m < 1e-4
    rng = default_rng(1)
    seconds = np.cumsum(rng.uniform(30.0, 90.0, 60))
    position, velocity = circular(seconds)
    jagged = position + rng.normal(scale=50.0, size=(60, 3))
    uneven = EphemerisSegment(START + (seconds * NS).astype(np.int64), jagged, velocity)
    assert spk_kernel(Ephemeris((uneven,)), CRAFT).data_type == 13
    forced = spk_kernel(Ephemeris((uneven,)), CRAFT, 3)
    assert forced.error_m is not None and forced.error_m > 1.0


def test_segments_of_an_spk_stay_segments_with_the_shared_epoch_in_both(tmp_path):
    """The second solution is 10 km higher, and a third overlaps it: the last in the file counts."""
    first, second, third = arc(0, 600), arc(600, 1800), arc(1200, 1500)
    higher = EphemerisSegment(second.utc_ns, second.position_m * 1.00565, second.velocity_m_s)
    lower = EphemerisSegment(third.utc_ns, third.position_m * 0.99, third.velocity_m_s)
    both = written(tmp_path / "both.bsp", first, higher)
    with spiceypy_file(both) as (spice, handle):
        et = et_from_utc_ns(lower.utc_ns)
        states = np.concatenate([lower.position_m, lower.velocity_m_s], axis=1) / 1e3
        spice.spkw13(handle, CRAFT, 301, "J2000", et[0] + 3e-7, et[-1] - 3e-7, "late", 7, len(et), states, et)
    found = load_spk(both)
    spans = [(one.start_utc_ns - START, one.stop_utc_ns - START) for one in found.segments]
    assert spans == [(a * NS, b * NS) for a, b in ((0, 600), (600, 1200), (1200, 1500), (1500, 1800))]
    for segment, given in zip(found.segments, (first, higher, lower, higher), strict=True):
        expected, _ = Ephemeris((given,)).at_tai(segment.tai_ns)
        near(segment.position_m, expected, atol=2e-3)


@contextmanager
def spiceypy_file(path):
    handle = spiceypy.spkopa(str(path))
    try:
        yield spiceypy, handle
    finally:
        spiceypy.spkcls(handle)


def test_an_spk_in_axes_that_need_other_kernels_is_refused_by_its_frame(tmp_path):
    path = written(tmp_path / "fixed.bsp", arc(0, 600))
    octets = path.read_bytes()
    one = struct.pack("<iiii", CRAFT, 301, 1, 3)
    assert octets.count(one) == 1
    path.write_bytes(octets.replace(one, struct.pack("<iiii", CRAFT, 301, 123456, 3)))
    with raises(UnknownFrameError, match=rf"body {CRAFT}: expected a reference frame out of J2000, .*, found '123456'"):
        load_spk(path)


def test_a_gap_of_an_ephemeris_is_one_of_its_spk(tmp_path):
    segment = segment_of(np.r_[0:601:60, 3600:4201:60])
    for data_type in (3, 13):
        read = load_spk(written(tmp_path / f"{data_type}.bsp", segment, data_type=data_type))
        assert [one.covers(START + 1800 * NS) for one in (Ephemeris((segment,)), read)] == [False, False]


def test_a_file_that_is_no_spk_is_refused_in_one_line(tmp_path):
    path = tmp_path / "orbit.bsp"
    path.write_bytes(b"DAF/SPK " + bytes(2000))
    with raises(DataFileError, match=r"orbit\.bsp: expected an SPK, found") as caught:
        load_spk(path)
    assert "\n" not in str(caught.value)


def test_ck_clock_and_frame_turn_vectors_as_the_attitudes_do(tmp_path):
    utc_ns = START + np.arange(0, 600, 15) * NS
    ticks = ticks_from_utc_ns(utc_ns)
    rng = default_rng(3)
    q_wxyz = rng.normal(size=4) + 0.01 * np.arange(len(ticks))[:, None] * rng.normal(size=4)
    q_wxyz /= np.linalg.norm(q_wxyz, axis=1, keepdims=True)
    q_wxyz[7] *= -1.0
    clock = format_sclk([ClockLine(int(ticks[0]) - 1000 * TICKS_PER_SECOND, START - 1000 * NS)], CRAFT)
    with kernels(
        tmp_path,
        clock=clock,
        attitude=ck_octets(ticks, q_wxyz, CRAFT, gap_ticks=20 * TICKS_PER_SECOND),
        frame=format_fk(CRAFT, "Selenita"),
    ) as spice:
        assert spice.bodn2c("SELENITA") == CRAFT
        for k in range(len(ticks)):
            found = spice.pxform("J2000", "SELENITA_CAMERA", float(et_from_utc_ns(utc_ns[k])))
            # 2 us between the clocks turn by less than 1e-8 rad here.
            near(found, matrix_from_quaternion(q_wxyz[k]), atol=1e-7)
        middle = spice.pxform("J2000", "SELENITA_CAMERA", float(et_from_utc_ns(utc_ns[4] + 7 * NS)))
        assert np.allclose(middle @ middle.T, np.eye(3))
        outside = float(et_from_utc_ns(int(utc_ns[-1]) + 60 * NS))
        with raises(spiceypy.utils.exceptions.SpiceyError):
            spice.pxform("J2000", "SELENITA_CAMERA", outside)


def test_clock_of_two_correlations_shows_each_from_its_start(tmp_path):
    fast = 1.0 + 5e-6
    ticks = int(ticks_from_utc_ns(START))
    lines = [ClockLine(ticks, START + 250_000_000), ClockLine(ticks + 3600 * TICKS_PER_SECOND, START + 3601 * NS, fast)]
    with kernels(tmp_path, clock=format_sclk(lines, CRAFT)) as spice:
        for clock_s, real_s in ((1800, 1800.25), (3600, 3601.0), (7200, 3601.0 + 3600 * fast)):
            et = spice.sct2e(CRAFT, float(ticks + clock_s * TICKS_PER_SECOND))
            # Rates have 15 decimals, and a float64 of seconds 0.1 us.
            assert et == approx(float(et_from_utc_ns(START + round(real_s * NS))), abs=5e-7)


def test_field_of_view_is_that_of_the_camera(tmp_path):
    camera = PinholeCamera()
    number = camera_id(CRAFT)
    with kernels(tmp_path, camera=format_ik(camera, CRAFT, "SELENITA"), frame=format_fk(CRAFT, "SELENITA")) as spice:
        shape, frame, boresight, count, corners = spice.getfov(number, 8)
    assert (shape, frame, count) == ("POLYGON", "SELENITA_CAMERA", 4)
    assert_array_equal(boresight, [0.0, 0.0, 1.0])
    # 120 degrees between the edges of the image.
    assert np.ptp(np.degrees(np.arctan2(corners[:, 0], corners[:, 2]))) == approx(120.0, abs=1e-9)


def test_without_spiceypy_one_line_names_the_extra(monkeypatch):
    usual = builtins.__import__

    def without(name, *rest):
        if name == "spiceypy":
            raise ImportError(name)
        return usual(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with raises(MissingLibrary, match=r"expected the library spiceypy, found none; install linna\[spice\]"):
        spk_kernel(Ephemeris((arc(0, 600),)), CRAFT)
