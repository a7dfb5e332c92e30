"""Latency and memory of the flight detector on this machine."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.flight.vision.preprocess import prepare_image


def bench(model_octets: bytes, threads: int = 1, frames: int = 100) -> dict[str, float | int]:
    """Median and 99th percentile of whole detections, of the network alone and of the preparation, in ms; peak memory.

    The `cpu_` ones are processor time of the calling thread, which a neighbour on the machine disturbs less (with more
    than one thread they leave the others out).

    The frame is noise over a gradient: the network's time does not depend on what it sees, and the few peaks that noise
    gives cost as much as a frame of craters.
    """
    detector = OnnxDetector(model_octets, threads=threads)
    rng = np.random.default_rng(0)
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


def peak_rss_mb() -> float:
    """Greatest resident memory of this process so far, MB; NaN where the system does not tell."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    except OSError:
        pass
    return float("nan")
