"""Choice of windows within the resources: battery, storage, downlink, duty limit and quotas, on a grid of time.

The battery is full where the grid begins. Data of a window are on board from its stop, leave in the order they came,
and have to be down within a given time. All planners are checked by the same simulation (`violation`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from itertools import pairwise

import numpy as np

from lunar.arrays import FloatArray
from lunar.constants import DAY_NS, NS

ROUNDS = 3
"""Passes of the exchange over all options; later ones found nothing in the months that were tried."""

ROUNDING_WH = 1e-6
"""Above the rounding of the sums, below any energy that counts."""

NEAR_NS = DAY_NS
"""Windows further apart than this are not exchanged: their resources hardly interact."""


@dataclass(frozen=True, slots=True)
class Option:
    """A window that may be chosen; `value` is what it adds to the plan, `period` the quota that it counts to."""

    start_utc_ns: int
    stop_utc_ns: int
    octets: int
    value: float = 1.0
    period: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class ResourceGrid:
    """Resources over steps of `step_s` from `start_utc_ns` on.

    Attributes
    ----------
    gain_wh
        Generation minus idle load of each step (n,).
    downlink_octets
        Octets that contacts can take in each step (n,).
    observe_s_per_day
        Largest duration of windows that begin within 24 hours; None: any.
    gap_ns
        Time between two windows that their telecommands need.
    """

    start_utc_ns: int
    step_s: float
    gain_wh: FloatArray
    downlink_octets: FloatArray
    battery_wh: float
    floor_wh: float
    observing_w: float
    storage_octets: float
    downlink_within_s: float = 86_400.0
    observe_s_per_day: float | None = None
    gap_ns: int = 0

    @property
    def step_ns(self) -> int:
        """Length of a step."""
        return round(self.step_s * NS)

    def observing_s(self, option: Option) -> FloatArray:
        """Return the time of an observation within each step (n,)."""
        edges = self.start_utc_ns + np.arange(len(self.gain_wh) + 1, dtype=np.int64) * self.step_ns
        inside = np.minimum(edges[1:], option.stop_utc_ns) - np.maximum(edges[:-1], option.start_utc_ns)
        return np.asarray(np.maximum(inside, 0) / NS)

    def arrival(self, option: Option) -> int:
        """Return the step at whose end the data of an observation are on board."""
        step = (option.stop_utc_ns - self.start_utc_ns) // self.step_ns
        return int(min(max(step, 0), len(self.gain_wh) - 1))

    def flows(self, chosen: Sequence[Option]) -> tuple[FloatArray, FloatArray]:
        """Return the change of the battery and the octets that arrive in each step (n,) with a set of windows."""
        change, arrivals = self.gain_wh.copy(), np.zeros(len(self.gain_wh))
        for option in chosen:
            change -= self.observing_s(option) * self.observing_w / 3600.0
            arrivals[self.arrival(option)] += option.octets
        return change, arrivals

    @property
    def later_octets(self) -> FloatArray:
        """Octets that contacts can take within `downlink_within_s` after each step (n,); infinite where unknown."""
        n, ahead = len(self.downlink_octets), round(self.downlink_within_s / self.step_s)
        total = np.concatenate(([0.0], np.cumsum(self.downlink_octets)))
        index = np.arange(n)
        later = total[np.minimum(index + 1 + ahead, n)] - total[index + 1]
        return np.asarray(np.where(index + 1 + ahead > n, np.inf, later))


def violation(grid: ResourceGrid, chosen: Sequence[Option]) -> str | None:
    """Return the first limit that a set of windows breaks; None if it keeps all."""
    ordered = sorted(chosen, key=lambda one: (one.start_utc_ns, one.stop_utc_ns))
    for before, after in pairwise(ordered):
        if after.start_utc_ns < before.stop_utc_ns + grid.gap_ns:
            return "overlaps another window or its telecommands"
    if (reason := _duty_violation(grid, ordered)) is not None:
        return reason
    change, arrivals = grid.flows(ordered)
    return _battery_violation(grid, change) or _storage_violation(grid, arrivals)


@dataclass(frozen=True, slots=True, eq=False)
class ResourceCurves:
    """Resources at the end of each step (n,) of a grid, with the windows of a plan; `sent_octets` within each step."""

    battery_wh: FloatArray
    stored_octets: FloatArray
    sent_octets: FloatArray


def curves(grid: ResourceGrid, chosen: Sequence[Option]) -> ResourceCurves:
    """Return battery, storage and downlink with a set of windows, whether or not it keeps the limits.

    Data come on board while a window lasts. The check of the limits takes them at its end, when they can be downlinked.
    """
    change, _ = grid.flows(chosen)
    arrivals = np.zeros(len(change))
    for option in chosen:
        inside = grid.observing_s(option)
        arrivals += option.octets * inside / max(inside.sum(), 1e-9)
    battery, stored, sent = np.empty(len(change)), np.empty(len(change)), np.empty(len(change))
    charge, held = grid.battery_wh, 0.0
    for i, (gain, arrived, can) in enumerate(
        zip(change.tolist(), arrivals.tolist(), grid.downlink_octets.tolist(), strict=True)
    ):
        charge = min(max(charge + gain, 0.0), grid.battery_wh)
        sent[i] = min(held, can)
        held += arrived - sent[i]
        battery[i], stored[i] = charge, held
    return ResourceCurves(battery, stored, sent)


def take_in_order(
    grid: ResourceGrid, options: Sequence[Option], committed: Sequence[Option], quota: Mapping[int, int] | None = None
) -> tuple[list[Option], dict[Option, str]]:
    """Take each option, in the given order, that the resources permit; return them and the reasons of the others.

    Parameters
    ----------
    quota
        Largest number of windows by period; None: any number.
    """
    taken: list[Option] = []
    reasons: dict[Option, str] = {}
    left = None if quota is None else dict(quota)
    for option in options:
        if left is not None and left.get(option.period, 0) <= 0:
            reasons[option] = "the number of windows of its period is planned"
            continue
        reason = violation(grid, [*committed, *taken, option])
        if reason is not None:
            reasons[option] = reason
            continue
        taken.append(option)
        if left is not None:
            left[option.period] -= 1
    return taken, reasons


def choose(
    grid: ResourceGrid,
    options: Sequence[Option],
    committed: Sequence[Option] = (),
    quota: Mapping[int, int] | None = None,
) -> tuple[list[Option], dict[Option, str]]:
    """Return the windows of a plan in order of time, and the reasons of the others.

    Options are taken in several fixed orders; the best result is improved by exchanges of one window for others.
    """
    options = sorted(options, key=astuple)  # equal values keep an order of their own, not that of the call
    orders = (
        options,
        sorted(options, key=lambda one: (-one.value / (one.stop_utc_ns - one.start_utc_ns), one.start_utc_ns)),
        sorted(options, key=lambda one: (-one.value, one.start_utc_ns)),
    )
    plans = [take_in_order(grid, order, committed, quota)[0] for order in orders]
    best = max(plans, key=_value)  # of equal plans the first, which has the earliest windows
    if _value(best) < _bound(options, quota):
        best = _improved(grid, best, orders[2], committed, quota)
    best.sort(key=lambda one: one.start_utc_ns)
    _, reasons = take_in_order(
        grid, [one for one in orders[0] if one not in best], [*committed, *best], _left(quota, best)
    )
    return best, reasons


def _improved(
    grid: ResourceGrid,
    plan: list[Option],
    options: Sequence[Option],
    committed: Sequence[Option],
    quota: Mapping[int, int] | None,
) -> list[Option]:
    for _ in range(ROUNDS):
        before = _value(plan)
        for out in sorted(plan, key=lambda one: (one.value, one.start_utc_ns)):
            if out not in plan:
                continue
            rest = [one for one in plan if one is not out]
            near = [one for one in options if one not in plan and abs(one.start_utc_ns - out.start_utc_ns) <= NEAR_NS]
            added, _ = take_in_order(grid, near, [*committed, *rest], _left(quota, rest))
            if _value(added) > out.value:
                plan = [*rest, *added]
        if _value(plan) <= before:
            break
    return plan


def _left(quota: Mapping[int, int] | None, plan: Sequence[Option]) -> dict[int, int] | None:
    if quota is None:
        return None
    return {period: number - sum(one.period == period for one in plan) for period, number in quota.items()}


def _bound(options: Sequence[Option], quota: Mapping[int, int] | None) -> float:
    """Return a value that no plan exceeds."""
    if quota is None:
        return _value(options)
    total = 0.0
    for period, number in quota.items():
        values = sorted((one.value for one in options if one.period == period), reverse=True)
        total += sum(values[: max(number, 0)])
    return total


def _value(plan: Sequence[Option]) -> float:
    return sum(one.value for one in plan)


def _duty_violation(grid: ResourceGrid, ordered: Sequence[Option]) -> str | None:
    if grid.observe_s_per_day is None:
        return None
    for first in ordered:
        seconds = sum(
            (one.stop_utc_ns - one.start_utc_ns) / NS
            for one in ordered
            if first.start_utc_ns <= one.start_utc_ns < first.start_utc_ns + DAY_NS
        )
        if seconds > grid.observe_s_per_day:
            return f"more than {grid.observe_s_per_day / 3600.0:g} h of observation within 24 h"
    return None


def _battery_violation(grid: ResourceGrid, change_wh: FloatArray) -> str | None:
    charge = grid.battery_wh
    for change in change_wh.tolist():
        charge = min(charge + change, grid.battery_wh)
        if charge < grid.floor_wh - ROUNDING_WH:
            share, floor = max(charge, 0.0) / grid.battery_wh, grid.floor_wh / grid.battery_wh
            return f"the battery would fall to {100 * share:.0f} %, expected {100 * floor:.0f} % or more"
    return None


def _storage_violation(grid: ResourceGrid, arrivals: FloatArray) -> str | None:
    stored = 0.0
    for arrived, sent, later in zip(
        arrivals.tolist(), grid.downlink_octets.tolist(), grid.later_octets.tolist(), strict=True
    ):
        stored = max(stored - sent, 0.0) + arrived
        if stored > grid.storage_octets:
            return f"{stored:.0f} octets would be stored on board, expected at most {grid.storage_octets:.0f}"
        if arrived > 0.0 and stored > later:
            return f"its data would not be down within {grid.downlink_within_s / 3600.0:g} h"
    return None
