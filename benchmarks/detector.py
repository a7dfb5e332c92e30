"""Latency and memory of the shipped detector: python benchmarks/detector.py."""

from __future__ import annotations

import json

from payload_emulator.flight.models import load_shipped_model
from payload_emulator.training.bench import bench

if __name__ == "__main__":
    print(json.dumps({"detector": bench(load_shipped_model())}, indent=1))
