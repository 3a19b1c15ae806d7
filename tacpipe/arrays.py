"""Names for arrays by what they hold, for annotations; their shapes stand in comments where they are made."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

AnyArray = NDArray[Any]
AnyFloats = NDArray[np.floating[Any]]  # of any precision
Floats = NDArray[np.float64]
Float32s = NDArray[np.float32]
Ints = NDArray[np.integer[Any]]  # of any width, with a sign or without
Int64s = NDArray[np.int64]
Int32s = NDArray[np.int32]
Times = NDArray[np.int64]  # nanoseconds
Indices = NDArray[np.intp]  # of rows, as numpy's own searches return them
Counts = NDArray[np.uint16]  # what a sensor's converter gives
Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]
