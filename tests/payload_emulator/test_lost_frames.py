"""Lost in space on rendered frames: sets of frames, what is kept, how searches are counted, and one set flown."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lunar.camera import PinholeCamera
from lunar.datafolder import find_data
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.navigation.lost_in_space import LostParameters, Place
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.session.scenario import load_scenario
from payload_emulator.session.world import World, build_world
from studies import lost_in_space as study
from studies.lost_in_space import LostRow, SeenFrames, Share


@pytest.fixture(scope="module")
def world() -> World:
    scenario = study.pointed(load_scenario("kidnapped"), 0.5)
    window = replace(scenario.window, duration_s=240.0)
    return build_world(replace(scenario, window=window), find_data(None))


def test_sets_hold_consecutive_frames_of_the_cadence_and_do_not_cross_gaps(world: World) -> None:
    second = 10**9
    # Seven frames, a gap over a pole, five frames: one set before and one behind it.
    utc_ns = np.concatenate([np.arange(7), 100 + np.arange(5)]) * 15 * second
    numbers = study.frames_in_sets(replace(world, frame_utc_ns=utc_ns), 10)
    assert numbers.reshape(-1, 4).tolist() == [[0, 1, 2, 3], [7, 8, 9, 10]]
    assert study.frames_in_sets(replace(world, frame_utc_ns=utc_ns), 1).size == 4
    assert not study.frames_in_sets(replace(world, frame_utc_ns=utc_ns[:3]), 5).size


def test_a_place_two_kilometres_off_is_wrong_and_no_fix_is_neither_right_nor_wrong() -> None:
    rows = [
        LostRow(25e3, 30, 8, 140.0, 0.3),
        LostRow(25e3, 30, 8, 2_100.0, 0.3),
        LostRow(35e3, 30, 8, math.nan, 0.3),
        LostRow(35e3, 30, 3, math.nan, 0.3),
    ]
    assert study.share(rows) == Share(4, 1, 1)
    assert study.share(rows, 6) == Share(3, 1, 1)
    assert [part.searches for _, _, part in study.by_altitude(rows, 6)] == [0, 2, 1, 0]


def test_hostile_detections_keep_sizes_and_stay_inside_the_image() -> None:
    camera = PinholeCamera()
    rng = np.random.default_rng(4)
    column = rng.uniform(0.0, 511.0, (2, 30))
    found = Detections(column[0], column[1], rng.uniform(8.0, 60.0, 30), np.ones(30), np.ones(30))
    changed = study.hostile_detections(found, camera, rng)
    assert list(changed) == ["mirrored", "turned by a quarter", "turned by half", "scattered"]
    apart = np.hypot(*(column[:, :, None] - column[:, None]))
    for kind, one in changed.items():
        places = np.stack([one.u_px, one.v_px])
        assert places.min() >= 0.0 and places.max() <= 511.0 and np.abs(places - column).max() > 100.0
        assert np.array_equal(one.diameter_px, found.diameter_px)
        kept = np.allclose(np.hypot(*(places[:, :, None] - places[:, None])), apart)
        assert kept == (kind != "scattered")
    # A quarter turns; a mirror would change the order of corners.
    corners = Detections(np.array([0.0, 511.0]), np.zeros(2), np.ones(2), np.ones(2), np.ones(2))
    turned = study.hostile_detections(corners, camera, rng)["turned by a quarter"]
    assert (turned.u_px.tolist(), turned.v_px.tolist()) == ([0.0, 0.0], [511.0, 0.0])


def test_a_fix_of_hostile_detections_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    column = np.arange(5.0)
    found = Detections(column, column, column + 5.0, np.ones(5), np.ones(5))
    seen = SeenFrames(np.arange(2), np.tile(np.eye(3), (2, 1, 1)), np.repeat([0, 1], [5, 0]), found)
    place = Place(np.ones(3), np.zeros(3), np.ones(3), np.arange(3), np.arange(3), -20.0)
    poor = replace(place, log_false=-2.0)
    monkeypatch.setattr(study, "place_index", lambda board: None)
    monkeypatch.setattr(
        study,
        "candidate_places",
        lambda one, *rest: [place] if len(one) and one.u_px[0] == 0.0 and one.v_px[0] == 511.0 else [poor],
    )
    board: Any = None
    searches = study.search_hostile(seen, board, PinholeCamera(), LostParameters(), 1)
    assert [(one.kind, one.searches, one.fixes) for one in searches] == [
        ("mirrored", 2, 0), ("turned by a quarter", 2, 1), ("turned by half", 2, 0), ("scattered", 2, 0),
    ]  # fmt: skip
    assert searches[0].least_log10_false == pytest.approx(-2.0 / math.log(10.0))
    assert searches[1].least_log10_false == pytest.approx(-20.0 / math.log(10.0))


def test_a_camera_that_knows_nothing_of_its_place_finds_it_in_rendered_frames(world: World) -> None:
    numbers = study.frames_in_sets(world, 1)
    seen = study.see_frames(world, OnnxDetector(load_shipped_model()), numbers)
    true, board = study.search_map(world, numbers, 5e3)
    # All over the Moon: the paper's density of craters from 5 km on.
    assert len(board) > 70_000
    rules = LostParameters(attitude_sigma_rad=math.radians(0.5))
    single, sets = study.search_frames(world, seen, true, board, rules)
    assert [len(single), len(sets)] == [4, 1]
    assert study.share(single).wrong == study.share(sets).wrong == 0
    assert study.share(sets).correct == 1
    # Single images fix to about one kilometre at this altitude with an attitude of half a degree.
    assert sets[0].error_m < study.WRONG_PLACE_M
