"""Fault campaigns: a scenario simulated with every fault and every seed, and the outcomes.

A case is *detected* when one of the events that it names comes down after the fault began; it ends *recovered* when the
payload works on frames after the fault has gone, *contained* when it waits in safe mode or standby as the case says
it shall, and *lost* otherwise.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lunar.datafolder import DataFolder
from payload_emulator.errors import ScenarioError
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.session.loading import LoadedPayload
from payload_emulator.session.scenario import SHIPPED, FaultsSection, Scenario
from payload_emulator.session.schedule import fly_scenario
from payload_emulator.session.spacecraft import new_spacecraft
from payload_emulator.session.starting import load_scenario_payload
from payload_emulator.session.typed_toml import TableFault, read_table
from payload_emulator.session.world import World, build_world, clock_ticks
from payload_emulator.sim.board.faults import Fault, parse_fault
from tmtc.cuc import TICKS_PER_SECOND
from tmtc.dictionary import DICTIONARY

CAMPAIGNS = SHIPPED / "campaigns"
_SETTLING_S = 240.0

Progress = Callable[[Iterable[Any], int], Iterator[Any]]


@dataclass(frozen=True, slots=True)
class Case:
    """Faults that come together, the events of which one tells of them, and whether the payload shall end waiting."""

    name: str = ""
    faults: tuple[str, ...] = ()
    events: tuple[str, ...] = ()
    safe: bool = False


@dataclass(frozen=True, slots=True)
class Campaign:
    """Cases to be flown with each of the seeds."""

    name: str
    seeds: tuple[int, ...] = (1,)
    case: tuple[Case, ...] = ()


@dataclass(frozen=True, slots=True)
class Result:
    """Outcome of one case with one seed; `latency_s` from fault to event, NaN without one."""

    case: str
    seed: int
    outcome: str
    detected: bool
    latency_s: float
    frames_expected: int
    frames_processed: int
    resets: int
    end_mode: str
    events: tuple[str, ...]


def load_campaign(path: Path | str) -> Campaign:
    """The campaign in a TOML file, or one of those shipped, by name.

    Raises
    ------
    ScenarioError
        The file is missing or says something else; the message names the place.
    """
    where = Path(path)
    if not where.exists() and (CAMPAIGNS / f"{where.name}.toml").exists():
        where = CAMPAIGNS / f"{where.name}.toml"
    try:
        table = tomllib.loads(where.read_text(encoding="utf-8"))
    except FileNotFoundError:
        shipped = ", ".join(sorted(file.stem for file in CAMPAIGNS.glob("*.toml")))
        raise ScenarioError(f"{path}: no such campaign file; shipped campaigns: {shipped}") from None
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"{where}: not TOML: {error}") from None
    try:
        campaign = read_table(Campaign, {"name": where.stem} | table)
    except TableFault as fault:
        raise ScenarioError(f"{where}: {fault}") from None
    if not campaign.seeds or min(campaign.seeds) < 0 or not campaign.case:
        raise ScenarioError(f"{where}: expected seeds from 0 and one [[case]] or more, found none")
    known = DICTIONARY.labels("event_info", "event_id").values()
    for number, case in enumerate(campaign.case, start=1):
        for event in case.events:
            if event not in known:
                raise ScenarioError(
                    f"{where}, case {number}: events must be names of the dictionary, found {event!r}"
                )
        for text in case.faults:
            parse_fault(text)
    named = [replace(case, name=case.name or f"case {k}") for k, case in enumerate(campaign.case, start=1)]
    return replace(campaign, case=tuple(named))


def run_campaign(
    scenario: Scenario, campaign: Campaign, data: DataFolder, progress: Progress | None = None
) -> list[Result]:
    """Fly every case with every seed; the world is made once."""
    world = build_world(scenario, data)
    loaded, _, _ = load_scenario_payload(world, data)
    runs = [(case, seed) for case in campaign.case for seed in campaign.seeds]
    return [
        fly_case(world, loaded, case, seed)
        for case, seed in (progress(runs, len(runs)) if progress else runs)
    ]


def fly_case(world: World, loaded: LoadedPayload, case: Case, seed: int) -> Result:
    """Fly one case with one seed."""
    scenario = replace(world.scenario, seed=seed, faults=FaultsSection(case.faults))
    world = replace(world, scenario=scenario)
    spacecraft = new_spacecraft(world, loaded)
    faults = tuple(parse_fault(text) for text in case.faults)
    labels = DICTIONARY.labels("event_info", "event_id")
    first_ticks = clock_ticks(world, int(world.frame_utc_ns[0]))
    events: list[tuple[float, str]] = []
    processed: list[float] = []
    for turn in fly_scenario(world, spacecraft):
        second = (turn.moment.utc_ns - int(world.frame_utc_ns[0])) / 1e9
        for packet in turn.packets:
            name, values = DICTIONARY.unpack(packet)
            if name.startswith("event_"):
                made_s = (int.from_bytes(packet[14:20], "big") - first_ticks) / TICKS_PER_SECOND
                events.append((made_s, labels[values["event_id"]]))
            elif name == "detections" and values["image_quality"] == 0:
                processed.append(second)
    detected = _detection(faults, case, events, spacecraft.payload.mode)
    return Result(
        case.name,
        seed,
        _outcome(faults, case, processed, float((world.frame_utc_ns[-1] - world.frame_utc_ns[0]) / 1e9)),
        detected is not None,
        float("nan") if detected is None else detected,
        int(world.frame_utc_ns.size),
        len(processed),
        len(spacecraft.resets),
        spacecraft.payload.mode.name,
        tuple(dict.fromkeys(event for _, event in events)),
    )


def _detection(
    faults: tuple[Fault, ...], case: Case, events: list[tuple[float, str]], mode: PayloadMode
) -> float | None:
    """Return seconds from the first fault to its event; None without one. Without faults: None if safe, else 0."""
    if not faults:
        return None if mode is PayloadMode.safe else 0.0
    began_s = min(fault.at_s for fault in faults)
    # A clock that has jumped dates its own events wrongly: the order in which they came is what counts.
    reported_s = [made_s for made_s, event in events if event in case.events]
    return max(reported_s[0] - began_s, 0.0) if reported_s else None


def _outcome(faults: tuple[Fault, ...], case: Case, processed: list[float], last_s: float) -> str:
    gone_s = max((fault.at_s + fault.duration_s for fault in faults), default=0.0)
    if case.safe:
        # Some minutes are allowed for counting to a limit, or for the next check of memory.
        settled_s = min(max(fault.at_s for fault in faults) + _SETTLING_S, last_s)
        return "lost" if any(second > settled_s for second in processed) else "contained"
    return "recovered" if any(second > gone_s for second in processed) else "lost"


def table(results: Iterable[Result]) -> list[dict[str, Any]]:
    """One row a case: runs, how many were detected, recovered, contained and lost, and the longest detection."""
    rows: dict[str, dict[str, Any]] = {}
    for result in results:
        row = rows.setdefault(
            result.case,
            {
                "case": result.case,
                "runs": 0,
                "detected": 0,
                "recovered": 0,
                "contained": 0,
                "lost": 0,
                "latency_max_s": 0.0,
                "frames_processed": 0,
                "frames_expected": 0,
            },
        )
        row["runs"] += 1
        row["detected"] += result.detected
        row[result.outcome] += 1
        row["frames_processed"] += result.frames_processed
        row["frames_expected"] += result.frames_expected
        if result.detected:
            row["latency_max_s"] = max(row["latency_max_s"], result.latency_s)
    return list(rows.values())
