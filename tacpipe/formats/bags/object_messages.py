"""Decode JSON and protobuf messages of an MCAP file: one column per path, such as ``pose.position.x``."""

from __future__ import annotations

import base64
import binascii
import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.formats.bags.topics import HEADER, Block, TopicError
from tacpipe.printable import plain

MAX_COLUMNS = 4096  # values per message
_STAMPS = ("header.stamp", "timestamp", "stamp")  # whole numbers under these paths are nanoseconds


def block_from_rows(rows: Sequence[Mapping[str, Any]], types: Mapping[str, pa.DataType]) -> Block:
    """Return messages, each its values by path, as columns; ``types`` are those of paths that a schema declares.

    Raises `TopicError` where they have too many paths.
    """
    names = list(dict.fromkeys(name for row in rows for name in row))
    if len(names) > MAX_COLUMNS:
        raise TopicError(f"its messages have more than {MAX_COLUMNS} values")
    stamp = next((name for name in _STAMPS if any(isinstance(row.get(name), int) for row in rows)), None)
    columns: dict[str, pa.Array] = {}
    for name in names:
        values = [row.get(name) for row in rows]
        if name == stamp:
            columns[HEADER] = pa.array([value if isinstance(value, int) else 0 for value in values], pa.int64())
        else:
            column = name.replace(".", "_")
            if column in columns:
                raise TopicError(f"its messages have two values that would both be named {plain(column)}")
            columns[column] = _column_array(values, types.get(name))
    return Block("", np.arange(len(rows)), columns, {name: {} for name in columns if name != HEADER})


def _column_array(values: Sequence[Any], kind: pa.DataType | None) -> pa.Array:
    try:
        column = pa.array(values, kind)
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
        numbers = all(isinstance(value, int | float | None) for value in values)
        floats = [None if value is None else float(value) for value in values] if numbers else None
        column = pa.array(floats) if floats else pa.array([None if value is None else str(value) for value in values])
    return pa.array([""] * len(values), pa.string()) if pa.types.is_null(column.type) else column


@dataclass(frozen=True)
class Json:
    """The messages of a topic in JSON; ``schema`` is its JSON schema, which states what is bytes in base64."""

    schema: str

    def blocks(self, messages: Sequence[bytes]) -> Iterator[Block]:
        """Yield the columns of messages; raises `TopicError` where one is not a JSON object."""
        encoded = self._encoded()
        rows: list[dict[str, Any]] = []
        for message in messages:
            try:
                value = json.loads(message, object_pairs_hook=_refuse_repeated)
            except TopicError:
                raise
            except (ValueError, RecursionError) as error:
                raise TopicError("a message is not JSON") from error
            if not isinstance(value, dict):
                raise TopicError("a message is not a JSON object")
            try:
                row = flatten_object(value)
            except RecursionError as error:
                raise TopicError("a message has too many objects within one another") from error
            row |= {name: _decode_base64(row[name]) for name in encoded if name in row}
            rows.append(row)
        yield block_from_rows(rows, dict.fromkeys(encoded, pa.binary()))

    def _encoded(self) -> set[str]:
        try:
            schema = json.loads(self.schema or "{}")
            return {
                name
                for name, property_schema in schema["properties"].items()
                if property_schema.get("contentEncoding") == "base64"
            }
        except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
            return set()


def _refuse_repeated(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON. Raises `TopicError` where two of its entries have the same name."""
    value = dict(pairs)
    if len(value) < len(pairs):
        raise TopicError("a message has two entries of the same name")
    return value


def flatten_object(nested: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return nested objects and lists as one object of paths; a time (``sec`` and ``nsec``) is one value in nanoseconds.

    >>> flatten_object({"stamp": {"sec": 1, "nsec": 5}, "a": {"x": 1.5}, "l": [1, 2], "n": None})
    {'stamp': 1000000005, 'a.x': 1.5, 'l.0': 1, 'l.1': 2, 'n': None}
    """
    values: dict[str, Any] = {}
    for name, value in nested.items():
        path = f"{before}{name}"
        if isinstance(value, list):
            value = {str(position): element for position, element in enumerate(value)}
        if not isinstance(value, dict):
            values[path] = value
        elif set(value) in ({"sec", "nsec"}, {"sec", "nanosec"}) and all(
            isinstance(part, int) for part in value.values()
        ):
            values[path] = value["sec"] * 10**9 + next(part for key, part in value.items() if key != "sec")
        else:
            values |= flatten_object(value, f"{path}.")
    return values


def _decode_base64(value: Any) -> bytes:
    try:
        return base64.b64decode(value or "")
    except (binascii.Error, TypeError, ValueError) as error:
        raise TopicError("a value is not base64, as its schema states") from error


TIMES = ("google.protobuf.Timestamp", "google.protobuf.Duration")
_TYPES = {  # column types by the ``cpp_type`` of a field's descriptor
    **{1: pa.int32(), 2: pa.int64(), 3: pa.uint32(), 4: pa.uint64(), 5: pa.float64(), 6: pa.float32(), 7: pa.bool_()},
    8: pa.int32(),  # enumerations
}
_MESSAGE, _TEXT, _BYTES = 10, 9, 12


@dataclass(frozen=True)
class Protobuf:
    """The messages of a topic of a protobuf type; ``schema`` is a set of file descriptors."""

    name: str
    schema: bytes

    def blocks(self, messages: Sequence[bytes]) -> Iterator[Block]:
        """Yield the columns of messages; raises `TopicError` where they are not of the type."""
        from google.protobuf.message import DecodeError

        types: dict[str, pa.DataType] = {}
        rows = []
        for message in messages:
            try:
                rows.append(flatten_message(self._class.FromString(message), types))
            except (DecodeError, RecursionError) as error:
                raise TopicError(f"a message is not a {plain(self.name)}") from error
        yield block_from_rows(rows, types)

    @functools.cached_property
    def _class(self) -> Any:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
        from google.protobuf.message import DecodeError

        try:
            pool = descriptor_pool.DescriptorPool()
            for file in descriptor_pb2.FileDescriptorSet.FromString(self.schema).file:
                pool.Add(file)
            descriptor = pool.FindMessageTypeByName(self.name)
            return message_factory.GetMessageClass(descriptor)
        except (DecodeError, KeyError, TypeError, ValueError) as error:
            raise TopicError(f"the file has no definition of its type {plain(self.name)}") from error


def flatten_message(message: Any, types: dict[str, pa.DataType], before: str = "") -> dict[str, Any]:
    """Return a message as values by path, all fields without presence too; the types of numbers are added to ``types``."""
    values: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        path = f"{before}{field.name}"
        if field.message_type is not None and field.message_type.GetOptions().map_entry:
            values_by_path = {f"{path}.{key}": value[key] for key in sorted(value, key=str)}
            field = field.message_type.fields_by_name["value"]
        elif field.is_repeated:
            values_by_path = {f"{path}.{position}": value for position, value in enumerate(value)}
        elif field.has_presence and not message.HasField(field.name):
            continue
        else:
            values_by_path = {path: value}
        for name, value in values_by_path.items():
            if field.cpp_type != _MESSAGE:
                values[name] = value
                types[name] = pa.binary() if field.type == _BYTES else _TYPES.get(field.cpp_type, pa.string())
            elif field.message_type.full_name in TIMES:
                values[name] = value.seconds * 10**9 + value.nanos
                types[name] = pa.int64()
            else:
                values |= flatten_message(value, types, f"{name}.")
    return values
