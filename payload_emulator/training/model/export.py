"""From a training run to the network that flies: ONNX, parity check, thresholds and provenance in its metadata."""

import io
import json
import logging
import resource
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar.catalogue import size_class
from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.vision.detector import GEOMETRY_NAME, HEATMAP_NAME, INPUT_NAME, INPUT_SIZE_PX, OnnxDetector
from payload_emulator.flight.vision.preprocess import Preparation, prepare_image
from payload_emulator.training.data.dataset import Dataset, write_whole
from payload_emulator.training.model.calibrate import Calibration, calibrate, paper_threshold

PARITY_LIMIT = 2e-4
"""Greatest difference allowed between torch and ONNX Runtime: far under one count of a score in telemetry (1/255)."""

INPUT_CONVENTION = "float32 (1, 1, 512, 512): square root of gray, zero mean, unit deviation, clipped at 4; Sun-up"
OUTPUT_CONVENTION = (
    "heatmap probability (1, 1 or 4, 128, 128): any crater, then the paper's classes in the paper's variant; geometry "
    "(1, 4 or 5, 128, 128): right, down in cells, ln(diameter / 16 px), ln(sigma / 1 px), ten times depth/diameter"
)


def load_network(path: Path) -> tuple[Any, dict[str, Any]]:
    """The averaged network of a checkpoint in evaluation mode, and the checkpoint's document."""
    from payload_emulator.training.model.model import CraterNet, parse_config
    from payload_emulator.training.model.restore import read_checkpoint, reading

    stored = read_checkpoint(path)
    with reading(path):
        network = CraterNet(parse_config(stored["config"]))
        network.load_state_dict(stored["average"])
    return network.eval(), stored


def export(
    checkpoint: Path,
    out: Path,
    datasets: Sequence[Dataset],
    revision: str = "",
    *,
    paper_classes: bool = False,
    classes_only: bool = False,
    enlarge: int = 0,
    test: bool = False,
) -> dict[str, Any]:
    """Write the ONNX network of a checkpoint; its parity with torch and its metadata come back.

    `paper_classes` keeps the class heatmaps of a network that has them; `classes_only` keeps only these and the
    offsets, as in the paper: the network flies with the median diameters of the data set's classes as a prior. `test`
    scores the test splits, source by source, at the thresholds fixed on validation, and writes the figures into the
    model. An exported network in place of a checkpoint gets new thresholds and corrections; `enlarge` makes it enlarge
    images so many times first.

    Raises
    ------
    ModelError
        The checkpoint cannot be read, lacks class heatmaps, or torch and ONNX Runtime disagree by more than
        `PARITY_LIMIT`.
    """
    from payload_emulator.training.model.model import ExportedCraterNet
    from payload_emulator.training.model.restore import enlarging, network_from_onnx

    is_exported = checkpoint.suffix == ".onnx"
    network, stored = network_from_onnx(checkpoint) if is_exported else load_network(checkpoint)
    if enlarge:
        network = enlarging(network, enlarge)
        stored = stored | {"config": network.config.to_dict()}
    paper_classes = paper_classes or classes_only
    if paper_classes and network.heat_channels == 1:
        raise ModelError(f"{checkpoint}: expected a network with the paper's class heatmaps, found one without")
    calibration = calibrate(network, datasets)
    heats = network.heat_channels if paper_classes else 1
    exported = ExportedCraterNet(network, calibration.geometry_shift, heats, classes_only=classes_only).eval()
    model = keep_blocked(onnx_model(exported))
    metadata = _metadata(stored, calibration, checkpoint, datasets) | {"git_revision": revision}
    if classes_only:
        metadata["class_median_diameter_m"] = json.dumps(class_medians_m(datasets))
    octets = _with_metadata(model, metadata)
    if paper_classes:
        metadata["paper_threshold"] = str(_paper_threshold(octets, datasets))
        if classes_only:
            metadata["score_threshold"] = metadata["paper_threshold"]
        octets = _with_metadata(model, metadata)
    difference = parity(exported, octets)
    if difference > PARITY_LIMIT:
        raise ModelError(f"{out}: expected torch and ONNX to agree within {PARITY_LIMIT:g}, found {difference:.2g}")
    tested: dict[str, Any] = {}
    if test:
        tested = _test_figures(octets, datasets, paper_classes)
        octets = _with_metadata(model, metadata | {"test_figures": json.dumps(tested)})
    out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, octets)
    return {
        "model": str(out),
        "model_bytes": len(octets),
        "parity_max_abs": difference,
        "geometry_shift": list(calibration.geometry_shift),
        "parallax_per_px": calibration.parallax_per_px,
        "parallax_error_per_px": calibration.parallax_error,
        "score_threshold": calibration.score_threshold,
        "f1_threshold": calibration.f1_threshold,
        "navigation_threshold": calibration.navigation_threshold,
        "validation": calibration.figures,
        "test": tested,
    }


