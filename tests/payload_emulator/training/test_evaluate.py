"""Evaluation from data set to figures and report: what is refused, what every answer holds."""

import json
from dataclasses import replace

import numpy as np
import pytest

from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.training.data.dataset import Dataset, frame_truth
from payload_emulator.training.evaluate import choice
from payload_emulator.training.evaluate.choice import choose, format_choice
from payload_emulator.training.evaluate.evaluate import (
    Scored,
    detect_by_class,
    evaluate,
    evidence_level,
    format_figures,
    open_for_evaluation,
    run,
    summary,
)
from payload_emulator.training.evaluate.metrics import Scene, Thresholds
from payload_emulator.training.evaluate.report import detector_report
from payload_emulator.training.evaluate.scoring import FrameDetections
from payload_emulator.training.model.quantise import quantise
from reports.json_form import to_json
from reports.render import render_html
from studies.trials import (
    AS_FLOWN,
    PER_CLASS,
    TRIALS,
    format_trials,
    run_trials,
    score_chosen_trial,
)
from studies.two_suns import format_two_suns, fuse, score_chosen_way, study_two_suns


@pytest.fixture(scope="module")
def detector():
    return open_for_evaluation(load_shipped_model())


@pytest.fixture(scope="module")
def scored(detector, blob_dataset):
    return run(detector, [blob_dataset], "test")


def test_figures_name_their_data_their_level_and_both_ways_of_scoring(detector, blob_dataset, scored):
    figures = summary(detector, [blob_dataset], scored, "test")
    assert figures["level"] == "2 (procedural Moon, held out)"
    assert figures["dataset_sha256"] == [blob_dataset.digest]
    expected = sum(frame.craters["id"].size for frame in blob_dataset.frames("test"))
    # Blobs of 26 to 50 px from 30 km are 5.3 to 10.1 km wide: all of the paper's classes.
    assert figures["micro"]["expected"] == expected
    for key in ("micro", "ignore_aware", "micro_half_radius", "ignore_aware_half_radius"):
        assert {"precision", "recall", "f1", "loc_px"} <= set(figures[key])
    text = format_figures(figures)
    assert "strict" in text and "ignore-aware" in text and "level 2" in text
    # Blobs are bowls of low contrast lit from the top: none is hidden, and visible are those of the upper ranges.
    ranges = figures["recall_by_visibility"]
    assert sum(row["expected"] for row in ranges if row["low"] >= 0.2) > 0.9 * expected
    assert figures["visible"]["expected"] == sum(row["expected"] for row in ranges if row["low"] >= 0.5)
    assert sum(row["expected"] for row in ranges) + figures["visible"]["unknown"] == expected
    assert "recall by visibility (craters)" in text and "5-30 km visible" in text


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
    study = run_trials(detector, [blob_dataset])
    rows = study["trials"]
    assert study["validation_frames"] == 6
    assert len(rows) == len(TRIALS) + 1  # the one more: a threshold for each class
    by_name = {row["trial"]: row for row in rows}
    # The Sun of these frames is at the top, so turning changes nothing; the exact turn is by zero degrees.
    plain = by_name["as flown (quarter turns to Sun-up)"]["strict"]
    assert by_name["not turned"]["strict"] == plain
    assert by_name["turned exactly Sun-up"]["strict"]["loc_px"] == pytest.approx(plain["loc_px"], abs=1e-6)
    assert plain["detected_true"] >= 10
    mirrored, enlarged = "averaged with its mirror image", "enlarged 1.5 times, four tiles"
    on_test = {
        name: score_chosen_trial(detector, [blob_dataset], study | {"chosen": name})
        for name in ("as flown (quarter turns to Sun-up)", mirrored, enlarged)
    }
    # Enlarging or mirroring keeps centres: a wrong convention would shift them by half a pixel or more.
    for name in (mirrored, enlarged):
        shown = on_test[name]["strict"]["loc_median_px"]
        assert shown < on_test["as flown (quarter turns to Sun-up)"]["strict"]["loc_median_px"] + 0.5
    best = max(row["strict"]["f1"] for row in rows)
    assert by_name[study["chosen"]]["strict"]["f1"] == best
    assert "as flown" in format_trials(
        study
    ) and f"chosen on the validation split: {study['chosen']}" in format_trials(study)
    test = score_chosen_trial(detector, [blob_dataset], study)
    assert test["trial"] == study["chosen"] and test["threshold"] == by_name[study["chosen"]]["threshold"]
    assert test["test_frames"] == 4
    assert test["strict"]["expected"] == sum(f.craters["id"].size for f in blob_dataset.frames("test"))
    assert "chosen, test, 4 frames" in format_trials(study, test)


