"""One network on the same scenes by several renderers."""

import dataclasses
import shutil

import numpy as np
import pytest

from linna.cli import run
from payload_emulator.errors import DatasetError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.training.data.dataset import Dataset, write_gray
from studies.domain import common_scenes, compare_renderers, format_domains, renderer_of


@pytest.fixture(scope="module")
def pair(make_blob_dataset, tmp_path_factory):
    """The same four scenes twice; in the second the pictures of two are plain."""
    folder = tmp_path_factory.mktemp("domain")
    one = make_blob_dataset(folder / "one", {"test": 4})
    shutil.copytree(folder / "one", folder / "other")
    other = Dataset(folder / "other")
    for number in (0, 1):
        gray = (np.indices((512, 512)).sum(axis=0) % 7 + 100).astype(np.uint8)
        write_gray(other.folder / "images" / f"{number:06d}.png", gray)
    other.index["recipe"]["renderer"] = "cycles"
    return one, other


@pytest.fixture(scope="module")
def figures(pair):
    return compare_renderers(load_shipped_model(), pair, threshold=0.3)


def test_the_reference_differs_from_itself_by_nothing(figures):
    row = figures["renderers"][0]["all"]["strict"]
    assert row["f1_less_reference"] == 0.0 and row["f1_less_reference_interval_95"] == [0.0, 0.0]


def test_craters_that_one_renderer_does_not_show_are_missed_against_the_references_labels(figures):
    reference, other = (row["all"]["strict"] for row in figures["renderers"])
    assert other["expected"] == reference["expected"] > 30
    assert 0 < other["detected_true"] < 0.7 * reference["detected_true"]
    low, high = other["f1_less_reference_interval_95"]
    assert other["f1_less_reference"] == pytest.approx(other["f1"] - reference["f1"])
    assert low <= other["f1_less_reference"] < 0.0
    # Blocks are frames here: drawings with both plain ones twice, and with neither, are among the 400.
    assert low < -0.3 and high >= -0.2


def test_figures_name_the_renderers_the_level_and_the_data(figures):
    assert [row["renderer"] for row in figures["renderers"]] == ["fast", "cycles"]
    assert figures["level"] == "2 (procedural Moon, held out)" and figures["data"] == ["blobs"]
    text = format_domains(figures)
    assert "cycles, all, ignore-aware" in text and "level 2" in text


def test_scenes_that_differ_are_left_out_and_none_in_common_is_an_error(pair):
    one, other = pair
    assert renderer_of(one) == "fast"
    moved = Dataset(other.folder)
    moved._frames[2] = dataclasses.replace(moved._frames[2], sun_camera=np.array([0.98, 0.0, -0.17]))
    assert [frames[0].number for frames in common_scenes([one, moved], "test")] == [0, 1, 3]
    with pytest.raises(DatasetError, match="expected frames of the same scenes in split 'train', found none"):
        common_scenes(pair, "train")
    with pytest.raises(DatasetError, match="two renderers or more, found 1"):
        compare_renderers(b"", [one])


def test_the_command_holds_renderers_to_the_reference(pair, capsys):
    folders = [str(dataset.folder) for dataset in pair]
    command = ["detector", "domain", "--dataset", *folders, "--threshold", "0.3", "--json"]
    assert run([*command, "--within", "0.05"]) == 1
    assert "F1 expected within 0.05 of the reference, found -0." in capsys.readouterr().err
    assert run([*command, "--within", "1"]) == 0
    assert '"f1_less_reference_interval_95"' in capsys.readouterr().out
