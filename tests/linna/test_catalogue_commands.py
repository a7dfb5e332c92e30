"""Commands about catalogues and identification: figures as JSON, bad input in one line."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path

import numpy as np
import pytest

from linna.cli import run
from lunar.catalogue import make_catalogue, save_catalogue
from payload_emulator.sim.terrain.registration import parse_registration
from tests.payload_emulator.sim.rasters import write_raster
from tmtc.dictionary.payload import DICTIONARY

METRES_PER_DEG = math.radians(1.0) * 1_737_400.0


def landmarks_packet(latitude: list[float], identity: int = 3_000_000_000) -> bytes:
    one = np.ones(len(latitude))
    items = {
        "landmark_id": identity + np.arange(len(latitude)),
        "latitude_deg": np.array(latitude),
        "longitude_deg": 300.0 * one,
        "height_m": 50.0 * one,
        "diameter_m": 6_000.0 * one,
        "sigma_east_m": 100.0 * one,
        "sigma_north_m": 100.0 * one,
        "sigma_up_m": 100.0 * one,
        "sightings": 3 * one.astype(int),
        "passes": one.astype(int),
    }
    values = {"frame_number": 1, "image_ticks": 5, "items": items}
    return DICTIONARY.pack("landmarks", values, ticks=0, sequence_count=0)


def test_a_downlinked_map_is_compared_with_a_catalogue(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, downlink = tmp_path / "list.csv", tmp_path / "map.bin"
    listed = make_catalogue(
        np.radians([10.0]), np.radians([300.0]), [6_000.0], source="one", rim_height_m=[50.0]
    )
    save_catalogue(listed, path)
    # 0.01 degrees are 303 m on the ground; the other landmark is far from any crater.
    downlink.write_bytes(landmarks_packet([10.01, 20.0]))
    assert run(["catalogue", "landmarks", str(downlink), "--catalogue", str(path), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert (figures["landmarks"], figures["in_catalogue"], figures["new"]) == (2, 1, 1)
    assert figures["median_horizontal_m"] == pytest.approx(303.2, abs=1.0)


def test_a_downlink_without_a_map_has_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, downlink = tmp_path / "list.csv", tmp_path / "other.bin"
    save_catalogue(make_catalogue([0.1], [0.2], [6_000.0], source="one"), path)
    time_report = {"reported_ticks": 1, "rate_exponent": 0}
    downlink.write_bytes(DICTIONARY.pack("time_report", time_report, ticks=0, sequence_count=0))
    assert run(["catalogue", "landmarks", str(downlink), "--catalogue", str(path), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert (figures["landmarks"], figures["median_horizontal_m"]) == (0, None)


def test_a_list_is_registered_to_terrain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    latitude, longitude = (
        part.ravel() for part in np.meshgrid(np.arange(1.5, 9, 1.5), np.arange(301.5, 309, 1.5))
    )

    def bowls(lat: np.ndarray, lon: np.ndarray) -> np.ndarray:
        height = np.zeros(np.broadcast_shapes(lat.shape, lon.shape))
        for north, east in zip(latitude, longitude, strict=True):
            level = np.cos(np.radians(north))
            # Radius 5 km, rim 200 m, depth 1,000 m.
            r = np.hypot(lat - north, (lon - east) * level) * METRES_PER_DEG / 5_000.0
            height += np.where(
                r < 1.0, 1_000.0 * np.minimum(r, 1.0) ** 2 - 800.0, 200.0 * np.maximum(r, 1.0) ** -4.0
            )
        return height

    raster = write_raster(tmp_path / "bowls.tif", 300.0, 9.0, 9.0, bowls, ppd=128)
    listed = make_catalogue(
        np.radians(latitude - 50.0 / METRES_PER_DEG), np.radians(longitude), [10_000.0] * 25, source="one"
    )
    path, out = tmp_path / "list.csv", tmp_path / "made" / "registration.json"
    save_catalogue(listed, path)
    words = ["catalogue", "register", str(path), "--terrain", str(raster), "--out", str(out), "--json"]
    assert run(words) == 0
    figures = json.loads(capsys.readouterr().out)
    assert (figures["rims"], figures["out"]) == (25, str(out))
    made = parse_registration(out.read_text(), "made")
    shift, sigma = made.at(np.radians([5.0]), np.radians([305.0]))
    assert shift[0] == pytest.approx([0.0, 50.0], abs=8.0) and sigma[0] < 20.0
    assert made.terrain == {"bowls.tif": hashlib.sha256(raster.read_bytes()).hexdigest()}
    assert made.catalogue == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["catalogue", "register"], "CATALOGUE: expected a crater list"),
        (["catalogue", "register", "none.csv"], "--terrain: expected height rasters"),
        (["catalogue", "curate", "none.csv", "--out", "x", "--region", "5"], "--region"),
        (["catalogue", "curate", "none.csv", "--out", "x", "--min-diameter", "40"], "--min-diameter"),
    ],
)
def test_bad_input_is_one_line_that_names_it(
    arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("LINNA_DATA", raising=False)
    assert run(arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert expected in error
