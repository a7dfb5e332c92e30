"""Networks shipped with the project, as octets."""

from __future__ import annotations

from importlib import resources

SHIPPED_MODEL = "craters.onnx"


def load_shipped_model() -> bytes:
    """Octets of the crater network that the flight software uses unless another is uploaded."""
    return resources.files(__name__).joinpath(SHIPPED_MODEL).read_bytes()
