"""Comparison of the navigation of several sessions: one row for each archive, from its summary.

Errors are three-dimensional, in metres, after the frames counted (see `counted_from`); every row names its
evidence level, which follows from the world stated in the mission description of the archive.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from payload_emulator.errors import RecordError
from payload_emulator.session.mission import MISSION_FILE, level_of, level_text


@dataclass(frozen=True, slots=True)
class NavigationRow:
    """Row of a session; values that are not available are None.

    Attributes
    ----------
    altitude_km
        Smallest, mean and largest over the frames.
    level
        Evidence level: "2", "3s" or "3"; "" if the archive states no world.
    unseen_share
        Share of frames over real terrain that was never used in training; None if it is not stated.
    median_m, p95_m, max_m
        Position error while images are available.
    coast_end_p95_m
        Position error immediately before the first image after a gap.
    recovery_frames
        Number of frames with an image until the error is below 500 m after a kidnap or an outage.
    propagate_only_m
        Median error of the start state propagated without images.
    """

    scenario: str
    seed: int
    level: str
    unseen_share: float | None
    altitude_km: tuple[float, float, float]
    frames: int
    counted_from: str
    median_m: float | None
    p95_m: float | None
    max_m: float | None
    coast_end_p95_m: float | None
    velocity_p95_m_s: float | None
    fixed_share: float | None
    wrong_fixes: int
    nees6: float | None
    nis_per_degree: float | None
    radial_bias_m: float | None
    propagate_only_m: float | None
    recovery_frames: int | None
    truth_reads_after_start: int


_COLUMNS = (
    "scenario",
    "seed",
    "level",
    "altitude km",
    "frames",
    "median m",
    "p95 m",
    "max m",
    "coast end p95 m",
    "velocity p95 m/s",
    "fixed",
    "wrong fixes",
    "NEES(6)",
    "NIS/dof",
    "radial bias m",
    "propagate only m",
    "back after",
    "truth reads",
)


def load_row(archive: Path) -> NavigationRow:
    """Return the row of a pass archive.

    Raises
    ------
    RecordError
        No archive, or one whose summary has no navigation because the anchored estimator did not run.
    """
    path = archive / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RecordError(f"{path}: expected the summary of a pass archive, found {error}") from None
    if not isinstance(summary, dict) or not isinstance(summary.get("navigation"), dict):
        raise RecordError(
            f"{path}: expected figures of the anchored estimator under navigation, found none; fly the scenario "
            "with --mode anchored"
        )
    return row_of(summary, *_declared(archive / MISSION_FILE))


def _declared(path: Path) -> tuple[str, float | None]:
    """Return level and share of unseen frames from a mission description; unknown without one."""
    try:
        evidence = tomllib.loads(path.read_text(encoding="utf-8")).get("evidence", {})
    except FileNotFoundError:
        return "", None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RecordError(f"{path}: expected a mission description, found {error}") from None
    world, share = evidence.get("world"), evidence.get("unseen_share")
    unseen = float(share) if isinstance(share, int | float) else None
    return level_of(str(world), unseen), unseen


def row_of(summary: Mapping[str, Any], level: str = "", unseen: float | None = None) -> NavigationRow:
    """Return the row of a session's summary at an evidence level."""
    navigation, altitude = summary["navigation"], summary["altitude_km"]
    imaging = navigation["imaging"]
    return NavigationRow(
        summary["scenario"],
        int(summary["seed"]),
        level,
        unseen,
        (altitude["min"], altitude["mean"], altitude["max"]),
        int(summary["frames"]),
        navigation["counted_from"],
        imaging["median_m"],
        imaging["p95_m"],
        imaging["max_m"],
        navigation["end_of_coast"]["p95_m"],
        navigation["velocity_p95_m_s"],
        navigation["fixed_share_imaging"],
        int(navigation["wrong_fixes"]),
        navigation["nees6"],
        navigation["nis_per_degree"],
        navigation["bias_rtn_m"][0],
        navigation["propagate_only"]["median_m"],
        (navigation.get("recovery") or {}).get("frames_until_below_500_m"),
        int(summary["truth_reads_after_start"]),
    )


def cells(row: NavigationRow) -> list[str]:
    """Return what the table shows of a row."""
    low, mean, high = row.altitude_km
    return [
        row.scenario,
        str(row.seed),
        level_text(row.level, row.unseen_share),
        f"{mean:.0f} ({low:.0f} to {high:.0f})",
        str(row.frames),
        _number(row.median_m),
        _number(row.p95_m),
        _number(row.max_m),
        _number(row.coast_end_p95_m),
        _number(row.velocity_p95_m_s, 2),
        "" if row.fixed_share is None else f"{100.0 * row.fixed_share:.1f} %",
        str(row.wrong_fixes),
        _number(row.nees6, 1),
        _number(row.nis_per_degree, 2),
        _number(row.radial_bias_m),
        _number(row.propagate_only_m),
        ""
        if row.recovery_frames is None
        else f"{row.recovery_frames} frame{'s' * (row.recovery_frames != 1)}",
        str(row.truth_reads_after_start),
    ]


def format_markdown(rows: Sequence[NavigationRow]) -> str:
    """Return the table as Markdown."""
    lines = ["| " + " | ".join(_COLUMNS) + " |", "|" + "---|" * len(_COLUMNS)]
    lines += ["| " + " | ".join(cells(row)) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def format_text(rows: Sequence[NavigationRow]) -> str:
    """Return the table in columns."""
    table = [list(_COLUMNS), *(cells(row) for row in rows)]
    width = [max(len(line[k]) for line in table) for k in range(len(_COLUMNS))]
    return "\n".join(
        "  ".join(cell.rjust(size) for cell, size in zip(line, width, strict=True)) for line in table
    )


def _number(value: float | None, digits: int = 0) -> str:
    return "" if value is None else f"{value:,.{digits}f}"
