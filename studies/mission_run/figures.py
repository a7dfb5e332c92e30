"""Closing figures of a mission run, read from the ground's archive through the client of its API."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from ground_service.evaluation.model import PassFigures
from ground_service.planning.model import Window
from studies.mission_run.ground import EmbeddedGround

FLOWN = ("executing", "executed", "downlinked", "processed")
NS = 1_000_000_000


class RunProgress(Protocol):
    """What the runner has counted (`run.Progress`)."""

    wall_s: float
    utc: str
    starts: int
    contacts: int
    frames: int
    packets: int
    telecommands: int
    interventions: int
    incidents: list[dict[str, str]]
    memory_mib: list[float]


def closing_figures(
    ground: EmbeddedGround, progress: RunProgress, days: float, scenario: str
) -> dict[str, Any]:
    """Return the figures of the closing report; what is not known is None."""
    windows = ground.windows()
    passes = [_figures_of(ground, one) for one in windows]
    evaluated = [one for one in passes if one is not None]
    packets = sum(one.packets for one in evaluated)
    return {
        "scenario": scenario,
        "days": days,
        "end": progress.utc,
        "windows": {
            "requested": len(windows),
            "flown": sum(one.state in FLOWN for one in windows),
            "processed": sum(one.state == "processed" for one in windows),
            "failed": sum(one.state == "failed" for one in windows),
        },
        "frames": progress.frames,
        "packets": progress.packets,
        "packets_of_passes": packets,
        "packets_lost": sum(one.packets_lost for one in evaluated),
        "reports": len(evaluated),
        "alerts": sum(1 for _ in ground.client.list_alarms()),
        "interventions": progress.interventions,
        "navigation": _navigation(evaluated),
        "detector": _detector(evaluated),
        "verdicts": {
            name: sum(one.verdict == name for one in evaluated) for name in {one.verdict for one in evaluated}
        },
        "trend": [_row(window, one) for window, one in zip(windows, passes, strict=True)],
        "contacts": progress.contacts,
        "telecommands": progress.telecommands,
        "starts": progress.starts,
        "incidents": progress.incidents,
        "memory_mib": _memory(progress.memory_mib),
        "wall_s": progress.wall_s,
    }


def _figures_of(ground: EmbeddedGround, window: Window) -> PassFigures | None:
    """Return the figures of the newest report of a window; None without any."""
    if window.pass_id is None:
        return None
    reports = ground.client.list_reports(window.pass_id).page(1).items
    return ground.client.get_report_summary(reports[0].id) if reports else None


def _navigation(passes: Sequence[PassFigures]) -> dict[str, dict[str, float | None]]:
    """Return the median over the passes of each estimator's median and 95th percentile of the error, m."""
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


def _row(window: Window, figures: PassFigures | None) -> dict[str, Any]:
    """Return one window of the trend."""
    row: dict[str, Any] = {"window": window.id, "start": str(window.start), "state": window.state}
    if figures is None:
        return row
    row |= {"frames": figures.frames, "packets_lost": figures.packets_lost, "verdict": figures.verdict}
    row["recall"] = figures.detector.recall
    row["median_m"] = {name: one.median_3d_m for name, one in figures.navigation.items()}
    return row


def _memory(samples: Sequence[float]) -> dict[str, float | None]:
    """Return the largest resident memory of this process after a tenth of the run and at its end, MiB."""
    if not samples:
        return {"early": None, "end": None}
    return {"early": samples[len(samples) // 10], "end": samples[-1]}


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None and np.isfinite(value)]
    return float(np.median(known)) if known else None
