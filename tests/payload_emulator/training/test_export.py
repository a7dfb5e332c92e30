"""What is exported is what was trained: parity, origin, the paper's variant, eight bits."""

import json
from dataclasses import replace

import numpy as np
import pytest

from payload_emulator.errors import ModelError
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.training.data.feeder import TrainParameters
from payload_emulator.training.evaluate.evaluate import evaluate
from payload_emulator.training.model.export import PARITY_LIMIT, export
from payload_emulator.training.model.train import train

ONE_STEP = TrainParameters(
    minutes=0.0, steps=1, batch=2, crop_px=96, validation_frames=1, replicas=1, detail_blocks=0
)


@pytest.fixture(scope="module")
def exported(blob_dataset, tmp_path_factory):
    run = tmp_path_factory.mktemp("export")
    train([blob_dataset], run, ONE_STEP)
    path = run / "m.onnx"
    figures = export(
        run / "checkpoint.pt", path, [blob_dataset], revision="abc", paper_classes=True, test=True
    )
    return path.read_bytes(), figures


def test_an_exported_network_agrees_with_torch_and_carries_its_origin(exported, blob_dataset):
    octets, figures = exported
    assert figures["parity_max_abs"] <= PARITY_LIMIT
    metadata = OnnxDetector(octets).metadata
    assert metadata["git_revision"] == "abc"
    assert metadata["training_seed"] == "1"
    assert json.loads(metadata["data"])[0]["labels_sha256"] == blob_dataset.digest
    assert float(metadata["score_threshold"]) == figures["score_threshold"]
    tested = json.loads(metadata["test_figures"])["test"]
    assert set(tested) == {"frames", "level", "strict", "ignore_aware"}


def test_the_papers_variant_keeps_its_class_heatmaps_and_is_scored_by_them(exported, blob_dataset):
    octets, _ = exported
    detector = OnnxDetector(octets)
    heatmap, geometry = detector.run_network(np.zeros((1, 1, 512, 512), np.float32))
    assert heatmap.shape[1] == 4 and geometry.shape[1] == 5
    scored = evaluate(octets, blob_dataset, threshold=0.01, paper_classes=True)
    assert [row["size_class"] for row in scored["per_class"]] == [0, 1, 2]


def test_a_network_without_class_heatmaps_is_no_papers_variant(blob_dataset, tmp_path):
    train([blob_dataset], tmp_path, replace(ONE_STEP, paper_classes=False, depth=False))
    with pytest.raises(ModelError, match="expected a network with the paper's class heatmaps"):
        export(tmp_path / "checkpoint.pt", tmp_path / "p.onnx", [], paper_classes=True)
