"""The simulated star tracker against geometry made by hand, and noise, drift and outages against their settings."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder
from lunar.frames import (
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_from_matrix,
    rotation_vector_from_matrix,
)
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError
from payload_emulator.flight.navigation import anchored
from payload_emulator.session.emulator import emulate
from payload_emulator.session.recording import load_record
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.sim.instruments import Situation, Surroundings
from payload_emulator.sim.instruments.star_tracker import (
    StarTrackerSection,
    boresight_in_camera,
    is_blinded,
    measure,
    start,
    tracker_from_camera,
)
from tests.payload_emulator.sim.instruments.test_altimeter import SCENARIO
from tmtc.downlink import decode
from tmtc.instruments import ATTITUDE

UTC_NS = parse_utc("2029-08-07T00:00:00Z")
ARCSEC = math.radians(1.0 / 3600.0)
DISTANCE_M = MOON_RADIUS_M + 30_000.0
AROUND: Any = Surroundings(None, 3)  # a star tracker asks nothing of the terrain
STEADY = StarTrackerSection(
    alignment_deg=0.0,
    outages_per_hour=0.0,
    sun_exclusion_deg=0.0,
    earth_exclusion_deg=0.0,
    moon_exclusion_deg=0.0,
)


def situation(
    attitude: Any, place: Any = (DISTANCE_M, 0.0, 0.0), utc_ns: int = UTC_NS, elapsed_s: float | None = 5.0
) -> Situation:
    position = np.asarray(place, dtype=np.float64)
    return Situation(utc_ns, elapsed_s, position, position, attitude, np.eye(3))


def samples(settings: StarTrackerSection, attitudes: list[Any], cadence_s: float = 5.0) -> Any:
    state, rows = start(settings, AROUND), []
    boresight = boresight_in_camera(math.radians(40.0), math.radians(90.0))
    for k, attitude in enumerate(attitudes):
        utc_ns = UTC_NS + round(k * cadence_s * 1e9)
        above = DISTANCE_M * (attitude.T @ boresight)  # the Moon lies behind the star tracker
        state, row = measure(settings, state, AROUND, situation(attitude, above, utc_ns, cadence_s))
        rows.append(row)
    return np.array(rows)


@pytest.mark.parametrize(
    ("off_zenith_deg", "azimuth_deg", "axis"),
    [(0.0, 0.0, (0, 0, -1)), (90.0, 0.0, (0, -1, 0)), (90.0, 90.0, (1, 0, 0)), (180.0, 45.0, (0, 0, 1))],
)
def test_the_boresight_leans_from_the_zenith_towards_its_azimuth(
    off_zenith_deg: float, azimuth_deg: float, axis: Any
) -> None:
    angles = math.radians(off_zenith_deg), math.radians(azimuth_deg)
    np.testing.assert_allclose(boresight_in_camera(*angles), axis, atol=1e-12)
    rotation = tracker_from_camera(*angles)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rotation @ axis, [0.0, 0.0, 1.0], atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_noise_across_and_about_the_boresight_is_that_of_the_settings() -> None:
    attitude = matrix_from_rotation_vector(np.array([0.4, -1.0, 0.2]))
    settings = replace(STEADY, cross_arcsec=8.0, roll_arcsec=80.0)
    found = samples(settings, [attitude] * 1_500)
    assert (found[:, 0] == 1.0).all()
    errors = rotation_vector_from_matrix(matrix_from_quaternion(found[:, 1:5]) @ attitude.T)
    tracker = tracker_from_camera(math.radians(40.0), math.radians(90.0))
    spread = (errors @ tracker.T).std(axis=0) / ARCSEC
    np.testing.assert_allclose(spread, [8.0, 8.0, 80.0], rtol=0.06)


def test_the_misalignment_is_constant() -> None:
    settings = replace(STEADY, cross_arcsec=1e-3, roll_arcsec=1e-3, alignment_deg=0.01)
    found = samples(settings, [np.eye(3)] * 3)
    offset = rotation_vector_from_matrix(matrix_from_quaternion(found[:, 1:5]))
    expected = math.radians(0.01) * AROUND.rng("star_tracker").standard_normal((2, 3))[0]
    np.testing.assert_allclose(offset, np.tile(expected, (3, 1)), atol=1e-7)


def test_gyroscopes_measure_the_turn_with_bias_and_random_walk() -> None:
    turn = np.array([0.001, -0.002, 0.003])
    attitudes = [np.eye(3)]
    for _ in range(1_000):
        attitudes.append(matrix_from_rotation_vector(turn) @ attitudes[-1])
    settings = replace(STEADY, gyro_walk_deg_h_sqrt_h=0.0, gyro_bias_deg_h=20.0, gyro_noise_deg_sqrt_h=0.6)
    found = samples(settings, attitudes)
    assert np.isnan(found[0, 5:]).all()
    errors = found[1:, 5:] - turn
    # angular random walk: 0.6 deg over the square root of an hour, here over 5 s
    sigma = math.radians(0.6) * math.sqrt(5.0 / 3600.0)
    np.testing.assert_allclose(errors.std(axis=0), sigma, rtol=0.08)
    bias = start(settings, AROUND).gyro_bias_rad_s * 5.0
    assert float(np.abs(bias).max()) > sigma / 10.0
    np.testing.assert_allclose(errors.mean(axis=0), bias, atol=4.0 * sigma / math.sqrt(1_000))


def test_the_bias_of_the_gyroscopes_walks() -> None:
    settings = replace(STEADY, gyro_bias_deg_h=0.0, gyro_walk_deg_h_sqrt_h=2.0)
    ends = []
    for seed in range(300):
        around: Any = Surroundings(None, seed)
        state = start(settings, around)
        for k in range(4):
            state, _ = measure(
                settings, state, around, situation(np.eye(3), utc_ns=UTC_NS + k, elapsed_s=900.0)
            )
        ends.append(state.gyro_bias_rad_s)
    # the first sample has no turn: three steps of a quarter of an hour
    expected = math.radians(2.0) / 3600.0 * math.sqrt(0.75)
    assert np.std(ends) == pytest.approx(expected, rel=0.08)


def pointing(axis: Any) -> Any:
    """Return an attitude whose tracker boresight has a direction in ICRF."""
    axis = np.asarray(axis) / np.linalg.norm(axis)
    aside = np.cross(axis, [0.3, -0.5, 0.8])
    aside /= np.linalg.norm(aside)
    tracker_from_icrf = np.stack([aside, np.cross(axis, aside), axis])
    return tracker_from_camera(math.radians(40.0), math.radians(90.0)).T @ tracker_from_icrf


def frame_towards_sun() -> tuple[Any, Any]:
    """Return the direction of the Sun and one perpendicular to it."""
    sun = np.asarray(sun_position_icrf_m(float(tdb_s_from_utc_ns(UTC_NS))))
    sun = sun / np.linalg.norm(sun)
    other = np.cross(sun, [0.0, 0.0, 1.0])
    return sun, other / np.linalg.norm(other)


def direction(angle_deg: float) -> Any:
    """Return a direction at an angle from the Sun."""
    sun, other = frame_towards_sun()
    angle = math.radians(angle_deg)
    return math.cos(angle) * sun + math.sin(angle) * other


@pytest.mark.parametrize(("angle_deg", "blind"), [(34.5, True), (35.5, False)])
def test_the_sun_blinds_within_its_exclusion_angle(angle_deg: float, blind: bool) -> None:
    place = DISTANCE_M * direction(0.0)
    settings = StarTrackerSection(earth_exclusion_deg=0.0, moon_exclusion_deg=0.0)
    assert is_blinded(settings, situation(pointing(direction(angle_deg)), place)) is blind


@pytest.mark.parametrize(("sun_from_nadir_deg", "blind"), [(78.0, False), (81.0, True)])
def test_a_sun_behind_the_moon_does_not_blind(sun_from_nadir_deg: float, blind: bool) -> None:
    # the limb of the Moon lies 79.5 degrees from nadir at 30 km; the boresight 22 degrees further out than the Sun
    assert math.degrees(math.asin(MOON_RADIUS_M / DISTANCE_M)) == pytest.approx(79.5, abs=0.1)
    place = -DISTANCE_M * direction(sun_from_nadir_deg)
    settings = StarTrackerSection(earth_exclusion_deg=0.0, moon_exclusion_deg=0.0)
    assert is_blinded(settings, situation(pointing(direction(-22.0)), place)) is blind


@pytest.mark.parametrize(("from_limb_deg", "blind"), [(14.0, True), (16.0, False)])
def test_the_limb_of_the_moon_blinds_within_its_exclusion_angle(from_limb_deg: float, blind: bool) -> None:
    limb_deg = math.degrees(math.asin(MOON_RADIUS_M / DISTANCE_M))
    settings = StarTrackerSection(earth_exclusion_deg=0.0, sun_exclusion_deg=0.0)
    place = -DISTANCE_M * direction(90.0)
    axis = direction(90.0 + limb_deg + from_limb_deg)
    assert is_blinded(settings, situation(pointing(axis), place)) is blind


def test_the_share_of_random_outages_is_that_of_the_settings() -> None:
    settings = replace(STEADY, outages_per_hour=12.0, outage_s=60.0)
    found = samples(settings, [np.eye(3)] * 6_000)
    lost = found[:, 0] == 0.0
    assert np.isnan(found[lost, 1:5]).all() and not np.isnan(found[~lost, 1:5]).any()
    assert not np.isnan(found[1:, 5:]).any()
    # 12 outages of a minute in an hour, some within others; 100 outages know their share to 10 %
    assert lost.mean() == pytest.approx(1.0 - math.exp(-0.2), rel=0.3)
    runs = np.count_nonzero(np.diff(lost.astype(int)) == 1)
    assert lost.sum() / runs > 4.0  # outages last, they are not single samples


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("[star_tracker]\ncross_arcsec = 0.0", "star_tracker.cross_arcsec must be positive, found 0.0"),
        (
            "[star_tracker]\nalignment_deg = 0.02",
            "star_tracker.alignment_deg must be from 0 to 0.01, found 0.02",
        ),
        ("[star_tracker]\nazimuth_deg = -1.0", "star_tracker.azimuth_deg must be from 0 to 360, found -1.0"),
        (
            "[star_tracker]\noff_zenith_deg = 181",
            "star_tracker.off_zenith_deg must be from 0 to 180, found 181.0",
        ),
        ("[star_tracker]\noutage_s = -1.0", "star_tracker.outage_s must be zero or more, found -1.0"),
        ("[star_tracker]\ncadence_s = 0.0", "star_tracker.cadence_s must be at least 0.1, found 0.0"),
        (
            "[attitude]\nknowledge_noise_deg = 0.1\n[star_tracker]",
            "attitude.knowledge_noise_deg must be left out because [star_tracker] takes its place, found 0.1",
        ),
    ],
)
def test_settings_that_make_no_sense_are_refused(lines: str, message: str) -> None:
    with pytest.raises(ScenarioError) as refusal:
        parse_scenario(SCENARIO + lines)
    assert str(refusal.value) == f"scenario: {message}"


def test_a_pass_with_a_star_tracker_has_its_attitude_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[anchored.Observation] = []
    usual = anchored.step

    def watched(state: Any, observation: anchored.Observation, setup: Any) -> Any:
        given.append(observation)
        return usual(state, observation, setup)

    monkeypatch.setattr(anchored, "step", watched)
    settings = "[star_tracker]\noutages_per_hour = 0.0\nalignment_deg = 0.0\nsun_exclusion_deg = 0.0\n"
    summary = emulate(parse_scenario(SCENARIO + settings), DataFolder(), tmp_path / "pass")
    assert summary["truth_reads_after_start"] == 0
    frames = [item for item in load_record(tmp_path / "pass").inputs if item.number >= 0]
    assert all(np.isnan(item.attitude[:4]).all() and np.isfinite(item.attitude[4:]).all() for item in frames)
    table = decode((tmp_path / "pass" / "downlink.cadu").read_bytes()).tables()["star_tracker"]
    assert len(table) == len(frames) == 3
    # the newest sample is that of the frame: the attitude on board follows it to its noise
    seen = np.stack([item.instruments["star_tracker"][-1, 2:6] for item in frames])
    estimate = table.columns[ATTITUDE]
    apart = rotation_vector_from_matrix(
        matrix_from_quaternion(estimate) @ np.swapaxes(matrix_from_quaternion(seen), 1, 2)
    )
    assert float(np.abs(apart).max()) < 4.0 * 70.0 * ARCSEC
    rows = (tmp_path / "pass" / "attitude.csv").read_text().splitlines()[1:]
    archived = np.array([[float(value) for value in row.split(",")] for row in rows])
    np.testing.assert_array_equal(archived[:, 1:], estimate)
    assert summary["outcomes"]["fixed"] >= 2
    # The orbit filter learns how the attitude error depends on that of the frame before.
    errors = [one.attitude_error for one in given]
    assert len(errors) == 3 and errors[2] is not None and errors[2].memory.any()
    assert quaternion_from_matrix(np.eye(3))[0] == 1.0
