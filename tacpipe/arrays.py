"""Name array types by their content, for annotations, and convert arrays from and to pyarrow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pyarrow as pa

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


def from_arrow(column: pa.Array | pa.ChunkedArray) -> AnyArray:
    """Return the values of a column (row,), like pyarrow's `to_numpy`.

    Numbers without nulls are views of pyarrow's buffers. pyarrow's own conversion imports pandas, which takes as long
    as importing pyarrow.

    >>> import pyarrow as pa
    >>> from_arrow(pa.array([1, 2, 3], pa.uint16())[1:])
    array([2, 3], dtype=uint16)
    """
    import pyarrow as pa

    if column.null_count or not (is_numeric(column) or pa.types.is_boolean(column.type)):
        return _convert_with_pyarrow(column)
    chunks = column.chunks if isinstance(column, pa.ChunkedArray) else [column]
    pieces = [_view(chunk) for chunk in chunks if len(chunk)]
    if len(pieces) == 1:
        return pieces[0]
    return np.concatenate(pieces) if pieces else np.zeros(0, column.type.to_pandas_dtype())


def _view(chunk: pa.Array) -> AnyArray:
    """Return the numbers or booleans of a chunk without nulls."""
    dtype, content = np.dtype(chunk.type.to_pandas_dtype()), chunk.buffers()[1]
    if dtype != np.bool_:
        return np.frombuffer(content, dtype, len(chunk), chunk.offset * dtype.itemsize)
    bits = np.unpackbits(np.frombuffer(content, np.uint8), count=chunk.offset + len(chunk), bitorder="little")
    return bits[chunk.offset :].view(np.bool_)


def is_numeric(column: pa.Array | pa.ChunkedArray) -> bool:
    """Return whether a column has only numbers, without nulls."""
    import pyarrow.types as kinds

    return (kinds.is_integer(column.type) or kinds.is_floating(column.type)) and not column.null_count


def _convert_with_pyarrow(column: pa.Array | pa.ChunkedArray) -> AnyArray:
    """Return the values of a column as pyarrow converts them, with missing values."""
    import pyarrow as pa

    values: AnyArray = (
        column.to_numpy() if isinstance(column, pa.ChunkedArray) else column.to_numpy(zero_copy_only=False)
    )
    return values


def to_arrow(values: AnyArray, kind: pa.DataType | None = None) -> pa.Array:
    """Return numbers or booleans (row,) as an arrow array of their type, or of ``kind``, without importing pandas.

    Contiguous numbers are not copied.

    >>> to_arrow(np.array([True, False])).to_pylist(), to_arrow(np.arange(2.0)).type
    ([True, False], DataType(double))
    """
    import pyarrow as pa

    is_bool = values.dtype == np.bool_
    content = np.packbits(values, bitorder="little") if is_bool else np.ascontiguousarray(values)
    array = pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(content)])
    return array if kind is None or array.type == kind else array.cast(kind)
