"""Evaluation, export and calibration of detectors: what is refused, and figures of scenes with known answers."""

import json
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import exp, hypot, isnan, log, pi, radians, sqrt
from numpy.random import default_rng
from pytest import approx, fixture, mark, raises

from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.calibration import CALIBRATION_KEY
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.training.data.feeder import TrainParameters
from payload_emulator.training.data.landmarks import load_landmarks, with_landmarks
from payload_emulator.training.evaluate.evaluate import (
    detect_by_class,
    evaluate,
    evidence_level,
    format_figures,
    open_for_evaluation,
    run,
    summary,
)
from payload_emulator.training.evaluate.metrics import Scene, Thresholds, bias_by_octant, bias_overall, score
from payload_emulator.training.evaluate.report import detector_report
from payload_emulator.training.evaluate.scoring import (
    MatchRule,
    average_precision,
    best_threshold,
    match,
    tally,
    threshold_for_precision,
    with_interval,
)
from payload_emulator.training.model.calibrate import fit_parallax, paper_threshold, without_parallax
from payload_emulator.training.model.export import PARITY_LIMIT, export
from payload_emulator.training.model.fit_calibration import (
    FRESH_FACTOR,
    Pairs,
    fit_calibration,
    fit_score,
    fit_sigma,
    fit_sun,
    format_calibration_figures,
    plain_model,
    sun_directions,
)
from payload_emulator.training.model.train import train
from reports.json_form import to_json
from reports.render import render_html
from tests.payload_emulator.training.conftest import found_at, truth_of


@fixture(scope="module")
def detector():
    return open_for_evaluation(load_shipped_model())


@fixture(scope="module")
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
    report = detector_report(detector, scored, summary(detector, [blob_dataset], scored, "test"))
    assert len(report.worst_frames) == 4
    page = render_html(report)
    for words in ("By type of terrain", "By altitude", "By Sun elevation", "Predicted uncertainty", "ignore-aware"):
        assert words in page
    assert "no training run was given" in page
    assert json.loads(to_json(report))["kind"] == "DetectorReport"


def test_a_split_without_frames_is_refused(detector, blob_dataset):
    with raises(DatasetError, match=r"expected frames of split 'test', source 'none', found none"):
        run(detector, [blob_dataset], "test", "none")


def test_frames_of_another_camera_or_field_of_view_are_refused(detector, make_blob_dataset, tmp_path, monkeypatch):
    other = make_blob_dataset(tmp_path / "set", {"test": 1})
    monkeypatch.setitem(detector.metadata, "camera_fov_deg", "90")
    with raises(DatasetError, match=r"90 degrees\), found 512 x 512 pixels, 120 degrees"):
        run(detector, [other], "test")
    monkeypatch.undo()
    other.index["camera"]["width_px"] = 640
    with raises(DatasetError, match=r"expected frames of the detector's camera \(512 x 512"):
        run(detector, [other], "test")


def test_the_papers_variant_needs_the_papers_heatmaps(detector, blob_dataset):
    with raises(ModelError, match="three class heatmaps, found 0"):
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


ONE_STEP = TrainParameters(minutes=0.0, steps=1, batch=2, crop_px=96, validation_frames=1, replicas=1, detail_blocks=0)


@fixture(scope="module")
def exported(blob_dataset, tmp_path_factory):
    run = tmp_path_factory.mktemp("export")
    train([blob_dataset], run, ONE_STEP)
    path = run / "m.onnx"
    figures = export(run / "checkpoint.pt", path, [blob_dataset], revision="abc", paper_classes=True, test=True)
    return path.read_bytes(), figures


def test_an_exported_network_agrees_with_torch_and_carries_its_origin(exported, blob_dataset):
    octets, figures = exported
    assert figures["parity_max_abs"] <= PARITY_LIMIT
    metadata = OnnxDetector(octets).metadata
    assert metadata["git_revision"] == "abc"
    assert metadata["training_seed"] == "1"
    assert json.loads(metadata["data"])[0]["labels_sha256"] == blob_dataset.digest
    assert float(metadata["score_threshold"]) == figures["score_threshold"]
    assert set(json.loads(metadata["test_figures"])["test"]) == {"frames", "level", "strict", "ignore_aware"}