class OtherTestLabels(Dataset):
    """The same data set with the labels of the test split moved to where nothing is drawn."""

    def __init__(self, folder):
        super().__init__(folder)
        self._frames = [
            replace(f, craters={**f.craters, "u_px": 511.0 - f.craters["u_px"]}) if f.split == "test" else f
            for f in self._frames
        ]


def test_the_chosen_trial_does_not_depend_on_the_labels_of_the_test_split(detector, blob_dataset):
    other = OtherTestLabels(blob_dataset.folder)
    study, again = (run_trials(detector, [data], TRIALS[:2]) for data in (blob_dataset, other))
    assert again == study
    figures, moved = (score_chosen_trial(detector, [data], study) for data in (blob_dataset, other))
    assert moved["strict"]["f1"] < 0.5 * figures["strict"]["f1"]
    assert moved["threshold"] == figures["threshold"]


def test_thresholds_for_each_class_are_those_of_the_validation_split(detector, blob_dataset):
    study = run_trials(detector, [blob_dataset], TRIALS[:1])
    row = next(row for row in study["trials"] if row["trial"] == PER_CLASS)
    per_class = score_chosen_trial(detector, [blob_dataset], study | {"chosen": PER_CLASS})
    # With one limit for all classes nothing is shifted: the figures are those of the network as flown.
    equal = dict(row, thresholds=[row["threshold"]] * 3)
    as_flown = score_chosen_trial(detector, [blob_dataset], study | {"chosen": AS_FLOWN.name})
    same = score_chosen_trial(detector, [blob_dataset], {"trials": [equal], "chosen": PER_CLASS})
    assert same["strict"] == as_flown["strict"]
    assert per_class["trial"] == PER_CLASS and per_class["threshold"] == row["threshold"]
    assert len(row["thresholds"]) == 3


def test_trials_need_frames_to_choose_on_and_to_judge_by(detector, make_blob_dataset, tmp_path):
    unvalidated = make_blob_dataset(tmp_path / "set", {"test": 1})
    with pytest.raises(DatasetError, match="trials: expected frames of split 'val', found none"):
        run_trials(detector, [unvalidated])
    untested = make_blob_dataset(tmp_path / "other", {"val": 1})
    study = run_trials(detector, [untested], TRIALS[:1])
    with pytest.raises(DatasetError, match="trials: expected frames of split 'test', source 'x', found none"):
        score_chosen_trial(detector, [untested], study, "x")


def test_trials_and_eight_bits_refuse_frames_of_another_camera(detector, make_blob_dataset, tmp_path):
    other = make_blob_dataset(tmp_path / "set", {"val": 1, "test": 1})
    other.index["camera"]["fov_deg"] = 90.0
    with pytest.raises(DatasetError, match="expected frames of the detector's camera"):
        run_trials(detector, [other])
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
    validation, test = (run(detector, [dataset], split) for split in ("val", "test"))
    study = study_two_suns(validation)
    assert study["validation_frames"] == study["of_validation_frames"] == 2
    assert study["one_sun"]["strict"]["expected"] == study["two_suns"]["strict"]["expected"] > 0
    f1 = {name: study[name]["strict"]["f1"] for name in ("one_sun", "two_suns")}
    assert f1[study["chosen"]] == max(f1.values())
    other = {"one_sun": "two_suns", "two_suns": "one_sun"}[study["chosen"]]
    figures = score_chosen_way(test, study)
    assert figures["test_frames"] == figures["of_test_frames"] == 3
    assert figures["way"] == study["chosen"] and figures["threshold"] == study[study["chosen"]]["threshold"]
    assert score_chosen_way(test, study | {"chosen": other})["way"] == other
    text = format_two_suns(study, figures)
    assert "both frames" in text and "chosen, test, 3 frames" in text
    for frame in dataset.frames():
        frame.values["sun_azimuth_deg"] = 0.0
    with pytest.raises(DatasetError, match="two Suns: expected frames of the split 'val'"):
        study_two_suns(validation)
    with pytest.raises(DatasetError, match="two Suns: expected frames of the split 'test'"):
        score_chosen_way(test, study)


def test_real_terrain_that_fixed_thresholds_or_weights_counts_as_seen(blob_dataset):
    def level(*frames):
        return evidence_level([replace(f, complete=complete) for f, complete in frames])

    train, val, test = (blob_dataset.frames(split)[0] for split in ("train", "val", "test"))
    assert level((test, False)).startswith("3 (real terrain, held out")
    for seen in (train, val):
        assert level((seen, False)).startswith("3s (real terrain, seen in training")
        assert level((test, False), (seen, False)).startswith("3s")
        assert level((test, True), (seen, False)).startswith("2 and 3s mixed")
    assert level((test, True)) == "2 (procedural Moon, held out)"
