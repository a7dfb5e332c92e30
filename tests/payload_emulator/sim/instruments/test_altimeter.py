"""The simulated altimeter against closed forms: spheres, slopes, the Gaussian beam, and shares of drop-outs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lunar.camera import nadir_camera_from_mcmf
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder
from lunar.frames import mcmf_from_spherical
from payload_emulator.errors import ScenarioError
from payload_emulator.session.emulator import emulate
from payload_emulator.session.recording import load_record
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.sim.instruments import Situation, Surroundings
from payload_emulator.sim.instruments.altimeter import AltimeterSection, beam, ground_ranges_m, measure
from tests.scenarios import short_scenario
from tmtc.downlink import decode

ALTITUDE_M = 30_000.0
SCENARIO = short_scenario(45.0)


class Ground:
    """A sphere at a height, or ground that rises to the north from the equator on."""

    def __init__(self, height_m: float = 0.0, slope: float = 0.0) -> None:
        self.level_m, self.slope = height_m, slope

    def height_m(self, latitude_rad: Any, longitude_rad: Any, level: int = 0) -> Any:
        assert level == 0
        return self.level_m + self.slope * MOON_RADIUS_M * np.asarray(latitude_rad)


def situation(utc_ns: int = 5, tilt_rad: float = 0.0) -> Situation:
    position = mcmf_from_spherical(0.0, 0.7, ALTITUDE_M)
    nadir = nadir_camera_from_mcmf(position)
    # about the axis to the right: the boresight leans towards image up
    turn = np.array(
        [
            [1.0, 0.0, 0.0],
            [0.0, np.cos(tilt_rad), np.sin(tilt_rad)],
            [0.0, -np.sin(tilt_rad), np.cos(tilt_rad)],
        ]
    )
    axes = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return Situation(utc_ns, None, axes @ position, position, turn @ nadir @ axes.T, axes.T)


def ranges(settings: AltimeterSection, ground: Ground, count: int, seed: int = 1) -> Any:
    there: Any = Surroundings(ground, seed)  # only heights are asked for
    return np.array([measure(settings, None, there, situation(k))[1][0] for k in range(count)])


def test_the_range_to_a_sphere_is_the_height_above_it() -> None:
    quiet = AltimeterSection(range_noise_m=1e-9, divergence_mrad=0.0, dropout_share=0.0)
    assert ranges(quiet, Ground(1_234.0), 1)[0] == pytest.approx(ALTITUDE_M - 1_234.0, abs=1e-3)


def test_an_oblique_ray_meets_the_sphere_where_geometry_says() -> None:
    position = mcmf_from_spherical(0.0, 0.0, ALTITUDE_M)
    angle = np.radians(30.0)
    direction = np.array([[-np.cos(angle), 0.0, np.sin(angle)]])
    # sine rule in the triangle of centre, spacecraft and ground
    radius = MOON_RADIUS_M - 2_000.0
    at_ground = np.pi - np.arcsin((MOON_RADIUS_M + ALTITUDE_M) / radius * np.sin(angle))
    expected = radius * np.sin(np.pi - angle - at_ground) / np.sin(angle)
    found = ground_ranges_m(Ground(-2_000.0), position, direction)
    assert found[0] == pytest.approx(expected, abs=0.01)
    for away in (np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])):
        assert np.isnan(ground_ranges_m(Ground(), position, away)).all()


def test_the_boresight_is_that_of_the_camera() -> None:
    quiet = AltimeterSection(range_noise_m=1e-9, divergence_mrad=0.0, dropout_share=0.0)
    tilt = np.radians(20.0)
    (leaning,) = measure(quiet, None, Surroundings(Ground(), 1), situation(5, tilt))[1]
    distance = MOON_RADIUS_M + ALTITUDE_M
    sine = distance / MOON_RADIUS_M * np.sin(tilt)
    expected = distance * np.cos(tilt) - MOON_RADIUS_M * np.sqrt(1.0 - sine**2)
    assert leaning == pytest.approx(expected, abs=0.01)


def test_the_rays_stand_for_a_gaussian_beam() -> None:
    offsets, weights = beam(2.0)
    assert weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(weights @ offsets, 0.0, atol=1e-12)
    # mean square radius of exp(-2 r^2 / w^2) inside w: w^2 (1/2 - 1 / (e^2 - 1))
    assert weights @ np.sum(offsets**2, axis=1) == pytest.approx(4.0 * (0.5 - 1.0 / np.expm1(2.0)), rel=0.1)


def test_noise_on_flat_ground_is_that_of_the_settings() -> None:
    settings = AltimeterSection(range_noise_m=3.0, divergence_mrad=1.0, dropout_share=0.0)
    found = ranges(settings, Ground(), 2_000)
    # 2,000 samples know a standard deviation to 1.6 %
    assert found.std() == pytest.approx(3.0, rel=0.06)
    assert found.mean() == pytest.approx(ALTITUDE_M, abs=0.3)


def test_noise_grows_with_slope_times_footprint() -> None:
    slope, settings = 0.5, AltimeterSection(divergence_mrad=4.0, echo_noise_share=0.5, dropout_share=0.0)
    offsets, weights = beam(2e-3)
    footprint_m = ALTITUDE_M * np.sqrt(weights @ offsets[:, 0] ** 2)
    expected = np.hypot(1.0, 0.5 * slope * footprint_m)
    assert expected > 5.0
    assert ranges(settings, Ground(slope=slope), 1_500).std() == pytest.approx(expected, rel=0.08)


def test_there_is_no_echo_from_beyond_the_maximum_range_nor_in_a_drop_out() -> None:
    assert np.isnan(ranges(AltimeterSection(maximum_range_km=29.0), Ground(), 20)).all()
    near = ranges(AltimeterSection(maximum_range_km=31.0, dropout_share=0.25), Ground(), 2_000)
    assert np.isnan(near).mean() == pytest.approx(0.25, abs=0.04)


def test_samples_depend_on_seed_and_time_alone() -> None:
    settings = AltimeterSection(dropout_share=0.0)
    np.testing.assert_array_equal(ranges(settings, Ground(), 5), ranges(settings, Ground(), 5))
    assert len(set(ranges(settings, Ground(), 5).tolist())) == 5
    assert (ranges(settings, Ground(), 5) != ranges(settings, Ground(), 5, seed=2)).all()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("range_noise_m = 0.0", "altimeter.range_noise_m must be positive, found 0.0"),
        ("divergence_mrad = 60.0", "altimeter.divergence_mrad must be from 0 to 50, found 60.0"),
        ("echo_noise_share = -0.1", "altimeter.echo_noise_share must be zero or more, found -0.1"),
        ("maximum_range_km = 0", "altimeter.maximum_range_km must be positive, found 0.0"),
        ("dropout_share = 1.1", "altimeter.dropout_share must be from 0 to 1, found 1.1"),
        ("cadence_s = 0.05", "altimeter.cadence_s must be at least 0.1, found 0.05"),
        ("rim_height_share = 0.3", "altimeter.rim_height_share must be from 0 to 0.2, found 0.3"),
        ("range_nose_m = 1.0", "unknown key 'altimeter.range_nose_m'; did you mean 'range_noise_m'?"),
    ],
)
def test_settings_out_of_range_are_refused(line: str, message: str) -> None:
    with pytest.raises(ScenarioError) as refusal:
        parse_scenario(f"{SCENARIO}[altimeter]\n{line}")
    assert str(refusal.value) == f"scenario: {message}"


def test_a_pass_with_an_altimeter_uses_its_ranges_without_reading_the_truth(tmp_path: Path) -> None:
    scenario = parse_scenario(SCENARIO + "[altimeter]\nrim_height_share = 0.0")
    summary = emulate(scenario, DataFolder(), tmp_path / "pass")
    assert summary["truth_reads_after_start"] == 0
    table = decode((tmp_path / "pass" / "downlink.cadu").read_bytes()).tables()["altimeter"]
    frames = [item for item in load_record(tmp_path / "pass").inputs if item.number >= 0]
    given = np.concatenate([item.instruments["altimeter"] for item in frames])
    np.testing.assert_allclose(table.items["range_m"], given[:, 1].astype(np.float32))
    assert table.items["sample_ticks"].tolist() == given[:, 0].tolist()
    # before the first frame there is neither an earlier attitude nor an orbit
    assert table.items["sample_status"][:3].tolist() == [3, 3, 3]
    status = table.items["sample_status"][3:]
    assert np.count_nonzero(status == 0) >= 4
    used = table.items["sample_status"] == 0
    assert np.all(np.abs(table.items["innovation"][used]) <= 4.0 * table.items["innovation_sigma"][used])
    assert replace(scenario, instruments={}).instruments == {}
