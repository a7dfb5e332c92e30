"""Evaluation from data set to figures and report: what is refused, what every answer holds."""

import json
from dataclasses import replace

import pytest

from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.training.evaluate.evaluate import (
    detect_by_class,
    evaluate,
    evidence_level,
    format_figures,
    open_for_evaluation,
    run,
    summary,
)
from payload_emulator.training.evaluate.report import detector_report
from reports.json_form import to_json
from reports.render import render_html


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
    for key in ("micro", "ignore_aware", "micro_half_radius"):
        assert {"precision", "recall", "f1", "loc_px"} <= set(figures[key])
    text = format_figures(figures)
    assert "strict" in text and "ignore-aware" in text and "level 2" in text


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