def class_medians_m(datasets: Sequence[Dataset]) -> list[float]:
    """Median diameter of the craters of each of the paper's classes in the training frames, m.

    Raises
    ------
    DatasetError
        A class has no crater there.
    """
    frames = [frame for dataset in datasets for frame in dataset.frames("train")]
    listed = [(frame.craters["id"], frame.craters["diameter_m"]) for frame in frames]
    diameter_m = np.concatenate([sizes[ids >= 0] for ids, sizes in listed]) if listed else np.zeros(0)
    classes = size_class(diameter_m.astype(np.float64))
    counts = [int(np.count_nonzero(classes == k)) for k in range(3)]
    if min(counts) == 0:
        raise DatasetError(f"class medians: expected craters of three classes in training frames, found {counts}")
    return [round(float(np.median(diameter_m[classes == k])), 1) for k in range(3)]


def onnx_model(exported: Any) -> Any:
    """The ONNX model of an `ExportedCraterNet`."""
    import torch

    example = torch.zeros(1, 1, INPUT_SIZE_PX, INPUT_SIZE_PX)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            exported,
            (example,),
            dynamo=True,
            input_names=[INPUT_NAME],
            output_names=[HEATMAP_NAME, GEOMETRY_NAME],
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    del model.graph.metadata_props[:]
    for node in model.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    return model


def keep_blocked(model: Any) -> Any:
    """The model with squeeze-excite gates in a form that ONNX Runtime runs without leaving its blocked layout.

    It knows the mean over the image as a pooling, and products only of maps of one size: means become poolings and
    gates are enlarged to the size of what they weigh. The same values, and two changes of layout fewer per gate.
    """
    import onnx
    from onnx import helper, numpy_helper

    inferred = onnx.shape_inference.infer_shapes(model).graph
    shape = {
        value.name: [size.dim_value for size in value.type.tensor_type.shape.dim]
        for value in (*inferred.value_info, *inferred.input, *inferred.output)
    }
    nodes = []
    for node in list(model.graph.node):
        if node.op_type == "ReduceMean" and _spatial_mean(node, shape):
            node.op_type = "GlobalAveragePool"
            del node.input[1:]
            del node.attribute[:]
        elif node.op_type == "Mul":
            for k, (gate, picture) in enumerate((node.input, (node.input[1], node.input[0]))):
                small, large = shape.get(gate, []), shape.get(picture, [])
                spread = len(small) == len(large) == 4 and small[2:] == [1, 1] and small[:2] == large[:2]
                if spread and small != large:
                    name = f"{gate}_enlarged"
                    scales = np.array([1.0, 1.0, *large[2:]], np.float32)
                    model.graph.initializer.append(numpy_helper.from_array(scales, f"{name}_scales"))
                    nodes.append(
                        helper.make_node(
                            "Resize",
                            [gate, "", f"{name}_scales"],
                            [name],
                            mode="nearest",
                            coordinate_transformation_mode="asymmetric",
                            nearest_mode="floor",
                        )
                    )
                    node.input[k] = name
                    break
        nodes.append(node)
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    return model


def _spatial_mean(node: Any, shape: dict[str, list[int]]) -> bool:
    """Return whether a mean is taken over height and width and leaves them as 1."""
    before, after = shape.get(node.input[0], []), shape.get(node.output[0], [])
    return len(before) == len(after) == 4 and before[:2] == after[:2] and after[2:] == [1, 1]


def _with_metadata(model: Any, metadata: dict[str, str]) -> bytes:
    import onnx

    del model.metadata_props[:]
    onnx.helper.set_model_props(model, metadata)
    buffer = io.BytesIO()
    onnx.save(model, buffer)
    return buffer.getvalue()


