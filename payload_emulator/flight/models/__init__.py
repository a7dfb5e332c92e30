"""Networks shipped with the project, as octets."""

from __future__ import annotations

from importlib import resources

DEFAULT_NETWORK = "craters"

NETWORKS = {DEFAULT_NETWORK: "craters.onnx"}
"""Files of the shipped networks by the names that scenarios use."""


def load_shipped_model(name: str = DEFAULT_NETWORK) -> bytes:
    """Octets of a shipped network; the default one is flown unless the scenario names or uploads another."""
    return resources.files(__name__).joinpath(NETWORKS[name]).read_bytes()
