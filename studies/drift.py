"""Study of bounded drift: when vision beats propagation, and how long a coast after the last image stays bounded.

Each pass takes an image every 30 s for one revolution and then coasts. The same pass is flown without images for
comparison. One condition differs from the nominal pass at a time: altitude, share of the revolution with light, crater
density, size of the on-board catalogue, or build. Detections are simulated (evidence level 1): many passes are
affordable, but the errors of a real network on a real picture are only those of its measured recall, precision and
centre errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lunar.arrays import BoolArray, FloatArray
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder
from lunar.elements import Elements, icrf_state_from_elements
from lunar.timescales import tdb_s_from_utc_ns
from studies.anchoring import chosen_craters
from studies.montecarlo import NavigationCase, fly
from studies.montecarlo_world import standard_case

Progress = Callable[[Sequence[tuple[str, int]]], Iterable[tuple[str, int]]]

IMAGING_S = 6_660.0
"""One revolution of 111 minutes."""

CADENCE_S = 30.0
COAST_STEP_S = 120.0
BOUNDS_M = (100.0, 1_000.0)
START_POSITION_M, START_VELOCITY_M_S = 100.0, 0.1
"""Error of the start state: that of an uploaded orbit determination, so that propagation starts well."""

RESAMPLES = 2_000
_NS = 1_000_000_000

PAPER_RECALL = (0.3248, 0.3586, 0.4659, 0.0)
PAPER_PRECISION = 0.74
PAPER_SIGMA_PX = 2.9
"""Table II of the LINNA paper: recall by class, mean precision, and the centre error per axis whose mean length is its
mean localisation error (3.5 to 4.75 px for most of the craters: 3.7 px over the root of half pi)."""

CLASS_DIAMETER_SIGMA = 0.25
"""Error of the logarithm of a diameter that is only known as the median of its class."""

MARE_DENSITY = 0.2
"""Craters of 5 to 30 km in a mare, as a share of the mean density."""


@dataclass(frozen=True, slots=True)
class Condition:
    """One deviation from the nominal pass, with its case."""

    factor: str
    value: str
    case: NavigationCase


@dataclass(frozen=True, slots=True, eq=False)
class PassResult:
    """Position errors of one pass over time, metres: with images, then coasting (n,), and without images (n,).

    The errors without images are NaN during the coast.
    """

    elapsed_s: FloatArray
    vision_m: FloatArray
    propagation_m: FloatArray


@dataclass(frozen=True, slots=True)
class Interval:
    """A value with its 95 % interval over resampled passes."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class DriftRow:
    """Result of one condition.

    Attributes
    ----------
    beats_after_min
        Median time from the start after which the error with images stays below that without, minutes.
    error_m, propagation_m
        Median error at the end of the images, with and without them.
    bounded_min
        By bound in metres: median time from the last image until the error exceeds the bound, minutes; infinite where
        most passes stay below it to the end.
    kept
        By bound: share of passes that stay below it to the end of the coast.
    """

    factor: str
    value: str
    passes: int
    beats_after_min: Interval
    error_m: Interval
    propagation_m: Interval
    bounded_min: dict[str, Interval]
    kept: dict[str, float]


def conditions(data: DataFolder, coast_h: float) -> list[Condition]:
    """Return the nominal pass and one condition per value of each factor."""
    nominal = _with_coast(standard_case(data, "test", 1.0), coast_h)
    made = [Condition("nominal", "paper's orbit, 19 to 43 km", nominal)]
    made += [Condition("altitude", f"{km} km, circular", _circular(nominal, km * 1e3)) for km in (20, 45, 70)]
    made += [
        Condition("illumination", f"{percent} % of the revolution", _lit(nominal, percent / 100.0))
        for percent in (33, 10)
    ]
    made.append(Condition("terrain", "mare, a fifth of the craters", _thinned(nominal, MARE_DENSITY)))
    made += [
        Condition("catalogue", f"{percent} % of the craters, spread", _catalogued(nominal, percent / 100.0))
        for percent in (25, 10, 5, 2)
    ]
    paper = replace(
        nominal.detector,
        recall=PAPER_RECALL,
        precision=PAPER_PRECISION,
        sigma_px=PAPER_SIGMA_PX,
        log_diameter_sigma=CLASS_DIAMETER_SIGMA,
    )
    made.append(Condition("build", "detector of the paper's Table II", replace(nominal, detector=paper)))
    return made


