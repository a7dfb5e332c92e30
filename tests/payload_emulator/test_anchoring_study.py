"""Parts of a catalogue: how they are chosen, and what navigation makes of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from lunar.catalogue import CraterCatalogue, make_catalogue
from payload_emulator.flight.navigation.anchored_parameters import AnchoredParameters
from studies.anchoring import CHOICES, chosen_craters, study_sizes
from studies.montecarlo import NavigationCase


@pytest.fixture(scope="module")
def craters() -> CraterCatalogue:
    rng = np.random.default_rng(1)
    # All but a tenth in one corner.
    latitude = np.concatenate([rng.uniform(0.5, 0.7, 900), rng.uniform(-1.2, 1.2, 100)])
    longitude = np.concatenate([rng.uniform(1.0, 1.2, 900), rng.uniform(0.0, 6.2, 100)])
    return make_catalogue(latitude, longitude, rng.uniform(5e3, 30e3, 1_000), source="made up")


@pytest.mark.parametrize("choice", CHOICES)
def test_as_many_are_chosen_as_asked_for_and_the_same_each_time(
    craters: CraterCatalogue, choice: str
) -> None:
    mask = chosen_craters(craters, 60, choice, 1)
    assert int(mask.sum()) == 60
    assert np.array_equal(mask, chosen_craters(craters, 60, choice, 1))
    assert chosen_craters(craters, 5_000, choice, 1).all()


def test_the_largest_are_the_largest_and_the_spread_ones_leave_the_crowded_corner(
    craters: CraterCatalogue,
) -> None:
    largest = chosen_craters(craters, 60, "largest", 1)
    assert craters.diameter_m[largest].min() >= craters.diameter_m[~largest].max()
    crowd = np.arange(1_000) < 900
    spread, random = (np.mean(crowd[chosen_craters(craters, 60, name, 1)]) for name in ("spread", "random"))
    assert spread < 0.4 < random


def test_fewer_craters_fix_fewer_frames(navigation_case: Callable[..., NavigationCase]) -> None:
    case = navigation_case(50, parameters=AnchoredParameters(gravity_degree=50))
    scores = study_sizes(case, (1.0, 0.02), 1, settle_frames=20)
    assert [score.choice for score in scores] == ["random", *CHOICES]
    whole, *parts = scores
    assert whole.craters == len(case.craters)
    assert whole.bounded
    for part in parts:
        assert part.craters == round(0.02 * len(case.craters))
        assert part.fixed_share < whole.fixed_share
        assert part.per_footprint == pytest.approx(0.02 * whole.per_footprint, rel=0.01)
