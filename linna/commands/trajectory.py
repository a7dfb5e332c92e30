"""`linna trajectory REPORT.json`: the solutions of a pass as TUM files, with absolute and relative errors."""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

from linna.output import emit, finish
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    option(parser, "report REPORT.json", Path, "report of a pass, as linna report wrote it")
    option(parser, "--out DIR", Path, "folder for the TUM files", required=True)
    option(parser, "--frames N", int, "frames that a relative error spans", 4)
    finish(parser, run)


def run(arguments: argparse.Namespace) -> int:
    import numpy as np

    from ground_service.evaluation.navigation.trajectory import absolute_error, format_tum, relative_error
    from linna.errors import UsageError
    from lunar.frames import mcmf_from_spherical

    if arguments.frames < 1:
        raise UsageError(f"--frames: expected 1 or more, found {arguments.frames}")
    report = _read(arguments.report)

    def positions(series: dict[str, Any]) -> tuple[Any, Any]:
        degrees = np.radians(np.array([series["latitude_deg"], series["longitude_deg"]], dtype=np.float64))
        altitude = np.array(series["altitude_m"], dtype=np.float64)
        return np.array(series["utc_ns"], dtype=np.int64), mcmf_from_spherical(
            degrees[0], degrees[1], altitude
        )

    reference_ns, reference = positions(report["reference"])
    arguments.out.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {}
    for series in report["navigation"]:
        utc_ns, position = positions(series)
        rows = np.searchsorted(reference_ns, utc_ns)
        known = np.isfinite(position).all(axis=1) & np.isfinite(reference[rows]).all(axis=1)
        if np.count_nonzero(known) < arguments.frames + 1:
            continue
        utc_ns, position, truth = utc_ns[known], position[known], reference[rows][known]
        stem = re.sub(r"[^a-z0-9]+", "-", series["name"].lower()).strip("-")
        (arguments.out / f"{stem}.tum").write_text(format_tum(utc_ns, position, truth))
        (arguments.out / f"{stem}-reference.tum").write_text(format_tum(utc_ns, truth, truth))
        figures[series["name"]] = {
            "ate": asdict(absolute_error(position, truth)),
            "rpe": asdict(relative_error(position, truth, arguments.frames)),
        }
    return emit(
        arguments,
        {"frames": arguments.frames, "series": figures, "out": str(arguments.out)},
        describe(figures),
    )


def describe(figures: dict[str, Any]) -> str:
    """A line per solution."""
    lines = [f"{'':<32}{'ATE rmse':>12}{'RPE rmse':>12}"]
    lines += [
        f"{name:<32}{row['ate']['rmse_m']:>10.1f} m{row['rpe']['rmse_m']:>10.2f} m"
        for name, row in figures.items()
    ]
    return "\n".join(lines)


def _read(path: Path) -> dict[str, Any]:
    from linna.errors import UsageError

    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise UsageError(f"{path}: expected the JSON report of a pass, found {error}") from None
    if not isinstance(report, dict) or not report.get("reference") or not report.get("navigation"):
        raise UsageError(
            f"{path}: expected the JSON report of a pass with a reference and solutions, found others"
        )
    return report
