"""Recipes: what is refused, and that splits cannot touch."""

from pathlib import Path

import numpy as np
import pytest

from lunar.boxes import Box, inside_box
from payload_emulator.errors import DatasetError
from payload_emulator.session.world.recipe import Source, load_recipe, procedural_recipe
from payload_emulator.training.data.build import plan_shards
from payload_emulator.training.data.shots import allowed

ROOT = Path(__file__).parents[3]


def write(tmp_path, text):
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    return path


GOOD = """[dataset]
name = "a"
seed = 1
[[dataset.source]]
name = "x"
split = "train"
terrain = "procedural"
share = 1.0
"""


def test_an_unknown_key_is_refused_with_the_nearest_known_one(tmp_path):
    with pytest.raises(DatasetError, match=r"unknown key 'sead' \(did you mean 'seed'\?\)"):
        load_recipe(write(tmp_path, GOOD.replace("seed = 1", "seed = 1\nsead = 2")))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('split = "train"', 'split = "trane"', "expected one of train, val, test"),
        ('terrain = "procedural"', 'terrain = "mars"', "expected one of 'procedural', 'real'"),
        ("share = 1.0", "share = 1.0\nboxes = [[1, 2, 3]]", "west, east, south, north"),
        ('name = "a"\n', "", "dataset.name"),
        ("[dataset]", "[dataset", "expected a TOML file"),
    ],
)
def test_a_wrong_recipe_is_refused_in_one_line_that_says_where(tmp_path, old, new, message):
    with pytest.raises(DatasetError, match=message) as caught:
        load_recipe(write(tmp_path, GOOD.replace(old, new, 1)))
    assert "recipe.toml" in str(caught.value)


def test_a_plain_scenario_gives_the_procedural_recipe_of_its_seed(tmp_path):
    assert load_recipe(write(tmp_path, "seed = 5\n")).digest == procedural_recipe(5).digest


def test_procedural_splits_share_no_world():
    seeds = [seed for source in procedural_recipe().sources for seed in source.seeds]
    assert len(seeds) == len(set(seeds))


def test_the_shipped_recipe_keeps_every_test_and_validation_box_away_from_training():
    recipe = load_recipe(ROOT / "scenarios" / "detector-dataset.toml")
    train = [s for s in recipe.sources if s.split == "train" and s.terrain == "real"]
    held = [box for s in recipe.sources if s.split != "train" and s.terrain == "real" for box in s.boxes]
    assert held
    for source in train:
        assert set(held) <= set(source.avoid)
        assert source.buffer_km >= 60.0
    seeds = {}
    for source in recipe.sources:
        if source.terrain == "procedural":
            for seed in source.seeds:
                assert seeds.setdefault(seed, source.split) == source.split


def test_a_footprint_within_the_buffer_of_a_forbidden_box_is_refused():
    source = Source("x", "train", "real", 1.0, avoid=(Box(285.0, 300.0, -60.0, 60.0),), buffer_km=60.0)
    world = Box(180.0, 330.0, -60.0, 60.0)
    # One degree of longitude is 30.3 km at the equator and half of that at 60 degrees.
    assert not allowed(source, world, np.array([0.0]), np.array([284.0]))
    assert not allowed(source, world, np.array([0.0]), np.array([283.1]))
    assert allowed(source, world, np.array([0.0]), np.array([282.9]))
    assert not allowed(source, world, np.array([58.0]), np.array([281.5]))


def test_boxes_join_over_the_zero_meridian():
    box = Box(350.0, 370.0, -10.0, 10.0)
    inside = inside_box(box, np.zeros(4), np.array([355.0, 5.0, 12.0, 349.0]), 0.0)
    assert inside.tolist() == [True, True, False, False]


def test_shards_hold_every_frame_once_and_each_source_its_share():
    recipe = procedural_recipe()
    shards = plan_shards(recipe, 300)
    numbers = [n for s in shards for n in s.frame_numbers]
    assert numbers == list(range(300))
    train = sum(s.frames for s in shards if s.source.split == "train")
    assert train == 240


def test_real_terrain_may_be_taken_without_what_is_stamped_on_it(tmp_path):
    path = tmp_path / "r.toml"
    text = '[dataset]\nname = "a"\nseed = 1\n[[dataset.source]]\nname = "x"\nsplit = "train"\nshare = 1.0\n'
    path.write_text(text + 'terrain = "real"\n')
    sharpened = load_recipe(path)
    path.write_text(text + 'terrain = "real"\nsharpen = false\n')
    plain = load_recipe(path)
    assert sharpened.sources[0].sharpen and not plain.sources[0].sharpen
    # What is as it always was keeps the identity that data sets carry.
    assert "sharpen" not in sharpened.to_dict()["sources"][0]
    assert plain.digest != sharpened.digest
    for terrain, value in (("procedural", "false"), ("real", "3")):
        path.write_text(f'{text}terrain = "{terrain}"\nsharpen = {value}\n')
        with pytest.raises(DatasetError, match="sharpen: expected true or false"):
            load_recipe(path)
