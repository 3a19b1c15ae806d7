"""ROS messages: their types from the definitions that a file carries, and the columns of their bytes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from tacpipe.formats.bags import meanings, wire
from tacpipe.formats.bags.meanings import Column
from tacpipe.formats.bags.topic_rows import FRAME, HEADER
from tacpipe.formats.bags.topics import Block, TopicError
from tacpipe.formats.bags.wire import ROS1, TEXT, Encoding, Leaf, Matrix, Shape, Types
from tacpipe.printable import plain

MOST_SHAPES = 256  # that are kept of a topic
Definition = Literal["msg", "idl"]


def normal(name: str) -> str:
    """Return a message type as ROS 2 writes it.

    >>> normal("std_msgs/String"), normal("std_msgs/msg/String"), normal("test_msgs/srv/BasicTypes_Event")
    ('std_msgs/msg/String', 'std_msgs/msg/String', 'test_msgs/srv/BasicTypes_Event')
    """
    package, *rest = name.split("/")
    return f"{package}/msg/{rest[0]}" if len(rest) == 1 else name


def types(name: str, kind: Definition, text: str) -> Types:
    """Return the fields of a message type and of those inside it, from its definition.

    Raises `TopicError` where the text is no definition. An empty one is looked up among ROS's own types.
    """
    from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

    if not text.strip():
        return _own(name)
    try:
        if kind == "idl":
            parts = text.split("=" * 80 + "\n")
            found: dict[str, Any] = {}
            for one in parts:
                body = one.partition("\n")[2] if one.startswith("IDL: ") else one
                found |= get_types_from_idl(body) if body.strip() else {}
        else:
            found = dict(get_types_from_msg(text, name))
    except TypesysError as error:
        if "\n---\n" in text:
            raise TopicError(
                f"its type {plain(name)} is an event of a service, whose definition is not one of a message"
            ) from error
        raise TopicError(f"the definition of its type {plain(name)} cannot be read: {plain(str(error), 80)}") from error
    except (ValueError, KeyError, RecursionError, AssertionError) as error:
        raise TopicError(f"the definition of its type {plain(name)} cannot be read") from error
    return {one: fields for one, (_, fields) in found.items()}


def _own(name: str) -> Types:
    """Return the fields of a type of ROS 2 itself, as those of bags before Humble, which carry no definitions."""
    from rosbags.typesys import Stores, get_typestore

    known = get_typestore(Stores.ROS2_HUMBLE).fielddefs
    if name not in known:
        raise TopicError(f"the file has no definition of its type {plain(name)}, and it is not one of ROS's own")
    return {one: fields for one, (_, fields) in known.items()}


@dataclass
class Ros:
    """The messages of a topic of a ROS type, in ROS 1's serialization or in CDR."""

    name: str  # of the message type
    types: Types
    cdr: bool
    _meaning: meanings.Meaning | None = None
    _shapes: dict[bytes, list[Shape]] = field(default_factory=dict)  # by the first bytes, which state the byte order

    def blocks(self, messages: Sequence[bytes]) -> Iterator[Block]:
        """Yield the columns of messages, those of one shape together; raises `TopicError` where they are not of the type."""
        self._meaning = meaning = self._meaning or meanings.of(self.name)
        marks = np.array([bytes(one[:2]) for one in messages] if self.cdr else [b""] * len(messages))
        try:
            for mark in np.unique(marks):
                encoding = wire.encoding_of(bytes(mark).ljust(2, b"\0")) if self.cdr else ROS1
                chosen = np.flatnonzero(marks == mark)
                known = self._shapes.setdefault(bytes(mark), [])
                own = [messages[row] for row in chosen.tolist()] if len(chosen) < len(messages) else messages
                self._expect_fitting(bytes(own[0]), encoding)
                single: dict[Any, _Single] = {}
                for shape, rows, matrix in wire.shapes(own, self.types, self.name, encoding, known):
                    if len(rows) == 1:
                        alone = replace(shape, first=matrix[0].tobytes())  # the shape may be one of earlier messages
                        self._take(alone, int(chosen[rows[0]]), meaning, single)
                        continue
                    for same, one in _by_keys(shape, matrix, meaning):
                        yield from _blocks(one, chosen[rows[same]], matrix[same], meaning)
                for found in single.values():
                    yield from found.blocks()
                del known[MOST_SHAPES:]
        except wire.WireError as error:
            raise TopicError(str(error)) from error

    def _take(self, shape: Shape, row: int, meaning: meanings.Meaning, single: dict[Any, _Single]) -> None:
        """Add a message that is alone with its shape to those with the same leaves."""
        keys = tuple(shape.first[leaf.offset : leaf.offset + leaf.size] for leaf in shape.leaves if meaning.keys(leaf))
        same = (tuple(shape.counts), keys)
        if same not in single:
            single[same] = _Single.of(shape, meaning)
        single[same].add(shape, row)

    def _expect_fitting(self, message: bytes, encoding: Encoding) -> None:
        """Take ROS's own definition of the type where the file's does not fit: old recorders wrote another type's."""
        try:
            wire.walked(message, self.types, self.name, encoding)
        except wire.WireError:
            with contextlib.suppress(TopicError, wire.WireError):
                own = _own(self.name)
                wire.walked(message, own, self.name, encoding)
                self.types = own


