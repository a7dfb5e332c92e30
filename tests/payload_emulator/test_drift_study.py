"""Study of bounded drift: times by hand on drawn errors, intervals, and one small run with a known outcome."""

from dataclasses import replace

import numpy as np
import pytest

from lunar.datafolder import find_data
from studies.drift import (
    PassResult,
    beats_after_min,
    bounded_for_min,
    conditions,
    format_markdown,
    median_interval,
    name_of,
    study,
)

NONE = float("nan")


def result(vision: list[float], propagation: list[float]) -> PassResult:
    return PassResult(np.arange(len(vision)) * 60.0, np.array(vision), np.array(propagation))


def test_vision_wins_from_the_frame_after_the_last_one_that_is_worse() -> None:
    one = result([50, 90, 40, 80, 30, 9e9], [60, 60, 60, 70, 100, NONE])
    assert beats_after_min(one) == 4.0  # worse at 1 and 3 minutes; the coast does not count
    assert beats_after_min(result([10, 10, 1], [20, 20, NONE])) == 0.0
    assert beats_after_min(result([10, 30, 1], [20, 20, NONE])) == float("inf")


def test_a_coast_is_bounded_until_the_first_error_above_the_bound() -> None:
    one = result([10, 20, 90, 101, 90, 300], [1, 1, NONE, NONE, NONE, NONE])
    assert bounded_for_min(one, 100.0) == 2.0  # images end at minute 1
    assert bounded_for_min(one, 1000.0) == float("inf")
    assert bounded_for_min(result([10, 200, 50], [1, 1, NONE]), 100.0) == 0.0


def test_medians_and_intervals_hold_with_endless_values() -> None:
    one = median_interval(np.array([1.0, 2.0, 3.0, 4.0, np.inf]))
    assert one.value == 3.0 and one.low <= 3.0 <= one.high and one.high == float("inf")
    same = median_interval(np.full(7, 5.0))
    assert (same.value, same.low, same.high) == (5.0, 5.0, 5.0)


def test_each_condition_changes_what_it_says_and_nothing_else() -> None:
    made = {name_of(one): one.case for one in conditions(find_data(None), 0.5)}
    nominal = made["nominal"]
    assert {name.partition(":")[0] for name in made} == {
        "nominal", "altitude", "illumination", "terrain", "catalogue", "build",
    }  # fmt: skip
    low = made["altitude: 20 km, circular"]
    assert np.linalg.norm(low.position_icrf_m) == pytest.approx(1_757_400.0, abs=200.0)
    assert low.detector == nominal.detector and low.craters is nominal.craters
    tenth = made["illumination: 10 % of the revolution"]
    assert tenth.imaging.sum() == pytest.approx(0.1 * nominal.imaging.sum(), abs=1)
    assert len(made["terrain: mare, a fifth of the craters"].craters) == pytest.approx(
        0.2 * len(nominal.craters), rel=0.03
    )
    few = made["catalogue: 5 % of the craters, spread"]
    assert few.on_board is not None and few.on_board.sum() == round(0.05 * len(nominal.craters))
    assert made["build: detector of the paper's Table II"].detector.recall[0] == 0.3248


@pytest.mark.slow
def test_images_bound_the_error_and_their_end_lets_it_grow() -> None:
    nominal = conditions(find_data(None), 0.5)[0]
    span = nominal.case.frame_utc_ns < nominal.case.frame_utc_ns[0] + 8_500 * 1_000_000_000
    case = replace(
        nominal.case,
        frame_utc_ns=nominal.case.frame_utc_ns[span][::4],
        imaging=nominal.case.imaging[span][::4],
    )
    rows, flown = study([replace(nominal, case=case)], [2001, 2002])
    assert rows[0].error_m.value < 300.0 < rows[0].propagation_m.value
    for one in flown["nominal"]:
        coast = ~np.isfinite(one.propagation_m)
        assert one.vision_m[coast].max() > one.vision_m[~coast][-1]
    assert "| paper's orbit, 19 to 43 km |" in format_markdown(rows)
