"""The figures of how two renderings agree."""

import math

import numpy as np
import pytest

from benchmarks.render import compare_renderings, thinned
from payload_emulator.sim.render.renderer import Rendering


def rendering(dark_columns, radiance=0.02, size=16):
    lit = np.ones((size, size), np.float32)
    lit[:, :dark_columns] = 0.0
    bright = np.linspace(0.5, 1.5, size, dtype=np.float32)[:, None] * np.float32(radiance)
    return Rendering(
        np.where(lit > 0, bright, 0.0).astype(np.float32), lit, np.full((size, size), 2e4, np.float32)
    )


def test_the_iou_of_shadows_is_counted_over_all_views():
    found = compare_renderings([rendering(4), rendering(8)], [rendering(6), rendering(8)])
    # 4 of 6 columns and 8 of 8: 12 of 14.
    assert found.shadow_iou == pytest.approx(12.0 / 14.0)
    assert found.dark_pixels == 14 * 16 and found.views == 2


def test_radiance_is_compared_with_the_references_mean():
    found = compare_renderings([rendering(0, 0.02)], [rendering(0, 0.022)])
    # A tenth too bright everywhere: 0.1 sqrt(mean b^2) / mean b for b even from 0.5 to 1.5.
    b = np.linspace(0.5, 1.5, 16)
    assert found.radiance_rmse == pytest.approx(0.1 * math.sqrt(np.mean(b**2)), rel=1e-4)
    assert found.correlation == pytest.approx(1.0)


def test_without_shadow_there_is_no_iou():
    assert math.isnan(compare_renderings([rendering(0)], [rendering(0)]).shadow_iou)
    assert math.isnan(compare_renderings([], []).correlation)


def test_thinning_takes_the_pixels_that_the_march_takes():
    thin = thinned(rendering(4), 4)
    assert thin.lit.shape == (4, 4) and thin.lit[0].tolist() == [0.0, 1.0, 1.0, 1.0]