def study(
    cases: Sequence[Condition],
    seeds: Sequence[int],
    progress: Progress = lambda jobs: jobs,
) -> tuple[list[DriftRow], dict[str, list[PassResult]]]:
    """Fly every condition with every seed; rows and passes by name of the condition."""
    flown: dict[str, list[PassResult]] = {name_of(one): [] for one in cases}
    by_name = {name_of(one): one for one in cases}
    blind: dict[tuple[bytes, int], FloatArray] = {}
    for name, seed in progress([(name, seed) for name in by_name for seed in seeds]):
        case = by_name[name].case
        key = (case.position_icrf_m.tobytes(), seed)
        if key not in blind:
            blind[key] = _without_images(case, seed)
        flown[name].append(_pass(case, seed, blind[key]))
    return [row_of(by_name[name], passes) for name, passes in flown.items()], flown


def name_of(condition: Condition) -> str:
    """Return the name of a condition."""
    return condition.factor if condition.factor == "nominal" else f"{condition.factor}: {condition.value}"


def row_of(condition: Condition, passes: Sequence[PassResult]) -> DriftRow:
    """Return the medians of a condition and their 95 % bootstrap intervals over passes."""
    last = [int(np.flatnonzero(np.isfinite(one.propagation_m))[-1]) for one in passes]
    bounded = {f"{bound:g}": np.array([bounded_for_min(one, bound) for one in passes]) for bound in BOUNDS_M}
    return DriftRow(
        condition.factor,
        condition.value,
        len(passes),
        median_interval(np.array([beats_after_min(one) for one in passes])),
        median_interval(np.array([one.vision_m[k] for one, k in zip(passes, last, strict=True)])),
        median_interval(np.array([one.propagation_m[k] for one, k in zip(passes, last, strict=True)])),
        {name: median_interval(values) for name, values in bounded.items()},
        {name: float(np.mean(np.isinf(values))) for name, values in bounded.items()},
    )


def beats_after_min(one: PassResult) -> float:
    """Return the time after which vision stays better than propagation, minutes; infinite if it does not."""
    both = np.isfinite(one.propagation_m)
    worse = np.flatnonzero(one.vision_m[both] >= one.propagation_m[both])
    first = 0 if not worse.size else int(worse[-1]) + 1
    times = one.elapsed_s[both]
    return float("inf") if first >= times.size else float(times[first] / 60.0)


def bounded_for_min(one: PassResult, bound_m: float) -> float:
    """Return the time from the end of the images until the error exceeds a bound, minutes; infinite if it never does.

    An error above the bound at the end of the images counts as zero minutes.
    """
    coast = ~np.isfinite(one.propagation_m)
    start_s = one.elapsed_s[~coast][-1]
    over = np.flatnonzero(one.vision_m[coast] > bound_m)
    if one.vision_m[~coast][-1] > bound_m:
        return 0.0
    return float("inf") if not over.size else float((one.elapsed_s[coast][over[0]] - start_s) / 60.0)


