"""Signed bias by the Sun's azimuth, in the axes of the image and of the Sun; distances from measured rims."""

import numpy as np
import pytest

from payload_emulator.errors import DatasetError
from payload_emulator.training.data.dataset import Frame, frame_truth
from payload_emulator.training.data.refits import load_refitted, refitted_frame
from payload_emulator.training.data.truth import FrameTruth
from payload_emulator.training.evaluate.localisation import (
    against_rims,
    bias_by_octant,
    bias_overall,
    without_registration,
)
from payload_emulator.training.evaluate.scoring import FrameDetections, tally
from tmtc.tables import CatalogueTable, pack_catalogue_table

METRES_PER_DEGREE = 1_737_400.0 * np.pi / 180.0


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
    few = FrameTruth(
        *(
            value[:5] if isinstance(value, np.ndarray) else value
            for value in (getattr(truth, name) for name in truth.__slots__)
        )
    )
    _, overall = bias_of((few, found))
    assert overall["pairs"] == 5 and overall["worst_octant"] is None


def frame_above(dataset):
    """A frame of the blob set as if it were real terrain, its craters on the ground below it."""
    frame = dataset.frames("train")[0]
    u, v = frame.craters["u_px"].astype(float), frame.craters["v_px"].astype(float)
    # From 30 km above latitude and longitude 0: north up, east right (flat to 1 part in 1,700 of the distance).
    scale = 30_000.0 / dataset.focal_px / METRES_PER_DEGREE
    craters = {
        **frame.craters,
        "latitude_deg": (255.5 - v) * scale,
        "longitude_deg": (u - 255.5) * scale,
    }
    return Frame(
        frame.number, frame.source, frame.split, False, frame.values, frame.sun_camera, frame.camera_from_mcmf,
        frame.position_mcmf_m, craters,
    )  # fmt: skip


def table_of(frame, rows, east_m, tmp_path):
    """A curated table of some craters of a frame, each rim east of the catalogue's place and a tenth larger."""
    craters = frame.craters
    table = CatalogueTable(
        craters["id"][rows].astype(np.int64),
        np.radians(craters["latitude_deg"][rows]),
        np.radians(craters["longitude_deg"][rows] + east_m / METRES_PER_DEGREE),
        1.1 * craters["diameter_m"][rows].astype(float),
        np.zeros(len(rows)),
        np.full((len(rows), 3), 50.0),
    )
    path = tmp_path / "rims.bin"
    path.write_bytes(pack_catalogue_table(table))
    return load_refitted(path)


def test_labels_move_to_measured_rims_and_others_stay(blob_dataset, tmp_path):
    frame = frame_above(blob_dataset)
    rims = table_of(frame, [2, 0], 300.0, tmp_path)
    moved, known = refitted_frame(blob_dataset, frame, rims)
    assert known.tolist() == [k in (0, 2) for k in range(frame.craters["id"].size)]
    # 300 m east at 203 m per pixel (30 km over a focal length of 147.8 px): 1.478 px. At the edge, 50 km off, ground
    # of the sphere lies 0.7 km lower (2.4 %) and is seen aslant.
    assert (moved.craters["u_px"] - frame.craters["u_px"])[[0, 2]] == pytest.approx([1.478] * 2, rel=0.06)
    assert moved.craters["v_px"][[0, 2]] == pytest.approx(frame.craters["v_px"][[0, 2]], abs=0.02)
    # The table holds diameters in steps of 4 m.
    assert (moved.craters["diameter_px"] / frame.craters["diameter_px"])[[0, 2]] == pytest.approx(
        1.1, rel=1e-3
    )
    assert moved.craters["u_px"][1] == frame.craters["u_px"][1]


def test_procedural_frames_are_on_their_rims_already(blob_dataset, tmp_path):
    rims = table_of(frame_above(blob_dataset), [0], 300.0, tmp_path)
    procedural = blob_dataset.frames("train")[0]
    moved, known = refitted_frame(blob_dataset, procedural, rims)
    assert moved is procedural and not known.any()


