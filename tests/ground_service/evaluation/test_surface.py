"""The albedo of the Moon as a picture under maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ground_service.errors import InvalidInput
from ground_service.evaluation.extras import dark_limit
from ground_service.evaluation.surface import surface_map
from lunar.datafolder import find_data


def test_a_map_of_minus_180_to_180_is_turned_to_begin_at_0(tmp_path: Path) -> None:
    columns = np.repeat(np.linspace(0, 255, 64).astype(np.uint8)[None], 32, axis=0)
    Image.fromarray(columns).save(tmp_path / "albedo.png")
    found = surface_map(tmp_path / "albedo.png")
    assert (found.image.shape, found.west_deg, found.east_deg) == ((1024, 2048), 0.0, 360.0)
    assert int(found.image[512, 1020]) > 210  # just west of 180 degrees: the eastern edge of the file
    assert int(found.image[512, 1030]) < 50


def test_a_file_that_is_no_picture_is_told(tmp_path: Path) -> None:
    (tmp_path / "albedo.jpg").write_text("no picture")
    with pytest.raises(InvalidInput, match="cannot be read"):
        surface_map(tmp_path / "albedo.jpg")


@pytest.mark.real_data
def test_a_fifth_of_the_real_moon_is_dark_and_the_sea_of_tranquillity_is(data_path: Path) -> None:
    # Maria cover about 17 % of the Moon (Head 1976, Reviews of Geophysics 14, 265); other ground is dark beside them.
    albedo = find_data(data_path).albedo
    assert albedo is not None
    found = surface_map(albedo)
    limit = dark_limit(found)
    area = np.cos(np.radians(90.0 - (np.arange(1024) + 0.5) * 180.0 / 1024))[:, None] / 2048
    share = float((area * (found.image < limit)).sum() / (area * 2048).sum())
    assert 0.14 < share < 0.25

    def grey(latitude_deg: float, longitude_deg: float) -> int:
        return int(found.image[int((90.0 - latitude_deg) / 180.0 * 1024), int(longitude_deg / 360.0 * 2048)])

    assert grey(8.5, 31.4) < limit  # Mare Tranquillitatis
    assert grey(18.4, 302.6) < limit  # Oceanus Procellarum
    assert grey(-43.3, 348.6) > limit  # Tycho
    assert grey(20.0, 180.0) > limit  # the far side
