"""A tree of named arrays, as in HDF5 and Zarr files, and its arrays as columns, one per value of a row.

Columns have quantity, unit and position in the metadata of the field. Pictures are one column of bytes. Encoded
pictures are elements of variable length, or rows padded with zeros, as in ALOHA. Decoded ones are the pixels of a row
of the array.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray
from tacpipe.formats.table import column_names
from tacpipe.formats.table.column_names import ColumnMeaning
from tacpipe.io import memory
from tacpipe.printable import plain
from tacpipe.video.images import COLOURS, PICTURE, array_format, picture_encoding, raw_images
from tacpipe.video.stream import VideoFormat

MAX_COLUMNS = 4096  # an array with more values per row is a picture or a mistake
MAX_TEXT = 200  # maximum length of a text attribute; longer ones are files, such as a simulator's model
IMAGE_SIDE = 32  # minimum side of a picture in pixels
IMAGE_NAMES = ("image", "img", "rgb", "depth", "cam", "video", "frame", "pixel")
DERIVED = "derived_from"  # attribute of an array that repeats another one, with its name


# value of an attribute: of HDF5 as returned by h5py and numpy, of Zarr as JSON
StoredValue = str | bytes | float | bool | None | np.generic | AnyArray | list[Any] | dict[str, Any]
StoredAttributes = Mapping[str, StoredValue]


@dataclass(frozen=True)
class ArrayDescription:
    """The description of one array; ``dtype`` is that of numpy, object where elements have no fixed length."""

    path: str  # path within the file, as "data/demo_0/actions"
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    attributes: StoredAttributes = field(default_factory=dict)
    chunk_rows: int = 0  # rows of a chunk, or 0 if the file has none
    problem: str = ""  # why the array cannot be read, as a clause such as "is …"; empty if it can be read
    time_axis: int = 0  # axis of the stored array that becomes the first axis of ``shape``

    @property
    def name(self) -> str:
        """The last part of the path."""
        return self.path.rpartition("/")[2]

    @property
    def group(self) -> str:
        """The path of the parent group; empty for the root."""
        return self.path.rpartition("/")[0]

    @property
    def row_bytes(self) -> int:
        """The size of a row in memory, in bytes."""
        return int(np.prod(self.shape[1:], dtype=np.int64)) * max(self.dtype.itemsize, 1)


class Tree(Protocol):
    """An opened file of arrays."""

    path: Path
    notes: Sequence[str] = ()  # sentences about missing parts of a truncated file

    def members(self, group: str) -> tuple[list[ArrayDescription], list[str]]:
        """Return the arrays and the paths of the groups in a group."""

    def is_group(self, path: str) -> bool:
        """Return whether a group has this path."""

    def identity(self, group: str) -> Any:
        """Return a value that identifies a group, which may have several paths because of links."""
        return group

    def attributes(self, group: str) -> StoredAttributes:
        """Return the attributes of a group."""

    def read(self, array: ArrayDescription, start: int, stop: int) -> AnyArray:
        """Return the rows ``start`` to ``stop`` (exclusive) of an array, or a scalar. Raises `TacpipeError`."""

    def files(self, array: ArrayDescription, start: int, stop: int) -> Mapping[str, Path] | None:
        """Return the files with these rows by path in the store, or None if the tree is a single file."""
        return None

    def encoding_metadata(self, array: ArrayDescription) -> Any:
        """Return the encoding of an array's rows as JSON, without the number of rows, or None if the file has it."""
        return None


