"""Drawn labels and contact sheets."""

import numpy as np
import pytest

from payload_emulator.training.evaluate.sheets import contact_sheet, draw_labels, save_png


def label(size_class, u, inside=True):
    ellipse = {"major_px": 20.0, "minor_px": 20.0, "angle_deg": 0.0}
    return {"class": size_class, "u_px": u, "v_px": 32.0, "inside": inside, "ellipse": ellipse}


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


def test_a_picture_is_written_whole_or_not_at_all(tmp_path):
    save_png(np.zeros((8, 8, 3), np.uint16), tmp_path / "a.png")
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]
    with pytest.raises(OSError):
        save_png(np.zeros((8, 8, 3), np.uint8), tmp_path / "missing" / "a.png")
