"""Accounting of packets by sequence count, ordered by on-board time and never by arrival.

The count of a space packet has 14 bits and wraps; before anything is called a gap or a conflict it is unwrapped,
step by step in on-board time. Over a silence in which more than half a wrap of packets could have been made, the
number of whole wraps is chosen nearest to what the usual rate predicts. A count that falls back while time goes on
is a restart and begins a new run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lunar.arrays import IntArray
from lunar.plausible import AGREEING_PACKETS, CLOCK_ERROR_S, SILENCE_S, UNSET_CLOCK_S
from tmtc.packets.cuc import NO_TICKS, TICKS_PER_SECOND

COUNT_MODULUS = 1 << 14

REORDER_TICKS = TICKS_PER_SECOND
"""Counts may fall back within this time without meaning a restart: packets made in the same instant are stored in
no particular order. One second is far above the time between making two packets of one frame."""

RATE_PACKETS = 64
"""Packets over which a rate is taken."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Packets missing between two that came: how many, and the on-board times around them."""

    run: int
    first_count: int
    last_count: int
    before_ticks: int
    after_ticks: int

    @property
    def missing(self) -> int:
        """How many packets are missing."""
        return self.last_count - self.first_count + 1


@dataclass(frozen=True, slots=True, eq=False)
class SequenceAccount:
    """What the counts of one vehicle and APID say.

    `order` sorts the packets given into on-board order; `run` and `count` (n,) are in that order: the number of the
    run since a restart, and the unwrapped count within it. `conflicts` are packets whose unwrapped count another
    packet of other content has as well.
    """

    order: IntArray
    run: IntArray
    count: IntArray
    gaps: tuple[Gap, ...]
    restarts: int
    conflicts: int

    @property
    def lost(self) -> int:
        """Packets known to be missing."""
        return sum(gap.missing for gap in self.gaps)


