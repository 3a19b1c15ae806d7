"""Turn arrays into columns, one per value of a row, with quantity, unit and place in the metadata of the field.

Encoded pictures are one column of bytes: elements of their own length, or rows padded with zeros, as in ALOHA.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray
from tacpipe.formats.arrays import array_names
from tacpipe.formats.arrays.array_names import ColumnMeaning
from tacpipe.formats.arrays.tree import Array, Tree, is_frames, is_text
from tacpipe.io import memory
from tacpipe.printable import plain

PICTURE = "data"  # name of the column, equal to that of image messages
MAGIC = {b"\xff\xd8\xff": "jpeg", b"\x89PNG": "png", b"RIFF": "webp"}  # how pictures begin


def picture_encoding(content: bytes) -> str:
    r"""Return the encoding of a picture by its first bytes; empty where it is none of these.

    >>> picture_encoding(b"\xff\xd8\xff\xe0"), picture_encoding(b"abc")
    ('jpeg', '')
    """
    return next((name for start, name in MAGIC.items() if content.startswith(start)), "")


def is_encoded(tree: Tree, array: Array, row: int) -> bool:
    """Return whether a row of an array is an encoded picture, by its first bytes."""
    return bool(picture_encoding(_rows_as_bytes(tree.read(array, row, row + 1))[0]))


def encoded_size(tree: Tree, array: Array, row: int) -> int:
    """Return how many bytes a row of an array of pictures has."""
    return len(_rows_as_bytes(tree.read(array, row, row + 1))[0])


def picture_column(array: Array, values: AnyArray) -> tuple[pa.Field, pa.Array]:
    """Return field and values of the column of pictures: bytes as they were written, without the zeros behind them."""
    pictures = picture_array(array, values)
    kind = next(filter(None, (picture_encoding(picture.as_py()) for picture in pictures)), "")
    about = {"quantity": "image", **({"encoding": kind} if kind else {})}
    return pa.field(PICTURE, pa.binary(), metadata=about), pictures


def picture_array(array: Array, values: AnyArray) -> pa.Array:
    """Return rows of bytes, without the zeros behind those that are padded."""
    rows = _rows_as_bytes(values)
    if array.dtype.kind != "O":
        rows = [row.rstrip(b"\0") for row in rows]  # a JPEG ends in FF D9, a PNG in its check sum of IEND
    return pa.array(rows, pa.binary())


def _rows_as_bytes(values: AnyArray) -> list[bytes]:
    return [bytes(memoryview(value)) for value in values]


AXES = ("x", "y", "z")
BLOCK_BYTES = 1 << 20  # bytes transposed at once


def columns_of_array(
    tree: Tree, array: Array, start: int, stop: int, meanings: list[ColumnMeaning] | None = None
) -> Iterator[tuple[pa.Field, pa.Array]]:
    """Yield field and values of each column of an array, the rows from ``start`` up to ``stop``.

    An array (time,) or (time, 1) is a column NAME, one (time, n) is n columns NAME_0, NAME_1, …, or NAME_x, … of a vector
    whose components are known; more dimensions have an index each. A compound array has a column a field.
    ``meanings`` replaces the meanings that names show.
    """
    if array.dtype.names is not None:
        yield from _compound_columns("", tree.read(array, start, stop), array)
        return
    flat = read_transposed(tree, array, start, stop)
    yield from _value_columns(array.name, flat, array.shape[1:], array, array.path, meanings)


def read_transposed(tree: Tree, array: Array, start: int, stop: int) -> AnyArray:
    """Return the rows of an array as (value, row): in blocks that a processor's cache holds, of whole chunks."""
    width = int(np.prod(array.shape[1:], dtype=np.int64))
    if width == 1 or array.dtype.hasobject:
        values = tree.read(array, start, stop)
        return values.reshape(len(values), width).T
    memory.require(array.row_bytes * (stop - start), f"{tree.path}, {plain(array.path, 200)},")
    block = np.empty((width, stop - start), array.dtype.newbyteorder("="))
    rows = max(1, BLOCK_BYTES // array.row_bytes)
    rows = -(-rows // array.chunk_rows) * array.chunk_rows if array.chunk_rows else rows
    for begin in range(start // rows * rows, stop, rows):
        first, last = max(begin, start), min(begin + rows, stop)
        block[:, first - start : last - start] = tree.read(array, first, last).reshape(last - first, width).T
    return block


def _compound_columns(before: str, values: AnyArray, array: Array) -> Iterator[tuple[pa.Field, pa.Array]]:
    for name in values.dtype.names or ():
        inner = values[name]
        if inner.dtype.names is not None:
            yield from _compound_columns(f"{before}{name}.", inner, array)
        else:
            flat = inner.reshape(len(inner), -1).T if inner.size else inner.reshape(int(np.prod(inner.shape[1:])), 0)
            yield from _value_columns(
                f"{before}{name}", flat, inner.shape[1:], array, f"{array.path}/{before}{name}", None
            )


def _value_columns(
    name: str, flat: AnyArray, shape: tuple[int, ...], array: Array, path: str, meanings: list[ColumnMeaning] | None
) -> Iterator[tuple[pa.Field, pa.Array]]:
    """Yield the columns of values (value, row) that have this shape in a row."""
    width = len(flat)
    declared = array_names.declared_metadata(array.attributes)
    about = meanings or array_names.meanings(path, width, flat.dtype.kind in "iub")
    if width == 1 and about == [array_names.NO_MEANING]:
        about = [array_names.meaning_from_name(name, flat.dtype.name)]
    if "quantity" in declared:  # an array with a declared quantity has no other meanings
        about = [array_names.NO_MEANING] * width
    components = [meaning.component for meaning in about]
    names, units = (
        array_names.declared_texts(array.attributes, "columns", width),
        array_names.declared_texts(array.attributes, "units", width),
    )
    flat = _native_values(flat, array)
    for position, at in enumerate(np.ndindex(*shape)):
        meaning = about[position]
        metadata = {"quantity": meaning.quantity, "unit": meaning.unit, "component": meaning.component} | declared
        metadata |= {"unit": units[position]} if units else {}
        metadata |= _taxel_and_axis(metadata["quantity"], shape, at)
        suffix = meaning.component if all(components) and len(set(components)) == width > 1 else "_".join(map(str, at))
        called = names[position] if names else f"{name}_{suffix}" if width > 1 else name
        column = _column_array(flat[position], array)
        yield pa.field(called, column.type, metadata={key: value for key, value in metadata.items() if value}), column


def _taxel_and_axis(quantity: str, shape: tuple[int, ...], at: tuple[int, ...]) -> dict[str, str]:
    """Return taxel and axis of a channel of a tactile array (…, taxel, axis) or (row, column).

    >>> _taxel_and_axis("tactile", (16, 3), (2, 1)), _taxel_and_axis("tactile", (4, 4), (1, 0))
    ({'taxel': '3', 'axis': 'y'}, {'taxel': '5'})
    >>> _taxel_and_axis("force", (16, 3), (2, 1))
    {}
    """
    if quantity != "tactile" or len(shape) < 2:
        return {}
    if shape[-1] != len(AXES):
        return {"taxel": str(int(np.ravel_multi_index(at, shape)) + 1)}
    return {"taxel": str(int(np.ravel_multi_index(at[:-1], shape[:-1])) + 1), "axis": AXES[at[-1]]}


def _native_values(values: AnyArray, array: Array) -> AnyArray:
    """Return values as one of the types that a column has."""
    if is_frames(array) and values.dtype.kind == "O":
        return values
    if is_text(array) or values.dtype.kind in "SUOT":
        return values
    if values.dtype == np.float16:
        return values.astype(np.float32)
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _column_array(values: Any, array: Array) -> pa.Array:
    if values.dtype.kind == "O" and is_frames(array):
        return picture_array(array, values)
    if values.dtype.kind in "SUOT":
        texts = [
            value.decode(errors="replace") if isinstance(value, bytes) else str(value) for value in values.tolist()
        ]
        return pa.array(texts, pa.string())
    return pa.array(np.ascontiguousarray(values))
