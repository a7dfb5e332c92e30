"""From on-board ticks to UTC with fitted time correlations, in whole nanoseconds.

A correlation is a straight line over a stretch of on-board time. Ticks outside every stretch use the nearest one;
without any, the clock is taken as ideal (correlation 0).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import EvaluationError
from lunar import timescales
from lunar.arrays import BoolArray, IntArray
from lunar.constants import NS
from lunar.plausible import STATION_DIFFERENCE_NS, WHOLE_SECONDS

IDEAL_CLOCK = 0
"""Id of the correlation of a clock that shows TAI without error."""

# One tick is 10^9 / 2^16 ns = 1953125 / 128 ns.
_NS_NUMERATOR = 1_953_125
_NS_DENOMINATOR = 128

REJECTION = 6.0
"""Time reports this many usual deviations off are not believed."""

RESOLUTION_NS = 2 * 15_259.0
"""Two ticks: deviations below that are the clock's resolution, not outliers."""

MAX_ROUNDS = 10

JUMP_NS = 20e6
"""A clock that is off by so much more than its drift explains has been set; delays on board are smaller."""

JUMP_RATE = 200e-6
"""No oscillator drifts faster, in real time."""

MOVED_NS = 10e6
"""Passes are evaluated again if a new correlation moves their time by more: 16 m along the track."""

LEAP_NS = 2e9
"""An on-board clock alone cannot tell a station that is off by a leap second."""

LONE_DRIFT = 50e-6
"""Crystal oscillators without compensation drift by up to 50 ppm."""

DRIFT_CHANGE = 2e-6
"""No oscillator changes its drift by more between two time reports."""

SIGNIFICANT = 3.0
"""A drift of fewer standard deviations than that is taken for none."""


@dataclass(frozen=True, slots=True)
class TimeCorrelation:
    """UTC of `reference_ticks`, and how fast the clock's ticks are: real time = ticks (1 + drift_ppb 1e-9)."""

    id: int
    start_ticks: int
    stop_ticks: int
    reference_ticks: int
    reference_utc_ns: int
    drift_ppb: float

    def utc_ns(self, ticks: IntArray) -> IntArray:
        """UTC (n,) of on-board ticks (n,)."""
        since = np.asarray(ticks, dtype=np.int64) - self.reference_ticks
        whole, part = np.divmod(since, timescales.TICKS_PER_SECOND)  # the product overflows after two years
        nominal = whole * NS + part * _NS_NUMERATOR // _NS_DENOMINATOR
        drift = np.rint(nominal * (self.drift_ppb * 1e-9)).astype(np.int64)
        tai = int(timescales.tai_ns_from_utc_ns(self.reference_utc_ns)) + nominal + drift
        return np.asarray(timescales.utc_ns_from_tai_ns(tai), dtype=np.int64)


def utc_ns_of_ticks(ticks: IntArray, correlations: Sequence[TimeCorrelation]) -> tuple[IntArray, IntArray]:
    """UTC (n,) of on-board ticks (n,), and the id of the correlation used for each."""
    ticks = np.asarray(ticks, dtype=np.int64)
    if not correlations:
        return np.asarray(timescales.utc_ns_from_ticks(ticks), dtype=np.int64), np.full(len(ticks), IDEAL_CLOCK)
    start = np.array([c.start_ticks for c in correlations])
    stop = np.array([c.stop_ticks for c in correlations])
    outside = np.maximum(np.maximum(start[None, :] - ticks[:, None], ticks[:, None] - stop[None, :]), 0)
    chosen = np.argmin(outside, axis=1)
    utc = np.zeros(len(ticks), dtype=np.int64)
    for number in np.unique(chosen):
        here = chosen == number
        utc[here] = correlations[number].utc_ns(ticks[here])
    return utc, np.array([c.id for c in correlations], dtype=np.int64)[chosen]


