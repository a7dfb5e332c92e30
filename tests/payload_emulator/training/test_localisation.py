"""Signed bias by the Sun's azimuth, in the axes of the image and of the Sun; distances from measured rims."""

from dataclasses import replace

import numpy as np
import pytest

from payload_emulator.training.data.truth import FrameTruth
from payload_emulator.training.evaluate.localisation import bias_by_octant, bias_overall
from payload_emulator.training.evaluate.scoring import FrameDetections, tally


def shifted_scene(azimuth_deg, shift, number=0):
    """Craters on a grid under a Sun at an image azimuth, every detection off by the same shift (right, down)."""
    u, v = (part.ravel() for part in np.meshgrid(np.arange(60.0, 460.0, 80.0), np.arange(60.0, 460.0, 80.0)))
    size = np.full(u.size, 30.0)
    truth = FrameTruth(
        u, v, size, np.full(u.size, 7_000.0), np.full(u.size, 0.1), np.arange(u.size) + 100 * number, 512, 512,
        np.radians(azimuth_deg), number,
    )  # fmt: skip
    found = FrameDetections(
        u + shift[0], v + shift[1], size, truth.diameter_m, np.full(u.size, 0.9), np.ones(u.size)
    )
    return truth, found


def bias_of(*scenes):
    truths = [truth for truth, _ in scenes]
    tallied = tally(truths, [found for _, found in scenes])
    octants = bias_by_octant(tallied, 0.5, truths)
    return octants, bias_overall(tallied, 0.5, truths, octants)


@pytest.mark.parametrize(
    ("azimuth_deg", "shift"),
    # Toward a Sun at the top, right, bottom, left: up, right, down, left in an image whose v grows downward.
    [(1.0, (0.0, -0.5)), (91.0, (0.5, 0.0)), (181.0, (0.0, 0.5)), (271.0, (-0.5, 0.0))],
)
def test_a_pull_toward_the_sun_is_told_as_such_wherever_the_sun_is(azimuth_deg, shift):
    octants, overall = bias_of(shifted_scene(azimuth_deg, shift))
    row = octants[int(azimuth_deg // 45)]
    assert row["pairs"] == overall["pairs"] == 25
    assert (row["du_px"], row["dv_px"]) == pytest.approx(shift)
    # The Sun is one degree past the axis: 0.5 cos 1 and 0.5 sin 1.
    assert row["toward_sun_px"] == pytest.approx(0.49992, abs=1e-5)
    assert row["across_sun_px"] == pytest.approx(-0.00873, abs=1e-5)
    assert row["length_px"] == overall["worst_octant_px"] == pytest.approx(0.5)


def test_pulls_that_cancel_over_all_suns_remain_in_their_octants():
    octants, overall = bias_of(shifted_scene(10.0, (0.3, 0.0)), shifted_scene(190.0, (-0.3, 0.0), 1))
    assert overall["length_px"] == pytest.approx(0.0, abs=1e-12)
    assert overall["worst_octant_px"] == pytest.approx(0.3)
    # Frames pull in opposite directions: resampling two frames gives anything from -0.3 to 0.3.
    assert overall["interval_95"]["du_px"] == pytest.approx([-0.3, 0.3])
    assert octants[0]["interval_95"]["du_px"] == pytest.approx([0.3, 0.3])
    assert octants[2]["pairs"] == 0 and np.isnan(octants[2]["du_px"])


def test_octants_of_a_few_craters_name_no_worst_one():
    truth, found = shifted_scene(10.0, (2.0, 0.0))
    columns = ("u_px", "v_px", "diameter_px", "diameter_m", "depth_ratio", "ids")
    few = replace(truth, **{name: getattr(truth, name)[:5] for name in columns})
    _, overall = bias_of((few, found))
    assert overall["pairs"] == 5 and overall["worst_octant"] is None