def test_the_papers_variant_keeps_its_class_heatmaps_and_is_scored_by_them(exported, blob_dataset):
    octets, _ = exported
    heatmap, geometry = OnnxDetector(octets).run_network(np.zeros((1, 1, 512, 512), np.float32))
    assert heatmap.shape[1] == 4 and geometry.shape[1] == 5
    scored = evaluate(octets, blob_dataset, threshold=0.01, paper_classes=True)
    assert [row["size_class"] for row in scored["per_class"]] == [0, 1, 2]


def test_a_network_without_class_heatmaps_is_no_papers_variant(blob_dataset, tmp_path):
    train([blob_dataset], tmp_path, replace(ONE_STEP, paper_classes=False, depth=False))
    with raises(ModelError, match="expected a network with the paper's class heatmaps"):
        export(tmp_path / "checkpoint.pt", tmp_path / "p.onnx", [], paper_classes=True)


HEADER = "latitude_deg,longitude_deg,height_m,diameter_m,sightings,looks,score\n"


@fixture
def landmarks(tmp_path):
    # 30 km over latitude and longitude 0: 203 m to the pixel, u to the east, v to the south, 30,323 m to the degree.
    place = f"{(255.5 - 150.0) * 203.0 / 30_323:.6f},{(200.0 - 255.5) * 203.0 / 30_323:.6f}"
    path = tmp_path / "labels.csv"
    path.write_text(f"{HEADER}{place},0,8119,4,5,0.800\n")
    return load_landmarks(path)


def test_landmarks_become_labels_where_they_are_in_view(blob_dataset, landmarks):
    frame = blob_dataset.frames("train")[0]
    bare = replace(frame, craters={key: values[:0] for key, values in frame.craters.items()})
    taught = with_landmarks(blob_dataset, bare, landmarks)
    # 21 and 11 km from the point below, the ground lies 167 m lower: 0.6 % closer to the middle.
    assert taught.craters["u_px"][-1] == approx(255.5 - 55.5 * 0.9944, abs=0.05)
    assert taught.craters["v_px"][-1] == approx(255.5 - 105.5 * 0.9944, abs=0.05)
    assert taught.craters["diameter_px"][-1] == approx(40.0, rel=0.02)
    assert taught.craters["id"][-1] > 1_000_000_000
    assert bare.craters["u_px"].size == 0
    away = replace(bare, position_mcmf_m=bare.position_mcmf_m + np.array([0.0, 90_000.0, 0.0]))
    assert with_landmarks(blob_dataset, away, landmarks).craters["u_px"].size == 0


def test_a_file_that_holds_no_landmarks_is_refused(tmp_path):
    path = tmp_path / "l.csv"
    path.write_text("a,b\n1,2\n")
    with raises(DatasetError, match="expected landmarks"):
        load_landmarks(path)


def shifted_scene(azimuth_deg, shift, number=0):
    """Craters on a grid under a Sun at an image azimuth, every detection off by the same shift (right, down)."""
    u, v = (part.ravel() for part in np.meshgrid(np.arange(60.0, 460.0, 80.0), np.arange(60.0, 460.0, 80.0)))
    return truth_of(u, v, azimuth=radians(azimuth_deg), number=number), found_at(u + shift[0], v + shift[1])


def bias_of(*scenes):
    truths = [truth for truth, _ in scenes]
    tallied = tally(truths, [found for _, found in scenes])
    octants = bias_by_octant(tallied, 0.5, truths)
    return octants, bias_overall(tallied, 0.5, truths, octants)


