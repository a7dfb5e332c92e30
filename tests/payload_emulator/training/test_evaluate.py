"""Evaluation from data set to figures and report: what is refused, what every answer holds."""

import json
from dataclasses import replace

import numpy as np
import pytest

from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.training import choice
from payload_emulator.training.choice import choose, format_choice
from payload_emulator.training.dataset import frame_truth
from payload_emulator.training.evaluate import (
    Scored,
    detect_by_class,
    evaluate,
    format_figures,
    open_for_evaluation,
    run,
    summary,
)
from payload_emulator.training.figures import Scene, Thresholds
from payload_emulator.training.report import detector_report
from payload_emulator.training.scoring import FrameDetections
from payload_emulator.training.trials import TRIALS, format_trials, run_trials
from payload_emulator.training.two_suns import format_two_suns, fuse, study_two_suns
from reports.json_form import to_json
from reports.render import render_html


@pytest.fixture(scope="module")
def detector():
    return open_for_evaluation(load_shipped_model())


@pytest.fixture(scope="module")
def scored(detector, blob_dataset):
    return run(detector, [blob_dataset], "test")


def test_figures_name_their_data_their_rung_and_both_ways_of_scoring(detector, blob_dataset, scored):
    figures = summary(detector, [blob_dataset], scored, "test")
    assert figures["rung"] == "2 (procedural Moon, held out)"
    assert figures["dataset_sha256"] == [blob_dataset.digest]
    expected = sum(frame.craters["id"].size for frame in blob_dataset.frames("test"))
    # Blobs of 26 to 50 px from 30 km are 5.3 to 10.1 km wide: all of the paper's classes.
    assert figures["micro"]["expected"] == expected
    for key in ("micro", "ignore_aware", "micro_half_radius", "ignore_aware_half_radius"):
        assert {"precision", "recall", "f1", "loc_px"} <= set(figures[key])
    text = format_figures(figures)
    assert "strict" in text and "ignore-aware" in text and "rung 2" in text


def test_the_report_shows_the_worst_frames_and_says_what_it_lacks(detector, blob_dataset, scored):
    figures = summary(detector, [blob_dataset], scored, "test")
    report = detector_report(detector, scored, figures)
    assert len(report.worst_frames) == 4
    page = render_html(report)
    for words in (
        "By type of terrain",
        "By altitude",
        "By Sun elevation",
        "Predicted uncertainty",
        "ignore-aware",
    ):
        assert words in page
    assert "no training run was given" in page
    assert json.loads(to_json(report))["kind"] == "DetectorReport"


def test_a_split_without_frames_is_refused(detector, blob_dataset):
    with pytest.raises(DatasetError, match=r"expected frames of split 'test', source 'none', found none"):
        run(detector, [blob_dataset], "test", "none")


def test_frames_of_another_camera_are_refused(detector, make_blob_dataset, tmp_path):
    other = make_blob_dataset(tmp_path / "set", {"test": 1})
    other.index["camera"]["width_px"] = 640
    with pytest.raises(DatasetError, match=r"expected frames of the detector's camera \(512 x 512"):
        run(detector, [other], "test")


def test_frames_of_another_field_of_view_are_refused(blob_dataset):
    detector = open_for_evaluation(load_shipped_model())
    detector.metadata["camera_fov_deg"] = "90"
    with pytest.raises(DatasetError, match=r"90 degrees\), found 512 x 512 pixels, 120 degrees"):
        run(detector, [blob_dataset], "test")


def test_the_papers_variant_needs_the_papers_heatmaps(detector, blob_dataset):
    with pytest.raises(ModelError, match="three class heatmaps, found 0"):
        detect_by_class(detector, blob_dataset, blob_dataset.frames("test")[0])


def test_a_higher_threshold_never_finds_more(blob_dataset):
    model = load_shipped_model()
    low = evaluate(model, blob_dataset, threshold=0.2)["micro"]
    high = evaluate(model, blob_dataset, threshold=0.6)["micro"]
    assert low["detected_true"] >= high["detected_true"]
    assert low["false_alarms"] >= high["false_alarms"]


def test_trials_give_places_in_the_frame_as_it_came(detector, blob_dataset):
    rows = run_trials(detector, [blob_dataset])
    assert len(rows) == len(TRIALS) + 1  # the one more: a threshold for each class
    by_name = {row["trial"]: row for row in rows}
    # The Sun of these frames is at the top, so turning changes nothing; the exact turn is by zero degrees.
    plain = by_name["as flown (quarter turns to Sun-up)"]["strict"]
    assert by_name["not turned"]["strict"] == plain
    assert by_name["turned exactly Sun-up"]["strict"]["loc_px"] == pytest.approx(plain["loc_px"], abs=1e-6)
    assert plain["detected_true"] >= 10
    # Enlarging or mirroring keeps centres: a wrong convention would shift them by half a pixel or more.
    for name in ("averaged with its mirror image", "enlarged 1.5 times, four tiles"):
        assert by_name[name]["strict"]["loc_median_px"] < plain["loc_median_px"] + 0.5
    assert "as flown" in format_trials(rows)


