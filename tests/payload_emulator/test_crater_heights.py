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


def recording(listed: CraterCatalogue, noise_px: float, *, spurious: bool = False) -> Any:
    """Nine frames straight down along the zero meridian; every crater in view is detected where it is seen."""
    rng = np.random.default_rng(3)
    camera = PinholeCamera(CAMERA_PX, CAMERA_PX, CAMERA_FOV_RAD)
    east = EAST_M / (MOON_RADIUS_M * np.cos(listed.latitude_rad))
    seen = np.asarray(
        mcmf_from_spherical(
            listed.latitude_rad + NORTH_M / MOON_RADIUS_M,
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
        if spurious:  # a tenth of the detections is elsewhere, a tenth is too weak to count
            u[::10] += 0.2 * diameter[::10]
            v[5::10] += 0.2 * diameter[5::10]
            score[5::10] = 0.3
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


def test_noise_and_false_detections_stay_within_the_stated_deviation() -> None:
    listed = catalogue(900, np.random.default_rng(2))
    fit = fit_height(sightings([recording(listed, 0.5, spurious=True)]))
    assert 0.5 < fit.sigma_m < 6.0
    assert abs(fit.height_m - SEEN_M) < 3.0 * fit.sigma_m


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
