"""Latency and memory of the shipped detector, compared with the first network: python -m benchmarks detector.

Where torch is missing the second is left out. A time in ms belongs to a machine; `of_first` is the ratio of the two
networks on this one, in the same run.
"""

from __future__ import annotations

import importlib.util
import json
from typing import Any

from payload_emulator.flight.models import load_shipped_model
from payload_emulator.training.model.bench import bench, compare_models, prototype_model

PROTOTYPE = "prototype (small, stride 4, 64 channels, untrained)"
PROTOTYPE_MS = 6.2
"""Of its network on one thread, where it was first measured."""


def main() -> dict[str, Any]:
    """Figures of the shipped model alone, then of both in turn."""
    shipped = load_shipped_model()
    document: dict[str, Any] = {"detector": bench(shipped)}  # first: memory is this process's greatest so far
    if importlib.util.find_spec("torch") is not None and importlib.util.find_spec("onnx") is not None:
        rows = compare_models({PROTOTYPE: prototype_model(), "shipped": shipped})
        document["beside"] = rows
        document["prototype_network_ms_elsewhere"] = PROTOTYPE_MS
        document["shipped_network_ms_there_by_ratio"] = PROTOTYPE_MS * rows["shipped"]["of_first"]
        document["shipped_whole_ms_there_by_ratio"] = (
            PROTOTYPE_MS * rows["shipped"]["cpu_whole_ms"] / rows[PROTOTYPE]["cpu_network_ms"]
        )
    return document


if __name__ == "__main__":
    print(json.dumps(main(), indent=1))
