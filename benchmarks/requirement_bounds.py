"""Limits for single passes, from healthy ones: the tolerance bound of each figure that a requirement limits.

    python -m benchmarks.requirement_bounds FOLDER [--share 0.95] [--confidence 0.9]

FOLDER holds the documents `pass-N/report.json` of a home or of a mission run (`FOLDER/ground/reports`). With the stated
confidence, the stated share of the passes of a healthy payload lies within the bound (one-sided tolerance bound of a
normal distribution). A limit of a mission description that is the bound, rounded outwards, is met by so many passes.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np


def tolerance_bound(values: Sequence[float], at_most: bool, share: float, confidence: float) -> float:
    """Return the bound that a share of the population keeps, with this confidence; NaN for fewer than two values."""
    from scipy import stats

    count = len(values)
    if count < 2:
        return float("nan")
    factor = stats.nct.ppf(confidence, count - 1, stats.norm.ppf(share) * np.sqrt(count)) / np.sqrt(count)
    margin = factor * np.std(values, ddof=1)
    return float(np.mean(values) + (margin if at_most else -margin))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--share", type=float, default=0.95)
    parser.add_argument("--confidence", type=float, default=0.9)
    given = parser.parse_args()
    paths = sorted(given.folder.glob("**/pass-*/report.json"))
    if not paths:
        raise SystemExit(f"{given.folder}: expected documents pass-N/report.json, found none")
    figures: dict[str, list[float]] = {}
    known: dict[str, dict[str, object]] = {}
    for path in paths:
        for one in json.loads(path.read_text())["requirements"]:
            if one["value"] is not None:
                figures.setdefault(one["key"], []).append(one["value"])
                known[one["key"]] = one
    print(f"{len(paths)} passes; bound that {given.share:.0%} keep with confidence {given.confidence:.0%}")
    print(f"{'requirement':<36}{'passes':>7}{'mean':>12}{'worst':>12}{'bound':>12}{'limit':>10}")
    for key, values in figures.items():
        at_most, limit = bool(known[key]["at_most"]), known[key]["limit"]
        worst = max(values) if at_most else min(values)
        bound = tolerance_bound(values, at_most, given.share, given.confidence)
        stated = "none" if limit is None else f"{limit:.4g}"
        print(f"{key:<36}{len(values):>7}{np.mean(values):>12.4g}{worst:>12.4g}{bound:>12.4g}{stated:>10}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
