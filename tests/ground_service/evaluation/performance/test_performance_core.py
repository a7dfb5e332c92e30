"""Means, change points and shares over passes."""

import math

import numpy as np
from pytest import approx, mark

from ground_service.evaluation.performance import core
from ground_service.evaluation.performance.core import (
    ALTITUDE_EDGES_KM,
    FALSE_ALARM_RATE,
    LEAST_PASSES,
    change_points,
    interval_name,
    interval_names,
    mean_level,
    rolling_counts,
    wilson,
)

NAN = math.nan


def test_a_mean_has_the_interval_of_students_t_and_a_single_pass_none():
    level = mean_level([1.0, 2.0, NAN, 3.0])
    # t with 2 degrees of freedom at 0.975 is 4.302653 (table); standard error 1 / sqrt(3).
    assert (level.passes, level.mean) == (3, 2.0)
    assert level.high - 2.0 == approx(4.302653 / math.sqrt(3.0), abs=1e-6)
    assert 2.0 - level.low == approx(level.high - 2.0)
    one = mean_level([0.5])
    assert (one.passes, one.mean) == (1, 0.5) and math.isnan(one.low) and math.isnan(one.high)
    none = mean_level([NAN])
    assert none.passes == 0 and math.isnan(none.mean)


@mark.parametrize(
    "value, name",
    [
        (19.999, "below 20 km"), (20.0, "20 to 30 km"), (39.0, "30 to 40 km"), (40.0, "40 km and above"),
        (NAN, "unknown"),
    ],
)  # fmt: skip
def test_a_value_belongs_to_one_interval(value, name):
    assert interval_name(value, ALTITUDE_EDGES_KM, "km") == name
    assert interval_names(ALTITUDE_EDGES_KM, "km") == [
        "below 20 km", "20 to 30 km", "30 to 40 km", "40 km and above", "unknown",
    ]  # fmt: skip


def test_steps_are_found_in_order_at_their_places_with_the_medians_of_both_sides():
    values = [0.70, 0.72, NAN, 0.71, 0.69, 0.73, 0.70, 0.71, 0.50, 0.52, 0.51, 0.49, 0.50, 0.53, 0.51]
    [change] = change_points(values)
    assert change.index == 8
    assert (change.before, change.after) == (0.71, 0.51)
    assert (change.count_before, change.count_after) == (7, 7)
    assert change.p_value <= FALSE_ALARM_RATE / 3.0
    rng = np.random.default_rng(1)
    values = np.concatenate([rng.normal(level, 1.0, 20) for level in (0.0, 6.0, -3.0)])
    found = change_points(values.tolist())
    assert [one.index for one in found] == [20, 40]
    assert [(one.count_before, one.count_after) for one in found] == [(20, 20), (20, 20)]
    assert found[0].after == found[1].before


def test_constant_levels_seldom_give_a_change_and_the_rate_is_divided_among_the_metrics():
    """Of 200 series without a change, the expected number with one is at most 200 * 0.01 / 3 < 1."""
    rng = np.random.default_rng(2)
    alarms = sum(bool(change_points(values.tolist(), permutations=999)) for values in rng.standard_cauchy((200, 24)))
    # With a probability of 0.0033 in each, more than 5 of 200 have a probability below 1e-4.
    assert alarms <= 5
    rng = np.random.default_rng(5)
    values = np.concatenate([rng.normal(0.0, 1.0, 12), rng.normal(2.0, 1.0, 12)]).tolist()
    [alone] = change_points(values, metrics=1)
    assert FALSE_ALARM_RATE / 100.0 < alone.p_value <= FALSE_ALARM_RATE
    assert change_points(values, metrics=1000) == []


@mark.parametrize("values", [[], [1.0], [NAN] * 30, [1.0] * 30, [0.0] * 4 + [9.0] * 5])
def test_nothing_is_found_in_few_or_equal_values(values):
    assert change_points(values) == []
    assert len(values) < 2 * LEAST_PASSES or len(set(map(str, values))) == 1


def test_a_share_has_the_interval_of_wilson_and_a_window_excludes_passes_of_its_length_ago():
    # Agresti and Coull, The American Statistician 52 (1998): 10 of 10 gives 0.722 to 1.
    share = wilson(10, 10)
    assert share.share == 1.0
    assert share.low == approx(0.7225, abs=1e-4)
    assert share.high == approx(1.0)
    assert math.isnan(wilson(0, 0).share)
    counts = rolling_counts([0, 10, 20, 21], ["met", "not met", "met", "unknown"], 20)
    assert counts == [
        {"met": 1}, {"met": 1, "not met": 1}, {"met": 1, "not met": 1}, {"met": 1, "not met": 1, "unknown": 1},
    ]  # fmt: skip


def test_permutations_in_blocks_give_the_same_changes(monkeypatch):
    values = np.random.default_rng(3).normal(size=60) + np.repeat([0.0, 3.0], 30)
    whole = core.change_points(values.tolist(), permutations=301)
    largest = []
    permuted = core._largest_cusum

    def seen(ranks):
        largest.append(ranks.size)
        return permuted(ranks)

    monkeypatch.setattr(core, "_largest_cusum", seen)
    monkeypatch.setattr(core, "_BLOCK_VALUES", 700)
    assert core.change_points(values.tolist(), permutations=301) == whole != []
    assert max(largest) <= 700
