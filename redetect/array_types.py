"""Names of array types for signatures and attributes; shapes are in the docstrings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BoolArray = NDArray[np.bool_]
ByteArray = NDArray[np.uint8]
Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]
GreyImage = NDArray[np.uint8]
IntArray = NDArray[np.int64]
Records = NDArray[np.void]  #: Of a structured type.