def moved_ticks(old: Sequence[TimeCorrelation], new: Sequence[TimeCorrelation]) -> tuple[int | None, int | None]:
    """Return the first and last on-board time whose UTC differs between two sets of lines; None if there is none.

    Any line in place of the ideal clock changes what a report can say.
    """
    if bool(old) != bool(new):
        return 0, (1 << 48) - 1
    ends = {tick for line in (*old, *new) for tick in (line.start_ticks, line.stop_ticks)}
    at = np.array(sorted({*ends, *((a + b) // 2 for a, b in pairwise(sorted(ends)))}), dtype=np.int64)
    moved = np.flatnonzero(np.abs(utc_ns_of_ticks(at, old)[0] - utc_ns_of_ticks(at, new)[0]) > MOVED_NS)
    if not moved.size:
        return None, None
    first, last = int(moved[0]), int(moved[-1])
    return int(at[first - 1]) if first else 0, int(at[last + 1]) if last + 1 < len(at) else (1 << 48) - 1


def largest_step_s(runs: Sequence[TimeCorrelation], after_utc_ns: int, until_utc_ns: int) -> float:
    """Return the largest difference in s between successive lines, where a run begins after a time until another."""
    largest_ns = 0
    for last, run in pairwise(sorted(runs, key=lambda one: one.start_ticks)):
        begin = np.array([run.start_ticks], dtype=np.int64)
        utc_ns, shown_ns = int(run.utc_ns(begin)[0]), int(last.utc_ns(begin)[0])
        if after_utc_ns < utc_ns <= until_utc_ns:
            largest_ns = max(largest_ns, abs(utc_ns - shown_ns))
    return largest_ns / NS


def ticks_of_utc_ns(utc_ns: int, correlations: Sequence[TimeCorrelation]) -> int:
    """On-board ticks that the clock shows at `utc_ns`, to about a tick."""
    return int(ticks_of_times(np.array([utc_ns], dtype=np.int64), correlations)[0])


def ticks_of_times(utc_ns: IntArray, correlations: Sequence[TimeCorrelation]) -> IntArray:
    """On-board ticks (n,) that the clock shows at times (n,), to about a tick."""
    ticks = timescales.ticks_from_utc_ns(utc_ns)
    for _ in range(3):
        whole, part = np.divmod(utc_ns - utc_ns_of_ticks(ticks, correlations)[0], _NS_NUMERATOR)
        ticks = ticks + whole * _NS_DENOMINATOR + part * _NS_DENOMINATOR // _NS_NUMERATOR
    return ticks


@dataclass(frozen=True, slots=True)
class CorrelationFit:
    """A fitted line of one run of the clock, and how well it fits."""

    start_ticks: int
    stop_ticks: int
    reference_ticks: int
    reference_utc_ns: int
    drift_ppb: float
    residual_rms_ns: float
    residual_max_ns: float
    points: int
    rejected: int


def fit_correlation(ticks: IntArray, earth_utc_ns: IntArray, light_time_ns: IntArray) -> CorrelationFit:
    """The line through time reports: on-board ticks (n,), UTC of reception on Earth, and light time to there.

    Points further off than `REJECTION` times the usual deviation (by the median, which outliers do not move) are
    left out. One point gives an offset without drift.

    Raises
    ------
    EvaluationError
        If there is no point at all.
    """
    ticks = np.asarray(ticks, dtype=np.int64)
    if len(ticks) == 0:
        raise EvaluationError("time correlation: expected at least one time report, found none")
    sent_tai = np.asarray(timescales.tai_ns_from_utc_ns(np.asarray(earth_utc_ns, dtype=np.int64))) - np.asarray(
        light_time_ns
    )
    middle = int(np.argsort(ticks, kind="stable")[len(ticks) // 2])
    nominal = (ticks - ticks[middle]) * _NS_NUMERATOR // _NS_DENOMINATOR
    # Small numbers from here on: what the clock is off by, against the middle point.
    deviation = (sent_tai - sent_tai[middle] - nominal).astype(np.float64)
    kept = np.ones(len(ticks), dtype=np.bool_)
    offset = slope = 0.0
    for _ in range(MAX_ROUNDS):
        offset, slope = _line(nominal[kept].astype(np.float64), deviation[kept])
        residual = deviation - offset - slope * nominal
        spread = 1.4826 * float(np.median(np.abs(residual[kept] - np.median(residual[kept]))))
        still = np.abs(residual) <= max(REJECTION * spread, RESOLUTION_NS)
        if (still == kept).all() or not still.any():
            break
        kept = still
    offset, slope = _without_chance(nominal[kept], deviation[kept], offset, slope)
    residual = (deviation - offset - slope * nominal)[kept]
    reference_tai = int(sent_tai[middle]) + round(offset)
    return CorrelationFit(
        start_ticks=int(ticks[kept].min()),
        stop_ticks=int(ticks[kept].max()),
        reference_ticks=int(ticks[middle]),
        reference_utc_ns=int(timescales.utc_ns_from_tai_ns(reference_tai)),
        drift_ppb=slope * 1e9,
        residual_rms_ns=float(np.sqrt(np.mean(residual**2))),
        residual_max_ns=float(np.abs(residual).max()),
        points=int(kept.sum()),
        rejected=int((~kept).sum()),
    )


def _line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Offset and slope of least squares; no slope where all x are alike."""
    centre = x - x.mean()
    square = float(centre @ centre)
    slope = float(centre @ y) / square if square > 0.0 else 0.0
    return float(y.mean() - slope * x.mean()), slope


def _without_chance(
    nominal: IntArray, deviation: NDArray[np.float64], offset: float, slope: float
) -> tuple[float, float]:
    """The line, level where its slope may be no more than the chance of the points and of the clock's resolution."""
    centre = nominal - nominal.mean()
    square = float(centre @ centre)
    if square == 0.0:
        return offset, slope
    free = max(len(nominal) - 2, 1)
    residual = deviation - offset - slope * nominal
    resolution = 0.5 * RESOLUTION_NS / np.sqrt(12.0)
    deviation_ns = max(float(np.sqrt(residual @ residual / free)), resolution)
    if abs(slope) >= SIGNIFICANT * deviation_ns / np.sqrt(square):
        return offset, slope
    return float(deviation.mean()), 0.0


@dataclass(frozen=True, slots=True)
class StationDoubt:
    """A station whose reception times disagree with those of `others`, by how much, and the usual cause."""

    station: str
    difference_s: float
    others: str = "the others"

    def __str__(self) -> str:
        """Return the remark for a person."""
        whole = round(abs(self.difference_s))
        cause = f": {WHOLE_SECONDS[whole]}?" if _is_whole(1e9 * self.difference_s) else ""
        side = "ahead of" if self.difference_s > 0 else "behind"
        name = self.station or "without a name"
        return f"the clock of station {name} is {abs(self.difference_s):.3f} s {side} {self.others}{cause}"


def doubted_stations(
    ticks: IntArray, earth_utc_ns: IntArray, light_time_ns: IntArray, boot: IntArray, station: Sequence[str]
) -> tuple[BoolArray, dict[int, StationDoubt]]:
    """Return which time reports (n,) count, and the doubt about each of the others.

    The reports of a station are split into runs as those of the clock. Two runs disagree if every change between them
    shows it: a clock that was set changes for all stations. Of runs that disagree, those count that more stations
    share, or that alone agree with the on-board clock where the others are off by seconds of a usual cause; otherwise
    neither. A single station counts as little if it differs from the on-board clock by whole seconds with a usual
    cause, from its first report on.
    """
    sent = np.asarray(timescales.tai_ns_from_utc_ns(np.asarray(earth_utc_ns, dtype=np.int64))) - light_time_ns
    whole, part = np.divmod(np.asarray(ticks, dtype=np.int64), timescales.TICKS_PER_SECOND)
    nominal = whole * NS + part * _NS_NUMERATOR // _NS_DENOMINATOR
    off = (nominal + timescales.ONBOARD_EPOCH_TAI_NS - sent).astype(np.float64)
    kept = np.ones(len(ticks), dtype=np.bool_)
    names = np.array(station)
    units: list[IntArray] = []
    for name in sorted(set(station)):
        mine = np.flatnonzero(names == name)
        runs = clock_runs(ticks[mine], earth_utc_ns[mine], light_time_ns[mine], boot[mine])
        units += [mine[run] for run in runs if len(run)]
    unit = np.zeros(len(ticks), dtype=np.int64)
    for number, rows in enumerate(units):
        unit[rows] = number
    differences = _differences(ticks, nominal, off, boot, unit, units, station)
    group = list(range(len(units)))
    for (one, other), found in differences.items():
        if found.changes and abs(found.least_ns) <= found.tolerance_ns:
            group = [group[one] if number == group[other] else number for number in group]
    doubts: dict[int, StationDoubt] = {}
    apart: list[tuple[int, int, float]] = []
    for (one, other), found in differences.items():
        sides = [{number for number, of in enumerate(group) if of == group[k]} for k in (one, other)]
        weight = [len({names[units[number][0]] for number in side}) for side in sides]
        is_station = found.changes > 1 or (min(weight) == 1 and _is_whole(found.least_ns))
        if group[one] == group[other] or names[units[one][0]] == names[units[other][0]] or not is_station:
            continue  # the clock was set on board
        near = [abs(float(np.median(off[units[k]]))) <= 0.1 * abs(found.least_ns) for k in (one, other)]
        wrong = [weight[0] < weight[1], weight[1] < weight[0]]
        if weight[0] == weight[1] or (near[0] != near[1] and _is_whole(found.least_ns)):
            wrong = [not near[0], not near[1]] if any(near) or found.changes > 1 else [False, False]
        for side, is_wrong, against, sign in zip(sides, wrong, (other, one), (1.0, -1.0), strict=True):
            apart += [(number, against, sign * found.least_ns) for number in side if is_wrong]
    for number, _, _ in apart:
        kept[units[number]] = False
    # A difference from what counts says more than one from what does not.
    for number, _, least_ns in sorted(apart, key=lambda one: bool(kept[units[one[1]]].all())):
        doubt = StationDoubt(str(names[units[number][0]]), least_ns * 1e-9)
        doubts.update(dict.fromkeys(units[number].tolist(), doubt))
    for name in sorted(set(station)):
        numbers = [number for number, rows in enumerate(units) if names[rows[0]] == name]
        shared = {group[number] for number in range(len(units)) if number not in numbers}
        ahead_ns = -float(np.median(off[units[numbers[0]]]))
        if not kept[units[numbers[0]]].all() or not _is_whole(ahead_ns) or abs(ahead_ns) < LEAP_NS:
            continue
        doubt = StationDoubt(name, ahead_ns * 1e-9, "the on-board clock")
        for own in (units[number] for number in numbers if group[number] not in shared):
            if np.abs(off[own] + ahead_ns).max() > STATION_DIFFERENCE_NS:
                break  # the clock was set on board
            kept[own] = False
            doubts.update(dict.fromkeys(own.tolist(), doubt))
    return kept, doubts


@dataclass(frozen=True, slots=True)
class _Difference:
    """Least difference of two runs over all changes between them, its tolerance, and the number of changes."""

    least_ns: float
    tolerance_ns: float
    changes: int


def _differences(
    ticks: IntArray,
    nominal: IntArray,
    off: NDArray[np.float64],
    boot: IntArray,
    unit: IntArray,
    units: Sequence[IntArray],
    names: Sequence[str],
) -> dict[tuple[int, int], _Difference]:
    """Return the differences of the offsets of runs (second minus first) that follow one another in time.

    A run is also compared with the last one of every other station before it, which counts as no change.
    """
    drifts = []
    for rows in units:
        lasted = float(np.ptp(nominal[rows])) if len(rows) > 2 else 0.0
        known = JUMP_NS + DRIFT_CHANGE * lasted < JUMP_RATE * lasted
        drift = _line((nominal[rows] - nominal[rows[0]]).astype(np.float64), off[rows])[1] if known else 0.0
        drifts.append((drift, DRIFT_CHANGE + JUMP_NS / lasted if known else JUMP_RATE))
    found: dict[tuple[int, int], _Difference] = {}
    order = np.lexsort((ticks, boot))
    latest: dict[str, int] = {}
    for k in np.flatnonzero((np.diff(unit[order]) != 0) & (np.diff(boot[order]) == 0)).tolist():
        first, second = int(order[k]), int(order[k + 1])
        latest[names[first]] = first
        for name, earlier in latest.items():
            pair = int(unit[earlier]), int(unit[second])
            if boot[earlier] != boot[second] or (name == names[second] and earlier != first):
                continue
            since = float(nominal[second] - nominal[earlier])
            drift, unknown = drifts[unit[earlier]]
            value = off[second] - off[earlier] - drift * since
            if pair[0] > pair[1]:
                pair, value = (pair[1], pair[0]), -value
            one = _Difference(float(value), STATION_DIFFERENCE_NS + unknown * since, int(earlier == first))
            before = found.get(pair, replace(one, changes=0))
            if one.changes or not before.changes:
                least = one if abs(one.least_ns) <= abs(before.least_ns) or not before.changes else before
                found[pair] = replace(least, changes=before.changes + one.changes)
    return found


def _is_whole(difference_ns: float) -> bool:
    """Return whether a difference has a usual cause: a whole number of seconds."""
    whole = round(abs(difference_ns) * 1e-9)
    return whole in WHOLE_SECONDS and abs(abs(difference_ns) - whole * 1e9) <= STATION_DIFFERENCE_NS


def clock_runs(ticks: IntArray, earth_utc_ns: IntArray, light_time_ns: IntArray, boot: IntArray) -> list[IntArray]:
    """Indices of the time reports (n,) of each run of the clock, in the order in which they were sent.

    A run ends with a boot, and where the clock was set: where it is off by more than `JUMP_NS` from where its drift
    would have taken it, and the next report says so too. The drift is at most `JUMP_RATE`; a run that has lasted for a
    time shows it to `JUMP_NS` over that time and `DRIFT_CHANGE`, so that a step is found after hours without reports.
    Two reports alone show a drift up to `LONE_DRIFT`, otherwise a step. A report that stands alone with what it says
    stays in the run, where the fit leaves it out.
    """
    sent = np.asarray(timescales.tai_ns_from_utc_ns(np.asarray(earth_utc_ns, dtype=np.int64))) - light_time_ns
    order = np.lexsort((ticks, sent))
    runs: list[IntArray] = []
    for number in np.unique(boot[order]):
        mine = order[boot[order] == number]
        nominal = (ticks[mine] - ticks[mine[0]]) * _NS_NUMERATOR // _NS_DENOMINATOR
        at = (sent[mine] - sent[mine[0]]).astype(np.float64)
        off = (nominal - nominal[0]).astype(np.float64) - at
        start, level, ends = 0, 0, list[int]()
        for k in range(1, len(mine)):
            lasted, since = at[level] - at[start], at[k] - at[level]
            drift, unknown = 0.0, JUMP_RATE
            if JUMP_NS + DRIFT_CHANGE * lasted < JUMP_RATE * lasted:
                drift, unknown = (off[level] - off[start]) / lasted, DRIFT_CHANGE + JUMP_NS / lasted
            if abs(off[k] - off[level] - drift * since) <= JUMP_NS + unknown * since:
                level = k
            elif k + 1 < len(mine) and abs(off[k + 1] - off[k]) <= JUMP_NS + JUMP_RATE * (at[k + 1] - at[k]):
                ends.append(k)
                start = level = k
        for run in np.split(np.arange(len(mine)), ends):
            lone = len(run) == 2 and abs(off[run[1]] - off[run[0]]) > JUMP_NS + LONE_DRIFT * (at[run[1]] - at[run[0]])
            runs += np.split(mine[run], [1] if lone else [])
    return runs
