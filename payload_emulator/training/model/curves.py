"""Curves of a training run: curves.csv, a line per validation, and curves.png drawn from it."""

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


def draw_curves(run: Path) -> None:
    """Draw curves.png from curves.csv."""
    path = run / "curves.csv"
    if not path.is_file():
        return
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    with path.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    minutes = [float(row["minutes"]) for row in rows]
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4), constrained_layout=True)
    for name in ("total", "heat", "offset", "diameter"):
        left.plot(minutes, [float(row[name]) for row in rows], label=name)
    left.set(xlabel="minutes", ylabel="training loss")
    left.legend()
    for name in ("f1", "precision", "recall"):
        right.plot(minutes, [float(row[name]) for row in rows], label=name)
    right.set(xlabel="minutes", ylabel="validation, strict, 5-30 km", ylim=(0, 1))
    right.legend()
    figure.savefig(run / "curves.png", dpi=110)
    pyplot.close(figure)
