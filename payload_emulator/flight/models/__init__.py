"""Networks shipped with the project, as octets."""

from __future__ import annotations

from importlib import resources

DEFAULT_NETWORK = "craters"

NETWORKS = {DEFAULT_NETWORK: "craters.onnx", "high-altitude": "high-altitude.onnx"}
"""Files of the shipped networks by the names that scenarios use.

`craters` is for 14 to 50 km, `high-altitude` for 50 to 160 km: it enlarges images twice before the first layer.
"""


def load_shipped_model(name: str = DEFAULT_NETWORK) -> bytes:
    """Octets of a shipped network; the default one is flown unless the scenario names or uploads another."""
    return resources.files(__name__).joinpath(NETWORKS[name]).read_bytes()
