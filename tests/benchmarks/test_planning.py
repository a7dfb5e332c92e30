"""The optimal plan of the planning benchmark agrees with the best of all subsets."""

from __future__ import annotations

import sys
from itertools import chain, combinations
from pathlib import Path

import numpy as np
import pytest

from benchmarks.planning import by_cp_sat, by_highs, day_by_day, program_of
from ground_service.planning.filling import NS, Option, ResourceGrid, violation

HOUR_NS = 3600 * NS


def _grid(**given: object) -> ResourceGrid:
    values: dict[str, object] = {
        "start_utc_ns": 0,
        "step_s": 1800.0,
        "gain_wh": np.array([2.0, 1.0, -3.0, 4.0] * 6),
        "downlink_octets": np.array([0.0, 700.0, 0.0, 300.0] * 6),
        "battery_wh": 20.0,
        "floor_wh": 8.0,
        "observing_w": 9.0,
        "storage_octets": 2500.0,
        "downlink_within_s": 2 * 3600.0,
    }
    return ResourceGrid(**{**values, **given})


def _options() -> list[Option]:
    begins = (0.2, 0.9, 1.6, 2.1, 3.4, 4.0, 4.9, 6.3, 7.1, 8.2)
    lengths = (0.6, 1.0, 0.4, 1.1, 0.7, 0.8, 1.2, 0.5, 0.9, 0.6)
    return [
        Option(round(begin * HOUR_NS), round((begin + length) * HOUR_NS), round(1100 * length), period=k // 5)
        for k, (begin, length) in enumerate(zip(begins, lengths, strict=True))
    ]


@pytest.mark.parametrize(
    ("grid", "quota"),
    [
        (_grid(), None),
        (_grid(), {0: 2, 1: 1}),
        (_grid(observe_s_per_day=7000.0), None),
        (_grid(floor_wh=3.0, storage_octets=1500.0), None),
        (_grid(downlink_octets=np.full(24, 1e9)), None),
    ],
)
def test_the_optimal_plan_is_the_best_of_all_subsets(
    grid: ResourceGrid, quota: dict[int, int] | None
) -> None:
    options = _options()
    values = [round((one.stop_utc_ns - one.start_utc_ns) / NS / 15.0) for one in options]
    subsets = chain.from_iterable(combinations(range(len(options)), n) for n in range(len(options) + 1))
    feasible = [
        subset
        for subset in subsets
        if violation(grid, [options[k] for k in subset]) is None
        and (
            quota is None
            or all(sum(options[k].period == period for k in subset) <= n for period, n in quota.items())
        )
    ]
    best = max(sum(values[k] for k in subset) for subset in feasible)
    chosen, bound = by_highs(program_of(grid, options, quota), values, 10.0)
    assert tuple(chosen) in feasible
    assert sum(values[k] for k in chosen) == best < sum(values)
    assert bound == pytest.approx(best)


def test_a_plan_made_day_by_day_keeps_the_limits_and_plans_every_day() -> None:
    grid = _grid(gain_wh=np.full(240, 3.0), downlink_octets=np.full(240, 1e6), observe_s_per_day=2 * 3600.0)
    options = [
        Option(one.start_utc_ns + 24 * HOUR_NS * day, one.stop_utc_ns + 24 * HOUR_NS * day, one.octets)
        for day in range(4)
        for one in _options()
    ]
    plan = day_by_day(grid, options, None)
    assert violation(grid, plan) is None
    assert {one.start_utc_ns // (24 * HOUR_NS) for one in plan} == {0, 1, 2, 3}


def test_an_environment_without_or_tools_ends_with_one_line(tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\nexec {sys.executable} -c 'import no_such_solver'\n")
    python.chmod(0o755)
    with pytest.raises(SystemExit, match="No module named 'no_such_solver'"):
        by_cp_sat(program_of(_grid(), _options(), None), [1] * len(_options()), 1.0, python)
