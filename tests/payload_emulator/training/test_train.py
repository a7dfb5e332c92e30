"""Training learns, resumes to the same weights, and exports what it trained."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from payload_emulator.errors import DatasetError, ModelError  # noqa: E402
from payload_emulator.flight.detector import OnnxDetector  # noqa: E402
from payload_emulator.training import train as training  # noqa: E402
from payload_emulator.training.export import PARITY_LIMIT, export, load_network  # noqa: E402
from payload_emulator.training.train import TrainParameters, train  # noqa: E402

SHORT = TrainParameters(
    minutes=0.0,
    steps=8,
    batch=4,
    crop_px=128,
    warm_up_steps=4,
    validation_frames=2,
    replicas=2,
    detail_blocks=0,
)


@pytest.fixture(scope="module")
def finished(blob_dataset, tmp_path_factory):
    run = tmp_path_factory.mktemp("run")
    figures = train([blob_dataset], run, SHORT)
    return run, figures


def test_a_run_leaves_checkpoints_curves_and_provenance(finished):
    run, figures = finished
    assert figures["steps"] == 8
    assert {path.name for path in run.iterdir()} >= {
        "checkpoint.pt",
        "best.pt",
        "curves.csv",
        "curves.png",
        "run.json",
    }
    document = json.loads((run / "run.json").read_text())
    assert document["datasets"][0]["labels_sha256"]
    assert document["parameters"]["seed"] == 1


def test_a_run_stopped_and_resumed_ends_at_the_same_weights(finished, blob_dataset, tmp_path, monkeypatch):
    run, _ = finished
    finish = training._finished
    monkeypatch.setattr(training, "_finished", lambda state, parameters: state.step >= 4)
    train([blob_dataset], tmp_path, SHORT)
    monkeypatch.setattr(training, "_finished", finish)
    lines = []
    train([blob_dataset], tmp_path, SHORT, report=lines.append)
    assert any("resumed at step 4" in line for line in lines)
    straight, _ = load_network(run / "checkpoint.pt")
    resumed, _ = load_network(tmp_path / "checkpoint.pt")
    for name, value in straight.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_the_loss_falls_on_blobs(blob_dataset, tmp_path):
    losses = []
    original = training._Team.step

    def recorded(self, *arguments):
        terms = original(self, *arguments)
        losses.append(terms[0])
        return terms

    training._Team.step = recorded
    try:
        train(
            [blob_dataset],
            tmp_path,
            TrainParameters(
                minutes=0.0,
                steps=24,
                batch=4,
                crop_px=128,
                warm_up_steps=4,
                validation_frames=1,
                detail_blocks=0,
            ),
        )
    finally:
        training._Team.step = original
    assert np.mean(losses[-4:]) < 0.8 * np.mean(losses[:4])


def test_an_exported_network_agrees_with_torch_and_carries_its_origin(finished, blob_dataset, tmp_path):
    run, _ = finished
    figures = export(run / "checkpoint.pt", tmp_path / "m.onnx", [blob_dataset], revision="abc")
    assert figures["parity_max_abs"] <= PARITY_LIMIT
    detector = OnnxDetector((tmp_path / "m.onnx").read_bytes())
    assert detector.metadata["git_revision"] == "abc"
    assert json.loads(detector.metadata["data"])[0]["labels_sha256"] == blob_dataset.digest
    assert float(detector.metadata["score_threshold"]) == figures["score_threshold"]


def test_a_data_set_without_training_frames_is_refused(make_blob_dataset, tmp_path):
    empty = make_blob_dataset(tmp_path / "set", {"test": 1})
    with pytest.raises(DatasetError, match="split 'train'"):
        train([empty], tmp_path / "run", SHORT)


def test_a_damaged_checkpoint_is_refused(tmp_path):
    (tmp_path / "x.pt").write_bytes(b"damaged")
    with pytest.raises(ModelError, match="expected a checkpoint"):
        load_network(tmp_path / "x.pt")


def test_a_killed_run_keeps_a_checkpoint_that_can_be_read(blob_dataset, tmp_path):
    """The file is replaced in one move, so whenever the process dies there is a whole one or none."""
    code = (
        "import sys; from pathlib import Path\n"
        "from payload_emulator.training import train as t; from payload_emulator.training.dataset import Dataset\n"
        "save = t._save\n"
        "def slow(path, *rest):\n"
        "    save(path, *rest); print('saved', flush=True)\n"
        "t._save = slow\n"
        "p = t.TrainParameters(minutes=0.0, steps=500, batch=2, crop_px=96, validation_frames=1, replicas=1,\n"
        "    validate_every_minutes=0.0, detail_blocks=0)\n"
        "t.train([Dataset(Path(sys.argv[1]))], Path(sys.argv[2]), p)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(blob_dataset.folder), str(tmp_path)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.getcwd()},
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline().strip() == "saved"
    assert process.stdout.readline().strip() == "saved"
    time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    _, stored = load_network(tmp_path / "checkpoint.pt")
    assert stored["progress"]["step"] >= 1
