"""Curves of a training run: curves.csv, a line per validation."""

from __future__ import annotations

import csv
from pathlib import Path

from lunar.arrays import FloatArray

CURVE_COLUMNS = (
    "step",
    "minutes",
    "total",
    "heat",
    "offset",
    "diameter",
    "sigma",
    "depth",
    "f1",
    "precision",
    "recall",
    "loc_px",
    "threshold",
)


def append_curve(run: Path, step: int, minutes: float, losses: FloatArray, figures: dict[str, float]) -> None:
    """Add a line to curves.csv: losses since the last one, figures of the validation."""
    path = run / "curves.csv"
    fresh = not path.is_file()
    with path.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        if fresh:
            writer.writerow(CURVE_COLUMNS)
        scores = [f"{figures[key]:.5f}" for key in CURVE_COLUMNS[8:]]
        writer.writerow([step, f"{minutes:.3f}", *(f"{value:.5f}" for value in losses), *scores])