def test_trials_need_frames_to_choose_on_and_to_judge_by(detector, make_blob_dataset, tmp_path):
    unvalidated = make_blob_dataset(tmp_path / "set", {"test": 1})
    with pytest.raises(DatasetError, match="trials: expected frames of split 'val', found none"):
        run_trials(detector, [unvalidated])


def test_trials_and_eight_bits_refuse_frames_of_another_camera(detector, make_blob_dataset, tmp_path):
    other = make_blob_dataset(tmp_path / "set", {"val": 1, "test": 1})
    other.index["camera"]["fov_deg"] = 90.0
    with pytest.raises(DatasetError, match="expected frames of the detector's camera"):
        run_trials(detector, [other])
    pytest.importorskip("onnx")
    from payload_emulator.training.quantise import quantise

    detector.metadata["camera_fov_deg"] = "120"
    with pytest.raises(DatasetError, match="expected frames of the detector's camera"):
        quantise(load_shipped_model(), [other])


def test_the_network_with_the_greater_validation_f1_is_chosen(blob_dataset, monkeypatch):
    frames = [(blob_dataset, frame) for frame in blob_dataset.frames("val")]
    truths = [frame_truth(*item) for item in frames]
    scenes = [Scene(30.0, 10.0, 0.0, "val")] * len(frames)

    def answered(model, datasets, split, progress):
        """The first model finds every crater of the validation frames, the second half of them."""
        assert split == "val"
        step = {b"good": 1, b"poor": 2}[model]
        found = []
        for truth in truths:
            kept = [part[::step] for part in (truth.u_px, truth.v_px, truth.diameter_px, truth.diameter_m)]
            found.append(FrameDetections(*kept, np.full(kept[0].size, 0.8), np.ones(kept[0].size)))
        return Scored(frames, truths, found, scenes, Thresholds(0.4, 0.4, 0.4))

    class Model(bytes):
        sha256 = "0"

    monkeypatch.setattr(choice, "open_for_evaluation", Model)
    monkeypatch.setattr(choice, "run", answered)
    document = choose({"a": b"poor", "b": b"good"}, [blob_dataset])
    assert document["chosen"] == "b"
    assert document["models"]["b"]["f1"] == 1.0 and document["models"]["a"]["precision"] == 1.0
    assert document["models"]["a"]["frames"] == len(frames)
    assert "chosen: b" in format_choice(document)


def detections(u, score):
    """Detections of 8 km at the height of the middle of the picture, 30 km up."""
    v, size = np.full(len(u), 255.5), np.full(len(u), 40.0)
    metres = size * 30_000.0 / 147.8
    return FrameDetections(np.array(u, float), v, size, metres, np.array(score, float), np.ones(len(u)))


def test_a_crater_seen_under_both_suns_gains_on_one_seen_under_one(blob_dataset):
    dataset = blob_dataset
    first = dataset.frames("test")[0]
    second = replace(first, values={**first.values, "sun_azimuth_deg": 120.0})
    found = [detections([100, 300], [0.6, 0.6]), detections([100, 400], [0.4, 0.4])]
    fused = fuse(dataset, first, found[0], dataset, second, found[1])
    # Seen in both: the mean. Seen in one: half. What only the other saw is added.
    assert fused.u_px == pytest.approx([100, 300, 400], abs=1e-6)
    assert fused.score == pytest.approx([0.5, 0.3, 0.2])
    # 29 km off the ground lies 0.25 km lower, so 8 km are 0.8 % smaller there.
    assert fused.diameter_px == pytest.approx([40, 40, 40 * (1 - 0.0083)], rel=1e-3)


def test_where_only_one_frame_looks_scores_stay(blob_dataset):
    first = blob_dataset.frames("test")[0]
    away = replace(first, position_mcmf_m=first.position_mcmf_m + np.array([0.0, 40_000.0, 0.0]))
    fused = fuse(
        blob_dataset, first, detections([100, 500], [0.6, 0.6]), blob_dataset, away, detections([], [])
    )
    # 40 km east at 203 m per pixel: the left 197 pixels of the first frame are outside the second.
    assert fused.u_px.tolist() == [100, 500]
    assert fused.score == pytest.approx([0.6, 0.3])


def test_pairs_are_judged_on_frames_that_have_a_partner(detector, make_blob_dataset, tmp_path):
    dataset = make_blob_dataset(tmp_path / "set", {"val": 2, "test": 3})
    for k, frame in enumerate(dataset.frames()):
        frame.values["sun_azimuth_deg"] = 90.0 * (k % 2)
    parts = [run(detector, [dataset], split) for split in ("val", "test")]
    figures = study_two_suns(*parts)
    assert figures["frames"] == figures["of_frames"] == 3 and figures["validation_frames"] == 2
    assert figures["one_sun"]["strict"]["expected"] == figures["two_suns"]["strict"]["expected"] > 0
    assert "both frames" in format_two_suns(figures)
    for frame in dataset.frames():
        frame.values["sun_azimuth_deg"] = 0.0
    with pytest.raises(DatasetError, match="two Suns: expected frames of the split 'val'"):
        study_two_suns(*parts)
