"""Drawn labels, contact sheets, and the figures of how two renderings agree."""

import math

import numpy as np
import pytest

from payload_emulator.sim.render.renderer import Rendering
from payload_emulator.training.evaluate.sheets import contact_sheet, draw_labels, save_png, shadow_map
from studies.renderers import compare_renderings, thinned


def label(size_class, u, inside=True):
    ellipse = {"major_px": 20.0, "minor_px": 20.0, "angle_deg": 0.0}
    return {"class": size_class, "u_px": u, "v_px": 32.0, "inside": inside, "ellipse": ellipse}


def rendering(dark_columns, radiance=0.02, size=16):
    lit = np.ones((size, size), np.float32)
    lit[:, :dark_columns] = 0.0
    bright = np.linspace(0.5, 1.5, size, dtype=np.float32)[:, None] * np.float32(radiance)
    return Rendering(
        np.where(lit > 0, bright, 0.0).astype(np.float32), lit, np.full((size, size), 2e4, np.float32)
    )


def test_classes_have_the_papers_colours_and_the_picture_is_left_alone():
    image = np.zeros((64, 200, 3), np.uint8)
    drawn = draw_labels(image, [label(0, 30.0), label(1, 80.0), label(2, 130.0), label(3, 180.0)])
    # The rightmost point of each circle of 20 pixels; the line is smoothed, so it may not be at full strength.
    cyan, lime, yellow = (drawn[32, u].astype(int) for u in (40, 90, 140))
    assert cyan[0] == 0 and cyan[1] == cyan[2] > 180
    assert lime[1] > 180 and lime[0] == lime[2] == 0
    assert yellow[0] == yellow[1] > 180 and yellow[2] == 0
    assert drawn[:, 165:].max() == 0 and image.max() == 0


def test_labels_outside_are_not_drawn_and_deep_pictures_become_eight_bits():
    image = np.full((64, 64, 3), 256 * 7 + 3, np.uint16)
    drawn = draw_labels(image, [label(0, 30.0, inside=False)])
    assert drawn.dtype == np.uint8 and (drawn == 7).all()


def test_a_sheet_has_a_place_for_every_picture_and_its_caption():
    pictures = [np.full((40, 50, 3), 30 + 50 * n, np.uint8) for n in range(4)]
    sheet = contact_sheet(pictures, ["a", "b", "c", "d"], 3)
    assert sheet.shape == (2 * (40 + 22 + 4) + 4, 3 * (50 + 4) + 4, 3)
    assert (sheet[4:44, 58:108] == 80).all()
    # The fourth picture begins the second row.
    assert (sheet[70:110, 4:54] == 180).all()


def test_the_shadow_map_tells_whose_shadow_it_is():
    drawn = shadow_map(rendering(4), rendering(6))
    np.testing.assert_array_equal(drawn[0, 5], [230, 40, 40])
    np.testing.assert_array_equal(drawn[0, 0], [60, 60, 60])
    np.testing.assert_array_equal(shadow_map(rendering(6), rendering(4))[0, 5], [40, 80, 240])


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


def test_a_picture_is_written_whole_or_not_at_all(tmp_path):
    save_png(np.zeros((8, 8, 3), np.uint16), tmp_path / "a.png")
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]
    with pytest.raises(OSError):
        save_png(np.zeros((8, 8, 3), np.uint8), tmp_path / "missing" / "a.png")
