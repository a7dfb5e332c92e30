"""Latency and memory of the shipped detector: python -m benchmarks detector."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks._rows import Row
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.training.model.bench import bench


def rows() -> Iterator[Row]:
    """Yield latency and memory; the peer is the network alone."""
    found = bench(load_shipped_model())
    yield Row(
        "detection, processor time",
        found["cpu_median_ms"],
        "ms",
        "network alone",
        found["network_cpu_median_ms"],
    )
    yield Row("detection, 99 %", found["p99_ms"], "ms", "median", found["median_ms"])
    yield Row("peak memory", found["peak_rss_mb"], "MB")
