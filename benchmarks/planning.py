"""Yield of the planner over a month, compared with a greedy and an optimal plan: python -m benchmarks planning.

All plans have the same candidates and the same grid of resources. The simulation of the planner checks each of them.

- greedy: every candidate that fits, in order of time.
- standing request: as the service plans, once a day for the coming three days, on top of what is already planned.
- month at once: the same choice over the whole month.
- optimal: an integer program, solved by HiGHS (scipy) and, as a check, by CP-SAT of OR-Tools (`make bench-planning`).

The value of a window is 1, as for the service; a second program maximises the frames instead.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csr_array

from benchmarks import _rows
from ground_service.planning.core import Constraints, Planner, Resources, data_octets, frames_between
from ground_service.planning.filling import DAY_NS, NS, Option, ResourceGrid, choose, take_in_order, violation
from lunar.camera import PinholeCamera
from lunar.datafolder import default_orientation, find_data
from payload_emulator.session.orbit import force_model, propagate_scenario, sample
from payload_emulator.session.scenario import Scenario, load_scenario

CADENCE_S = 15.0
STEP_S = 600.0
HORIZON_DAYS = 3
WEEK_DAYS = 7
SCALE = 100_000
"""The program has whole hundred-thousandths of a watt-hour and whole octets, rounded against the plan."""

ORTOOLS = Path(__file__).resolve().parent.parent / ".venv-ortools" / "bin" / "python"


@dataclass(frozen=True, slots=True)
class Case:
    """Resources of a spacecraft and the terms of a request."""

    name: str
    resources: Resources
    hours_per_day: float | None = None
    windows_per_week: int | None = None


LATITUDE_RAD = (np.radians(-35.0), np.radians(35.0))
REGIONS_DEG = ((300.0, 40.0), (80.0, 110.0), (170.0, 220.0))
"""Requested regions, west to east: tracks cross their edges, so that windows differ in duration."""

CASES = (
    Case("10 windows per week", Resources(), windows_per_week=10),
    Case("battery 20 Wh, generation 22 W", Resources(battery_wh=20.0, generation_w=22.0)),
    Case("downlink 100 bit/s", Resources(downlink_bit_s=100.0)),
    Case("1 h of observation per day", Resources(), hours_per_day=1.0),
)


@dataclass(frozen=True, slots=True)
class Program:
    """Integers between `lower` and `upper`, whose first are the options; each row is at most its limit."""

    lower: list[int]
    upper: list[int]
    rows: list[tuple[list[int], list[int], int]]


@dataclass(frozen=True, slots=True)
class Row:
    """Yield of one plan."""

    case: str
    plan: str
    windows: int
    observed_h: float
    frames: int
    seconds: float
    bound: float | None = None


def main(words: Sequence[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.planning")
    parser.add_argument("--scenario", default="selenita")
    parser.add_argument("--days", type=float, default=30.0)
    parser.add_argument("--limit-s", type=float, default=60.0, help="time of a solver for each program")
    parser.add_argument(
        "--ortools", type=Path, default=ORTOOLS, help="Python of an environment with OR-Tools"
    )
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args(words)
    python = arguments.ortools if arguments.ortools.is_file() else None
    if python is None:
        print(
            f"planning: no CP-SAT check: expected OR-Tools in {arguments.ortools}, found none; "
            "make bench-planning installs it",
            file=sys.stderr,
        )
    scenario, options, rows = plans_of(arguments.scenario, arguments.days, arguments.limit_s, python)
    if arguments.json:
        plans = [{name: getattr(row, name) for name in Row.__slots__} for row in rows]
        print(json.dumps({"scenario": scenario.name, "candidates": options, "plans": plans}))
        return 0
    print(f"{scenario.name}, {arguments.days:g} days, {options} candidates of 5 to 25 min, Sun 2 to 60 deg")
    print(f"{'case':<31} {'plan':<26} {'windows':>7} {'hours':>6} {'frames':>7} {'bound':>8} {'seconds':>8}")
    for row in rows:
        bound = "" if row.bound is None else f"{row.bound:.1f}"
        print(
            f"{row.case:<31} {row.plan:<26} {row.windows:>7} {row.observed_h:>6.1f} {row.frames:>7} "
            f"{bound:>8} {row.seconds:>8.1f}"
        )
    return 0


def plans_of(name: str, days: float, limit_s: float, python: Path | None) -> tuple[Scenario, int, list[Row]]:
    """Return the scenario, the number of candidates, and the yield of each plan of each case."""
    data = find_data(None)
    scenario = load_scenario(name)
    orbit = propagate_scenario(scenario, force_model(scenario, data), (days + 1.0) * 86_400.0)
    ephemeris, _ = sample(orbit, 60.0)
    start = ephemeris.start_utc_ns + 10 * NS
    stop = start + round(days * DAY_NS)
    table: list[Row] = []
    options: list[Option] = []
    for case in CASES:
        planner = Planner(ephemeris, default_orientation(data), case.resources, PinholeCamera())
        options = candidates(planner, start, stop)
        table += compared(case, grid_of(planner, case, start, stop), options, limit_s, python)
    return scenario, len(options), table


def rows() -> Iterator[_rows.Row]:
    """Yield the windows of a week of the planner beside the optimal number; more than the bound is an error."""
    _, _, plans = plans_of("selenita", 7.0, 10.0, None)
    best = {one.case: one for one in plans if one.plan == "optimal windows, HiGHS"}
    for one in plans:
        if one.bound is None:
            optimal = best[one.case]
            wrong = "" if one.windows <= (optimal.bound or 0) + 1e-6 else "more windows than possible"
            what = f"{one.case}: {one.plan}"
            yield _rows.Row(what, one.windows, "windows", "optimal", optimal.windows, wrong)


def candidates(planner: Planner, start: int, stop: int) -> list[Option]:
    """Return the windows in daylight over the requested regions."""
    wanted = Constraints(
        sun_elevation_rad=(np.radians(2.0), np.radians(60.0)),
        regions_rad=tuple((LATITUDE_RAD, (np.radians(w), np.radians(e))) for w, e in REGIONS_DEG),
        minimum_duration_s=300.0,
        maximum_duration_s=1500.0,
    )
    options = []
    for first, last in planner.spans(wanted, start, stop, step_s=60.0):
        octets = data_octets(
            _frames(first, last), planner.resources.detections_per_frame, planner.resources.estimators
        )
        period = (first - start) // (WEEK_DAYS * DAY_NS)
        options.append(Option(first, last, octets, period=period))
    return options


def grid_of(planner: Planner, case: Case, start: int, stop: int) -> ResourceGrid:
    """Return the resources of a case from the start to half a day after the stop."""
    steps = int((stop + DAY_NS // 2 - start) // round(STEP_S * NS))
    resources = planner.resources
    epochs = start + (np.arange(steps, dtype=np.int64) * 2 + 1) * round(STEP_S * NS / 2)
    gain_w = planner.sunlit(epochs) * resources.generation_w - resources.idle_w
    return ResourceGrid(
        start_utc_ns=start,
        step_s=STEP_S,
        gain_wh=gain_w * STEP_S / 3600.0,
        downlink_octets=planner.downlink_octets(start, steps, STEP_S, {}),
        battery_wh=resources.battery_wh,
        floor_wh=0.3 * resources.battery_wh,
        observing_w=resources.observing_w,
        storage_octets=resources.storage_octets,
        observe_s_per_day=None if case.hours_per_day is None else case.hours_per_day * 3600.0,
    )


def compared(
    case: Case, grid: ResourceGrid, options: list[Option], limit_s: float, python: Path | None
) -> list[Row]:
    """Return the yield of each plan, checked by the simulation of the planner."""
    quota = None
    if case.windows_per_week is not None:
        quota = dict.fromkeys({one.period for one in options}, case.windows_per_week)
    rows: list[Row] = []

    def add(name: str, plan: Sequence[Option], begin: float, bound: float | None = None) -> None:
        seconds = time.perf_counter() - begin
        if (reason := violation(grid, plan)) is not None:
            raise SystemExit(f"{case.name}, {name}: expected a feasible plan, found one that {reason}")
        frames = sum(_frames(one.start_utc_ns, one.stop_utc_ns) for one in plan)
        hours = sum(one.stop_utc_ns - one.start_utc_ns for one in plan) / NS / 3600.0
        rows.append(Row(case.name, name, len(plan), hours, frames, seconds, bound))

    begin = time.perf_counter()
    add("greedy", take_in_order(grid, options, (), quota)[0], begin)
    begin = time.perf_counter()
    add("standing request", day_by_day(grid, options, quota), begin)
    begin = time.perf_counter()
    add("month at once", choose(grid, options, (), quota)[0], begin)
    program = program_of(grid, options, quota)
    frames = [_frames(one.start_utc_ns, one.stop_utc_ns) for one in options]
    for what, values in (("windows", [1] * len(options)), ("frames", frames)):
        begin = time.perf_counter()
        chosen, bound = by_highs(program, values, limit_s)
        add(f"optimal {what}, HiGHS", [options[k] for k in chosen], begin, bound)
        if python is not None:
            begin = time.perf_counter()
            chosen, bound = by_cp_sat(program, values, limit_s, python)
            add(f"optimal {what}, CP-SAT", [options[k] for k in chosen], begin, bound)
    return rows


def day_by_day(grid: ResourceGrid, options: Sequence[Option], quota: dict[int, int] | None) -> list[Option]:
    """Return the windows of a planner that fills the coming days, once each day."""
    plan: list[Option] = []
    last = max((one.stop_utc_ns for one in options), default=grid.start_utc_ns)
    days = -((grid.start_utc_ns - last) // DAY_NS)
    for day in range(days):
        now = grid.start_utc_ns + day * DAY_NS
        coming = [
            one
            for one in options
            if now <= one.start_utc_ns
            and one.stop_utc_ns <= now + HORIZON_DAYS * DAY_NS
            and not any(
                one.start_utc_ns < old.stop_utc_ns and old.start_utc_ns < one.stop_utc_ns for old in plan
            )
        ]
        left = None
        if quota is not None:
            left = {period: n - sum(one.period == period for one in plan) for period, n in quota.items()}
        plan += choose(grid, coming, tuple(plan), left)[0]
    return plan


def program_of(grid: ResourceGrid, options: Sequence[Option], quota: dict[int, int] | None) -> Program:
    """Return the limits of a plan as linear rows.

    Charge and stored data are variables of each step: the charge is at most what the balance gives, the stored data are
    at least that.
    """
    n, steps = len(options), len(grid.gain_wh)
    full, floor = int(grid.battery_wh * SCALE), int(np.ceil(grid.floor_wh * SCALE))
    room = int(grid.storage_octets)
    charge = range(n, n + steps)
    stored = range(n + steps, n + 2 * steps)
    use: dict[int, list[tuple[int, int]]] = {}
    data: dict[int, list[tuple[int, int]]] = {}
    for k, option in enumerate(options):
        energy = grid.energy_wh(option)
        for step in np.flatnonzero(energy).tolist():
            use.setdefault(step, []).append((k, int(np.ceil(energy[step] * SCALE))))
        data.setdefault(grid.arrival(option), []).append((k, option.octets))
    rows = _counted(grid, options, quota)
    for step in range(steps):
        gain = int(np.floor(grid.gain_wh[step] * SCALE))
        terms = [(charge[step], 1), *use.get(step, ())]
        if step:
            rows.append(_row([*terms, (charge[step - 1], -1)], gain))
        else:
            rows.append(_row(terms, full + gain))
        arrivals = data.get(step, [])
        sent = int(grid.downlink_octets[step])
        rows.append(_row([(stored[step], -1), *arrivals], 0))
        if step:
            rows.append(_row([(stored[step], -1), (stored[step - 1], 1), *arrivals], sent))
        later = grid.later_octets[step]
        if arrivals and np.isfinite(later) and int(later) < room:
            limit = int(later)
            rows += [_row([(stored[step], 1), (k, room - limit)], room) for k, _ in arrivals]
    return Program(
        lower=[0] * n + [floor] * steps + [0] * steps,
        upper=[1] * n + [full] * steps + [room] * steps,
        rows=rows,
    )


def _counted(
    grid: ResourceGrid, options: Sequence[Option], quota: dict[int, int] | None
) -> list[tuple[list[int], list[int], int]]:
    """Return the rows of overlaps, of hours of observation and of windows in a period."""
    rows = []
    for a, first in enumerate(options):
        for b in range(a + 1, len(options)):
            if options[b].start_utc_ns < first.stop_utc_ns:
                rows.append(_row([(a, 1), (b, 1)], 1))
        if grid.observe_s_per_day is not None:
            day = [
                (k, -(-(one.stop_utc_ns - one.start_utc_ns) // NS))
                for k, one in enumerate(options)
                if first.start_utc_ns <= one.start_utc_ns < first.start_utc_ns + DAY_NS
            ]
            rows.append(_row(day, int(grid.observe_s_per_day)))
    for period, number in (quota or {}).items():
        rows.append(_row([(k, 1) for k, one in enumerate(options) if one.period == period], number))
    return rows


def by_highs(program: Program, values: Sequence[int], limit_s: float) -> tuple[list[int], float]:
    """Return the chosen options and the bound that HiGHS proved."""
    size, n = len(program.lower), len(values)
    lines = [line for line, (columns, _, _) in enumerate(program.rows) for _ in columns]
    columns = [column for row in program.rows for column in row[0]]
    numbers = [number for row in program.rows for number in row[1]]
    matrix = csr_array((np.array(numbers, float), (lines, columns)), shape=(len(program.rows), size))
    with _quiet():
        result = milp(
            -np.array([*values, *[0] * (size - n)], float),
            integrality=np.arange(size) < n,
            bounds=Bounds(np.array(program.lower, float), np.array(program.upper, float)),
            constraints=LinearConstraint(matrix, -np.inf, np.array([row[2] for row in program.rows], float)),
            options={"time_limit": limit_s},
        )
    if result.x is None:
        raise SystemExit(f"planning: expected a plan of HiGHS, found none: {result.message}")
    return np.flatnonzero(np.round(result.x[:n])).tolist(), -float(result.mip_dual_bound)


def by_cp_sat(
    program: Program, values: Sequence[int], limit_s: float, python: Path
) -> tuple[list[int], float]:
    """Return the chosen options and the bound that CP-SAT proved, computed in another environment."""
    given = {
        "lower": program.lower,
        "upper": program.upper,
        "rows": program.rows,
        "objective": [*values, *[0] * (len(program.lower) - len(values))],
        "limit_s": limit_s,
    }
    script = Path(__file__).with_name("_cp_sat.py")
    done = subprocess.run(
        [python, script], input=json.dumps(given), capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise SystemExit(f"planning: {python} {script.name}: {last}")
    answer = json.loads(done.stdout)
    if answer["values"] is None:
        raise SystemExit("planning: expected a plan of CP-SAT, found none within its time")
    return [k for k, value in enumerate(answer["values"][: len(values)]) if value], float(answer["bound"])


@contextmanager
def _quiet() -> Iterator[None]:
    """Send what the solver prints to stderr: the table or the JSON object goes to stdout."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _row(terms: Sequence[tuple[int, int]], limit: int) -> tuple[list[int], list[int], int]:
    return [column for column, _ in terms], [number for _, number in terms], limit


def _frames(start_utc_ns: int, stop_utc_ns: int) -> int:
    return frames_between(start_utc_ns, stop_utc_ns, CADENCE_S)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