def with_time_first(arrays: Sequence[ArrayDescription]) -> list[ArrayDescription]:
    """Return the arrays of a group with the time axis first: the axis that is as long as the group's 1-D arrays.

    If no axis has that length, time is the first axis, unless that is much shorter than the longest.

    >>> arrays = [ArrayDescription("tactile", (18, 3, 400), np.dtype("f4")), ArrayDescription("t", (400,), np.dtype("f8"))]
    >>> [array.shape for array in with_time_first(arrays)]
    [(400, 18, 3), (400,)]
    """
    lengths = {array.shape[0] for array in arrays if len(array.shape) == 1 and array.shape[0] > 1}
    firsts = [array.shape[0] for array in arrays if array.shape]
    described = []
    for array in arrays:
        axis = 0
        if (
            len(array.shape) > 1
            and array.dtype.kind in "biuf"
            and not is_image(array)
            and array.shape[0] not in lengths
        ):
            matching = [axis for axis, length in enumerate(array.shape) if length in lengths]
            is_alone = firsts.count(array.shape[0]) == 1
            axis = matching[0] if matching else is_alone * column_names.longer_axis(array.shape)
        shape = (array.shape[axis], *array.shape[:axis], *array.shape[axis + 1 :]) if array.shape else ()
        described.append(replace(array, shape=shape, time_axis=axis, chunk_rows=0 if axis else array.chunk_rows))
    return described


def walk(tree: Tree, group: str = "") -> Iterator[tuple[str, list[ArrayDescription]]]:
    """Yield ``group`` and each group below it, with its arrays.

    A group with several paths is walked once; at its other paths, one array with a problem represents it.
    """
    first_paths: dict[Any, str] = {}
    pending = [group]
    while pending:
        path = pending.pop()
        first = first_paths.setdefault(tree.identity(path), path)
        if first != path:
            problem = f"is the group {plain(first) or '/'}, which is read there"
            yield path.rpartition("/")[0], [ArrayDescription(path, (), np.dtype("V"), problem=problem)]
            continue
        arrays, subgroups = tree.members(path)
        yield path, arrays
        pending += reversed(subgroups)


def is_frames(array: ArrayDescription) -> bool:
    """Return whether an array may contain one encoded image per row: bytes of variable length, or padded with zeros."""
    if array.dtype.kind == "O":
        return (
            array.dtype.metadata is not None and array.dtype.metadata.get("vlen") == np.uint8 and len(array.shape) == 1
        )
    return array.dtype == np.uint8 and len(array.shape) == 2 and _named_as_image(array.path)


def pixel_format(array: ArrayDescription) -> VideoFormat | None:
    """Return the format of decoded images, or None if the array has none or their type is no pixel format.

    >>> pixel_format(ArrayDescription("obs/agentview_image", (9, 84, 64, 3), np.dtype("uint8"))).describe()
    'rawvideo, 64 x 84 pixels'
    """
    return array_format(array.shape, array.dtype) if is_image(array) else None


def is_image(array: ArrayDescription) -> bool:
    """Return whether an array contains one decoded image per row.

    >>> is_image(ArrayDescription("obs/agentview_image", (9, 84, 84, 3), np.dtype("uint8")))
    True
    >>> is_image(ArrayDescription("obs/tactile", (9, 16, 3), np.dtype("uint16")))
    False
    """
    sides = array.shape[1:]
    if len(sides) < 2 or max(sides) < IMAGE_SIDE:
        return False
    coloured = len(sides) == 3 and (sides[-1] in COLOURS or sides[0] in COLOURS) and sorted(sides)[1] >= IMAGE_SIDE
    return coloured or _named_as_image(array.path)


def reason_left_out(array: ArrayDescription) -> str:
    """Return the reason why an array is not read as columns, without its name; an empty string if it is read.

    >>> reason_left_out(ArrayDescription("a/cam", (5, 480, 640, 3), np.dtype("float32")))
    'holds decoded pictures (480 x 640 x 3) of float32; uint8 and, without colours, uint16 are read'
    """
    if array.problem:
        return array.problem
    if DERIVED in array.attributes:
        return f"repeats {plain(str(array.attributes[DERIVED]))}"
    if is_image(array):
        if pixel_format(array) is not None:
            return ""
        shape = " x ".join(map(str, array.shape[1:]))
        return f"holds decoded pictures ({shape}) of {array.dtype}; uint8 and, without colours, uint16 are read"
    if array.dtype.kind not in "biufSUOTV" or (array.dtype.itemsize > 8 and array.dtype.kind == "f"):
        return f"has the type {array.dtype}, which is not read"
    if array.dtype.kind == "O" and not is_text(array) and not is_frames(array):
        return "has elements of no fixed length, which are not read"
    if not is_frames(array) and int(np.prod(array.shape[1:], dtype=np.int64)) > MAX_COLUMNS:
        return (
            f"has {int(np.prod(array.shape[1:], dtype=np.int64))} values a row, more than the {MAX_COLUMNS} of a stream"
        )
    return ""


