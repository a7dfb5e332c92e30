"""The studies of identification draw what they say, count what they find, and repeat with their seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lunar.catalogue import make_catalogue
from lunar.frames import mcmf_from_spherical
from studies.identification import (
    STUDY_DETECTOR,
    StudyWorld,
    draw_frame,
    study_lost,
    study_lost_in_frames,
    study_world,
)


@pytest.fixture(scope="module")
def world() -> StudyWorld:
    rng = np.random.default_rng(2)
    count = 1_200
    latitude, longitude = rng.uniform(-0.2, 0.2, count), rng.uniform(0.0, 0.5, count)
    diameter = rng.uniform(5e3, 20e3, count)
    craters = make_catalogue(
        latitude, longitude, diameter, source="made up", rim_height_m=rng.normal(0.0, 300.0, count)
    )
    return study_world(craters, 1, "made up")


def test_detections_have_the_recall_and_the_precision_they_are_drawn_with(world: StudyWorld) -> None:
    rng = np.random.default_rng(1)
    place, model = mcmf_from_spherical(0.0, 0.25, 30e3), STUDY_DETECTOR
    frames = [draw_frame(world, place, np.zeros(3), model, rng) for _ in range(300)]
    true = sum(frame.true_detections for frame in frames)
    total = sum(len(frame.found) for frame in frames)
    perfect = replace(STUDY_DETECTOR, recall=(1.0,) * 4, precision=1.0)
    every = draw_frame(world, place, np.zeros(3), perfect, rng)
    # Binomial and Poisson counts of about 10,000 and 3,000: three sigma are 2 %.
    assert true / (300 * len(every.found)) == pytest.approx(0.5, rel=0.04)
    assert true / total == pytest.approx(0.8, rel=0.03)


def test_a_hostile_frame_has_no_true_detection(world: StudyWorld) -> None:
    rng = np.random.default_rng(1)
    place = mcmf_from_spherical(0.0, 0.25, 30e3)
    for kind in ("all_false", "mirrored", "rotated"):
        frame = draw_frame(world, place, np.zeros(3), STUDY_DETECTOR, rng, kind)
        assert len(frame.found) > 5
        assert frame.true_detections == 0


def test_single_frames_and_sets_of_frames_are_found_and_never_wrongly(world: StudyWorld) -> None:
    single = study_lost(world, 12, 1)
    assert single.wrong == 0
    assert single.correct >= 10
    assert single.median_error_m < 1_000.0
    several = study_lost_in_frames(world, 3, 1)
    assert (several.frames, several.correct, several.wrong) == (3, 3, 0)


def test_the_same_seed_gives_the_same_score(world: StudyWorld) -> None:
    assert study_lost(world, 3, 3).median_error_m == study_lost(world, 3, 3).median_error_m
