"""Figures of a mission run with disturbances, compared with those of the same run without them.

    linna mission run selenita --days 30 --folder plain
    linna mission run selenita --days 30 --disturbances arrivals --folder disturbed
    python -m benchmarks.campaigns.arrivals plain disturbed

Each figure of both reports is equal, flagged by alarms of the disturbed run that the other run does not have and that
concern it, or different. The exit status is 1 if a figure is different, or a window failed without an alarm.
"""

import argparse
import json
import math
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lunar.constants import NS
from lunar.timescales import parse_utc
from studies.mission_run.run import REPORT

RELATIVE, SPAN_NS = 1e-4, 3600 * NS
"""Tolerance of figures: a report uses the time correlation that exists when it is made.  Time from the start of a
window within which an alarm concerns it."""

OF_DISTURBED = "implausible_time"
TOTALS = ("frames", "frames_received", "images_lost", "packets_lost", "reports", "spacecraft_resets", "interventions")
LEFT = {"pass_id", "name", "start", "report_id"}

Report = Mapping[str, Any]


class Finding(NamedTuple):
    """A figure of both runs; `flags` are the alarms that concern it, empty if it is equal or different."""

    name: str
    plain: Any
    disturbed: Any
    outcome: str
    flags: tuple[str, ...] = ()


def is_equal(one: Any, other: Any) -> bool:
    """Return whether two figures are equal within the tolerance."""
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=RELATIVE, abs_tol=1e-9)
    return bool(one == other)


def compare(plain: Report, disturbed: Report) -> Iterator[Finding]:
    """Yield the figures of both runs: of windows and passes by their start, then totals."""
    known = {one["name"] for one in plain["alarms"]}
    alarms = [one for one in disturbed["alarms"] if one["name"] not in known]
    flagged: set[str] = set()
    for start, before, after in _parts(plain, disturbed):
        at = parse_utc(start)
        flags = tuple(
            sorted({one["name"] for one in alarms if parse_utc(one["first"]) < at + SPAN_NS and parse_utc(one["last"]) > at})
        )
        for key in sorted({*before, *after}):
            found = _finding(f"{start} {key}", before.get(key), after.get(key), flags)
            flagged.update(found.flags)
            yield found
    apart = sum(one["count"] for one in alarms if one["name"] == OF_DISTURBED)
    for key in TOTALS:
        flags = tuple(sorted(flagged))
        if key == "packets_lost" and disturbed[key] == apart:
            flags = (OF_DISTURBED,)
        yield _finding(key, plain[key], disturbed[key], flags)
