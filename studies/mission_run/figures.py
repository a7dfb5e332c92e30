"""Closing figures of a mission run: what the ground service says of its month, and what the spacecraft counted."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ground_service.evaluation.performance.model import PassPerformance
from ground_service.planning.model import RequestPlan
from lunar.constants import DAY_NS
from studies.mission_run.ground import MissionGround

UNKNOWN = "not known"
"""Reason of a missing window that no plan states."""

FLOWN = ("executing", "executed", "downlinked", "processed")


@dataclass(slots=True)
class Progress:
    """Progress of a run; kept in the folder of the run and in its checkpoints.

    Attributes
    ----------
    posts
        First and last number of the entries of the audit log for the posts of each start.
    not_entered
        Why the last plan of each day of the run, by its number, has no further windows.
    """

    wall_s: float = 0.0
    utc: str = ""
    starts: int = 0
    contacts: int = 0
    frames: int = 0
    images_lost: int = 0
    packets: int = 0
    packets_lost_on_link: int = 0
    telecommands: int = 0
    telecommand_octets_lost: int = 0
    resets: int = 0
    reference_day: int = -1
    request_id: int | None = None
    not_entered: dict[str, str] = field(default_factory=dict)
    finished: bool = False
    posts: list[tuple[int, int]] = field(default_factory=list)


def windows_asked(days: float, windows_per_day: int, last_days: float) -> int:
    """Return the number of windows that a standing request asks for, which ends `last_days` before the run."""
    return windows_per_day * max(math.ceil(days - last_days), 0)


def note_plan(progress: Progress, plan: RequestPlan, start_utc_ns: int) -> None:
    """Record why a plan has no further windows, by the number of the day of the run."""
    reasons: dict[int, Counter[str]] = {}
    for one in plan.candidates:
        if one.reason is not None:
            day = (one.start.utc_ns - start_utc_ns) // DAY_NS
            reasons.setdefault(day, Counter())[one.reason] += 1
    if plan.reason is not None and plan.planned is not None:
        reasons[(plan.planned.utc_ns - start_utc_ns) // DAY_NS] = Counter([plan.reason])
    for day, counts in reasons.items():
        progress.not_entered[str(day)] = counts.most_common(1)[0][0]


def missing_windows(
    starts_utc_ns: Iterable[int], start_utc_ns: int, per_day: int, asked: int, progress: Progress
) -> list[dict[str, Any]]:
    """Return the days of the run with fewer windows than asked for, with the reason; "not known" without one."""
    entered = Counter((one - start_utc_ns) // DAY_NS for one in starts_utc_ns)
    return [
        {"day": day, "missing": per_day - entered[day], "reason": progress.not_entered.get(str(day), UNKNOWN)}
        for day in range(asked // per_day)
        if entered[day] < per_day
    ]


def closing_figures(
    ground: MissionGround, progress: Progress, asked: int, per_day: int, start_utc_ns: int, spacecraft_id: int
) -> dict[str, Any]:
    """Return the figures of the closing report; what is not known is None."""
    windows = ground.windows(spacecraft_id)
    kept = [one.start.utc_ns for one in windows if one.state != "failed"]
    performance = ground.client.get_performance(spacecraft_id)
    passes = performance.passes
    alarms = [one.model_dump(mode="json") for one in ground.client.list_alarms(spacecraft_id=spacecraft_id)]
    interventions = ground.interventions(progress.posts)
    received = ground.packets_received(spacecraft_id)
    apart = len(list(ground.client.list_implausible(spacecraft_id=spacecraft_id)))
    return {
        "end": progress.utc,
        "windows": {
            "requested": asked,
            "flown": sum(one.state in FLOWN for one in windows),
            "processed": sum(one.state == "processed" for one in windows),
            "failed": sum(one.state == "failed" for one in windows),
        },
        "window_list": [{"start": str(one.start), "state": one.state, "reason": one.reason} for one in windows],
        "missing_windows": missing_windows(kept, start_utc_ns, per_day, asked, progress),
        "frames": progress.frames,
        "frames_received": sum(one.frames or 0 for one in passes),
        "images_lost": progress.images_lost,
        "packets": progress.packets,
        "packets_lost_on_link": progress.packets_lost_on_link,
        "packets_received": received,
        "packets_implausible": apart,
        "packets_lost": progress.packets - progress.packets_lost_on_link - received - apart,
        "contacts": progress.contacts,
        "telecommands": progress.telecommands,
        "telecommand_octets_lost": progress.telecommand_octets_lost,
        "spacecraft_resets": progress.resets,
        "reports": len(passes),
        "verdicts": _counted(one.verdict_level for one in passes),
        "evidence": _counted(one.terrain or "not stated" for one in passes),
        "navigation": _navigation(passes),
        "detector": {"recall": _median([one.recall for one in passes])},
        "performance": performance.model_dump(mode="json"),
        "alerts": len(alarms),
        "alarms": alarms,
        "interventions": len(interventions),
        "interventions_list": interventions,
        "starts": progress.starts,
        "wall_s": progress.wall_s,
    }


def months(starts: Iterable[str]) -> list[str]:
    """Return the months of times, such as 2029-08, in order."""
    return sorted({start[:7] for start in starts})


def _navigation(passes: Sequence[PassPerformance]) -> dict[str, dict[str, float | None]]:
    """Return the medians over the passes of the median error in m and of the drift, by judged estimator."""
    found: dict[str, dict[str, float | None]] = {}
    for name in sorted({one.estimator for one in passes if one.estimator}):
        rows = [one for one in passes if one.estimator == name]
        found[name] = {
            "passes": float(len(rows)),
            "median_m": _median([row.median_error_m for row in rows]),
            "drift_percent": _median([row.drift_percent for row in rows]),
        }
    return found


def _counted(values: Iterable[str]) -> dict[str, int]:
    return dict(sorted(Counter(values).items()))


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None and np.isfinite(value)]
    return float(np.median(known)) if known else None