@mark.parametrize(
    "azimuth_deg, shift",
    # Toward a Sun at the top, right, bottom, left: up, right, down, left in an image whose v grows downward.
    [(1.0, (0.0, -0.5)), (91.0, (0.5, 0.0)), (181.0, (0.0, 0.5)), (271.0, (-0.5, 0.0))],
)
def test_a_pull_toward_the_sun_is_reported_as_such_wherever_the_sun_is(azimuth_deg, shift):
    octants, overall = bias_of(shifted_scene(azimuth_deg, shift))
    row = octants[int(azimuth_deg // 45)]
    assert row["pairs"] == overall["pairs"] == 25
    assert (row["du_px"], row["dv_px"]) == approx(shift)
    # The Sun is one degree past the axis: 0.5 cos 1 and 0.5 sin 1.
    assert row["toward_sun_px"] == approx(0.49992, abs=1e-5)
    assert row["across_sun_px"] == approx(-0.00873, abs=1e-5)
    assert row["length_px"] == overall["worst_octant_px"] == approx(0.5)


def test_pulls_that_cancel_over_all_suns_remain_in_their_octants():
    octants, overall = bias_of(shifted_scene(10.0, (0.3, 0.0)), shifted_scene(190.0, (-0.3, 0.0), 1))
    assert overall["length_px"] == approx(0.0, abs=1e-12)
    assert overall["worst_octant_px"] == approx(0.3)
    # Frames pull in opposite directions: resampling two frames gives anything from -0.3 to 0.3.
    assert overall["interval_95"]["du_px"] == approx([-0.3, 0.3])
    assert octants[0]["interval_95"]["du_px"] == approx([0.3, 0.3])
    assert octants[2]["pairs"] == 0 and isnan(octants[2]["du_px"])


def test_octants_of_a_few_craters_name_no_worst_one():
    truth, found = shifted_scene(10.0, (2.0, 0.0))
    columns = ("u_px", "v_px", "diameter_px", "diameter_m", "depth_ratio", "ids")
    _, overall = bias_of((replace(truth, **{name: getattr(truth, name)[:5] for name in columns}), found))
    assert overall["pairs"] == 5 and overall["worst_octant"] is None


SHARE = 4e-4


def frames(count=12, share=SHARE, depth_said=True, noise=0.0, seed=0):
    """Frames whose detections lie inward of the rims by a share of the depth, as parallax has it."""
    rng = default_rng(seed)
    pairs = []
    for _ in range(count):
        n = 30
        place = np.arange(40.0, 480.0, 80.0)
        u, v = (part.ravel()[:n] for part in np.meshgrid(place, place))
        diameter, ratio = rng.uniform(12, 60, n), rng.uniform(0.06, 0.2, n)
        inward = 1.0 / (1.0 + share * ratio * diameter)
        shown = (255.5 + (at - 255.5) * inward + rng.normal(0, noise + 1e-12, n) for at in (u, v))
        said = (ratio,) if depth_said else ()
        pairs.append((truth_of(u, v, diameter, ratio), found_at(*shown, diameter, 7e3, 0.9, 1.0, *said)))
    return pairs


def test_the_share_put_in_is_the_share_found():
    share, error = fit_parallax(frames())
    assert share == approx(SHARE, rel=1e-6) and error < 1e-9


def test_the_standard_error_covers_the_scatter_of_the_fit():
    fits = np.array([fit_parallax(frames(noise=0.5, seed=seed)) for seed in range(12)])
    assert np.abs(fits[:, 0].mean() - SHARE) < 3 * fits[:, 1].mean() / sqrt(12)
    # Twelve fits know their spread to a factor of about 1.5.
    assert fits[:, 0].std() == approx(fits[:, 1].mean(), rel=0.6)


def test_detections_come_back_onto_the_rims():
    for truth, found in frames(2):
        put_right = without_parallax(found, SHARE, truth)
        assert put_right.u_px == approx(truth.u_px, abs=1e-6)
        assert put_right.v_px == approx(truth.v_px, abs=1e-6)


def test_a_network_that_tells_no_depth_is_corrected_on_the_whole():
    share, _ = fit_parallax(frames(depth_said=False))
    truth, found = frames(1, depth_said=False)[0]
    before, after = (
        hypot(one.u_px - truth.u_px, one.v_px - truth.v_px).mean()
        for one in (found, without_parallax(found, share, truth))
    )
    assert after < 0.5 * before


def test_too_few_craters_give_no_correction():
    share, error = fit_parallax(frames(1)[:1])
    assert share == 0.0 and isnan(error)


def test_the_papers_threshold_is_chosen_over_its_classes_together():
    # One crater of class 0 found at 0.7, a false detection of class 1 at 0.5: anything in between is best.
    places, classes = [100, 300], np.array([0, 1], np.int8)
    found = found_at(places, places, 30.0, [7e3, 12e3], [0.7, 0.5], size_class=classes)
    assert 0.5 < paper_threshold([truth_of([100], [100])], [found]) <= 0.7


THRESHOLDS = Thresholds(0.5, 0.3, 0.7)


def scene(u, v, *, shift=(0.0, 0.0), sigma=1.0, said=0.15, depth=0.15, azimuth=0.0, found=True):
    """Craters at (u, v) and detections of all (or of a mask), moved by a shift."""
    u, v = np.array(u, float), np.array(v, float)
    keep = np.broadcast_to(found, u.shape)
    shown = ((at + moved)[keep] for at, moved in zip((u, v), shift, strict=True))
    return truth_of(u, v, 30.0, depth, azimuth), found_at(*shown, 30.0, 7e3, 0.8, sigma, said)


def figures_of(parts, scenes):
    return score([t for t, _ in parts], [d for _, d in parts], THRESHOLDS, scenes)


GRID = np.reshape(np.meshgrid(np.arange(40.0, 500.0, 60.0), np.arange(40.0, 500.0, 60.0)), (2, -1))
LOW = Scene(16.0, 5.0, -2_000.0, "mare")
HIGH = Scene(42.0, 12.0, 500.0, "hills")


def test_groups_hold_their_own_frames_and_no_others():
    figures = figures_of([scene(*GRID), scene(*GRID, found=False)], [LOW, HIGH])
    assert [row["strict"]["recall"] for row in figures["by_altitude_km"]] == [1.0, 0.0]
    assert {row["name"]: row["strict"]["recall"] for row in figures["by_terrain"]} == {"lowland": 1.0, "upland": 0.0}
    assert {row["name"]: row["ignore_aware"]["recall"] for row in figures["by_source"]} == {"mare": 1.0, "hills": 0.0}
    sun = [(row["low"], row["strict"]["recall"]) for row in figures["by_sun_elevation_deg"]]
    assert sun == [(3.0, 1.0), (12.0, 0.0)]


def test_a_common_shift_is_the_bias_of_its_sun_octant():
    figures = figures_of([scene(*GRID, shift=(0.4, -0.2), azimuth=radians(100.0))], [LOW])
    biased = [row for row in figures["bias_px_by_sun_octant"] if row["pairs"]]
    assert [row["octant"] for row in biased] == [2]
    assert (biased[0]["du_px"], biased[0]["dv_px"]) == approx((0.4, -0.2))


def test_sigma_is_called_calibrated_where_errors_follow_it():
    rng = default_rng(4)
    u, v = rng.uniform(30, 480, 4000), rng.uniform(30, 480, 4000)
    parts = []
    for k in range(40):
        truth, found = scene(u[[100 * k]], v[[100 * k]], sigma=0.7)
        error_u, error_v = rng.normal(0, 0.7, (2, 1))
        parts.append((truth, replace(found, u_px=found.u_px + error_u, v_px=found.v_px + error_v)))
    calibration = figures_of(parts, [LOW] * 40)["sigma_calibration"]
    # 80 draws: the rms of a unit Gaussian is known to 1 / sqrt(160) = 0.08.
    assert calibration["rms"] == approx(1.0, abs=0.25)
    assert calibration["by_altitude_km"][0]["pairs"] == 40


def test_states_said_are_counted_against_the_terrains_own():
    fresh = scene([100, 200], [100, 200], depth=0.15, said=0.15)
    state = figures_of([fresh, scene([100], [100], depth=0.15, said=0.03)], [LOW, LOW])["degradation_state"]
    assert state["confusion"] == [[0, 0, 0], [0, 0, 0], [1, 0, 2]]
    assert state["agreement"] == approx(2 / 3)


def test_thresholds_of_three_purposes_are_scored_side_by_side():
    figures = figures_of([scene([100], [100])], [LOW])
    assert figures["micro"]["recall"] == 1.0
    assert figures["balanced"]["strict"]["recall"] == 1.0
    assert figures["navigation"]["threshold"] == 0.7


def test_no_detections_at_all_give_nan_and_zero_rather_than_an_error():
    figures = figures_of([scene([100], [100], found=False)], [LOW])
    assert figures["micro"]["recall"] == 0.0
    assert figures["sigma_calibration"]["pairs"] == 0


def test_average_precision_of_a_ranking_done_by_hand():
    # Ranked right, wrong, right over 2 craters: areas 0.5 * 1 + 0.5 * 2/3.
    truth, _ = scene([100, 200], [100, 200])
    found = found_at([100, 400, 200], [100, 400, 200], scores=[0.9, 0.8, 0.7])
    assert average_precision(tally([truth], [found])) == approx(0.5 + 0.5 * 2 / 3)


def truth(u, v, depth_ratio=0.15, **more):
    return truth_of(u, v, ratio=depth_ratio, **more)


def found(u, v, score, diameter_m=7e3):
    return found_at(u, v, 30.0, diameter_m, score)


def test_two_detections_of_one_crater_are_one_right_and_one_false():
    figures = tally([truth([100], [100])], [found([101, 103], [100, 100], [0.9, 0.8])]).figures(0.1)
    assert (figures.detected_true, figures.false_alarms, figures.expected) == (1, 1, 1)


def test_the_better_detection_takes_the_crater():
    tallied = tally([truth([100], [100])], [found([105, 100], [100, 100], [0.9, 0.8])])
    assert tallied.figures(0.85).detected_true == 1
    assert tallied.error_u[tallied.outcome == 1] == approx([5.0])


def test_precision_recall_and_f1_of_a_case_counted_by_hand():
    # 4 craters, 3 detections of which 2 are right: P 2/3, R 1/2, F1 = 2*2/(3+4).
    figures = tally(
        [truth([50, 150, 250, 350], [50, 50, 50, 50])], [found([52, 150, 450], [50, 53, 450], [0.9, 0.8, 0.7])]
    ).figures(0.5)
    assert figures.precision == approx(2 / 3)
    assert figures.recall == approx(0.5)
    assert figures.f1 == approx(4 / 7)
    assert figures.loc_px == approx(2.5)


def test_the_pixel_rule_ends_at_ten_pixels_and_the_radius_rule_at_half_a_radius():
    frame = truth([100], [100])
    for u, right, rule in ((110, 1, {}), (110.1, 0, {}), (107.4, 1, {"radii": 0.5}), (107.6, 0, {"radii": 0.5})):
        assert tally([frame], [found([u], [100], [0.9])], rule=MatchRule(**rule)).figures(0.5).detected_true == right


def test_a_ghost_counts_when_strict_and_is_left_out_when_ignore_aware():
    frame = truth([100, 300], [100, 300], depth_ratio=[0.15, 0.01])
    detections = found([100, 300], [100, 300], [0.9, 0.8])
    strict = tally([frame], [detections]).figures(0.5)
    fair = tally([frame], [detections], ignore_aware=True).figures(0.5)
    assert (strict.expected, strict.detected_true, strict.false_alarms) == (2, 2, 0)
    assert (fair.expected, fair.detected_true, fair.false_alarms) == (1, 1, 0)


def test_a_detection_on_nothing_is_false_by_both_rules():
    frame = truth([100], [100])
    detections = found([100, 300], [100, 300], [0.9, 0.8])
    for aware in (False, True):
        assert tally([frame], [detections], ignore_aware=aware).figures(0.5).false_alarms == 1


def test_a_detection_of_the_wrong_class_is_false_and_its_crater_missed():
    frame = truth([100], [100], diameter_m=9_500.0)
    detections = found([100], [100], [0.9], diameter_m=10_500.0)
    assert tally([frame], [detections], classes=(0,)).figures(0.5).recall == 0.0
    assert tally([frame], [detections], classes=(1,)).figures(0.5).precision == 0.0
    assert tally([frame], [detections]).figures(0.5).f1 == 1.0


def test_nothing_expected_and_nothing_found_gives_no_figure_instead_of_a_perfect_one():
    figures = tally([truth([], [])], [found([], [], [])]).figures(0.5)
    assert isnan([figures.precision, figures.recall, figures.f1, figures.loc_px]).all()


def test_the_best_threshold_separates_right_from_wrong():
    frames = [truth([100, 200], [100, 200])] * 5
    threshold, figures = best_threshold(tally(frames, [found([100, 200, 300], [100, 200, 300], [0.8, 0.7, 0.3])] * 5))
    assert 0.3 < threshold <= 0.7
    assert figures.f1 == 1.0


def test_the_bootstrap_interval_holds_the_figure_and_narrows_to_it_when_blocks_agree():
    frames = [truth([100, 200], [100, 200], number=k) for k in range(8)]
    detections = [found([100], [100], [0.9])] * 8
    assert with_interval(tally(frames, detections), 0.5)["f1_interval_95"] == approx([2 / 3, 2 / 3])


points = st.lists(st.tuples(st.floats(0, 100), st.floats(0, 100)), max_size=12)


@settings(max_examples=60, deadline=None)
@given(points, points)
def test_a_match_is_one_to_one_and_within_reach(detections, craters):
    du, dv = (np.array([p[k] for p in detections]) for k in (0, 1))
    cu, cv = (np.array([p[k] for p in craters]) for k in (0, 1))
    taken = match(du, dv, cu, cv, np.full(len(craters), 20.0), MatchRule())
    used = taken[taken >= 0]
    assert len(set(used.tolist())) == used.size
    for i, k in enumerate(taken):
        if k >= 0:
            assert hypot(du[i] - cu[k], dv[i] - cv[k]) <= 10.0


def test_a_precision_that_rests_on_a_handful_of_detections_decides_nothing():
    # The two best detections are false, the next 298 are right: from 100 detections on the precision is 0.98 and over.
    n = 300
    place = np.linspace(5.0, 505.0, 20)
    u, v = (part.ravel()[:n] for part in np.meshgrid(place, place))
    score = np.linspace(0.94, 0.30, n)
    tallied = tally([truth(u[2:], v[2:], diameter=10.0)], [found(u, v, score)], rule=MatchRule(pixels=3.0))
    assert tallied.figures(0.93).precision < 0.9
    assert threshold_for_precision(tallied, 0.9) < 0.31


def scored_frames(count=150, seed=1):
    """Detections far from each other; right with the odds of exp(2 logit(score) + 1 - ln(diameter / 20))."""
    rng = default_rng(seed)
    truths, found = [], []
    u, v = (part.ravel() for part in np.meshgrid(np.arange(40.0, 500.0, 60.0), np.arange(40.0, 500.0, 60.0)))
    for _ in range(count):
        diameter = exp(rng.uniform(log(10.0), log(80.0), u.size))
        score = np.sort(rng.uniform(0.1, 0.9, u.size))[::-1]
        odds = exp(2.0 * log(score / (1.0 - score)) + 1.0 - log(diameter / 20.0))
        right = rng.uniform(size=u.size) < odds / (1.0 + odds)
        found.append(found_at(u, v, diameter, 8e3, score))
        truths.append(truth_of(u[right], v[right], diameter[right], diameter_m=8e3))
    return truths, found


def test_the_odds_put_in_are_the_odds_found():
    model = fit_score(*scored_frames())
    assert model.slope == approx(2.0, rel=0.1)
    offset = np.interp(log([14.0, 20.0, 40.0]), model.log_diameter_px, model.offset)
    # Some 10,000 detections: the standard error of an offset is about 0.08.
    assert offset == approx(1.0 - log(np.array([14.0, 20.0, 40.0]) / 20.0), abs=0.3)
    assert model.probability(np.array([0.5]), np.array([20.0]))[0] == approx(np.e / (1.0 + np.e), abs=0.05)


def test_too_few_detections_are_refused():
    with raises(DatasetError, match="expected at least 200 detections"):
        fit_score(*scored_frames(2))


def pairs(pull=(0.3, 0.2, 0.4), ground_m=((60.0, -30.0), (-20.0, 10.0)), lasting=1.2, fresh=0.4, seed=2):
    """Craters seen four times under one Sun, with a pull, a registration of two cells, and an error in two parts."""
    rng = default_rng(seed)
    error, directions, scale, place, crater, size = [], [], [], [], [], []
    for number in range(3_000):
        azimuth = rng.uniform(-pi, pi)
        sun = np.array([np.sin(azimuth), -np.cos(azimuth), -0.2])
        diameter = float(exp(rng.uniform(log(10.0), log(60.0))))
        cell, m_per_px = number % 2, rng.uniform(100.0, 300.0)
        own = lasting * diameter / 20.0 * rng.standard_normal(2)
        toward = sun_directions(np.array([diameter]), sun)[0]
        east, north = ground_m[cell]
        for _ in range(4):
            moved = toward @ np.array(pull) + np.array([east, -north]) / m_per_px
            error.append(moved + own + fresh * rng.standard_normal(2))
            directions.append(toward)
            scale.append(m_per_px)
            place.append(cell)
            crater.append(number)
            size.append(log(diameter / 20.0))
    count = len(error)
    one = np.ones(count)
    features = np.stack([one, np.array(size), log(1.5) * one, one, 1.7 * one, rng.uniform(0, 1.4, count)], axis=1)
    return Pairs(np.array(error), features, np.array(directions), np.array(scale), np.array(place), np.array(crater))


def test_pull_and_registration_are_separated():
    residual, evidence = fit_sun(pairs())
    assert tuple(evidence["coefficients_px"]) == approx((0.3, 0.2, 0.4), abs=0.08)
    assert max(evidence["standard_errors_px"]) < 0.05
    for row, (east, north) in zip(evidence["registration"], ((60.0, -30.0), (-20.0, 10.0)), strict=True):
        assert row["east_m"] == approx(east, abs=8.0)
        assert row["north_m"] == approx(north, abs=8.0)
        assert row["standard_error_m"] < 6.0
    assert np.abs(residual.mean(axis=0)).max() < 0.05


def test_lasting_and_fresh_errors_are_separated():
    from dataclasses import replace

    every = pairs()
    residual, _ = fit_sun(every)
    model, evidence = fit_sigma(replace(every, error_px=residual))
    for size in (-0.5, 0.0, 0.8):
        total, fresh = model.variances_px2(np.array([[1.0, size, log(1.5), 1.0, 1.7, 0.5]]))
        lasting = 1.2 * exp(size)
        assert sqrt(fresh[0]) == approx(FRESH_FACTOR * 0.4, rel=0.1)
        assert sqrt(total[0]) == approx(hypot(0.4, lasting), rel=0.15)
    assert evidence["mean_square_over_variance"] == approx(1.0, abs=0.05)


def test_craters_seen_once_do_not_tell_what_lasts():
    every = pairs()
    once = every.select(np.arange(every.place.size) % 4 == 0)
    with raises(DatasetError, match="several frames under one Sun"):
        fit_sigma(once)


def test_a_data_set_without_validation_frames_is_refused(make_blob_dataset, tmp_path):
    only_test = make_blob_dataset(tmp_path / "set", {"test": 1})
    with raises(DatasetError, match="expected frames of split 'val'"):
        fit_calibration(load_shipped_model(), [only_test])


def test_a_calibrated_model_gives_back_the_plain_one():
    plain = plain_model(load_shipped_model())
    metadata = OnnxDetector(plain).metadata
    assert CALIBRATION_KEY not in metadata and metadata["score_threshold"] == "0.44"
    assert plain_model(plain) == plain


def test_the_same_frames_give_the_same_file(blob_dataset, monkeypatch):
    from payload_emulator.training.model import fit_calibration as module

    monkeypatch.setattr(module, "_pairs", lambda *_: pairs())
    monkeypatch.setattr(module, "_LEAST_ROWS", 10)
    first, document = fit_calibration(load_shipped_model(), [blob_dataset])
    again, _ = fit_calibration(first, [blob_dataset])
    assert again == first
    assert OnnxDetector(first).calibration.fresh == tuple(document["sigma"]["fresh"])
    assert plain_model(first) == plain_model(load_shipped_model())
    text = format_calibration_figures(document)
    assert "pull of the Sun" in text and "lasting share" in text and "registration" in text
