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
