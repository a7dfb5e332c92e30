"""The figures of one build over archived passes, each with its confidence: what a candidate will be held against."""

from __future__ import annotations

import math
from typing import Any

from ground_service.evaluation.service import plain
from ground_service.regression.gates.metrics import metrics_of
from ground_service.regression.gates.samples import PassFrames
from ground_service.regression.gates.statistics import joined_sums, ratio_error
from ground_service.regression.outcome import RegressionOutcome, pass_figures
from reports.text import counted


def baseline_figures(outcome: RegressionOutcome) -> dict[str, Any]:
    """Every metric over the suite and over each pass; ratios with the 95 % interval by units of the evidence."""
    judged = [(one.name, one.baseline_read.frames) for one in outcome.passes if one.baseline_read is not None]
    result: dict[str, Any] = plain(
        {
            "build": {"name": outcome.baseline.name, "digest": outcome.baseline.digest},
            "suite": _figures([frames for _, frames in judged]) if judged else {},
            "passes": [
                {
                    "name": name,
                    "frames": len(frames),
                    "figures": _figures([frames]),
                    **pass_figures(frames),
                }
                for name, frames in judged
            ],
            "not_flown": [
                {"name": one.name, "detail": one.detail}
                for one in outcome.passes
                if one.baseline_read is None
            ],
        }
    )
    return result


def baseline_text(figures: dict[str, Any]) -> str:
    """The figures of the suite as lines."""
    lines = [f"{figures['build']['name']} over {counted(len(figures['passes']), 'passes')}"]
    for name, row in figures["suite"].items():
        if row["value"] is None:
            continue
        low, high = row["interval_95"]
        between = "" if low is None else f"  ({low:.4g} to {high:.4g})"
        lines.append(f"  {name:<34}{row['value']:>12.4g} {row['unit']}{between}")
    lines += [f"  {one['name']}: {one['detail']}" for one in figures["not_flown"]]
    return "\n".join(lines)


def _figures(passes: list[PassFrames]) -> dict[str, Any]:
    found = {}
    for metric in metrics_of(passes):
        value, low, high = metric.over(passes), math.nan, math.nan
        if metric.sums is not None:
            sums = joined_sums([metric.sums(one) for one in passes])
            reach = 1.96 * ratio_error(sums)
            low, high = value - reach, value + reach
        found[metric.name] = {"value": value, "interval_95": [low, high], "unit": metric.unit}
    return found
