"""Rendered data sets: the same frames whatever the order, resumable, kept apart by footprint."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from lunar.datafolder import find_data
from payload_emulator.errors import DatasetError
from payload_emulator.training import dataset as store
from payload_emulator.training.build import build, make_shard, plan_shards
from payload_emulator.training.integrity import check
from payload_emulator.training.recipe import Recipe, Source, load_recipe

ROOT = Path(__file__).parents[3]
RECIPE = Recipe(
    "tiny",
    7,
    (
        Source("world", "train", "procedural", 0.5, (41,), altitude_km=(14.0, 16.0)),
        Source(
            "world-test", "test", "procedural", 0.5, (41,), light="low", vary=False, altitude_km=(14.0, 16.0)
        ),
    ),
    frames_per_shard=1,
)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("built") / "set"
    steps = list(build(RECIPE, folder, 3, find_data(None)))
    return folder, steps


def test_progress_ends_with_every_frame_and_the_folder_is_whole(built):
    folder, steps = built
    assert steps[0] == (0, 4) and steps[-1] == (4, 4)
    assert check(folder) == []


def test_a_shard_does_not_depend_on_what_was_made_before(built, tmp_path):
    folder, _ = built
    for name in ("images", "metadata", "shards"):
        (tmp_path / name).mkdir()
    for shard in reversed(plan_shards(RECIPE, 3)[-2:]):
        make_shard(RECIPE, shard, tmp_path, "")
        for path in (f"images/{shard.first_frame:06d}.png", f"shards/{shard.name}.npz"):
            assert (tmp_path / path).read_bytes() == (folder / path).read_bytes(), path


def test_a_finished_data_set_is_not_made_again(built, monkeypatch):
    folder, _ = built

    def refuse(*arguments):
        raise AssertionError("a finished shard was rendered again")

    monkeypatch.setattr("payload_emulator.training.build.make_shard", refuse)
    assert list(build(RECIPE, folder, 3, find_data(None))) == [(4, 4)]


def test_another_data_set_in_the_folder_is_refused(built):
    folder, _ = built
    with pytest.raises(DatasetError, match="expected an empty folder or the same data set"):
        list(build(dataclasses.replace(RECIPE, seed=8), folder, 3, find_data(None)))


def test_other_files_in_the_folder_are_left_alone(tmp_path):
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(DatasetError, match="found other files"):
        list(build(RECIPE, tmp_path, 3, find_data(None)))
    assert (tmp_path / "letter.txt").read_text() == "mine"


def test_real_terrain_without_data_is_refused(tmp_path):
    recipe = load_recipe(ROOT / "scenarios" / "detector-dataset.toml")
    with pytest.raises(DatasetError, match="expected terrain tiles"):
        list(build(recipe, tmp_path / "set", 40, find_data(None)))


def test_labels_of_fresh_craters_sit_on_dark_and_bright_walls(built):
    """Along the Sun's direction the wall toward the Sun is the darker: the label's centre parts them."""
    folder, _ = built
    dataset = store.Dataset(folder)
    contrast = []
    for frame in dataset.frames():
        image = dataset.image(frame).astype(float)
        toward = frame.sun_camera[:2] / np.hypot(*frame.sun_camera[:2])
        c = frame.craters
        for k in np.flatnonzero((c["depth_ratio"] > 0.08) & (c["diameter_px"] > 12) & (c["id"] >= 0)):
            step = 0.3 * c["diameter_px"][k] * toward
            places = [(c["u_px"][k] + s * step[0], c["v_px"][k] + s * step[1]) for s in (1.0, -1.0)]
            if all(3 < u < 508 and 3 < v < 508 for u, v in places):
                near, far = (image[round(float(v)), round(float(u))] for u, v in places)
                contrast.append(far - near)
    assert len(contrast) >= 5
    assert np.mean(np.array(contrast) > 0) > 0.85


@pytest.mark.real_data
def test_training_frames_keep_sixty_kilometres_from_every_held_out_box(tmp_path, data_path):
    recipe = load_recipe(ROOT / "scenarios" / "detector-dataset.toml")
    for name in ("images", "metadata", "shards"):
        (tmp_path / name).mkdir()
    shard = dataclasses.replace(plan_shards(recipe, 400)[0], frames=2)
    make_shard(recipe, shard, tmp_path, str(data_path))
    km_per_degree = 1737.4 * np.pi / 180.0
    for path in (tmp_path / "metadata").glob("*.json"):
        corners = json.loads(path.read_text())["corners_deg"]
        for corner in corners:
            for box in shard.source.avoid:
                middle = 0.5 * (box.west_deg + box.east_deg)
                east = abs((corner["longitude"] - middle + 180) % 360 - 180) - 0.5 * (
                    box.east_deg - box.west_deg
                )
                east_km = max(east, 0.0) * km_per_degree * np.cos(np.radians(corner["latitude"]))
                north = max(box.south_deg - corner["latitude"], corner["latitude"] - box.north_deg, 0.0)
                # A parallel is no great circle: up to 1 % short over such distances.
                assert np.hypot(east_km, north * km_per_degree) >= 59.4