def is_text(array: ArrayDescription) -> bool:
    """Return whether an array contains text."""
    about = array.dtype.metadata
    return array.dtype.kind in "SUT" or (about is not None and about.get("vlen") in (str, bytes))


def plain_attributes(attributes: StoredAttributes) -> dict[str, str | int | float | bool]:
    """Return the attributes that are a short text, a number or a boolean, as plain Python values.

    >>> plain_attributes({"a": np.float32(0.5), "b": b"x", "c": np.array([1, 2]), "d": np.array([3])})
    {'a': 0.5, 'b': 'x', 'd': 3}
    """
    values: dict[str, str | int | float | bool] = {}
    for name, stored in attributes.items():
        value: Any = stored.reshape(-1)[0] if isinstance(stored, np.ndarray) and stored.size == 1 else stored
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, bytes):
            value = value.decode(errors="replace")
        is_finite = not isinstance(value, float) or math.isfinite(value)
        if isinstance(value, str | int | float | bool) and is_finite and len(str(value)) <= MAX_TEXT:
            values[plain(str(name))] = value
    return values


def _named_as_image(path: str) -> bool:
    return any(word in path.lower() for word in IMAGE_NAMES)


def first_picture(tree: Tree, array: ArrayDescription, row: int) -> bytes:
    """Return the bytes of a row of an array that may contain encoded images."""
    return _rows_as_bytes(tree.read(array, row, row + 1))[0]


def picture_column(array: ArrayDescription, values: AnyArray) -> tuple[pa.Field, pa.Array]:
    """Return field and values of an image column: the bytes as written without trailing zeros, or the pixels."""
    video_format = pixel_format(array)
    if video_format is not None:
        pixels = pa.array(raw_images(values), pa.binary())
        return pa.field(PICTURE, pa.binary(), metadata=video_format.to_metadata()), pixels
    pictures = picture_array(array, values)
    kind = next(filter(None, (picture_encoding(picture.as_py()) for picture in pictures)), "")
    about = {"quantity": "image", **({"encoding": kind} if kind else {})}
    return pa.field(PICTURE, pa.binary(), metadata=about), pictures


def picture_array(array: ArrayDescription, values: AnyArray) -> pa.Array:
    """Return rows of bytes without the trailing zeros of padded rows."""
    rows = _rows_as_bytes(values)
    if array.dtype.kind != "O":
        rows = [row.rstrip(b"\0") for row in rows]  # a JPEG ends with FF D9, a PNG with the checksum of IEND
    return pa.array(rows, pa.binary())


def _rows_as_bytes(values: AnyArray) -> list[bytes]:
    return [bytes(memoryview(value)) for value in values]


AXES = ("x", "y", "z")
BLOCK_BYTES = 1 << 20  # number of bytes that are transposed at once


def columns_of_array(
    tree: Tree, array: ArrayDescription, start: int, stop: int, meanings: list[ColumnMeaning] | None = None
) -> Iterator[tuple[pa.Field, pa.Array]]:
    """Yield field and values of each column of an array, rows ``start`` to ``stop`` (exclusive).

    An array (time,) or (time, 1) becomes the column NAME. An array (time, n) becomes n columns NAME_0, NAME_1, …, or
    NAME_x, … for a vector with known components. Further axes add an index each. A compound array has one column per
    field. ``meanings`` replaces the meanings inferred from names.
    """
    if array.dtype.names is not None:
        yield from _compound_columns("", tree.read(array, start, stop), array)
        return
    flat = read_transposed(tree, array, start, stop)
    yield from _value_columns(array.name, flat, array.shape[1:], array, array.path, meanings)


