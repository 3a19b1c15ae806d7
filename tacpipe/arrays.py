"""Name array types by their content, for annotations; comments give the shapes where arrays are made."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

AnyArray = NDArray[Any]
ArrayType = np.dtype[Any]
AnyFloats = NDArray[np.floating[Any]]  # any precision
Floats = NDArray[np.float64]
Float32s = NDArray[np.float32]
Ints = NDArray[np.integer[Any]]  # any width, signed or unsigned
Int64s = NDArray[np.int64]
Int32s = NDArray[np.int32]
Times = NDArray[np.int64]  # nanoseconds
Indices = NDArray[np.intp]  # row numbers, as numpy's own searches return them
Counts = NDArray[np.uint16]  # values of a sensor's converter
Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]