def _metadata(
    stored: dict[str, Any], calibration: Calibration, checkpoint: Path, datasets: Sequence[Dataset]
) -> dict[str, str]:
    run = checkpoint.parent / "run.json"
    trained = json.loads(run.read_text(encoding="utf-8")) if run.is_file() else {}
    return {
        "project": "linna crater detector",
        "input": INPUT_CONVENTION,
        "outputs": OUTPUT_CONVENTION,
        "score_threshold": str(calibration.score_threshold),
        "f1_threshold": str(calibration.f1_threshold),
        "navigation_threshold": str(calibration.navigation_threshold),
        "geometry_shift": json.dumps([round(value, 5) for value in calibration.geometry_shift]),
        **({"camera_fov_deg": f"{datasets[0].index['camera']['fov_deg']:g}"} if datasets else {}),
        "preparation": str(stored["config"].get("preparation", Preparation.gray_first)),
        "parallax_per_px": f"{calibration.parallax_per_px:.3g}",
        "validation": json.dumps(calibration.figures),
        "training_steps": str(stored["progress"]["step"]),
        "training_minutes": f"{stored['progress']['seconds'] / 60:.1f}",
        "training_seed": str(trained.get("parameters", {}).get("seed", "")),
        "training_started_from": json.dumps(trained.get("started_from")),
        "model_config": json.dumps(stored["config"]),
        "data": json.dumps(
            trained.get("datasets")
            or [{"name": d.index["name"], "labels_sha256": d.digest, "data": d.index["data"]} for d in datasets]
        ),
    }


def _paper_threshold(octets: bytes, datasets: Sequence[Dataset]) -> float:
    from payload_emulator.training.evaluate.evaluate import open_for_evaluation, run

    if not any(dataset.frames("val") for dataset in datasets):
        return 0.4
    scored = run(open_for_evaluation(octets), datasets, "val", paper_classes=True)
    return paper_threshold(scored.truths, scored.found)


def _test_figures(octets: bytes, datasets: Sequence[Dataset], paper_classes: bool) -> dict[str, Any]:
    from payload_emulator.training.evaluate.evaluate import evaluate

    kept = ("precision", "recall", "f1", "loc_px", "loc_median_px")
    tested: dict[str, Any] = {}
    for source in sorted({frame.source for dataset in datasets for frame in dataset.frames("test")}):
        figures = evaluate(octets, datasets, "test", source, paper_classes=paper_classes)
        tested[source] = {
            "frames": figures["frames"],
            "level": figures["level"],
            "strict": {key: round(figures["micro"][key], 4) for key in kept},
            "ignore_aware": {key: round(figures["ignore_aware"][key], 4) for key in kept},
        }
    return tested


def parity(exported: Any, octets: bytes) -> float:
    """Greatest difference between torch and the flight detector's runtime over random images."""
    import torch

    detector = OnnxDetector(octets)
    rng = np.random.default_rng(0)
    worst = 0.0
    for _ in range(3):
        image = rng.standard_normal((1, 1, INPUT_SIZE_PX, INPUT_SIZE_PX)).astype(np.float32)
        with torch.no_grad():
            expected = [part.numpy() for part in exported(torch.from_numpy(image))]
        found = detector.run_network(image)
        worst = max(worst, *(float(np.abs(a - b).max()) for a, b in zip(expected, found, strict=True)))
    return worst


def bench(model_octets: bytes, threads: int = 1, frames: int = 100) -> dict[str, float]:
    """Return median and 99th percentile of whole detections in ms, processor times in ms, and peak memory in MB.

    The `cpu_` ones are processor time of the calling thread, which a neighbour on the machine disturbs less.

    The frame is noise over a gradient: the network's time does not depend on what it sees, and the few peaks that noise
    gives cost as much as a frame of craters.
    """
    detector = OnnxDetector(model_octets, threads=threads)
    frame = np.random.default_rng(0).integers(20, 235, (512, 512, 3), dtype=np.uint8)
    sun = np.array([0.0, -1.0, -0.2])
    whole, whole_cpu, network_cpu = [], [], []
    for count in range(frames + 5):
        began, began_cpu = time.perf_counter(), time.thread_time()
        detector.detect(frame, sun)
        done, done_cpu = time.perf_counter(), time.thread_time()
        gray = prepare_image(frame).gray
        prepared_cpu = time.thread_time()
        detector.run_network(gray[None, None])
        if count >= 5:
            whole.append(done - began)
            whole_cpu.append(done_cpu - began_cpu)
            network_cpu.append(time.thread_time() - prepared_cpu)
    return {
        "median_ms": 1e3 * float(np.median(whole)),
        "p99_ms": 1e3 * float(np.percentile(whole, 99)),
        "cpu_median_ms": 1e3 * float(np.median(whole_cpu)),
        "network_cpu_median_ms": 1e3 * float(np.median(network_cpu)),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "model_bytes": len(model_octets),
    }