def read_transposed(tree: Tree, array: ArrayDescription, start: int, stop: int) -> AnyArray:
    """Return the rows of an array as (value, row), read in whole chunks and transposed in blocks that fit the CPU cache."""
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


def _compound_columns(prefix: str, values: AnyArray, array: ArrayDescription) -> Iterator[tuple[pa.Field, pa.Array]]:
    """Yield field and values of each column of a compound array; names of nested fields start with ``prefix``."""
    for name in values.dtype.names or ():
        inner = values[name]
        if inner.dtype.names is not None:
            yield from _compound_columns(f"{prefix}{name}.", inner, array)
        else:
            flat = inner.reshape(len(inner), -1).T if inner.size else inner.reshape(int(np.prod(inner.shape[1:])), 0)
            yield from _value_columns(
                f"{prefix}{name}", flat, inner.shape[1:], array, f"{array.path}/{prefix}{name}", None
            )


def _value_columns(
    name: str,
    flat: AnyArray,
    shape: tuple[int, ...],
    array: ArrayDescription,
    path: str,
    meanings: list[ColumnMeaning] | None,
) -> Iterator[tuple[pa.Field, pa.Array]]:
    """Yield field and values of each column of ``flat`` (value, row), an array whose rows have this ``shape``.

    ``path`` is used to infer the meanings of columns if ``meanings`` is None.
    """
    width = len(flat)
    declared = column_names.declared_metadata(array.attributes)
    about = meanings or column_names.meanings(path, width, flat.dtype.kind in "iub")
    if width == 1 and about == [column_names.NO_MEANING]:
        about = [column_names.meaning_from_name(name, flat.dtype.name)]
    if "quantity" in declared:  # an array with a declared quantity has no other meanings
        about = [column_names.NO_MEANING] * width
    components = [meaning.component for meaning in about]
    names = column_names.declared_texts(array.attributes, "columns", width)
    units = column_names.declared_texts(array.attributes, "units", width)
    has_components = all(components) and len(set(components)) == width > 1
    native = _native_values(flat, array)
    for position, at in enumerate(np.ndindex(*shape)):
        meaning = about[position]
        metadata = {"quantity": meaning.quantity, "unit": meaning.unit, "component": meaning.component} | declared
        metadata |= {"unit": units[position]} if units else {}
        metadata |= _taxel_and_axis(metadata["quantity"], shape, at)
        suffix = meaning.component if has_components else "_".join(map(str, at))
        column_name = f"{name}_{suffix}" if width > 1 else name
        column_name = names[position] if names else column_name
        column = _column_array(native[position], array)
        metadata = {key: value for key, value in metadata.items() if value}
        yield pa.field(column_name, column.type, metadata=metadata), column


def _taxel_and_axis(quantity: str, shape: tuple[int, ...], at: tuple[int, ...]) -> dict[str, str]:
    """Return the taxel and axis of a channel of a tactile array (…, taxel, axis) or (row, column).

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


def _native_values(values: AnyArray, array: ArrayDescription) -> AnyArray:
    """Return the values, with the same shape, in a type that columns support."""
    if is_frames(array) and values.dtype.kind == "O":
        return values
    if is_text(array) or values.dtype.kind in "SUOT":
        return values
    if values.dtype == np.float16:
        return values.astype(np.float32)
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _column_array(values: Any, array: ArrayDescription) -> pa.Array:
    """Return one column of an array: images, text or numbers."""
    if values.dtype.kind == "O" and is_frames(array):
        return picture_array(array, values)
    if values.dtype.kind in "SUOT":
        texts = [
            value.decode(errors="replace") if isinstance(value, bytes) else str(value) for value in values.tolist()
        ]
        return pa.array(texts, pa.string())
    return pa.array(np.ascontiguousarray(values))
