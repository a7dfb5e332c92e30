"""Latency and memory of the flight detector on this machine."""

import resource
import time

import numpy as np

from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.flight.vision.preprocess import prepare_image


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
