"""Decode ROS messages with the definitions in the file."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from tacpipe.formats.bags import meanings, wire
from tacpipe.formats.bags.meanings import PartColumn
from tacpipe.formats.bags.topics import FRAME, HEADER, Block, TopicError
from tacpipe.formats.bags.wire import ROS1, TEXT, Encoding, Leaf, Matrix, MessageShape, Types
from tacpipe.printable import plain

MAX_SHAPES = 256  # maximum number of shapes cached per topic
Definition = Literal["msg", "idl"]


def normalize_type_name(name: str) -> str:
    """Return a message type in ROS 2 notation.

    >>> normalize_type_name("std_msgs/String"), normalize_type_name("test_msgs/srv/BasicTypes_Event")
    ('std_msgs/msg/String', 'test_msgs/srv/BasicTypes_Event')
    """
    package, *parts = name.split("/")
    return f"{package}/msg/{parts[0]}" if len(parts) == 1 else name


def parse_definitions(name: str, kind: Definition, text: str) -> Types:
    """Return the fields of a message type and of its nested types by name, parsed from its definition.

    An empty definition is looked up in ROS 2's standard types. Raises `TopicError` if the text is not a definition.
    """
    from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

    if not text.strip():
        return _builtin_types(name)
    try:
        if kind == "idl":
            sections = text.split("=" * 80 + "\n")
            definitions: dict[str, tuple[Any, Any]] = {}  # constants and fields by type
            for section in sections:
                body = section.partition("\n")[2] if section.startswith("IDL: ") else section
                definitions |= get_types_from_idl(body) if body.strip() else {}
        else:
            definitions = dict(get_types_from_msg(text, name))
    except TypesysError as error:
        if "\n---\n" in text:
            raise TopicError(
                f"its type {plain(name)} is an event of a service, whose definition is not one of a message"
            ) from error
        raise TopicError(f"the definition of its type {plain(name)} cannot be read: {plain(str(error), 80)}") from error
    except (ValueError, KeyError, RecursionError, AssertionError) as error:
        raise TopicError(f"the definition of its type {plain(name)} cannot be read") from error
    return {type_name: fields for type_name, (_, fields) in definitions.items()}


def _builtin_types(name: str) -> Types:
    """Return the fields of a standard ROS 2 type; bags from before Humble contain no definitions.

    Raises `TopicError` for another type.
    """
    from rosbags.typesys import Stores, get_typestore

    definitions = get_typestore(Stores.ROS2_HUMBLE).fielddefs
    if name not in definitions:
        raise TopicError(f"the file has no definition of its type {plain(name)}, and it is not one of ROS's own")
    return {type_name: fields for type_name, (_, fields) in definitions.items()}


@dataclass
class RosDecoder:
    """Decodes messages of a ROS type, serialized as in ROS 1 or in CDR."""

    name: str  # name of the message type
    types: Types
    cdr: bool
    _meaning: meanings.Meaning | None = None
    # shapes by the first two bytes, which contain the byte order
    _shapes: dict[bytes, list[MessageShape]] = field(default_factory=dict)

    def blocks(self, messages: Sequence[bytes]) -> Iterator[Block]:
        """Yield the columns of messages, grouped by shape. Raises `TopicError` if they do not match the type."""
        self._meaning = meaning = self._meaning or meanings.meaning_of_type(self.name)
        marks = np.array([bytes(message[:2]) for message in messages] if self.cdr else [b""] * len(messages))
        try:
            for mark in np.unique(marks):
                encoding = wire.cdr_encoding(bytes(mark).ljust(2, b"\0")) if self.cdr else ROS1
                chosen = np.flatnonzero(marks == mark)
                known_shapes = self._shapes.setdefault(bytes(mark), [])
                chosen_messages = (
                    [messages[row] for row in chosen.tolist()] if len(chosen) < len(messages) else messages
                )
                self._replace_wrong_definition(bytes(chosen_messages[0]), encoding)
                packed: dict[Any, _PackedMessages] = {}
                for shape, rows, matrix in wire.group_by_shape(
                    chosen_messages, self.types, self.name, encoding, known_shapes
                ):
                    if len(rows) == 1:
                        # the shape may come from an earlier message
                        own_shape = replace(shape, first=matrix[0].tobytes())
                        keys = [own_shape.bytes_of(leaf) for leaf in shape.leaves if meaning.is_key(leaf)]
                        group = (tuple(shape.counts), tuple(keys))
                        packed.setdefault(group, _PackedMessages(own_shape)).add(own_shape, int(chosen[rows[0]]))
                        continue
                    for same, message in _split_by_keys(shape, matrix, meaning):
                        yield from _decode_matrix(message, chosen[rows[same]], matrix[same], meaning.parts(message), {})
                for messages_of_leaves in packed.values():
                    yield from messages_of_leaves.blocks(meaning)
                del known_shapes[MAX_SHAPES:]
        except wire.WireError as error:
            raise TopicError(str(error)) from error

    def _replace_wrong_definition(self, message: bytes, encoding: Encoding) -> None:
        """Use ROS's own definition of the type if the file's does not match ``message``.

        Old recorders wrote the definition of another type.
        """
        try:
            wire.walk_message(message, self.types, self.name, encoding)
        except wire.WireError:
            with contextlib.suppress(TopicError, wire.WireError):
                ros_types = _builtin_types(self.name)
                wire.walk_message(message, ros_types, self.name, encoding)
                self.types = ros_types


@dataclass
class _PackedMessages:
    """Messages with the same leaves but different text lengths: a matrix of their numbers, and their texts."""

    first: MessageShape
    rows: list[int] = field(default_factory=list)
    numbers: list[bytes] = field(default_factory=list)
    texts: list[list[str]] = field(default_factory=list)  # texts of each message

    def add(self, shape: MessageShape, row: int) -> None:
        """Add a message."""
        self.rows.append(row)
        self.numbers.append(b"".join(shape.bytes_of(leaf) for leaf in shape.leaves if leaf.kind != TEXT))
        self.texts.append([shape.text(leaf) for leaf in shape.leaves if leaf.kind == TEXT])

    def blocks(self, meaning: meanings.Meaning) -> Iterator[Block]:
        """Yield one block of columns for each part of the messages."""
        texts = iter(zip(*self.texts, strict=True))
        arrays: dict[wire.Path, Any] = {}
        leaves: dict[Leaf | None, Leaf] = {}  # leaves of the matrix by leaf of the first message
        offset = 0
        for leaf in self.first.leaves:
            leaves[leaf] = replace(leaf, offset=offset)
            if leaf.kind == TEXT:
                arrays[leaf.path] = pa.array(next(texts), pa.string())
            else:
                offset += leaf.size
        parts = meaning.parts(self.first)
        for part in parts:
            part.columns = [replace(column, leaf=leaves[column.leaf]) for column in part.columns]
            part.stamp, part.frame = leaves.get(part.stamp), leaves.get(part.frame)
        matrix = np.frombuffer(b"".join(self.numbers), np.uint8).reshape(len(self.rows), offset)
        yield from _decode_matrix(self.first, np.array(self.rows), matrix, parts, arrays)


def _free_name(name: str, columns: Collection[str]) -> str:
    while name in columns:
        name = f"{name}_"
    return name


def _split_by_keys(
    shape: MessageShape, matrix: Matrix, meaning: meanings.Meaning
) -> Iterator[tuple[np.ndarray[Any, np.dtype[np.int64]], MessageShape]]:
    """Yield the indices (row,) of messages with equal keys, and a shape whose first message has these keys."""
    keys = [leaf for leaf in shape.leaves if meaning.is_key(leaf)]
    remaining = np.arange(len(matrix))
    if not keys:
        yield remaining, shape
        return
    key_bytes = np.concatenate([np.arange(leaf.offset, leaf.offset + leaf.size) for leaf in keys])
    while len(remaining):
        first = matrix[remaining[0]]
        same = (matrix[remaining][:, key_bytes] == first[key_bytes]).all(axis=1)
        yield remaining[same], replace(shape, first=first.tobytes())
        remaining = remaining[~same]


def _decode_matrix(
    shape: MessageShape,
    rows: np.ndarray[Any, np.dtype[np.int64]],
    matrix: Matrix,
    parts: Sequence[meanings.MessagePart],
    arrays: dict[wire.Path, Any],
) -> Iterator[Block]:
    """Yield the block of each part of messages (message, byte) of one shape; ``rows`` are their positions in the batch.

    ``arrays`` has values by path of their leaf, so that an array is read once for all of its columns.
    """
    for part in parts:
        header = [(HEADER, part.stamp), (FRAME, part.frame)]
        columns = {
            name: _column_array(shape, PartColumn(name, leaf), matrix, arrays)
            for name, leaf in header
            if leaf is not None
        }
        about: dict[str, Mapping[str, str]] = {}
        for column in part.columns:
            name = _free_name(column.name, columns)
            columns[name] = _column_array(shape, column, matrix, arrays)
            about[name] = dict(column.about)
        if about:
            yield Block(part.suffix, rows, columns, about)


def _column_array(shape: MessageShape, column: PartColumn, matrix: Matrix, arrays: dict[wire.Path, Any]) -> pa.Array:
    """Return a column of messages (message, byte). ``arrays`` keeps the values of each leaf by path."""
    leaf = column.leaf
    if leaf.kind == TEXT:
        return arrays[leaf.path] if leaf.path in arrays else _text_array(leaf, matrix)
    if column.index is None and leaf.count is not None:
        return _bytes_array(leaf, matrix)
    if leaf.path not in arrays:
        values = shape.numbers(leaf, matrix)
        arrays[leaf.path] = values.T.copy() if values.ndim == 2 else values  # (position, message)
    values = arrays[leaf.path] if column.index is None else arrays[leaf.path][column.index]
    return pa.array(values.astype(bool) if leaf.kind == "bool" else values)


def _bytes_array(leaf: Leaf, matrix: Matrix) -> pa.Array:
    """Return an array of bytes, one per message. Raises `TopicError` if they exceed the limit of 2 GiB."""
    count = leaf.count or 0
    content = np.ascontiguousarray(matrix[:, leaf.offset : leaf.offset + count])
    offsets = np.arange(len(matrix) + 1, dtype=np.int64) * count
    if offsets[-1] < 2**31:
        return pa.Array.from_buffers(
            pa.binary(), len(matrix), [None, pa.py_buffer(offsets.astype(np.int32)), pa.py_buffer(content)]
        )
    raise TopicError(f"one batch of its messages has {offsets[-1]} bytes")


def _text_array(leaf: Leaf, matrix: Matrix) -> pa.Array:
    """Return a text of each message, with replacement characters for invalid UTF-8."""
    content = _bytes_array(leaf, matrix)
    try:
        return content.cast(pa.string())
    except pa.ArrowInvalid:
        return pa.array([text_bytes.as_py().decode(errors="replace") for text_bytes in content], pa.string())
