"""Figures of a mission run with disturbances, compared with those of the same run without them.

    linna mission run selenita --days 30 --folder plain
    linna mission run selenita --days 30 --disturbances arrivals --folder disturbed
    python -m benchmarks.campaigns.arrivals plain disturbed

Each figure of the closing reports is equal, flagged, or different. A pass is flagged by the event reports within it
that the other run does not have, and by a step of the clock that its report names. A figure of several passes is
flagged by those of its passes; a count of packets by event reports and packets that are kept apart; the state of a
window, and a pass of one run only, by a missed contact, or a planted step of the on-board clock, within the two days
before. The payload learns from its passes: behind a pass of one run only, those that differ by less than `LEARNED` are
flagged. The exit status is 1 if a figure is different.
"""

import argparse
import json
import math
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ground_service.client.local import local_client
from ground_service.contacts.links.store import contacts_between
from ground_service.ground import open_ground
from lunar.constants import NS
from lunar.timescales import parse_utc
from payload_emulator.session.scenario import load_scenario
from studies.mission_run.run import REPORT

RELATIVE = 1e-3
"""Tolerance of figures: a report uses the time correlation that exists when it is made. Two ticks of the clock move the
spacecraft by 5 cm along the track, and the errors of a pass have 60 m and more."""

LEARNED = 0.1
"""Largest difference of the figures of passes whose payload has learned from other passes; what it learned has none."""

KEYS = ("start", "key", "day", "factor", "group", "metric", "time")
"""Keys that identify an item of a list of figures."""

OF_PACKETS = {"packets", "packets_received", "packets_implausible", "alerts"}
OF_TIME = ("performance.passes[", "window_list[")
HOUR_NS, DAY_NS = 3600 * NS, 86_400 * NS
LEFT = {"alarms", "contacts", "monthly_reports", "pass_id", "report_id", "starts", "wall_s", *KEYS}
"""Names of processes and identities, and what the disturbances change by themselves: alarms and contacts."""

CLOCK_STEP = "time.step"
"""Requirement of a pass report."""

Report = Mapping[str, Any]


class Finding(NamedTuple):
    """A figure of both runs, and what flags a difference; "" where nothing does."""

    name: str
    plain: Any
    disturbed: Any
    outcome: str
    flags: str = ""

    def __str__(self) -> str:
        values = "" if self.outcome == "equal" else f"  {self.plain} | {self.disturbed}"
        return f"{self.outcome:<9}  {self.name}{values}{f'  by {self.flags}' if self.flags else ''}"