@dataclass
class _Single:
    """Messages with the same leaves whose texts have lengths of their own, value by value."""

    parts: list[meanings.Part]
    leaves: dict[Leaf, int]  # positions
    rows: list[int] = field(default_factory=list)
    values: list[list[list[Any]]] = field(default_factory=list)  # by part and column

    @classmethod
    def of(cls, shape: Shape, meaning: meanings.Meaning) -> _Single:
        """Return the columns of messages such as the first of a shape."""
        parts = [one for one in meaning.parts(shape) if one.columns]
        for one in parts:
            one.columns = [*_about_time(one), *one.columns]
        leaves = {leaf: position for position, leaf in enumerate(shape.leaves)}
        return cls(parts, leaves, [], [[[] for _ in one.columns] for one in parts])

    def add(self, shape: Shape, row: int) -> None:
        """Take in the values of a message."""
        self.rows.append(row)
        for part, values in zip(self.parts, self.values, strict=True):
            for column, cells in zip(part.columns, values, strict=True):
                cells.append(shape.value(shape.leaves[self.leaves[column.leaf]], column.index))

    def blocks(self) -> Iterator[Block]:
        """Yield the columns."""
        for part, values in zip(self.parts, self.values, strict=True):
            columns: dict[str, pa.Array] = {}
            about: dict[str, Mapping[str, str]] = {}
            for column, cells in zip(part.columns, values, strict=True):
                name = _free(column.name, columns)
                columns[name] = pa.array(cells, _type(column))
                if column.name not in (HEADER, FRAME):
                    about[name] = dict(column.about)
            yield Block(part.suffix, np.array(self.rows), columns, about)


def _about_time(part: meanings.Part) -> list[Column]:
    """Return the columns of a part's header."""
    found = [(HEADER, part.stamp), (FRAME, part.frame)]
    return [Column(name, leaf) for name, leaf in found if leaf is not None]


def _type(column: Column) -> pa.DataType:
    leaf = column.leaf
    if leaf.kind in (TEXT, "stamp"):
        return pa.string() if leaf.kind == TEXT else pa.int64()
    if column.index is None and leaf.count is not None:
        return pa.binary()
    return pa.bool_() if leaf.kind == "bool" else pa.from_numpy_dtype(np.dtype(wire.NUMBERS[leaf.kind]))


def _free(name: str, taken: Mapping[str, Any]) -> str:
    while name in taken:
        name = f"{name}_"
    return name


def _by_keys(
    shape: Shape, matrix: Matrix, meaning: meanings.Meaning
) -> Iterator[tuple[np.ndarray[Any, np.dtype[np.int64]], Shape]]:
    """Yield rows whose keys are the same, and a shape whose first message has these."""
    keys = [leaf for leaf in shape.leaves if meaning.keys(leaf)]
    left = np.arange(len(matrix))
    if not keys:
        yield left, shape
        return
    places = np.concatenate([np.arange(leaf.offset, leaf.offset + leaf.size) for leaf in keys])
    while len(left):
        first = matrix[left[0]]
        same = (matrix[left][:, places] == first[places]).all(axis=1)
        yield left[same], replace(shape, first=first.tobytes())
        left = left[~same]


def _blocks(
    shape: Shape, rows: np.ndarray[Any, np.dtype[np.int64]], matrix: Matrix, meaning: meanings.Meaning
) -> Iterator[Block]:
    cache: dict[int, Any] = {}  # numbers by the offset of their leaf: an array is viewed once for all of its columns
    for part in meaning.parts(shape):
        columns: dict[str, pa.Array] = {}
        about: dict[str, Mapping[str, str]] = {}
        if part.stamp is not None:
            columns[HEADER] = pa.array(shape.numbers(part.stamp, matrix))
        if part.frame is not None:
            columns[FRAME] = _texts(part.frame, matrix)
        for column in part.columns:
            name = _free(column.name, columns)
            columns[name] = _array(shape, column, matrix, cache)
            about[name] = dict(column.about)
        if about:
            yield Block(part.suffix, rows, columns, about)


def _array(shape: Shape, column: Column, matrix: Matrix, cache: dict[int, Any]) -> pa.Array:
    leaf = column.leaf
    if leaf.kind == TEXT:
        return _texts(leaf, matrix)
    if column.index is None and leaf.count is not None:
        return _bytes(leaf, matrix)
    if leaf.offset not in cache:
        values = shape.numbers(leaf, matrix)
        cache[leaf.offset] = values.T.copy() if values.ndim == 2 else values  # (position, message)
    values = cache[leaf.offset] if column.index is None else cache[leaf.offset][column.index]
    return pa.array(values.astype(bool) if leaf.kind == "bool" else values)


def _bytes(leaf: Leaf, matrix: Matrix) -> pa.Array:
    count = leaf.count or 0
    content = np.ascontiguousarray(matrix[:, leaf.offset : leaf.offset + count])
    offsets = np.arange(len(matrix) + 1, dtype=np.int64) * count
    if offsets[-1] < 2**31:
        return pa.Array.from_buffers(
            pa.binary(), len(matrix), [None, pa.py_buffer(offsets.astype(np.int32)), pa.py_buffer(content)]
        )
    raise TopicError(f"one batch of its messages has {offsets[-1]} bytes")


def _texts(leaf: Leaf, matrix: Matrix) -> pa.Array:
    content = _bytes(leaf, matrix)
    try:
        return content.cast(pa.string())
    except pa.ArrowInvalid:
        return pa.array([one.as_py().decode(errors="replace") for one in content], pa.string())
