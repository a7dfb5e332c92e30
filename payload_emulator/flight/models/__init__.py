"""Networks shipped with the project, as octets."""

import hashlib
from importlib import resources

DEFAULT_NETWORK = "craters"

NETWORKS = {DEFAULT_NETWORK: "craters.onnx", "high-altitude": "high-altitude.onnx"}
"""Files of the shipped networks by the names that scenarios use."""

_PURPOSES = {
    DEFAULT_NETWORK: "altitudes of 14 to 50 km; flown where a scenario names no other",
    "high-altitude": "altitudes of 50 to 160 km; enlarges images twice before the first layer",
}


def load_shipped_model(name: str = DEFAULT_NETWORK) -> bytes:
    """Octets of a shipped network; the default one is flown unless the scenario names or uploads another."""
    return resources.files(__name__).joinpath(NETWORKS[name]).read_bytes()


def describe_networks() -> dict[str, dict[str, str]]:
    """Return path in the installed packages, SHA-256 and purpose of each shipped network by its name."""
    return {
        name: {
            "file": f"{__name__.replace('.', '/')}/{file}",
            "sha256": hashlib.sha256(load_shipped_model(name)).hexdigest(),
            "purpose": _PURPOSES[name],
        }
        for name, file in NETWORKS.items()
    }
