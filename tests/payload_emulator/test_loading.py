"""On-board table of craters made from a list."""

from dataclasses import replace

import numpy as np
import pytest

from lunar.catalogue import CraterCatalogue
from payload_emulator.session.scenario import load_scenario
from payload_emulator.session.spacecraft.loading import SEEN_BELOW_RIM_M, onboard_catalogue
from tmtc.dictionary.tables import CatalogueTable


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


def on_board(source: str, fraction: float = 0.0) -> CatalogueTable:
    """On-board table with errors of its centres of a fraction of the diameter, and none of its heights."""
    scenario = load_scenario("selenita")
    navigation = replace(
        scenario.navigation, catalogue_error_fraction_of_diameter=fraction, catalogue_height_error_m=0.0
    )
    return onboard_catalogue(replace(scenario, navigation=navigation), measured(source))


def test_real_craters_are_placed_below_their_rims_where_the_network_sees_them() -> None:
    rims = measured("LU1319381").rim_height_m
    np.testing.assert_allclose(on_board("LU1319381").rim_height_m - rims, -SEEN_BELOW_RIM_M, atol=1e-9)
    # Of the order of the measured 16 to 23 m: another sign would double the error of the altitude.
    assert 14.0 <= SEEN_BELOW_RIM_M <= 24.0


def test_procedural_craters_are_placed_on_their_rims() -> None:
    np.testing.assert_array_equal(on_board("synthetic, seed 1").rim_height_m, measured("").rim_height_m)


@pytest.mark.parametrize("source", ["LU1319381", "synthetic, seed 1"])
def test_centres_have_the_errors_that_are_added_the_error_of_the_list_is_the_detectors(source: str) -> None:
    np.testing.assert_array_equal(on_board(source, 0.03).sigma_m[:, :2], 150.0)
    np.testing.assert_array_equal(on_board(source).sigma_m[:, :2], 10.0)
