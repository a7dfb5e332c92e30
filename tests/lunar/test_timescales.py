"""Time scales against ERFA, NAIF and the leap-second table of the IERS."""

import erfa
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lunar.constants import NS
from lunar.errors import LeapSecondError, TimeFormatError
from lunar.timescales import (
    LEAP_DATES,
    TIME_SYSTEMS,
    format_tai,
    format_utc,
    from_tai_ns,
    in_leap_second,
    parse_tai,
    parse_utc,
    tai_ns_from_utc_ns,
    tdb_minus_tt_s,
    tdb_s_from_utc_ns,
    ticks_from_utc_ns,
    to_tai_ns,
    utc_ns_from_tai_ns,
    utc_ns_from_tdb_s,
    utc_ns_from_ticks,
)


def test_the_start_of_the_papers_month_is_the_posix_count_of_gnu_date():
    # date -u -d 2029-08-07T00:00:00Z +%s
    assert parse_utc("2029-08-07T00:00:00.000Z") == 1_880_755_200 * NS


def test_day_of_year_calendar_space_and_missing_time_name_the_same_epoch():
    texts = ("2029-08-07T00:00:00Z", "2029-219T00:00:00", "2029-08-07 00:00:00.0", "2029-08-07", "2029-08-07T00:00")
    assert {parse_utc(text) for text in texts} == {1_880_755_200 * NS}


def test_an_epoch_within_a_leap_second_is_refused_with_that_reason_where_it_has_no_count():
    with pytest.raises(LeapSecondError, match=r"epoch outside of a leap second, .* found '2016-12-31T23:59:60.5Z'"):
        parse_utc("2016-12-31T23:59:60.5Z")


@pytest.mark.parametrize("text", ["2016-12-30T23:59:60", "2016-12-31T22:59:60", "2029-06-30T23:59:60"])
def test_a_leap_second_that_does_not_exist_is_no_epoch(text):
    with pytest.raises(TimeFormatError, match="expected a UTC epoch like"):
        parse_tai(text)


def tai_of_erfa(text):
    date, clock = text.split("T")
    hours, minutes, seconds = clock.split(":")
    utc = erfa.dtf2d("UTC", *map(int, date.split("-")), int(hours), int(minutes), float(seconds))
    days, rest = erfa.utctai(*utc)
    return round((days - 2_440_587.5) * 86_400) * NS + round(rest * 86_400 * 1e9)


@pytest.fixture(params=["2016-12-31", "2029-06-30"])
def leap_day(request):
    """The last day with a leap second, and one that the table does not have yet."""
    table = erfa.leap_seconds.get()
    if request.param == "2029-06-30":
        LEAP_DATES.append("2029-07-01")
        erfa.leap_seconds.set(np.append(table, np.array([(2029, 7, 38.0)], dtype=table.dtype)))
    yield request.param
    erfa.leap_seconds.set(table)
    if request.param == "2029-06-30":
        LEAP_DATES.pop()


@pytest.mark.filterwarnings("ignore:ERFA function")
def test_instants_around_and_within_a_leap_second_are_those_of_erfa_in_every_time_system(leap_day):
    next_day = str(np.datetime64(leap_day) + 1)
    texts = [f"{leap_day}T23:59:59.25", f"{leap_day}T23:59:60", f"{leap_day}T23:59:60.999", f"{next_day}T00:00:00.5"]
    for text in texts:
        tai = parse_tai(text)
        # Two float64 of days are good to 0.01 ns, the text to a nanosecond.
        assert abs(tai - tai_of_erfa(text)) <= 20_000, text
        assert format_tai(tai, 9).rstrip("Z") == f"{text:0<29}" if "." in text else f"{text}.000000000"
        assert in_leap_second(tai) == (":60" in text)
        for system in ("TAI", "TT", "TDB", "GPS"):
            counts = from_tai_ns(tai, system)
            assert to_tai_ns(counts, system) == tai
            assert parse_tai(str(np.datetime64(counts, "ns")), system) == tai
        assert from_tai_ns(tai, "TT") - tai == 32_184_000_000
        assert from_tai_ns(tai, "GPS") - tai == -19 * NS
        seconds = (from_tai_ns(tai, "TT") / NS - 946_728_000.0) / 86_400.0
        tdb = from_tai_ns(tai, "TDB") - from_tai_ns(tai, "TT")
        assert tdb / NS == pytest.approx(erfa.dtdb(2_451_545.0, seconds, 0.0, 0.0, 0.0, 0.0), abs=20e-6)


