"""Samples of the gates: figures of one estimator by frame, units of the evidence."""

from __future__ import annotations

import numpy as np
import pytest

from ground_service.evaluation.detection.recall import ExpectedCraters
from ground_service.regression.gates.samples import (
    KINDS,
    VISIT_GAP_FRAMES,
    _cells,
    _estimator,
    _tracks,
    terrain_kinds,
)
from lunar.catalogue import make_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical


def test_squared_normalised_errors_are_summed_over_the_axes_and_unknown_without_every_sigma() -> None:
    error = np.array([[3.0, 8.0, 10.0], [3.0, 8.0, 10.0], [3.0, 8.0, 10.0], [np.nan, 8.0, 10.0]])
    sigma = np.array([[1.0, 2.0, 5.0], [1.0, 2.0, np.nan], [1.0, 0.0, 5.0], [1.0, 2.0, 5.0]])
    frames = _estimator(np.ones(4, np.bool_), error, sigma, {})
    # 3^2 + 4^2 + 2^2; a sigma of zero is no claim that can be judged.
    assert frames.squared_normalised_error[0] == pytest.approx(29.0)
    assert np.isnan(frames.squared_normalised_error[1:]).all()
    assert not hasattr(frames, "nees")


def test_a_track_is_one_crater_in_one_visit() -> None:
    crater = np.array([7, 3, 7, 7, 3, 7])
    frame = np.array([0, 0, 1, 2 + VISIT_GAP_FRAMES, 1, 1 + VISIT_GAP_FRAMES])
    # Crater 7 is out of view for as long as a visit may have gaps, and is then seen twice: still one track.
    assert _tracks(crater, frame).tolist() == [1, 0, 1, 1, 0, 1]
    frame[[3, 5]] += 1
    assert _tracks(crater, frame).tolist() == [1, 0, 1, 2, 0, 2]


def test_a_ground_cell_is_where_the_line_of_sight_meets_the_sphere() -> None:
    """From 100 km above 10.1 N 20 E: nadir, 3 degrees off nadir (5.2 km, below a cell), and above the horizon."""
    up = mcmf_from_spherical(np.radians(10.1), np.radians(20.0))
    up = up / np.linalg.norm(up)
    east = np.cross([0.0, 0.0, 1.0], up) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], up))
    tilt = np.radians(3.0)
    lines = np.array([-up, -np.cos(tilt) * up + np.sin(tilt) * east, east])
    cells = _cells(np.tile((MOON_RADIUS_M + 100e3) * up, (3, 1)), lines)
    # Rows of 0.25 degrees; columns of 0.25 degrees of arc, 20 cos 10 at this latitude.
    assert cells.tolist() == [40 * 100_000 + 78, 40 * 100_000 + 79, -1]


def test_terrain_is_cratered_by_the_density_of_catalogued_craters() -> None:
    """Forty craters of 6 km around 0 N 0 E, 32 within 100 km are the limit; one alone at 0 N 90 E."""
    around = np.linspace(-1.0, 1.0, 40)
    longitude = np.radians(np.append(around, 90.0))
    catalogue = make_catalogue(0.0 * longitude, longitude, np.full(41, 6_000.0), source="test")
    expected = ExpectedCraters(*(np.array([5, 40]) for _ in range(7)))
    kinds = terrain_kinds(catalogue, expected, np.array([0, 1]))
    assert [KINDS[kind] for kind in kinds] == ["cratered", "sparse"]
