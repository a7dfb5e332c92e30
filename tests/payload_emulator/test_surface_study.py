"""Error of the surface between crater rims, on ground whose height is known at every place."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import ArrayLike

from lunar.arrays import FloatArray, IntArray
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from payload_emulator.flight.instruments.altimeter import AltimeterParameters
from payload_emulator.session.scenario import NavigationSection, Scenario, load_scenario
from studies.surface_error import SurfaceErrors, study_surface

Height = Callable[[FloatArray], FloatArray]
FLAT_CRATERS = AltimeterParameters(rim_height_share=0.0)


class Ground:
    """Ground whose height follows from the latitude, with craters every 0.3 degrees and rims ``rim_m`` above it."""

    def __init__(self, height: Height, rim_m: float = 0.0, diameter_m: float = 5_000.0) -> None:
        latitude, longitude = np.meshgrid(
            np.radians(np.arange(-8.0, 8.0, 0.3)), np.radians(np.arange(-2, 2.1, 0.3))
        )
        count = latitude.size
        self.height = height
        self.catalogue = CraterCatalogue(
            np.arange(count),
            latitude.ravel(),
            longitude.ravel(),
            np.full(count, diameter_m),
            height(latitude.ravel()) + rim_m,
            np.full(count, 0.1 * diameter_m),
            "synthetic",
            np.ones(count, dtype=bool),
        )

    def height_m(self, latitude_rad: ArrayLike, longitude_rad: ArrayLike, level: int = 0) -> FloatArray:
        return self.height(np.asarray(latitude_rad))

    def measured(self, indices: IntArray) -> CraterCatalogue:
        return self.catalogue.select(indices)


def exact_catalogue() -> Scenario:
    scenario = load_scenario("altimeter")
    navigation: NavigationSection = dataclasses.replace(
        scenario.navigation, catalogue_error_fraction_of_diameter=0.0, catalogue_height_error_m=0.0
    )
    return dataclasses.replace(scenario, navigation=navigation)


def study(ground: Ground, parameters: AltimeterParameters = FLAT_CRATERS) -> SurfaceErrors:
    return study_surface(ground, exact_catalogue(), parameters, (0.0, 0.5), 5.0, 2_000.0, (1, 5))


def test_level_ground_is_known_exactly_and_rims_above_it_are_a_bias() -> None:
    level = study(Ground(lambda latitude: np.full_like(latitude, 300.0)))
    assert level.bias_m == pytest.approx(0.0, abs=1e-6)
    assert level.sigma_m == pytest.approx(0.0, abs=1e-6)
    raised = study(Ground(lambda latitude: np.full_like(latitude, 300.0), rim_m=100.0))
    assert raised.bias_m == raised.sigma_m == raised.calm_sigma_m == pytest.approx(100.0)
    # The claim is the relief between craters alone, as the rims do not scatter.
    assert raised.scaled_rms == pytest.approx(100.0 / 250.0)
    lowered = study(
        Ground(lambda latitude: np.full_like(latitude, 300.0), rim_m=100.0),
        AltimeterParameters(rim_height_share=0.02),
    )
    assert lowered.bias_m == pytest.approx(0.0, abs=1e-6)


def test_waves_shorter_than_the_spacing_of_craters_are_errors_of_their_own_size_and_correlation() -> None:
    # Waves of 20 km on the ground; the mean of the rims within 50 km follows none of it.
    wave = 2.0 * math.pi * MOON_RADIUS_M / 20_000.0
    found = study(Ground(lambda latitude: 400.0 * np.sin(wave * latitude)))
    assert found.sigma_m == pytest.approx(400.0 / math.sqrt(2.0), rel=0.15)
    assert found.correlation[2_000.0] == pytest.approx(math.cos(2.0 * math.pi / 10.0), abs=0.1)
    assert found.correlation[10_000.0] == pytest.approx(-1.0, abs=0.1)


def test_each_track_is_reported_and_places_without_craters_are_unknown() -> None:
    ground = Ground(lambda latitude: np.zeros_like(latitude))
    found = study_surface(ground, exact_catalogue(), FLAT_CRATERS, (0.0, 90.0), 5.0, 10_000.0, (1,))
    assert [track.longitude_deg for track in found.tracks] == [0.0, 90.0]
    assert [track.known_share for track in found.tracks] == [1.0, 0.0]
    assert math.isnan(found.tracks[1].sigma_m)
    assert found.sigma_m == pytest.approx(0.0, abs=1e-6)
