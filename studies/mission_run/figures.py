"""Closing figures of a mission run, read from the ground's archive through the client of its API."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ground_service.evaluation.model import PassFigures
from ground_service.planning.model import Window
from lunar.constants import NANOSECONDS_PER_SECOND as NS
from lunar.timescales import parse_utc
from payload_emulator.session.spacecraft import SPACECRAFT_ID
from studies.mission_run.ground import MissionGround
from studies.mission_run.incidents import find_incidents
from studies.mission_run.processes import judged_memory

FLOWN = ("executing", "executed", "downlinked", "processed")
NEES = "consistency.nees"
IN_TIME_S = 120.0
DAY_S = 86_400.0


class RunProgress(Protocol):
    """What the runner has counted (`run.Progress`)."""

    wall_s: float
    utc: str
    starts: int
    contacts: int
    frames: int
    packets: int
    packets_lost_on_link: int
    telecommands: int
    telecommand_octets_lost: int
    resets: int
    posts: list[tuple[int, int]]
    contact_stops: list[str]
    processed: dict[str, str]
    memory_mib: dict[str, list[float]]
    memory_lives: dict[str, list[tuple[float, int]]]
    cpu_s: dict[str, float]


def closing_figures(
    ground: MissionGround, progress: RunProgress, days: float, scenario: str
) -> dict[str, Any]:
    """Return the figures of the closing report; what is not known is None."""
    windows = ground.windows()
    passes = [_figures_of(ground, one) for one in windows]
    evaluated = [one for one in passes if one is not None]
    rows = [_row(window, one, progress) for window, one in zip(windows, passes, strict=True)]
    interventions = ground.interventions(progress.posts)
    received = ground.packets_received()
    return {
        "scenario": scenario,
        "days": days,
        "end": progress.utc,
        "windows": {
            "requested": len(windows),
            "flown": sum(one.state in FLOWN for one in windows),
            "processed": sum(one.state == "processed" for one in windows),
            "failed": sum(one.state == "failed" for one in windows),
            "processed_after_contacts": _counted(row["contacts_to_processed"] for row in rows),
        },
        "frames": progress.frames,
        "frames_received": sum(one.frames for one in evaluated if one.frames is not None),
        "reports_without_frames": sum(one.frames is None for one in evaluated),
        "packets": progress.packets,
        "packets_lost_on_link": progress.packets_lost_on_link,
        "packets_received": received,
        "packets_lost": progress.packets - progress.packets_lost_on_link - received,
        "packets_lost_of_passes": sum(one.packets_lost for one in evaluated),
        "reports": len(evaluated),
        "reports_complete": sum(not _missing(one) for one in evaluated),
        "reports_lack": _counted(
            f"{name}: {reason}" for one in evaluated for name, reason in _missing(one).items()
        ),
        "evidence": _counted(one.evidence_level for one in evaluated),
        "time_correlation": _correlations(ground),
        "interventions": len(interventions),
        "interventions_list": interventions,
        "navigation": _navigation(evaluated),
        "detector": _detector(evaluated),
        "nees_inside_percent": _median([_value(one, NEES) for one in evaluated]),
        "requirements": _requirements(evaluated),
        "verdicts": _counted(one.verdict_level for one in evaluated),
        "trends": _trends(windows, passes),
        "trend": rows,
        "contacts": progress.contacts,
        "telecommands": progress.telecommands,
        "telecommand_octets_lost": progress.telecommand_octets_lost,
        "spacecraft_resets": progress.resets,
        "starts": progress.starts,
        "incidents": find_incidents(ground, windows),
        "memory_mib": {
            name: judged_memory(samples, progress.memory_lives[name])
            for name, samples in progress.memory_mib.items()
        },
        "memory_series_mib": progress.memory_mib,
        "memory_lives": progress.memory_lives,
        "cpu_s": progress.cpu_s,
        "wall_s": progress.wall_s,
    }


def contacts_until(stop_utc_ns: int, processed_utc_ns: int, contact_stops: Sequence[int]) -> int:
    """Return the number of contacts that ended after a window until it was seen as processed."""
    return sum(stop_utc_ns < one <= processed_utc_ns for one in contact_stops)


def _figures_of(ground: MissionGround, window: Window) -> PassFigures | None:
    """Return the figures of the newest report of a window; None without any."""
    if window.pass_id is None:
        return None
    reports = ground.client.list_reports(window.pass_id).page(1).items
    return ground.client.get_report_summary(reports[0].id) if reports else None


def _correlations(ground: MissionGround) -> dict[str, dict[str, float | int | None]]:
    """Return the time correlations in force by their first reported time, on-board ticks."""
    return {
        str(one.start_ticks): {
            "time_reports": one.points,
            "rejected": one.rejected,
            "drift_ppb": one.drift_ppb,
            "residual_rms_us": None if one.residual_rms_ns is None else one.residual_rms_ns * 1e-3,
            "residual_max_us": None if one.residual_max_ns is None else one.residual_max_ns * 1e-3,
        }
        for one in ground.client.list_correlations(SPACECRAFT_ID)
        if one.in_force
    }


def _missing(one: PassFigures) -> dict[str, str]:
    """Return what a report has to have and has not, with the reasons."""
    found: Mapping[str, bool] = {
        "recall": one.detector.recall is not None,
        "baselines": bool(one.baselines),
        "nees": _value(one, NEES) is not None,
        "evidence level": bool(one.evidence_level),
        "navigation": any(row.median_3d_m is not None for row in one.navigation.values()),
    }
    return {name: _reason(one, name) for name, has in found.items() if not has}


def _reason(one: PassFigures, name: str) -> str:
    """Return why a report has no recall, baselines, NEES, evidence level or navigation error."""
    stated = one.not_available
    if "error" in stated:
        return stated["error"]
    if name == "recall":
        return stated.get("recall") or stated.get("detector") or "unknown"
    if name == "baselines":
        return stated.get("baselines") or "no start state was uploaded, or the gravity field is not known"
    if name == "nees":
        return next((row.note for row in one.requirements if row.key == NEES), "") or "unknown"
    return "not stated in the mission description" if name == "evidence level" else "no estimate came down"


def _value(one: PassFigures, key: str) -> float | None:
    return next((row.value for row in one.requirements if row.key == key), None)


def _navigation(passes: Sequence[PassFigures]) -> dict[str, dict[str, float | None]]:
    """Return the medians over the passes of each estimator's median and 95th percentile of the error, m."""
    found: dict[str, dict[str, float | None]] = {}
    for name in sorted({name for one in passes for name in one.navigation}):
        rows = [one.navigation[name] for one in passes if name in one.navigation]
        found[name] = {
            "passes": float(len(rows)),
            "median_m": _median([row.median_3d_m for row in rows]),
            "drift_percent": _median([row.drift_percent for row in rows]),
            "p95_m": _median([row.p95_3d_m for row in rows]),
        }
    return found


