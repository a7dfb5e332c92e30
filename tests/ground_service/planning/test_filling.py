"""Choice of windows within battery, storage, downlink, duty limit and quotas, compared with all sets of windows."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ground_service.planning.filling import Option, ResourceGrid, choose, take_in_order, violation
from lunar.constants import NS

HOUR = 3600 * NS
STEP_S = 600.0


def grid(hours=24, **changes):
    n = round(hours * 3600 / STEP_S)
    plain = ResourceGrid(
        start_utc_ns=0, step_s=STEP_S, gain_wh=np.full(n, 1.0), downlink_octets=np.full(n, 1000.0), battery_wh=50.0,
        floor_wh=15.0, observing_w=20.0, storage_octets=10_000.0,
    )  # fmt: skip
    return replace(plain, **changes)


def window(start_h, hours, octets=100, value=1.0, period=0):
    return Option(round(start_h * HOUR), round((start_h + hours) * HOUR), octets, value, period)


def why(one, *windows):
    """Return why windows are not feasible."""
    return violation(one, [window(*each) for each in windows])


def test_windows_that_touch_do_not_overlap():
    assert why(grid(), (1, 1), (2, 1)) is None
    for one, gap in ((grid(), 1.99), (grid(gap_ns=HOUR // 10), 2.09)):
        assert why(one, (1, 1), (gap, 1)) == "overlaps another window or its telecommands"
        assert why(one, (1, 1), (gap + 0.02, 1)) is None


def test_the_battery_is_that_of_a_balance_by_hand():
    # 6 Wh an hour in, 20 Wh an hour out: 14 Wh an hour less, from 50 Wh to 15 Wh in 2.5 h
    assert why(grid(), (1, 2.5)) is None
    assert why(grid(), (1, 2.6)) == "the battery would fall to 28 %, expected 30 % or more"
    # full again only after 28 / 6 h
    assert why(grid(), (1, 2), (3 + 14 / 3, 2.5)) is None
    assert why(grid(), (1, 2), (3 + 14 / 3 - 0.5, 2.5)) is not None


def test_energy_of_a_window_does_not_depend_on_the_steps():
    for start in (0.0, 0.1, 1.05, 23.0):
        change, _ = grid().flows([window(start, 0.75)])
        assert (grid().gain_wh - change).sum() == pytest.approx(15.0)


def test_stored_data_leave_in_contacts():
    silent = np.zeros(144)
    silent[60:63] = 1000.0
    assert why(grid(downlink_octets=silent), (1, 1, 3000)) is None
    assert why(grid(), (1, 1, 10_000)) is None
    assert why(grid(), (1, 1, 10_001)) == "10001 octets would be stored on board, expected at most 10000"
    full = grid(downlink_octets=silent)
    assert why(full, (1, 1, 6000), (3, 1, 5000)) is not None
    assert why(full, (1, 1, 6000), (11, 1, 5000)) is None  # 3000 left in between


def test_data_have_to_be_down_in_time():
    late = np.zeros(48 * 6)
    late[6 * 30] = 5000.0
    slow = grid(48, downlink_octets=late)
    assert why(slow, (1, 1, 100)) == "its data would not be down within 24 h"
    assert why(slow, (8, 1, 5000)) is None
    assert why(slow, (8, 1, 5001)) == "its data would not be down within 24 h"


def test_the_duty_limit_counts_windows_that_begin_within_a_day():
    strong = grid(72, gain_wh=np.full(72 * 6, 10.0), observe_s_per_day=7200.0)
    assert why(strong, (1, 1), (5, 1)) is None
    assert why(strong, (1, 1), (5, 1), (24.99, 0.5)) is not None
    assert why(strong, (1, 1), (5, 1), (25, 0.5)) is None


def test_quotas_are_kept_by_period_and_reasons_are_given():
    options = [window(k, 0.1, period=k // 4) for k in range(8)]
    chosen, reasons = choose(grid(), options, quota={0: 2, 1: 0})
    assert chosen == options[:2]
    assert set(reasons) == set(options[2:])
    assert set(reasons.values()) == {"the number of windows of its period is planned"}


def test_planned_windows_keep_their_resources():
    committed = [window(1, 2.4)]
    chosen, reasons = choose(grid(), [window(3.5, 1), window(20, 1)], committed)
    assert chosen == [window(20, 1)] and "battery" in reasons[window(3.5, 1)]


def test_nothing_is_chosen_of_nothing():
    assert choose(grid(), []) == ([], {})


options_of_a_day = st.lists(
    st.tuples(st.integers(0, 40), st.integers(1, 8), st.integers(1, 4000), st.integers(1, 5), st.integers(0, 1)).map(
        lambda v: window(v[0] / 2, v[1] / 4, v[2], float(v[3]), v[4])
    ),
    max_size=7,
    unique=True,
)


@settings(max_examples=60, deadline=None)
@given(options_of_a_day, st.integers(0, 4), st.integers(0, 4))
def test_a_plan_is_feasible_and_not_worse_than_any_order(options, first, second):
    tight = grid(downlink_octets=np.full(144, 150.0), storage_octets=5000.0, observe_s_per_day=4 * 3600.0)
    quota = {0: first, 1: second}
    chosen, reasons = choose(tight, options, quota=quota)
    assert violation(tight, chosen) is None
    assert all(sum(one.period == k for one in chosen) <= number for k, number in quota.items())
    assert sorted([*chosen, *reasons], key=hash) == sorted(options, key=hash)
    in_time = take_in_order(tight, sorted(options, key=lambda one: one.start_utc_ns), (), quota)[0]
    assert sum(one.value for one in chosen) >= sum(one.value for one in in_time)
    best = max(
        sum(one.value for one in some)
        for n in range(len(options) + 1)
        for some in itertools.combinations(options, n)
        if all(sum(one.period == k for one in some) <= number for k, number in quota.items())
        and violation(tight, some) is None
    )
    assert sum(one.value for one in chosen) <= best
    assert choose(tight, list(reversed(options)), quota=quota)[0] == chosen


def test_one_long_window_gives_way_to_several_of_more_value():
    long, short = window(2, 2.4, value=1.5), [window(2 + k, 0.5, value=1.0) for k in range(3)]
    chosen, _ = choose(grid(), [long, *short])
    assert chosen == short