def figures(tree: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the figures of a closing report by their place; items of lists are named by what they are about."""
    if isinstance(tree, Mapping):
        for key, one in tree.items():
            if key not in LEFT:
                yield from figures(one, f"{name}.{key}" if name else key)
    elif isinstance(tree, list):
        for k, one in enumerate(tree):
            about = [str(one[key]) for key in KEYS if key in one] if isinstance(one, Mapping) else []
            yield from figures(one, f"{name}[{' '.join(about) or k}]")
    else:
        yield name, tree


def is_equal(one: Any, other: Any, relative: float = RELATIVE) -> bool:
    """Return whether two figures are equal within a tolerance."""
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=relative, abs_tol=relative**2) or (
            math.isnan(one) and math.isnan(other)
        )
    return bool(one == other)


def compare(
    plain: Report, disturbed: Report, events: Mapping[str, set[str]], causes: Mapping[int, str]
) -> list[Finding]:
    """Return the figures of both runs.

    `events` are those that only the disturbed run has, by the start of a pass; `causes` are missed contacts and planted
    steps of the on-board clock, by their time.
    """
    flags = {start: sorted(names) for start, names in events.items()}
    before, after = dict(figures(plain)), dict(figures(disturbed))
    of_packets = [f"event {one['name']}" for one in disturbed["alarms"] if one["source"] == "event"]
    if disturbed["packets_implausible"]:
        of_packets.append(f"{disturbed['packets_implausible']} packets kept apart")
    starts = [{one["start"] for one in report["performance"]["passes"]} for report in (plain, disturbed)]
    first = min(starts[0] ^ starts[1], default="")
    of_passes: set[str] = set()
    found = []
    for name in sorted({*before, *after}, key=lambda one: (not one.startswith(OF_TIME), one)):
        values = name, before.get(name), after.get(name)
        if is_equal(*values[1:]):
            found.append(Finding(*values, "equal"))
            continue
        start = name.partition("[")[2].partition("]")[0] if name.startswith(OF_TIME) else ""
        if start and (name.startswith("window_list") or None in values):
            at = parse_utc(start)
            reasons = sorted({cause for since, cause in causes.items() if at - 2 * DAY_NS <= since <= at + HOUR_NS})
        elif start:
            learned = first and start > first and (name.endswith("map_offset_m") or is_equal(*values[1:], LEARNED))
            reasons = [*flags.get(start, []), *(["other passes before it"] if learned else [])]
        else:
            reasons = of_packets if name in OF_PACKETS else sorted(of_passes)
        if start:
            of_passes.update(reasons)
        if name == "packets_lost":
            reasons = []
        found.append(Finding(*values, "flagged" if reasons else "DIFFERENT", ", ".join(reasons)))
    return found


def events_of(folder: Path, report: Report) -> dict[str, set[str]]:
    """Return the names of the event reports, and the step of the clock, of each pass of a run, by its start."""
    found: dict[str, set[str]] = {}
    with (
        tempfile.TemporaryDirectory() as made,
        open_ground(folder / "ground") as ground,
        local_client(ground, "viewer") as client,
    ):
        for one in report["performance"]["passes"]:
            client.get_report(one["report_id"], Path(made) / "report.json", format="json")
            stated = json.loads((Path(made) / "report.json").read_text())
            steps = {
                f"clock step {row['value']:.3f} s"
                for row in stated["requirements"]
                if row["key"] == CLOCK_STEP and row["status"] == "not met"
            }
            found[one["start"]] = {event["name"] for event in stated["events"]} | steps
    return found


def causes_of(folder: Path) -> dict[int, str]:
    """Return the contacts that the ground missed, and the planted steps of the on-board clock, by their time."""
    scenario = load_scenario(folder / "scenario.toml")
    lines = [one.split() for one in scenario.faults.events if one.startswith("clock_jump at ")]
    found = {scenario.epoch_utc_ns + round(float(words[2]) * NS): f"clock step {words[4]} s" for words in lines}
    with open_ground(folder / "ground") as ground:
        contacts = ground.read(contacts_between, scenario.epoch_utc_ns, scenario.epoch_utc_ns + 400 * DAY_NS)
    return found | {one.start_utc_ns: f"missed contact {one.station}" for one in contacts if one.state == "missed"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the figures of two runs; return 1 if one is different."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.campaigns.arrivals", description=__doc__)
    parser.add_argument("plain", type=Path, help="folder of the run without disturbances")
    parser.add_argument("disturbed", type=Path, help="folder of the run with disturbances")
    given = parser.parse_args(arguments)
    plain, disturbed = (json.loads((one / REPORT).read_text()) for one in (given.plain, given.disturbed))
    known = events_of(given.plain, plain)
    events = {start: names - known.get(start, set()) for start, names in events_of(given.disturbed, disturbed).items()}
    found = compare(plain, disturbed, events, causes_of(given.disturbed))
    print("\n".join(map(str, found)))
    for alarm in disturbed["alarms"]:
        print(f"alarm      {alarm['name']}: {alarm['count']}, {alarm['first']} to {alarm['last']}, {alarm['value']}")
    counts = Counter(one.outcome for one in found)
    failed = [one for one in disturbed["window_list"] if one["state"] == "failed"]
    false = [one for one in found if one.name.startswith("window_list[") and one.outcome == "DIFFERENT"]
    print(
        f"{len(found)} figures: {counts['equal']} equal, {counts['flagged']} flagged, {counts['DIFFERENT']} different; "
        f"{len(failed)} windows failed, {len(false)} of them for a false reason"
    )
    return int(counts["DIFFERENT"] > 0)


if __name__ == "__main__":
    sys.exit(main())
