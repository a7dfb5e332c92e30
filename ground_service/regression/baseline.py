"""The figures of one build over archived passes, each with its confidence: what a candidate will be held against."""

from __future__ import annotations

from typing import Any

import numpy as np

from ground_service.evaluation.service import plain
from ground_service.regression.gates.core import metric_interval
from ground_service.regression.gates.metrics import figures_of, joined
from ground_service.regression.gates.samples import PassFrames
from ground_service.regression.outcome import RegressionOutcome, pass_figures


def baseline_figures(outcome: RegressionOutcome) -> dict[str, Any]:
    """Every figure over the suite and over each pass, with its 95 % interval by blocks of frames."""
    judged = [(one.name, one.baseline_read.frames) for one in outcome.passes if one.baseline_read is not None]
    result: dict[str, Any] = plain(
        {
            "build": {"name": outcome.baseline.name, "digest": outcome.baseline.digest},
            "suite": _figures([frames for _, frames in judged], outcome) if judged else {},
            "passes": [
                {
                    "name": name,
                    "frames": len(frames),
                    "figures": _figures([frames], outcome),
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
    lines = [f"{figures['build']['name']} over {len(figures['passes'])} passes"]
    for name, row in figures["suite"].items():
        if row["value"] is None:
            continue
        low, high = row["interval_95"]
        between = "" if low is None else f"  ({low:.4g} to {high:.4g})"
        lines.append(f"  {name:<34}{row['value']:>12.4g} {row['unit']}{between}")
    lines += [f"  {one['name']}: {one['detail']}" for one in figures["not_flown"]]
    return "\n".join(lines)


def _figures(passes: list[PassFrames], outcome: RegressionOutcome) -> dict[str, Any]:
    frames = joined(passes)
    sizes = [len(one) for one in passes]
    whole = np.ones((1, len(frames)))
    return {
        figure.name: {
            "value": float(figure.compute(frames, whole)[0]),
            "interval_95": list(
                metric_interval(figure.sample(frames), sizes, outcome.policy.policy.resamples)
            ),
            "unit": figure.unit,
        }
        for figure in figures_of(passes)
    }
