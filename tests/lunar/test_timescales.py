"""Time scales against ERFA, NAIF and the leap-second table of the IERS."""

import erfa
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lunar.errors import TimeFormatError
from lunar.timescales import (
    NS,
    TIME_SYSTEMS,
    format_utc,
    from_utc_ns,
    parse_utc,
    tai_ns_from_utc_ns,
    tdb_minus_tt_s,
    tdb_s_from_utc_ns,
    ticks_from_utc_ns,
    to_utc_ns,
    utc_ns_from_tai_ns,
    utc_ns_from_tdb_s,
    utc_ns_from_ticks,
)

# 1970 to 2100.
epochs_utc_ns = st.integers(0, 4_102_444_800 * NS)


def test_the_start_of_the_papers_month_is_the_posix_count_of_gnu_date():
    # date -u -d 2029-08-07T00:00:00Z +%s
    assert parse_utc("2029-08-07T00:00:00.000Z") == 1_880_755_200 * NS


def test_day_of_year_calendar_space_and_missing_time_name_the_same_epoch():
    texts = (
        "2029-08-07T00:00:00Z",
        "2029-219T00:00:00",
        "2029-08-07 00:00:00.0",
        "2029-08-07",
        "2029-08-07T00:00",
    )
    assert {parse_utc(text) for text in texts} == {1_880_755_200 * NS}


def test_a_leap_second_counts_as_the_first_second_of_the_next_day():
    assert parse_utc("2016-12-31T23:59:60.5Z") == parse_utc("2017-01-01T00:00:00.5Z")


@pytest.mark.parametrize(
    "text",
    [
        *("", "soon", "07/08/2029", "2029-13-01T00:00:00", "2029-02-29T00:00:00", "2029-366T00:00:00"),
        *("2029-000T00:00:00", "2029-08-07T24:00:00", "2029-08-07T00:00:61", "2029-08-07T00:00:00+01:00"),
    ],
)
def test_what_is_no_utc_epoch_is_refused_with_the_text(text):
    with pytest.raises(TimeFormatError, match="expected a UTC epoch") as caught:
        parse_utc(text)
    assert repr(text) in str(caught.value)


@given(epochs_utc_ns)
def test_formatting_with_nine_digits_loses_nothing(utc_ns):
    assert parse_utc(format_utc(utc_ns, 9)) == utc_ns


def test_rounding_to_milliseconds_carries_into_the_next_day():
    assert format_utc(parse_utc("2029-12-31T23:59:59.999600000")) == "2030-01-01T00:00:00.000Z"


def test_tai_minus_utc_is_that_of_erfa_at_every_step_of_the_leap_second_table():
    table = erfa.leap_seconds.get()
    table = table[table["year"] >= 1972]
    assert len(table) == 28  # else the IERS announced a new one and this module must learn it
    for year, month, offset in table.tolist():
        after = parse_utc(f"{year}-{month:02d}-01T00:00:00")
        assert tai_ns_from_utc_ns(after) - after == round(offset) * NS
        assert tai_ns_from_utc_ns(after - 1) - (after - 1) == max(round(offset) - 1, 10) * NS


@given(epochs_utc_ns)
def test_tai_and_back_is_the_same_count(utc_ns):
    assert utc_ns_from_tai_ns(tai_ns_from_utc_ns(utc_ns)) == utc_ns


def test_tdb_minus_tt_agrees_with_the_full_series_of_erfa_to_20_us():
    # erfa.dtdb: Fairhead and Bretagnon 1990, 787 terms, good to nanoseconds.  The short series claims 10 us; 20 us move
    # the Moon's ground under an orbiter by 0.1 mm.
    days = np.linspace(-15_000.0, 20_000.0, 400)
    full = erfa.dtdb(2_451_545.0, days, 0.0, 0.0, 0.0, 0.0)
    assert np.max(np.abs(tdb_minus_tt_s(days * 86_400.0) - full)) < 20e-6


def test_tdb_of_the_example_in_the_lunar_frame_kernel_of_naif():
    # moon_080317.tf, "Program output": '2008 MAR 17 20:10:00' is "ET (sec past J2000 TDB): 259056665." (whole seconds).
    assert int(tdb_s_from_utc_ns(parse_utc("2008-03-17T20:10:00"))) == 259_056_665


@given(epochs_utc_ns)
def test_tdb_and_back_is_good_to_the_resolution_of_float64(utc_ns):
    # Seconds past J2000 up to 3.2e9 are told apart to 0.5 us.
    assert abs(utc_ns_from_tdb_s(tdb_s_from_utc_ns(utc_ns)) - utc_ns) <= 500


def test_the_onboard_clock_starts_at_zero_at_2000_tai():
    # TAI - UTC was 32 s then.
    assert ticks_from_utc_ns(parse_utc("1999-12-31T23:59:28Z")) == 0
    assert ticks_from_utc_ns(parse_utc("1999-12-31T23:59:29Z")) == 65_536


@given(st.integers(0, 2**48 - 1))
def test_every_reading_of_the_onboard_clock_survives_utc_and_back(ticks):
    assert ticks_from_utc_ns(utc_ns_from_ticks(ticks)) == ticks


@pytest.mark.parametrize("system", TIME_SYSTEMS)
def test_every_time_system_of_a_file_converts_there_and_back(system):
    utc_ns = parse_utc("2029-08-07T00:00:00") + np.arange(5) * 86_400 * NS
    assert np.array_equal(to_utc_ns(from_utc_ns(utc_ns, system), system), utc_ns)


def test_gps_time_is_ahead_of_utc_by_18_s_since_2017():
    utc_ns = parse_utc("2029-08-07T00:00:00")
    assert from_utc_ns(utc_ns, "GPS") - utc_ns == 18 * NS


def test_numbers_give_numbers_and_arrays_give_arrays_of_the_same_shape():
    utc_ns = parse_utc("2029-08-07")
    assert type(tdb_s_from_utc_ns(utc_ns)) is float
    assert type(ticks_from_utc_ns(utc_ns)) is int
    for shape in ((0,), (1,), (2, 3)):
        array = np.full(shape, utc_ns, dtype=np.int64)
        assert tdb_s_from_utc_ns(array).shape == shape
        assert ticks_from_utc_ns(array).dtype == np.int64
        assert utc_ns_from_ticks(ticks_from_utc_ns(array)).shape == shape
