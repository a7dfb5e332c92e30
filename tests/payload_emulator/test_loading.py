"""On-board table of craters made from a list."""

from dataclasses import replace

import numpy as np

from lunar.catalogue import CraterCatalogue
from payload_emulator.session.loading import SEEN_BELOW_RIM_M, onboard_catalogue
from payload_emulator.session.scenario import load_scenario


def measured(source: str) -> CraterCatalogue:
    count = 5
    return CraterCatalogue(
        np.arange(count),
        np.linspace(-0.1, 0.1, count),
        np.linspace(0.2, 0.3, count),
        np.full(count, 5_000.0),
        np.linspace(-2_000.0, 2_000.0, count),
        np.full(count, 400.0),
        source,
        np.ones(count, dtype=bool),
    )


def heights(source: str) -> np.ndarray:
    """Heights (m) of the on-board table, without the errors that a scenario adds."""
    scenario = load_scenario("selenita")
    navigation = replace(
        scenario.navigation, catalogue_error_fraction_of_diameter=0.0, catalogue_height_error_m=0.0
    )
    return onboard_catalogue(replace(scenario, navigation=navigation), measured(source)).rim_height_m


def test_real_craters_are_placed_below_their_rims_where_the_network_sees_them() -> None:
    rims = measured("LU1319381").rim_height_m
    np.testing.assert_allclose(heights("LU1319381") - rims, -SEEN_BELOW_RIM_M, atol=1e-9)
    # Of the order of the measured 16 to 23 m: another sign would double the error of the altitude.
    assert 14.0 <= SEEN_BELOW_RIM_M <= 24.0


def test_procedural_craters_are_placed_on_their_rims() -> None:
    np.testing.assert_array_equal(heights("synthetic, seed 1"), measured("").rim_height_m)
