"""The columns of arrays: one a value of a row, with what name, shape and attributes show of it as metadata of the field."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray
from tacpipe.formats.arrays import frames, known
from tacpipe.formats.arrays.known import Meaning
from tacpipe.formats.arrays.tree import Array, is_frames, is_text

AXES = ("x", "y", "z")


def of(array: Array, values: AnyArray, meanings: list[Meaning] | None = None) -> Iterator[tuple[pa.Field, pa.Array]]:
    """Yield field and values of each column of an array, of which ``values`` are the rows that were read.

    An array (time,) or (time, 1) is a column NAME, one (time, n) is n columns NAME_0, NAME_1, …, or NAME_x, … of a vector
    whose components are known; more dimensions have an index each. A compound array has a column a field.
    ``meanings`` replaces what names show.
    """
    if array.dtype.names is not None:
        yield from _compound("", values, array)
        return
    yield from _columns(array.name, values, array, array.path, meanings)


def _compound(before: str, values: AnyArray, array: Array) -> Iterator[tuple[pa.Field, pa.Array]]:
    for name in values.dtype.names or ():
        inner = values[name]
        if inner.dtype.names is not None:
            yield from _compound(f"{before}{name}.", inner, array)
        else:
            yield from _columns(f"{before}{name}", inner, array, f"{array.path}/{before}{name}", None)


def _columns(
    name: str, values: AnyArray, array: Array, path: str, meanings: list[Meaning] | None
) -> Iterator[tuple[pa.Field, pa.Array]]:
    shape = values.shape[1:]
    width = int(np.prod(shape, dtype=np.int64))
    stated = known.declared(array.attributes)
    about = meanings or known.meanings(path, width, values.dtype.kind in "iub")
    if width == 1 and about == [known.NOTHING]:
        about = [known.of_name(name, values.dtype.name)]
    if "quantity" in stated:  # then what is not stated is not so
        about = [known.NOTHING] * width
    components = [one.component for one in about]
    names, units = known.listed(array.attributes, "columns", width), known.listed(array.attributes, "units", width)
    flat = _native(values.reshape(len(values), width), array).T
    for position, at in enumerate(np.ndindex(*shape)):
        one = about[position]
        metadata = {"quantity": one.quantity, "unit": one.unit, "component": one.component} | stated
        metadata |= {"unit": units[position]} if units else {}
        metadata |= _place(metadata["quantity"], shape, at)
        suffix = one.component if all(components) and len(set(components)) == width > 1 else "_".join(map(str, at))
        called = names[position] if names else f"{name}_{suffix}" if width > 1 else name
        column = _array(flat[position], array)
        yield pa.field(called, column.type, metadata={key: value for key, value in metadata.items() if value}), column


def _place(quantity: str, shape: tuple[int, ...], at: tuple[int, ...]) -> dict[str, str]:
    """Return taxel and axis of a channel of a tactile array (…, taxel, axis) or (row, column).

    >>> _place("tactile", (16, 3), (2, 1)), _place("tactile", (4, 4), (1, 0)), _place("force", (16, 3), (2, 1))
    ({'taxel': '3', 'axis': 'y'}, {'taxel': '5'}, {})
    """
    if quantity != "tactile" or len(shape) < 2:
        return {}
    if shape[-1] != len(AXES):
        return {"taxel": str(int(np.ravel_multi_index(at, shape)) + 1)}
    return {"taxel": str(int(np.ravel_multi_index(at[:-1], shape[:-1])) + 1), "axis": AXES[at[-1]]}


def _native(values: AnyArray, array: Array) -> AnyArray:
    """Return values as one of the types that a column has."""
    if is_frames(array) and values.dtype.kind == "O":
        return values
    if is_text(array) or values.dtype.kind in "SUOT":
        return values
    if values.dtype == np.float16:
        return values.astype(np.float32)
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _array(values: Any, array: Array) -> pa.Array:
    if values.dtype.kind == "O" and is_frames(array):
        return frames.binary(array, values)
    if values.dtype.kind in "SUOT":
        texts = [one.decode(errors="replace") if isinstance(one, bytes) else str(one) for one in values.tolist()]
        return pa.array(texts, pa.string())
    return pa.array(np.ascontiguousarray(values))
