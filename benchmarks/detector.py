"""Latency and memory of the shipped detector: python -m benchmarks detector."""

from __future__ import annotations

import json
from typing import Any

from payload_emulator.flight.models import load_shipped_model
from payload_emulator.training.model.bench import bench


def main() -> dict[str, Any]:
    """Return the figures of the shipped network."""
    return {"detector": bench(load_shipped_model())}


if __name__ == "__main__":
    print(json.dumps(main(), indent=1))