def _detector(passes: Sequence[PassFigures]) -> dict[str, float | None]:
    return {
        "recall": _median([one.detector.recall for one in passes]),
        "precision": _median([one.detector.precision for one in passes]),
    }


def _requirements(passes: Sequence[PassFigures]) -> dict[str, dict[str, int]]:
    """Return the numbers of passes by requirement and its status."""
    found: dict[str, Counter[str]] = {}
    for one in passes:
        for row in one.requirements:
            found.setdefault(row.key, Counter())[row.status] += 1
    return {key: dict(sorted(counts.items())) for key, counts in found.items()}


def _trends(windows: Sequence[Window], passes: Sequence[PassFigures | None]) -> dict[str, Any]:
    """Return the change a day of recall, and of error and drift of each estimator, by least squares."""
    known = [(window, one) for window, one in zip(windows, passes, strict=True) if one is not None]
    if not known:
        return {}
    first = known[0][0].start.utc_ns
    days = [(window.start.utc_ns - first) / NS / DAY_S for window, _ in known]
    series: dict[str, list[float | None]] = {"recall": [one.detector.recall for _, one in known]}
    for name in sorted({name for _, one in known for name in one.navigation}):
        rows = [one.navigation.get(name) for _, one in known]
        series[f"{name} median_m"] = [None if row is None else row.median_3d_m for row in rows]
        series[f"{name} drift_percent"] = [None if row is None else row.drift_percent for row in rows]
    return {name: trend(days, values) for name, values in series.items()}


def trend(days: Sequence[float], values: Sequence[float | None]) -> dict[str, float | int | None]:
    """Return the number of known values, the medians of their first and last third, and their slope a day."""
    pairs = [
        (day, value)
        for day, value in zip(days, values, strict=True)
        if value is not None and np.isfinite(value)
    ]
    third = max(len(pairs) // 3, 1)
    slope = None
    if len(pairs) >= 3 and pairs[-1][0] > pairs[0][0]:
        slope = float(np.polyfit([day for day, _ in pairs], [value for _, value in pairs], 1)[0])
    return {
        "passes": len(pairs),
        "first_third": _median([value for _, value in pairs[:third]]),
        "last_third": _median([value for _, value in pairs[-third:]]),
        "slope_per_day": slope,
    }


def _row(window: Window, figures: PassFigures | None, progress: RunProgress) -> dict[str, Any]:
    """Return one window in the list of windows."""
    row: dict[str, Any] = {"window": window.id, "start": str(window.start), "state": window.state}
    row["contacts_to_processed"] = None
    seen = progress.processed.get(str(window.id))
    if seen is not None:
        stops = [parse_utc(one) for one in progress.contact_stops]
        row["contacts_to_processed"] = contacts_until(window.stop.utc_ns, parse_utc(seen), stops)
    if figures is None:
        return row
    row |= {"frames": figures.frames, "packets_lost": figures.packets_lost, "verdict": figures.verdict_level}
    row["recall"] = figures.detector.recall
    row["median_m"] = {name: one.median_3d_m for name, one in figures.navigation.items()}
    row["drift_percent"] = {name: one.drift_percent for name, one in figures.navigation.items()}
    row["nees_inside_percent"] = _value(figures, NEES)
    row["not_met"] = [one.key for one in figures.requirements if one.status == "not met"]
    row["lacks"] = _missing(figures)
    row["evidence"] = figures.evidence_level
    return row


def _counted(values: Any) -> dict[str, int]:
    counts = Counter("unknown" if value is None else str(value) for value in values)
    return dict(sorted(counts.items()))


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None and np.isfinite(value)]
    return float(np.median(known)) if known else None
