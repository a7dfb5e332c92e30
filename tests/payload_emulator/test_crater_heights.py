"""Height of the seen crater centres, fitted to detections with true positions."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical
from payload_emulator.errors import RecordError
from payload_emulator.flight.vision.detections import Detections
from studies.crater_heights import fit_height, sightings
from studies.navigation_windows import CAMERA_FOV_RAD, CAMERA_PX

SEEN_M, EAST_M, NORTH_M = -25.0, 40.0, -30.0


def catalogue(count: int, rng: np.random.Generator) -> CraterCatalogue:
    diameter = rng.uniform(4_000.0, 9_000.0, count)
    return CraterCatalogue(
        np.arange(count) + 7,
        np.radians(rng.uniform(-12.0, 12.0, count)),
        np.radians(rng.uniform(-2.0, 2.0, count)),
        diameter,
        rng.uniform(-800.0, 800.0, count),
        0.1 * diameter,
        "LU1319381",
        np.ones(count, dtype=bool),
    )


def recording(
    listed: CraterCatalogue,
    noise_px: float,
    *,
    spurious: bool = False,
    east_m: float = EAST_M,
    north_m: float = NORTH_M,
) -> Any:
    """Nine frames straight down along the zero meridian; every crater in view is detected where it is seen.

    With spurious detections a tenth is displaced toward the image centre as if its crater lay much lower, a tenth has a
    low score, a tenth has another size, and a tenth states no sigma: none of these may count.
    """
    rng = np.random.default_rng(3)
    camera = PinholeCamera(CAMERA_PX, CAMERA_PX, CAMERA_FOV_RAD)
    east = east_m / (MOON_RADIUS_M * np.cos(listed.latitude_rad))
    seen = np.asarray(
        mcmf_from_spherical(
            listed.latitude_rad + north_m / MOON_RADIUS_M,
            listed.longitude_rad + east,
            listed.rim_height_m + SEEN_M,
        )
    )
    truth, attitudes, found = [], [], []
    for latitude, altitude_m in zip(
        np.radians(np.linspace(-8.0, 8.0, 9)), np.linspace(19e3, 38e3, 9), strict=True
    ):
        up = np.array([np.cos(latitude), 0.0, np.sin(latitude)])
        position = (MOON_RADIUS_M + altitude_m) * up
        right = np.array([0.0, 1.0, 0.0])
        rotation = np.stack([right, np.cross(-up, right), -up])
        local = (seen - position) @ rotation.T
        uv = camera.project(local)
        visible = camera.contains(uv) & (local[:, 2] > 0.0)
        u, v = uv[visible].T + noise_px * rng.standard_normal((2, np.count_nonzero(visible)))
        diameter = camera.focal_px * listed.diameter_m[visible] / local[visible, 2]
        score, sigma = np.full(u.size, 0.9), np.full(u.size, 0.5)
        if spurious:
            u[::10] += 0.02 * (255.5 - u[::10])
            v[::10] += 0.02 * (255.5 - v[::10])
            score[3::10] = 0.3
            u[5::10] += 0.01 * (255.5 - u[5::10])
            diameter[5::10] *= 1.5
            sigma[7::10] = np.nan
        truth.append(np.concatenate([position, np.zeros(3)]))
        attitudes.append(rotation)
        found.append(Detections(u, v, diameter, score, sigma))
    return SimpleNamespace(
        utc_ns=15_000_000_000 * np.arange(9),
        truth=np.array(truth),
        mcmf_from_icrf=np.tile(np.eye(3), (9, 1, 1)),
        camera_from_mcmf=np.array(attitudes),
        catalogue=listed,
        found=found.__getitem__,
    )


def test_height_and_shift_of_a_window_are_told_apart() -> None:
    listed = catalogue(900, np.random.default_rng(1))
    fit = fit_height(sightings([recording(listed, 0.0)]))
    assert fit.height_m == pytest.approx(SEEN_M, abs=0.2)
    assert fit.craters > 300 and fit.detections > fit.craters


def test_windows_have_shifts_of_their_own() -> None:
    listed = catalogue(900, np.random.default_rng(1))
    seen = sightings([recording(listed, 0.0), recording(listed, 0.0, east_m=-60.0, north_m=90.0)])
    assert set(seen.window) == {0, 1}
    assert fit_height(seen).height_m == pytest.approx(SEEN_M, abs=0.2)
    one = replace(seen, window=np.zeros_like(seen.window))
    assert fit_height(one).sigma_m > 5.0 * fit_height(seen).sigma_m


def test_detections_that_do_not_count() -> None:
    """Displaced ones are outliers; weak ones, ones of another size and ones without sigma are no pairs."""
    listed = catalogue(900, np.random.default_rng(2))
    clean, disturbed = (sightings([recording(listed, 0.05, spurious=spurious)]) for spurious in (False, True))
    assert 0.6 * clean.crater.size < disturbed.crater.size < 0.71 * clean.crater.size
    fit = fit_height(disturbed)
    assert fit.detections < 0.95 * disturbed.crater.size
    assert fit.height_m == pytest.approx(SEEN_M, abs=2.0)


def test_noise_stays_within_the_stated_deviation() -> None:
    fit = fit_height(sightings([recording(catalogue(900, np.random.default_rng(2)), 0.5)]))
    assert 0.5 < fit.sigma_m < 6.0
    assert abs(fit.height_m - SEEN_M) < 3.0 * fit.sigma_m


def test_only_craters_of_three_to_thirty_kilometres_count() -> None:
    listed = catalogue(900, np.random.default_rng(1))
    sized = listed.diameter_m.copy()
    sized[::3], sized[1::3] = 2_900.0, 31_000.0
    seen = sightings([recording(replace(listed, diameter_m=sized), 0.0)])
    assert set(seen.crater) <= set(listed.ids[2::3])
    assert np.all((seen.altitude_m > 18_900.0) & (seen.altitude_m < 38_100.0))
    np.testing.assert_allclose(
        seen.depth_ratio, 0.1 * listed.diameter_m[seen.crater - 7] / sized[seen.crater - 7]
    )


def test_more_certain_detections_weigh_more() -> None:
    seen = sightings([recording(catalogue(900, np.random.default_rng(1)), 0.0)])
    moved = seen.residual_px + np.where(np.arange(seen.crater.size) % 2, 1.0, 0.0)[:, None] * 20.0 * seen.up
    heights = [
        fit_height(
            replace(seen, residual_px=moved, weight=np.where(np.arange(seen.crater.size) % 2, odd, 1.0))
        )
        for odd in (1.0, 9.0)
    ]
    assert heights[0].height_m == pytest.approx(SEEN_M + 10.0, abs=1.0)
    assert heights[1].height_m > SEEN_M + 17.0


@pytest.mark.parametrize("count", [0, 1])
def test_a_height_without_enough_detections_is_unknown(count: int) -> None:
    seen = sightings([recording(catalogue(900, np.random.default_rng(1)), 0.0)])
    fit = fit_height(seen.chosen(np.arange(seen.crater.size) < count))
    assert np.isnan(fit.height_m) and np.isnan(fit.sigma_m) and fit.detections == count


def test_errors_of_one_crater_count_as_one() -> None:
    """The same detections seen twice say no more about the height."""
    seen = sightings([recording(catalogue(900, np.random.default_rng(2)), 0.5)])
    twice = seen.chosen(np.repeat(np.arange(seen.crater.size), 2))
    assert fit_height(twice).sigma_m == pytest.approx(fit_height(seen).sigma_m, rel=1e-6)


def test_detections_of_no_known_crater_are_refused() -> None:
    far = catalogue(5, np.random.default_rng(1))
    empty = recording(far, 0.0)
    empty.catalogue = replace(far, longitude_rad=far.longitude_rad + np.pi)
    with pytest.raises(RecordError, match="expected detections of known craters, found none"):
        sightings([empty])
