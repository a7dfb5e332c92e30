"""Type aliases of NumPy arrays."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
OctetArray = NDArray[np.uint8]
RecordArray = NDArray[Any]
"""Array of a structured element type."""

Octets = bytes | bytearray | memoryview | OctetArray


def as_octets(buffer: Octets) -> OctetArray:
    """Return `buffer` as a one-dimensional array of octets, without a copy."""
    if isinstance(buffer, np.ndarray):
        return np.ascontiguousarray(buffer, dtype=np.uint8).reshape(-1)
    return np.frombuffer(buffer, dtype=np.uint8)
