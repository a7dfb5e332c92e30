"""How well renderers agree: shadow masks, radiance and correlation, pooled over views."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from payload_emulator.session.frame import View, render_view
from payload_emulator.session.world import World
from payload_emulator.sim.render.cycles_scene import CyclesSettings
from payload_emulator.sim.render.renderer import Rendering

Progress = Callable[[Sequence[tuple[str, View]], int], Iterable[tuple[str, View]]]

LIKE_FOR_LIKE = CyclesSettings(
    samples=8, pixels_per_polygon=0.25, filter_px=0.01, terminator_offset=0.0, geometry_offset=0.0
)
"""Cycles as the other two sample: at pixel centres, crests no lower than the terrain's, shadow where it falls.

The paper's half a pixel per polygon cuts the crests of small craters by 5 to 10 m, which shortens their shadows by a
third of a pixel.
"""

SHADOW = 0.5
"""Ground that sees less of the Sun's disc is in shadow."""

FULLY_LIT = 0.95


@dataclass(frozen=True, slots=True)
class Agreement:
    """Of one renderer with another.

    Attributes
    ----------
    shadow_iou
        Pixels dark in both over pixels dark in either; NaN without any.
    radiance_rmse
        Root mean square difference where both see the whole Sun, as a share of the reference's mean there; each view
        against its own mean.
    correlation
        Of radiance over all pixels on the Moon, the mean over views.
    views, dark_pixels
        What the figures come from; dark in either.
    """

    shadow_iou: float
    radiance_rmse: float
    correlation: float
    views: int
    dark_pixels: int


def compare_on_views(
    world: World,
    views: Sequence[View],
    names: Sequence[str],
    blender_python: str,
    progress: Progress,
) -> tuple[dict[str, list[Rendering]], dict[str, Agreement]]:
    """Renderings of views by renderers under the scenario's photometric law, and how they agree."""
    jobs = [(name, view) for name in names for view in views]
    made: dict[str, list[Rendering]] = {name: [] for name in names}
    for name, view in progress(jobs, len(jobs)):
        made[name].append(render_view(world, view, name, blender_python, settings=LIKE_FOR_LIKE)[0])
    figures = {}
    if "raymarch" in names:
        figures["fast_vs_raymarch"] = compare_renderings(made["raymarch"], made["fast"])
    if "cycles" in names:
        figures["cycles_vs_fast"] = compare_renderings(made["fast"], made["cycles"])
    return made, figures


def compare_renderings(reference: Sequence[Rendering], other: Sequence[Rendering]) -> Agreement:
    """Agreement over views: renderings of the same ones by two renderers, in the same order."""
    both = either = 0
    errors, correlations = [], []
    for one, two in zip(reference, other, strict=True):
        ground = np.isfinite(one.range_m) & np.isfinite(two.range_m)
        dark, also = ground & (one.lit < SHADOW), ground & (two.lit < SHADOW)
        both += int(np.count_nonzero(dark & also))
        either += int(np.count_nonzero(dark | also))
        lit = ground & (one.lit > FULLY_LIT) & (two.lit > FULLY_LIT)
        if lit.any():
            expected = one.radiance[lit].astype(np.float64)
            errors.append(float(np.mean((two.radiance[lit] - expected) ** 2)) / float(expected.mean()) ** 2)
        correlations.append(_correlation(one.radiance[ground], two.radiance[ground]))
    return Agreement(
        shadow_iou=both / either if either else math.nan,
        radiance_rmse=math.sqrt(float(np.mean(errors))) if errors else math.nan,
        correlation=float(np.mean(correlations)) if correlations else math.nan,
        views=len(reference),
        dark_pixels=either,
    )


def thinned(rendering: Rendering, every: int) -> Rendering:
    """Each so-manieth pixel of each so-manieth row, as `raymarch.render` gives with the same ``every``."""
    return Rendering(
        rendering.radiance[::every, ::every],
        rendering.lit[::every, ::every],
        rendering.range_m[::every, ::every],
    )


def _correlation(one: NDArray[np.float32], two: NDArray[np.float32]) -> float:
    if one.size < 2 or one.std() == 0.0 or two.std() == 0.0:
        return math.nan
    return float(np.corrcoef(one, two)[0, 1])
