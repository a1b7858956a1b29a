"""Types of arrays."""

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
Complex128Array = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]