def median_interval(values: FloatArray, seed: int = 1) -> Interval:
    """Return the median and the 2.5 and 97.5 percentiles of the medians of resampled values."""
    rng = np.random.default_rng(seed)
    drawn = np.sort(values[rng.integers(0, values.size, (RESAMPLES, values.size))], axis=1)
    # Order statistics instead of interpolation: values may be infinite.
    medians = np.sort(drawn[:, (values.size - 1) // 2])
    low, high = medians[int(0.025 * RESAMPLES)], medians[int(0.975 * RESAMPLES) - 1]
    return Interval(float(np.sort(values)[(values.size - 1) // 2]), float(low), float(high))


def _with_coast(case: NavigationCase, coast_h: float) -> NavigationCase:
    imaging_s = np.arange(0.0, IMAGING_S, CADENCE_S)
    coast_s = np.arange(IMAGING_S, IMAGING_S + coast_h * 3600.0 + 1.0, COAST_STEP_S)
    elapsed_s = np.concatenate([imaging_s, coast_s])
    return replace(
        case,
        frame_utc_ns=case.epoch_utc_ns + np.rint(elapsed_s * _NS).astype(np.int64),
        imaging=elapsed_s < IMAGING_S,
        start_position_m=START_POSITION_M,
        start_velocity_m_s=START_VELOCITY_M_S,
    )


def _circular(case: NavigationCase, altitude_m: float) -> NavigationCase:
    elements = Elements(MOON_RADIUS_M + altitude_m, 1e-4, float(np.radians(89.0)), 0.0, 0.0, 0.0)
    position, velocity = icrf_state_from_elements(
        elements, float(tdb_s_from_utc_ns(case.epoch_utc_ns)), case.gravity.gm_m3_s2
    )
    return replace(case, position_icrf_m=position, velocity_icrf_m_s=velocity)


def _lit(case: NavigationCase, share: float) -> NavigationCase:
    """The last part of the revolution in light, so that the coast begins after images."""
    elapsed_s = (case.frame_utc_ns - case.frame_utc_ns[0]) / _NS
    lit: BoolArray = case.imaging & (elapsed_s >= (1.0 - share) * IMAGING_S)
    return replace(case, imaging=lit)


def _thinned(case: NavigationCase, share: float) -> NavigationCase:
    kept = np.random.default_rng(5).uniform(size=len(case.craters)) < share
    return replace(case, craters=case.craters.select(kept))


def _catalogued(case: NavigationCase, share: float) -> NavigationCase:
    count = max(1, round(share * len(case.craters)))
    return replace(case, on_board=chosen_craters(case.craters, count, "spread", 1))


def _elapsed_s(case: NavigationCase) -> FloatArray:
    return np.asarray((case.frame_utc_ns - case.frame_utc_ns[0]) / _NS, dtype=np.float64)


def _pass(case: NavigationCase, seed: int, blind_m: FloatArray) -> PassResult:
    elapsed_s = _elapsed_s(case)
    propagation = np.full(elapsed_s.size, np.nan)
    propagation[: blind_m.size] = blind_m
    return PassResult(elapsed_s, fly(case, seed).error_m, propagation)


def _without_images(case: NavigationCase, seed: int) -> FloatArray:
    span = _elapsed_s(case) < IMAGING_S
    dark = replace(
        case, frame_utc_ns=case.frame_utc_ns[span], imaging=np.zeros(int(span.sum()), dtype=np.bool_)
    )
    return fly(dark, seed).error_m


def format_markdown(rows: Sequence[DriftRow]) -> str:
    """Return the table of the study as Markdown."""
    lines = [
        "| condition | vision beats propagation after, min | error with images, m | without images, m | coast below "
        "100 m, min | coast below 1 km, min | passes that stay below 1 km |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += list(_cells(rows))
    return "\n".join(lines)


def _cells(rows: Sequence[DriftRow]) -> Iterator[str]:
    for row in rows:
        name = row.value if row.factor == "nominal" else f"{row.factor}: {row.value}"
        cells = [
            _interval(row.beats_after_min),
            _interval(row.error_m),
            _interval(row.propagation_m),
            *(_interval(row.bounded_min[f"{bound:g}"]) for bound in BOUNDS_M),
            f"{100 * row.kept[f'{BOUNDS_M[-1]:g}']:.0f} %",
        ]
        yield f"| {name} | {' | '.join(cells)} |"


def _interval(one: Interval) -> str:
    def text(value: float) -> str:
        return (
            "never"
            if np.isinf(value)
            else f"{value:,.0f}"
            if value >= 10.0 or value == 0.0
            else f"{value:.1f}"
        )

    return f"{text(one.value)} [{text(one.low)}, {text(one.high)}]"
