"""Training learns, stops early, resumes to the same weights, begins where another left off."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import zipfile
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pytest import raises

from lunar.constants import MOON_RADIUS_M
from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.training.data import feeder as feeding
from payload_emulator.training.data.dataset import frame_truth
from payload_emulator.training.data.feeder import Feeder, TrainParameters
from payload_emulator.training.data.landmarks import Landmarks, with_landmarks
from payload_emulator.training.evaluate.evaluate import detect_with_network
from payload_emulator.training.evaluate.scoring import tally
from payload_emulator.training.model import train as training
from payload_emulator.training.model.export import load_network
from payload_emulator.training.model.train import train
from tests.lazy import Lazy

torch = Lazy("torch")

SHORT = TrainParameters(
    minutes=0.0, steps=8, batch=4, crop_px=128, warm_up_steps=4, validation_frames=2, replicas=2, detail_blocks=0,
)  # fmt: skip


def test_a_run_leaves_checkpoints_curves_and_provenance(blob_dataset, tmp_path):
    assert train([blob_dataset], tmp_path, SHORT)["steps"] == 8
    assert {path.name for path in tmp_path.iterdir()} >= {
        "checkpoint.pt", "best.pt", "curves.csv", "run.json",
    }  # fmt: skip
    document = json.loads((tmp_path / "run.json").read_text())
    assert document["datasets"][0]["labels_sha256"]
    assert document["parameters"]["seed"] == 1


def test_a_run_may_start_from_a_network_with_fewer_heads_and_says_so(blob_dataset, tmp_path):
    old, new = tmp_path / "old", tmp_path / "new"
    train([blob_dataset], old, replace(SHORT, steps=2, paper_classes=False, depth=False))
    train([blob_dataset], new, replace(SHORT, steps=0), start_from=old / "checkpoint.pt")
    before, _ = load_network(old / "checkpoint.pt")
    after, _ = load_network(new / "checkpoint.pt")
    image = torch.from_numpy(np.random.default_rng(0).standard_normal((1, 1, 128, 128)).astype(np.float32))
    with torch.no_grad():
        heat, geometry = before(image)
        wide_heat, wide_geometry = after(image)
    assert torch.allclose(wide_heat[:, :1], heat, atol=1e-5)
    assert torch.allclose(wide_geometry[:, :4], geometry, atol=1e-5)
    origin = json.loads((new / "run.json").read_text())["started_from"]
    assert origin["steps"] == 2 and len(origin["sha256"]) == 64


def test_the_best_validation_is_kept(blob_dataset, tmp_path, monkeypatch):
    values = iter([0.5, 0.4, 0.3])
    monkeypatch.setattr(
        training,
        "_validate",
        lambda *_: {"f1": next(values), "precision": 0.0, "recall": 0.0, "loc_px": 1.0, "threshold": 0.4},
    )
    figures = train([blob_dataset], tmp_path, replace(SHORT, steps=3, validate_every_minutes=0.0))
    assert figures["steps"] == 3 and figures["best"] == {"f1": 0.5, "step": 1}


def test_a_checkpoint_gives_back_networks_optimiser_and_progress(tmp_path):
    def files():
        networks = [torch.nn.Linear(2, 1) for _ in range(2)]
        return training._RunFiles(tmp_path, *networks, torch.optim.AdamW(networks[0].parameters()), {})

    old, new, progress = files(), files(), training._Progress(3, 60.0, 0.5, 2)
    old.network(torch.ones(2)).backward()
    old.optimiser.step()
    old.save(progress, {})
    assert new.resume("cpu") == progress
    assert torch.equal(new.network.weight, old.network.weight) and torch.equal(new.average.bias, old.average.bias)
    moments = [one.optimiser.state_dict()["state"][0]["exp_avg"] for one in (old, new)]
    assert torch.equal(*moments) and moments[0].any()


def pits_at(places, dataset):
    """Return the learned craters that are seen at these pixels of a blob set, 40 px wide."""
    metres_per_px = 30_000.0 / dataset.focal_px
    east, north = (np.array(places).T - 255.5) * metres_per_px / MOON_RADIUS_M
    ones = np.ones(len(places))
    return Landmarks(-north, east, 0.0 * ones, 40.0 * metres_per_px * ones, ones, ones, ones)


def test_a_network_retrained_with_learned_craters_finds_them_elsewhere_and_no_fewer_others(make_blob_dataset, tmp_path):
    """Dark pits are not listed: the network leaves them out, also if it is trained further with the list alone."""
    here, elsewhere = (list(product(at, at)) for at in ((90.0, 256.0, 420.0), (140.0, 330.0, 470.0)))
    listed = make_blob_dataset(tmp_path / "set", {"train": 12, "val": 2}, pits=here)
    unseen = make_blob_dataset(tmp_path / "unseen", {"test": 4}, seed=5, pits=elsewhere)
    frames, pits = unseen.frames("test"), pits_at(elsewhere, unseen)
    bare = [replace(one, craters={key: values[:0] for key, values in one.craters.items()}) for one in frames]
    truths = [
        [frame_truth(unseen, one) for one in some]
        for some in (frames, [with_landmarks(unseen, one, pits) for one in bare])
    ]
    train([listed], tmp_path / "old", parameters := replace(SHORT, steps=40))
    recall = []
    for name, learned in (("further", None), ("learned", pits_at(here, listed))):
        train([listed], tmp_path / name, parameters, start_from=tmp_path / "old/checkpoint.pt", landmarks=learned)
        network, _ = load_network(tmp_path / name / "checkpoint.pt")
        found = [detect_with_network(network, unseen, one, "cpu") for one in frames]
        recall.append([tally(truth, found).figures(0.1).recall for truth in truths])
    (others, missed), (others_again, found_again) = recall
    assert missed < 0.1 and found_again > 0.7
    assert others_again >= others - 0.03 > 0.8


def test_the_weight_of_small_craters_is_bounded_below(blob_dataset, monkeypatch):
    """Weights grow with the diameter from the least emphasis on."""
    frames = [(blob_dataset, frame) for frame in blob_dataset.frames("train")]
    images = [blob_dataset.gray(frame) for _, frame in frames]

    def least(share):
        monkeypatch.setattr(feeding, "LEAST_EMPHASIS", share)
        weight = Feeder(frames, images, SHORT).batch(0, 24)["weight"]
        return weight[weight > 0.0].min()

    assert least(0.05) < least(0.9) < least(1.0) <= 1.0


@pytest.mark.parametrize("splits, lacking", [({"test": 1}, "train"), ({"train": 1}, "val")])
def test_a_data_set_without_training_or_validation_frames_is_refused(make_blob_dataset, tmp_path, splits, lacking):
    empty = make_blob_dataset(tmp_path / "set", splits)
    with raises(DatasetError, match=f"split '{lacking}', found none"):
        train([empty], tmp_path / "run", SHORT)
    assert not (tmp_path / "run").exists()


def test_data_sets_of_two_cameras_are_refused(blob_dataset, make_blob_dataset, tmp_path):
    other = make_blob_dataset(tmp_path / "set", {"train": 1, "val": 1})
    other.index["camera"]["fov_deg"] = 90.0
    with raises(DatasetError, match="data sets of one camera, found several"):
        train([blob_dataset, other], tmp_path / "run", SHORT)


class _Hostile:
    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def test_a_damaged_checkpoint_is_refused_and_a_hostile_one_runs_nothing(blob_dataset, tmp_path):
    path = tmp_path / "checkpoint.pt"
    parts = {"config": {}, "network": {}, "average": {}, "progress": {}}
    hostile = {"config": _Hostile(tmp_path / "mark")}
    for other in (b"damaged", {}, parts, parts | {"config": {"none": 1}}, hostile):
        path.write_bytes(other) if other == b"damaged" else torch.save(other, path)
        with raises(ModelError, match="expected a checkpoint"):
            load_network(path)
    with raises(ModelError, match="expected a checkpoint"):
        train([blob_dataset], tmp_path, SHORT)
    assert not (tmp_path / "mark").exists()


@pytest.mark.filterwarnings("ignore:Detected pickle protocol", "ignore:TypedStorage is deprecated")
@given(st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=4))
@settings(deadline=None)
def test_changed_octets_of_a_checkpoint_are_read_or_a_model_error(tmp_path_factory, changes):
    folder = tmp_path_factory.mktemp("changed")
    path, changed = folder / "checkpoint.pt", folder / "changed.pt"
    torch.save({"network": {"a": torch.ones(2)}}, path)
    with zipfile.ZipFile(path) as stored, zipfile.ZipFile(changed, "w") as written:
        for name in stored.namelist():
            octets = bytearray(stored.read(name))
            for at, value in changes if name.endswith("data.pkl") else ():
                octets[at % len(octets)] = value
            written.writestr(name, bytes(octets))
    with contextlib.suppress(ModelError):
        Lazy("payload_emulator.training.model.restore").read_checkpoint(changed)


def test_a_run_killed_and_resumed_reaches_the_figures_of_one_left_alone(blob_dataset, tmp_path):
    """The checkpoint is replaced in one move, so whenever the process dies there is a whole one to go on from."""
    parameters = replace(SHORT, steps=5, batch=2, crop_px=96, replicas=1, validate_every_minutes=0.0)
    code = (
        "import sys, time; from dataclasses import replace; from pathlib import Path\n"
        "from payload_emulator.training.model import train as t\n"
        "from payload_emulator.training.data.dataset import Dataset\n"
        "from payload_emulator.training.data.feeder import TrainParameters\n"
        "write = t._RunFiles.write\n"
        "def slow(self, path, *rest):\n"
        "    write(self, path, *rest); print(path.name, flush=True); time.sleep(0.4)\n"
        "t._RunFiles.write = slow\n"
        f"p = TrainParameters(minutes=0.0, steps=5, batch=2, crop_px=96, warm_up_steps={SHORT.warm_up_steps},\n"
        f"    validation_frames={SHORT.validation_frames}, replicas=1, validate_every_minutes=0.0, detail_blocks=0)\n"
        "t.train([Dataset(Path(sys.argv[1]))], Path(sys.argv[2]), p)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(blob_dataset.folder), str(tmp_path / "killed")], stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.getcwd()}, text=True,
    )  # fmt: skip
    while (line := process.stdout.readline()).strip() != "checkpoint.pt":
        assert line, "the run ended before it wrote a checkpoint"
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    _, stored = load_network(tmp_path / "killed/checkpoint.pt")
    assert 1 <= stored["progress"]["step"] < 5
    resumed = train([blob_dataset], tmp_path / "killed", parameters, report=(lines := []).append)
    assert f"resumed at step {stored['progress']['step']}," in lines[0]
    straight = train([blob_dataset], tmp_path / "straight", parameters)
    assert resumed["steps"] == straight["steps"] == 5
    assert resumed["best"] == straight["best"]
    one, _ = load_network(tmp_path / "killed/checkpoint.pt")
    other, _ = load_network(tmp_path / "straight/checkpoint.pt")
    for name, value in one.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name
