"""Latency and memory of the flight detector on this machine."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.flight.vision.preprocess import prepare_image


def bench(model_octets: bytes, threads: int = 1, frames: int = 100, seed: int = 0) -> dict[str, float | int]:
    """Median and 99th percentile of whole detections, of the network alone and of the preparation, in ms; peak memory.

    The `cpu_` ones are processor time of the calling thread, which a neighbour on the machine disturbs less (with more
    than one thread they leave the others out).

    The frame is noise over a gradient: the network's time does not depend on what it sees, and the few peaks that noise
    gives cost as much as a frame of craters.
    """
    detector = OnnxDetector(model_octets, threads=threads)
    rng = np.random.default_rng(seed)
    frame = rng.integers(20, 235, (512, 512, 3), dtype=np.uint8)
    sun = np.array([0.0, -1.0, -0.2])
    whole, network, preparation = [], [], []
    whole_cpu, network_cpu = [], []
    for count in range(frames + 5):
        began, began_cpu = time.perf_counter(), time.thread_time()
        detector.detect(frame, sun)
        done, done_cpu = time.perf_counter(), time.thread_time()
        gray = prepare_image(frame).gray
        prepared, prepared_cpu = time.perf_counter(), time.thread_time()
        detector.run_network(gray[None, None])
        ran, ran_cpu = time.perf_counter(), time.thread_time()
        if count >= 5:
            whole.append(done - began)
            preparation.append(prepared - done)
            network.append(ran - prepared)
            whole_cpu.append(done_cpu - began_cpu)
            network_cpu.append(ran_cpu - prepared_cpu)
    return {
        "median_ms": 1e3 * float(np.median(whole)),
        "p99_ms": 1e3 * float(np.percentile(whole, 99)),
        "network_median_ms": 1e3 * float(np.median(network)),
        "cpu_median_ms": 1e3 * float(np.median(whole_cpu)),
        "network_cpu_median_ms": 1e3 * float(np.median(network_cpu)),
        "preparation_median_ms": 1e3 * float(np.median(preparation)),
        "peak_rss_mb": peak_rss_mb(),
        "model_bytes": len(model_octets),
        "threads": threads,
        "frames": frames,
    }


def compare_models(
    models: Mapping[str, bytes], rounds: int = 40, seed: int = 0
) -> dict[str, dict[str, float]]:
    """Time of each model's network and of whole detections, ms, taken in turn so that a neighbour hits all alike.

    Medians over `rounds` of one thread: `cpu_` is its processor time, the others by the clock. `of_first` is the
    network's processor time over that of the first model.
    """
    detectors = {name: OnnxDetector(octets) for name, octets in models.items()}
    frame = np.random.default_rng(seed).integers(20, 235, (512, 512, 3), dtype=np.uint8)
    tile = prepare_image(frame).gray[None, None]
    sun = np.array([0.0, -1.0, -0.2])
    times: dict[str, list[tuple[float, ...]]] = {name: [] for name in detectors}
    for count in range(rounds + 3):
        for name, detector in detectors.items():
            marks = [(time.perf_counter(), time.thread_time())]
            detector.run_network(tile)
            marks.append((time.perf_counter(), time.thread_time()))
            detector.detect(frame, sun)
            marks.append((time.perf_counter(), time.thread_time()))
            if count >= 3:
                steps = [(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(marks)]
                times[name].append((*steps[0], *steps[1]))
    medians = {name: 1e3 * np.median(np.array(kept), axis=0) for name, kept in times.items()}
    first = next(iter(medians.values()))
    names = ("network_ms", "cpu_network_ms", "whole_ms", "cpu_whole_ms")
    return {
        name: {
            **{key: float(value) for key, value in zip(names, row, strict=True)},
            "of_first": float(row[1] / first[1]),
        }
        for name, row in medians.items()
    }


def prototype_model() -> bytes:
    """The untrained network of the first studies, as they exported it: MobileNetV3-small, stride 4, 64 channels.

    They measured 6.2 ms for it on one thread of their machine, so that a time here can be told apart from a machine.
    """
    import io

    import onnx

    from payload_emulator.training.model.export import onnx_model
    from payload_emulator.training.model.model import CraterNet, ExportedCraterNet, ModelConfig

    network = CraterNet(ModelConfig(pyramid_channels=64, detail_blocks=0)).eval()
    buffer = io.BytesIO()
    onnx.save(onnx_model(ExportedCraterNet(network).eval()), buffer)
    return buffer.getvalue()


def peak_rss_mb() -> float:
    """Greatest resident memory of this process so far, MB; NaN where the system does not tell."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    except OSError:
        pass
    return float("nan")