def test_detections_on_measured_rims_are_near_those_and_off_the_catalogue(blob_dataset, tmp_path):
    frame = frame_above(blob_dataset)
    rims = table_of(frame, [0, 1, 2], 300.0, tmp_path)
    truth = frame_truth(blob_dataset, frame)
    on_rims = frame_truth(blob_dataset, refitted_frame(blob_dataset, frame, rims)[0])
    ones = np.ones(truth.ids.size)
    found = FrameDetections(on_rims.u_px, on_rims.v_px, truth.diameter_px, truth.diameter_m, ones, ones)
    figures = against_rims([(blob_dataset, frame)], [truth], [found], 0.5, rims)
    assert figures["refitted"]["pairs"] == figures["catalogue"]["pairs"] == 3
    assert figures["refitted"]["median_px"] == pytest.approx(0.0, abs=1e-5)
    assert figures["catalogue"]["median_px"] == pytest.approx(1.478, rel=0.06)
    assert figures["bias_px"]["pairs"] == 3


def test_a_file_that_is_no_table_of_rims_is_refused(tmp_path):
    path = tmp_path / "rims.csv"
    path.write_text("id,lat,lon\n")
    with pytest.raises(DatasetError, match="expected a table of rims"):
        load_refitted(path)


def test_registration_is_taken_out_and_the_pull_of_the_sun_stays():
    rng = np.random.default_rng(4)
    frames, m_per_px = [], []
    for number in range(240):
        azimuth = rng.uniform(-np.pi, np.pi)
        scale = rng.uniform(80.0, 300.0)
        u, v = (
            part.ravel() for part in np.meshgrid(np.arange(60.0, 480.0, 100.0), np.arange(60.0, 480.0, 100.0))
        )
        n = u.size
        truth = FrameTruth(
            u,
            v,
            np.full(n, 30.0),
            np.full(n, 7e3),
            np.full(n, 0.1),
            np.arange(n),
            512,
            512,
            azimuth,
            number % 3,
        )
        # 60 m east and 90 m south in one block, the reverse in another; 0.4 px toward the Sun everywhere.
        east, south = ((60.0, 90.0), (-60.0, -90.0), (0.0, 0.0))[number % 3]
        moved_u = u + east / scale + 0.4 * np.sin(azimuth) + rng.normal(0.0, 0.3, n)
        moved_v = v + south / scale - 0.4 * np.cos(azimuth) + rng.normal(0.0, 0.3, n)
        found = FrameDetections(
            moved_u, moved_v, np.full(n, 30.0), np.full(n, 7e3), np.full(n, 0.9), np.ones(n)
        )
        frames.append((truth, found))
        m_per_px.append(scale)
    tallied = tally([truth for truth, _ in frames], [found for _, found in frames])
    moved = without_registration(tallied, 0.5, np.array(m_per_px))
    scale = np.array(m_per_px)[tallied.detection_frame.astype(int)]
    for block, (east, south) in enumerate(((60.0, 90.0), (-60.0, -90.0), (0.0, 0.0))):
        mine = tallied.detection_block == block
        assert (tallied.error_u - moved.error_u)[mine] * scale[mine] == pytest.approx(east, abs=6.0)
        assert (tallied.error_v - moved.error_v)[mine] * scale[mine] == pytest.approx(south, abs=6.0)
    octants = bias_by_octant(moved, 0.5, [truth for truth, _ in frames])
    # The mean of a vector of 0.4 px over an octant is 0.39 px long.
    assert [row["length_px"] for row in octants] == pytest.approx([0.39] * 8, abs=0.06)
    assert [row["toward_sun_px"] for row in octants] == pytest.approx([0.4] * 8, abs=0.06)


def test_blocks_of_few_pairs_are_left_out_without_registration():
    truth = FrameTruth(
        np.array([100.0]),
        np.array([100.0]),
        np.array([30.0]),
        np.array([7e3]),
        np.array([0.1]),
        np.array([1]),
        512,
        512,
        0.0,
        5,
    )
    found = FrameDetections(
        np.array([101.0]),
        np.array([100.0]),
        np.array([30.0]),
        np.array([7e3]),
        np.array([0.9]),
        np.array([1.0]),
    )
    moved = without_registration(tally([truth], [found]), 0.5, np.array([200.0]))
    assert moved.score.size == 0 and moved.crater_id.size == 1
