"""Matching and figures, against counts done by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from payload_emulator.training.evaluate.scoring import (
    MatchRule,
    best_threshold,
    match,
    tally,
    threshold_for_precision,
    with_interval,
)
from tests.payload_emulator.training.conftest import found_at, truth_of


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
    assert tallied.error_u[tallied.outcome == 1] == pytest.approx([5.0])


def test_precision_recall_and_f1_of_a_case_counted_by_hand():
    # 4 craters, 3 detections of which 2 are right: P 2/3, R 1/2, F1 = 2*2/(3+4).
    figures = tally(
        [truth([50, 150, 250, 350], [50, 50, 50, 50])], [found([52, 150, 450], [50, 53, 450], [0.9, 0.8, 0.7])]
    ).figures(0.5)
    assert figures.precision == pytest.approx(2 / 3)
    assert figures.recall == pytest.approx(0.5)
    assert figures.f1 == pytest.approx(4 / 7)
    assert figures.loc_px == pytest.approx(2.5)


def test_the_pixel_rule_ends_at_ten_pixels_and_the_radius_rule_at_half_a_radius():
    frame = truth([100], [100])
    for u, right, rule in ((110, 1, {}), (110.1, 0, {}), (107.4, 1, {"radii": 0.5}), (107.6, 0, {"radii": 0.5})):
        tallied = tally([frame], [found([u], [100], [0.9])], rule=MatchRule(**rule))
        assert tallied.figures(0.5).detected_true == right


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
    assert np.isnan([figures.precision, figures.recall, figures.f1, figures.loc_px]).all()


def test_the_best_threshold_separates_right_from_wrong():
    frames = [truth([100, 200], [100, 200])] * 5
    detections = [found([100, 200, 300], [100, 200, 300], [0.8, 0.7, 0.3])] * 5
    threshold, figures = best_threshold(tally(frames, detections))
    assert 0.3 < threshold <= 0.7
    assert figures.f1 == 1.0


def test_the_bootstrap_interval_holds_the_figure_and_narrows_to_it_when_blocks_agree():
    frames = [truth([100, 200], [100, 200], number=k) for k in range(8)]
    detections = [found([100], [100], [0.9])] * 8
    assert with_interval(tally(frames, detections), 0.5)["f1_interval_95"] == pytest.approx([2 / 3, 2 / 3])


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
            assert np.hypot(du[i] - cu[k], dv[i] - cv[k]) <= 10.0


def test_a_precision_that_rests_on_a_handful_of_detections_decides_nothing():
    # The two best detections are false, the next 298 are right: from 100 detections on the precision is 0.98 and over.
    n = 300
    place = np.linspace(5.0, 505.0, 20)
    u, v = (part.ravel()[:n] for part in np.meshgrid(place, place))
    score = np.linspace(0.94, 0.30, n)
    craters = truth(u[2:], v[2:], diameter=10.0)
    tallied = tally([craters], [found(u, v, score)], rule=MatchRule(pixels=3.0))
    assert tallied.figures(0.93).precision < 0.9
    assert threshold_for_precision(tallied, 0.9) < 0.31