def account_sequence(ticks: IntArray, sequence_count: IntArray) -> SequenceAccount:
    """Unwrap the counts of one APID and find what is missing.

    Parameters
    ----------
    ticks, sequence_count
        (n,) on-board time and 14-bit count of distinct packets, in any order.
    """
    ticks = np.asarray(ticks, dtype=np.int64)
    counts = np.asarray(sequence_count, dtype=np.int64)
    order = np.lexsort((counts, ticks)).astype(np.int64)
    if order.size == 0:
        return SequenceAccount(order, order.copy(), order.copy(), (), 0, 0)
    ticks, counts = ticks[order], counts[order]
    step_ticks = np.diff(ticks)
    near = np.mod(np.diff(counts) + COUNT_MODULUS // 2, COUNT_MODULUS) - COUNT_MODULUS // 2
    predicted = _usual_rate(near, step_ticks) * step_ticks
    far = predicted >= COUNT_MODULUS // 2
    wraps = np.where(far, np.rint((predicted - near) / COUNT_MODULUS), 0.0).astype(np.int64)
    steps = near + wraps * COUNT_MODULUS
    restart = (steps < 0) & (step_ticks > REORDER_TICKS)
    run = np.concatenate(([0], np.cumsum(restart))).astype(np.int64)
    total = np.concatenate(([0], np.cumsum(steps)))
    first = np.flatnonzero(np.concatenate(([True], restart)))
    count = total - total[first][run] + counts[first][run]

    by_count = np.lexsort((ticks, count, run))
    sorted_run, sorted_count, sorted_ticks = run[by_count], count[by_count], ticks[by_count]
    jump = np.diff(sorted_count)
    same_run = np.diff(sorted_run) == 0
    gaps = tuple(
        Gap(
            int(sorted_run[i]),
            int(sorted_count[i]) + 1,
            int(sorted_count[i + 1]) - 1,
            int(sorted_ticks[i]),
            int(sorted_ticks[i + 1]),
        )
        for i in np.flatnonzero(same_run & (jump > 1))
    )
    conflicts = int(np.count_nonzero(same_run & (jump == 0)))
    return SequenceAccount(order, run, count, gaps, int(run[-1]), conflicts)


def _usual_rate(near: IntArray, step_ticks: IntArray) -> float:
    """Packets per tick, as the median over stretches of `RATE_PACKETS` packets; 0 where too few packets say.

    Stretches, because packets come in bursts: the time between two of one burst says nothing about the rate.
    """
    if len(near) < RATE_PACKETS:
        return 0.0
    count = np.concatenate(([0], np.cumsum(near)))
    time = np.concatenate(([0], np.cumsum(step_ticks)))
    packets, ticks = count[RATE_PACKETS:] - count[:-RATE_PACKETS], time[RATE_PACKETS:] - time[:-RATE_PACKETS]
    forward = (packets > 0) & (ticks > 0)
    return float(np.median(packets[forward] / ticks[forward])) if forward.any() else 0.0


LONGEST_STEP = round(CLOCK_ERROR_S * TICKS_PER_SECOND)
UNSET_TICKS = round(UNSET_CLOCK_S * TICKS_PER_SECOND)
LONGEST_SILENCE = round(SILENCE_S * TICKS_PER_SECOND)


def implausible_times(
    ticks: IntArray, received: IntArray | None, newest: int | None, latest: int | None
) -> dict[int, str]:
    """Return the packets whose on-board time is implausible, with the reason.

    Time goes on in stretches without a longer silence than `LONGEST_STEP`. One that begins later than that after all
    telemetry is believed if a station received it then, or by a clock of the mission, or because enough of its packets
    agree. A clock that shows the time since its epoch was not set.

    Parameters
    ----------
    ticks
        On-board time (n,), `NO_TICKS` where a packet has none.
    received
        On-board time (n,) at which an ideal clock would have shown the reception, `NO_TICKS` if unknown.
    newest
        Greatest on-board time of the archive; None if the archive has too little to compare with.
    latest
        Greatest on-board time that the mission clock allows; None if no clock but telemetry states it.
    """
    timed = np.flatnonzero(ticks != NO_TICKS)
    order = timed[np.argsort(ticks[timed], kind="stable")]
    if not order.size:
        return {}
    times = ticks[order]
    doubts: dict[int, str] = {}
    known = None if received is None else (received != NO_TICKS) & (ticks != NO_TICKS)
    agreed = np.zeros(len(ticks), dtype=np.bool_)
    if received is not None and known is not None:
        ahead = known & (ticks > received + LONGEST_STEP)
        agreed = known & (np.abs(ticks - received) <= LONGEST_STEP)
        if agreed.any():  # otherwise the clock of the station is wrong
            doubts = {
                int(k): f"{_span(int(ticks[k] - received[k]))} after its reception"
                for k in np.flatnonzero(ahead)
            }
    reached = newest
    for stretch in np.split(order, np.flatnonzero(np.diff(times) > LONGEST_STEP) + 1):
        first, last = int(ticks[stretch[0]]), int(ticks[stretch[-1]])
        reason = None
        if reached is not None and first - reached > LONGEST_STEP and not agreed[stretch].any():
            if latest is not None:
                reason = f"{_span(last - latest)} after the mission time" if last > latest else None
            elif len(stretch) < AGREEING_PACKETS:
                few = f"{len(stretch)} of {AGREEING_PACKETS} packets agree"
                reason = f"{_span(first - reached)} after all other telemetry, {few}"
            elif first - reached > LONGEST_SILENCE:
                reason = f"{_span(first - reached)} after all other telemetry"
        if reason is None:
            is_firm = newest is not None or len(stretch) >= AGREEING_PACKETS
            reached = max(reached or last, last) if is_firm else reached
        else:
            doubts.update(dict.fromkeys(stretch.tolist(), reason))
    if reached is not None and reached > 2 * UNSET_TICKS and times[0] < UNSET_TICKS:
        doubts.update(dict.fromkeys(order[times < UNSET_TICKS].tolist(), "the clock was not set"))
    return doubts


def fits_between(count: int, before: int | None, after: int | None) -> bool:
    """Return whether a 14-bit count is plausible between those of the packets around it in time."""
    if before is None or after is None:
        return True
    return (count - before) % COUNT_MODULUS <= (after - before) % COUNT_MODULUS


def _span(ticks: int) -> str:
    seconds = ticks / TICKS_PER_SECOND
    return f"{seconds / 86_400:.1f} d" if seconds >= 86_400 else f"{seconds / 3600:.1f} h"
