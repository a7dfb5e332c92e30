"""Numbers, times and names as they are printed."""

import math

import pytest

from reports.document import evidence_label, evidence_number, evidence_text
from reports.text import (
    NOT_A_VALUE,
    count_text,
    duration_text,
    headline_text,
    length_text,
    number_text,
    percent_text,
    rate_text,
    significant_text,
    utc_text,
)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (51.23, "51.2"),
        (0.70444, "0.704"),
        (0.0996, "0.0996"),
        (0.9996, "1.00"),
        (148.4, "148"),
        (59_012.0, "59\u202f000"),
        (9, "9"),
        (12_345, "12\u202f345"),
        (-3.14159, "−3.14"),
        (0.0, "0"),
        (math.nan, "–"),
        (None, "–"),
        ("words", "words"),
        (1e-9, "1.00e−09"),
    ],
)
def test_three_significant_digits(value: float | int | str | None, text: str) -> None:
    assert significant_text(value) == text


@pytest.mark.parametrize(
    ("metres", "text"),
    [(84.0, "84.0 m"), (999.4, "999 m"), (1_310.0, "1.31 km"), (58_960.0, "59.0 km"), (math.nan, "–")],
)
def test_lengths_carry_the_unit_that_fits(metres: float, text: str) -> None:
    assert length_text(metres) == text


def test_shares_of_nothing_are_no_number() -> None:
    assert percent_text(3, 0) == "–"
    assert percent_text(1, 3) == "33.3\u202f%"


def test_counts_and_numbers_are_grouped_by_thousands() -> None:
    assert count_text(1_234_567) == "1\u202f234\u202f567"
    assert number_text(-1234.5, 1) == "−1\u202f234.5"
    assert count_text(None) == "–"


def test_times_are_cut_to_the_second_and_named() -> None:
    # The leap day and the last second before 1970 are the edges of the calendar arithmetic.
    assert utc_text(951_782_400_000_000_000) == "2000-02-29 00:00:00 UTC"
    assert utc_text(-1) == "1969-12-31 23:59:59 UTC"
    assert utc_text(None) == "–"


@pytest.mark.parametrize(
    ("seconds", "text"), [(42.0, "42 s"), (2_220.0, "37.0 min"), (86_400.0, "24.0 h"), (864_000.0, "10.0 d")]
)
def test_durations_fit_their_size(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text


@pytest.mark.parametrize(
    ("level", "number"),
    [
        ("3", 3),
        ("level 2", 2),
        ("(4) another renderer", 4),
        ("3s (real terrain seen in training)", 3),
        ("real terrain", None),
        ("flown over 3 craters", None),
        ("31", None),
        ("", None),
    ],
)
def test_evidence_levels_are_read_from_their_number_and_never_guessed_from_words(
    level: str, number: int | None
) -> None:
    assert evidence_number(level) == number


def test_a_level_on_terrain_seen_in_training_keeps_its_mark_and_words() -> None:
    text = "3s (real terrain seen in training; 25 % of frames over unseen terrain)"
    assert (
        evidence_label(text) == "3s"
        and evidence_label("3 (real terrain)") == "3"
        and evidence_label("") == ""
    )
    assert evidence_text(text) == f"level 3s of 5, {text[4:-1]}"
    assert evidence_text("3s") == "level 3s of 5, real terrain seen in training"
    assert evidence_text("3") == "level 3 of 5, real terrain never used in training"
    assert (
        evidence_text("2") == "level 2 of 5, procedural Moon" and evidence_text("") == "evidence not stated"
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.1e-5, "< 0.001"), (-1.1e-5, "> −0.001"), (1.23e-3, "0.00123"), (0.0, "0"), (28.14, "28.1"), (0, "0")],
)
def test_what_is_next_to_nothing_is_said_so_on_the_first_page(value: float, text: str) -> None:
    assert headline_text(value) == text


def test_a_rate_of_zero_has_no_power_of_ten() -> None:
    assert [rate_text(rate) for rate in (None, 0.0, 2.5e-5)] == [NOT_A_VALUE, "0", "2.5e-05"]
