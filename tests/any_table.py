"""Tables of every type that a stage, a format or a sensor writes, with the values that are the hardest to keep."""

import string
from typing import Any

import numpy as np
import pyarrow as pa
from hypothesis import strategies as st

FLOATS = {
    "float": ("<u4", [0, 0x80000000, 1, 0x7F800000, 0xFF800000, 0x7FC00000, 0x7F800001, 0xFFC12345, 0x3F800000]),
    "double": ("<u8", [0, 1 << 63, 1, 0x7FF << 52, 0xFFF << 52, 0x7FF8 << 48, (0x7FF << 52) + 1, 0x3FF << 52]),
}  # zeros, the smallest, infinities, quiet and signalling NaN with payloads, one
WHOLE = [pa.int8(), pa.uint8(), pa.int16(), pa.uint16(), pa.int32(), pa.uint32(), pa.int64(), pa.uint64()]
TYPES = [*WHOLE, pa.float32(), pa.float64(), pa.bool_(), pa.string()]
CLOCKS = ("t_ns", "t_device_ns", "seq")  # stored in a way of their own
MOST_ROWS = 3000
_names = st.sampled_from(CLOCKS) | st.text(string.ascii_lowercase + "_ .\u00e9\U0001f590", min_size=1, max_size=6)
_metadata = st.dictionaries(st.sampled_from(["unit", "quantity", "", "\u00e9"]), st.text(max_size=3), max_size=3)


@st.composite
def tables(draw: st.DrawFn, *, columns: int = 6) -> pa.Table:
    """Draw a table with no or many rows, which may repeat, nulls anywhere, extreme values, and metadata of fields."""
    rows = draw(st.sampled_from([0, 1, 2]) | st.integers(0, 40) | st.integers(41, MOST_ROWS))
    names = (
        draw(st.lists(_names, max_size=columns, unique=True))
        if rows == 0
        else draw(st.lists(_names, min_size=1, max_size=columns, unique=True))
    )
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    # Rows of the values of all columns, so that full rows repeat.
    order = _order(rows, draw(st.sampled_from([1, 2, 50])), rng)
    fields, arrays = [], []
    for name in names:
        kind = draw(st.sampled_from(TYPES))
        distinct_values = pa.array(draw(st.lists(st.none() | _value(kind), min_size=1, max_size=6)), _raw(kind))
        array = distinct_values.take(pa.array(order % len(distinct_values))) if rows else distinct_values.slice(0, 0)
        arrays.append(array.view(kind) if pa.types.is_floating(kind) else array)
        fields.append(pa.field(name, kind, metadata=draw(_metadata) or None))
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def bits(table: pa.Table) -> list[tuple[Any, ...]]:
    """Return all that a table is: name, type, what is told of it and values of each column, floats as their bits."""
    return [
        (field.name, str(field.type), field.metadata or {}, _values(column))
        for field, column in zip(table.schema, table.columns, strict=True)
    ]


def _values(column: pa.ChunkedArray) -> list[Any]:
    array = column.combine_chunks()
    return list((array.view(_raw(array.type)) if pa.types.is_floating(array.type) else array).to_pylist())


def _raw(kind: pa.DataType) -> pa.DataType:
    return {pa.float32(): pa.uint32(), pa.float64(): pa.uint64()}.get(kind, kind)


def _value(kind: pa.DataType) -> st.SearchStrategy[Any]:
    if pa.types.is_floating(kind):
        width, hard = FLOATS[str(kind)]
        return st.sampled_from(hard) | st.integers(0, int(np.iinfo(width).max))
    if pa.types.is_integer(kind):
        limits = np.iinfo(kind.to_pandas_dtype())
        return st.sampled_from([int(limits.min), int(limits.max), 0, 1]) | st.integers(int(limits.min), int(limits.max))
    return st.booleans() if pa.types.is_boolean(kind) else st.text(max_size=5)


def _order(rows: int, hold: int, rng: np.random.Generator) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return which of a few values stands in each row (time,), each for ``hold`` rows on average."""
    changes = rng.random(rows) < 1 / hold
    return np.where(changes, rng.integers(0, 60, rows), 0).cumsum()