def test_rounding_within_a_leap_second_carries_into_the_next_day():
    assert format_tai(parse_tai("2016-12-31T23:59:60.9996")) == "2017-01-01T00:00:00.000Z"
    assert format_tai(parse_tai("2016-12-31T23:59:59.9996")) == "2016-12-31T23:59:60.000Z"


NO_EPOCHS = """
soon, 07/08/2029, 2029-13-01T00:00:00, 2029-02-29T00:00:00, 2029-366T00:00:00, 2029-000T00:00:00,
2029-08-07T24:00:00, 2029-08-07T00:00:61, 2029-08-07T00:00:00+01:00
"""


@pytest.mark.parametrize("text", ["", *NO_EPOCHS.replace("\n", " ").strip().split(", ")])
def test_what_is_no_utc_epoch_is_refused_with_the_text(text):
    with pytest.raises(TimeFormatError, match="expected a UTC epoch") as caught:
        parse_utc(text)
    assert repr(text) in str(caught.value)


@given(st.integers(0, 4_102_444_800 * NS))  # 1970 to 2100
def test_counts_survive_text_with_nine_digits_and_tai(utc_ns):
    assert parse_utc(format_utc(utc_ns, 9)) == utc_ns_from_tai_ns(tai_ns_from_utc_ns(utc_ns)) == utc_ns
    # Seconds past J2000 up to 3.2e9 are resolved to 0.5 us.
    assert abs(utc_ns_from_tdb_s(tdb_s_from_utc_ns(utc_ns)) - utc_ns) <= 500


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


def test_tdb_minus_tt_agrees_with_the_full_series_of_erfa_to_20_us():
    # erfa.dtdb: Fairhead and Bretagnon 1990, 787 terms, good to nanoseconds.  The short series claims 10 us; 20 us move
    # the Moon's ground under an orbiter by 0.1 mm.
    days = np.linspace(-15_000.0, 20_000.0, 400)
    full = erfa.dtdb(2_451_545.0, days, 0.0, 0.0, 0.0, 0.0)
    assert np.max(np.abs(tdb_minus_tt_s(days * 86_400.0) - full)) < 20e-6


def test_tdb_of_the_example_in_the_lunar_frame_kernel_of_naif():
    # moon_080317.tf, "Program output": '2008 MAR 17 20:10:00' is "ET (sec past J2000 TDB): 259056665." (whole seconds).
    assert int(tdb_s_from_utc_ns(parse_utc("2008-03-17T20:10:00"))) == 259_056_665


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
    tai_ns = tai_ns_from_utc_ns(utc_ns)
    assert np.array_equal(to_tai_ns(from_tai_ns(tai_ns, system), system), tai_ns)


def test_gps_time_is_ahead_of_utc_by_18_s_since_2017():
    utc_ns = parse_utc("2029-08-07T00:00:00")
    assert from_tai_ns(tai_ns_from_utc_ns(utc_ns), "GPS") - utc_ns == 18 * NS


def test_numbers_give_numbers_and_arrays_give_arrays_of_the_same_shape():
    utc_ns = parse_utc("2029-08-07")
    assert type(tdb_s_from_utc_ns(utc_ns)) is float
    assert type(ticks_from_utc_ns(utc_ns)) is int
    for shape in ((0,), (1,), (2, 3)):
        array = np.full(shape, utc_ns, dtype=np.int64)
        assert tdb_s_from_utc_ns(array).shape == shape
        assert ticks_from_utc_ns(array).dtype == np.int64
        assert utc_ns_from_ticks(ticks_from_utc_ns(array)).shape == shape
