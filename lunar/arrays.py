"""Type aliases of NumPy arrays."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
OctetArray = NDArray[np.uint8]
Float32Array = NDArray[np.float32]
Int32Array = NDArray[np.int32]
