"""The ground under a pass: mare or highland, from the albedo of the Moon."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ground_service.evaluation.extras import dark_limit, with_terrain
from reports.values import NavigationSeries, TerrainMap


def two_tones(dark_rows: int) -> TerrainMap:
    """A map whose northern rows are dark (grey 50 to 59) and whose rest is bright (200 to 209)."""
    image = np.full((180, 360), 200, dtype=np.uint8)
    image[:dark_rows] = 50
    image += (np.arange(360) % 10).astype(np.uint8)
    return TerrainMap(image, 0.0, 360.0, -90.0, 90.0)


def series_at(latitude_deg: list[float], longitude_deg: list[float]) -> tuple[NavigationSeries, Any]:
    times = np.arange(len(latitude_deg), dtype=np.int64)
    nothing = np.full(len(times), np.nan)
    series = NavigationSeries(
        "anchored", "estimate", times, nothing, nothing, nothing, np.full((len(times), 3), np.nan)
    )
    track = SimpleNamespace(
        utc_ns=times, latitude_deg=np.array(latitude_deg), longitude_deg=np.array(longitude_deg)
    )
    return series, track


@pytest.mark.parametrize("dark_rows", [20, 90, 160])
def test_the_limit_lies_between_two_tones_however_much_there_is_of_each(dark_rows: int) -> None:
    assert 59 < dark_limit(two_tones(dark_rows)) <= 200


def test_samples_over_dark_ground_are_mare_and_those_outside_the_reference_nothing() -> None:
    series, track = series_at([80.0, 80.0, -10.0, float("nan")], [10.0, -10.0, 359.9, 5.0])
    found = with_terrain(series, track, two_tones(45))
    assert found.terrain == ("mare", "mare", "highland", "")


def test_the_poles_and_the_edge_of_the_map_have_a_pixel() -> None:
    series, track = series_at([90.0, -90.0, 0.0], [0.0, 360.0, 359.999999])
    assert with_terrain(series, track, two_tones(45)).terrain == ("mare", "highland", "highland")
