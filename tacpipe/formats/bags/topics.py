"""Decode the messages of a topic in batches and collect the rows in a spill file, ordered by one clock.

JSON and protobuf messages of an MCAP file get one column per path, such as ``pose.position.x``.
"""

from __future__ import annotations

import base64
import binascii
import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Int64s
from tacpipe.formats.container import Batched, Time
from tacpipe.io import spill
from tacpipe.io.spill import Piece, Spill
from tacpipe.plugins.stage import Values
from tacpipe.printable import plain

LOG, HEADER, PUBLISH, FRAME = "t_log_ns", "t_header_ns", "t_publish_ns", "frame_id"
# maximum difference between a header stamp and its log time if both use the same clock
MAX_STAMP_OFFSET_NS = 60 * 10**9
ABOUT_TIME = {"unit": "ns", "quantity": "time"}


@dataclass(frozen=True)
class TopicStream:
    """A stream of a topic: its rows in time order, and the name of the time column."""

    suffix: str
    content: Batched
    time: Time
    note: str  # remark about the timestamps, empty if there is none


class TopicRows:
    """Collects the rows of one stream in ``spill``, and the properties shared by all rows."""

    def __init__(self, spill: Spill) -> None:
        """Create an empty stream whose rows are stored in ``spill``."""
        self._spill = spill
        self._pieces: list[Piece] = []
        self._schema: pa.Schema = pa.schema([])
        self._about: dict[str, Mapping[str, str]] = {}
        self._absent: set[str] = set()  # columns that are missing in some rows
        self._headers_set = self._headers_unset = False
        self._apart_ns = 0  # maximum difference between header stamp and log time
        self._published_apart = False  # True if a publish time differs from its log time
        self._frames: set[str] = set()  # frame names, at most two

    def describe(self, about: Mapping[str, Mapping[str, str]]) -> int:
        """Add field metadata by column without replacing existing metadata. Returns the number of described columns."""
        for name, values in about.items():
            self._about.setdefault(name, values)
        return len(self._about)

    def add(self, table: pa.Table) -> None:
        """Add rows to the spill."""
        names = set(table.column_names)
        if self._pieces:
            self._absent |= names ^ set(self._schema.names)
            self._schema = pa.unify_schemas([self._schema, table.schema], promote_options="permissive")
        else:
            self._schema = table.schema
        self._absent |= {name for name in names if table.column(name).null_count}
        log_ns = table.column(LOG).to_numpy()
        orders = [LOG]
        if HEADER in names and not table.column(HEADER).null_count:
            orders.append(HEADER)
            header_ns = table.column(HEADER).to_numpy()
            self._headers_set |= bool(header_ns.any())
            self._headers_unset |= not header_ns.all()
            self._apart_ns = max(self._apart_ns, int(np.abs(header_ns - log_ns).max(initial=0)))
        self._published_apart |= not table.column(PUBLISH).equals(table.column(LOG))
        if len(self._frames) < 2:
            frames = table.column(FRAME).unique().to_pylist() if FRAME in names else [""]
            self._frames |= {frame or "" for frame in frames}
        self._pieces.append(self._spill.add(table, orders))

    def finish(self, suffix: str) -> TopicStream:
        """Return a stream of the rows, ordered by their clock. ``suffix`` is the stream's suffix after the topic.

        Columns of constant or redundant times and frames are left out.
        """
        clock, note = self._choose_clock()
        left_out = set() if self._published_apart else {PUBLISH}
        if clock == LOG and HEADER not in self._absent and not self._headers_set:
            left_out.add(HEADER)
        metadata = {name: dict(values) for name, values in self._about.items()}
        metadata |= {name: dict(ABOUT_TIME) for name in (LOG, PUBLISH, HEADER)}
        metadata[clock]["clock"] = "header stamp" if clock == HEADER else "log time"
        if FRAME in self._schema.names and len(self._frames) == 1:
            (frame,) = self._frames
            if frame:
                metadata[clock]["frame"] = plain(frame)
            left_out.add(FRAME)
        kinds = {column.name: _column_type(column.type, column.name in self._absent) for column in self._schema}
        schema = pa.schema(
            [pa.field(name, kind, metadata=metadata.get(name)) for name, kind in kinds.items() if name not in left_out]
        )

        def read(piece: Piece) -> pa.Table:
            table = self._spill.read(piece)
            return pa.table([_fill_nulls(table, field) for field in schema], schema)

        count = sum(piece.rows for piece in self._pieces)
        content = Batched(schema, count, lambda: spill.in_order(self._pieces, read, clock))
        return TopicStream(suffix, content, Time(clock, "ns"), note)

    def _choose_clock(self) -> tuple[str, str]:
        """Return the name of the time column, and the reason if header stamps exist and are not used, or "".

        A header stamp is the time of measurement; the log time is the time of arrival. Header stamps are used only if
        all are set and they share the log's clock. Stamps of a simulation, of a device clock, or of a clock that was
        set during the recording would separate streams.
        """
        if HEADER not in self._schema.names or HEADER in self._absent:
            return LOG, ""
        if self._headers_unset:
            return LOG, "some header stamps are not set" if self._headers_set else ""
        if self._apart_ns > MAX_STAMP_OFFSET_NS:
            return LOG, f"header stamps are up to {self._apart_ns / 1e9:.3g} s from the log times"
        return HEADER, ""


def _column_type(kind: pa.DataType, absent: bool) -> pa.DataType:
    """Return the stored type of a column. Numbers that some rows lack become float64, so that NaN can mark them."""
    if not absent or pa.types.is_string(kind) or pa.types.is_binary(kind) or pa.types.is_floating(kind):
        return kind
    return pa.float64()


def _fill_nulls(table: pa.Table, field: pa.Field) -> pa.ChunkedArray:
    """Return a column cast to the type of ``field``, with NaN or empty text in place of nulls."""
    if field.name not in table.column_names:
        column = pa.chunked_array([pa.nulls(table.num_rows, field.type)])
    else:
        column = table.column(field.name)
        if pa.types.is_boolean(column.type) and column.type != field.type:
            column = column.cast(pa.uint8())
        column = column.cast(field.type, safe=False)
    if not column.null_count:
        return column
    if pa.types.is_string(field.type):
        return column.fill_null("")
    return column.fill_null(b"" if pa.types.is_binary(field.type) else float("nan"))


BATCH_BYTES = 1 << 24  # size of undecoded messages per topic in memory
BATCH_MESSAGES = 1 << 16
MAX_STREAM_COLUMNS = 1 << 14


class TopicError(ValueError):
    """The reason why a topic cannot be read."""


@dataclass(frozen=True)
class Block:
    """Decoded messages of one shape: their row numbers and columns."""

    suffix: str  # suffix of the stream name; a message may have rows for several streams
    rows: Int64s  # (row,), positions in the batch
    columns: Mapping[str, pa.Array]
    about: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # field metadata by column


class MessageDecoder(Protocol):
    """Decodes the messages of a topic to columns."""

    def blocks(self, messages: Sequence[bytes]) -> Iterator[Block]:
        """Yield the columns of messages. Raises `TopicError` if they cannot be decoded."""


class TopicDecoder:
    """Decodes the messages of one topic to streams; their rows are written to ``spill``."""

    def __init__(self, decoder: MessageDecoder, spill: Spill) -> None:
        self._decoder, self._spill = decoder, spill
        self._messages: list[bytes] = []
        self._log_ns: list[int] = []
        self._publish_ns: list[int] = []
        self._bytes = 0
        self._streams: dict[str, TopicRows] = {}  # rows by stream suffix
        self.count = 0

    def add(self, message: bytes, log_ns: int, publish_ns: int) -> None:
        """Add a message. Raises `TopicError` if a batch is full and cannot be decoded."""
        self._messages.append(message)
        self._log_ns.append(log_ns)
        self._publish_ns.append(publish_ns)
        self._bytes += len(message)
        self.count += 1
        if self._bytes >= BATCH_BYTES or len(self._messages) >= BATCH_MESSAGES:
            self._flush()

    def finish(self) -> list[TopicStream]:
        """Return the streams of the topic. Raises `TopicError` if they cannot be decoded."""
        self._flush()
        return [rows.finish(suffix) for suffix, rows in self._streams.items()]

    def _flush(self) -> None:
        """Decode the messages in memory and add their rows to the streams.

        Raises `TopicError` for too many values per message, and for values of different types in one column.
        """
        if not self._messages:
            return
        log_ns, publish_ns = (_stamp_array(values) for values in (self._log_ns, self._publish_ns))
        blocks: dict[str, list[Block]] = {}
        for block in self._decoder.blocks(self._messages):
            blocks.setdefault(block.suffix, []).append(block)
        self._messages, self._log_ns, self._publish_ns, self._bytes = [], [], [], 0
        for suffix, suffix_blocks in blocks.items():
            stream = self._streams.setdefault(suffix, TopicRows(self._spill))
            tables = []
            for block in suffix_blocks:
                stamps = {LOG: pa.array(log_ns[block.rows]), PUBLISH: pa.array(publish_ns[block.rows])}
                tables.append(pa.table({**stamps, **block.columns}))
                if stream.describe(block.about) > MAX_STREAM_COLUMNS:
                    raise TopicError(f"its messages have more than {MAX_STREAM_COLUMNS} values")
            table = pa.concat_tables(tables, promote_options="permissive")
            rows = np.concatenate([block.rows for block in suffix_blocks])
            if (np.diff(rows) < 0).any():
                table = table.combine_chunks().take(pa.array(np.argsort(rows, kind="stable")))
            try:
                stream.add(table)
            except pa.ArrowException as error:
                raise TopicError("its messages hold values of different types in one place") from error


def _stamp_array(values: Sequence[int]) -> Int64s:
    try:
        return np.array(values, np.int64)
    except OverflowError:
        raise TopicError("its log times are beyond the year 2262") from None


MAX_COLUMNS = 4096  # maximum number of values per message
_STAMPS = ("header.stamp", "timestamp", "stamp")  # integers at these paths are nanoseconds


Leaf = str | bytes | float | bool | None  # a value of a message


def block_from_rows(rows: Sequence[Mapping[str, Leaf]], types: Mapping[str, pa.DataType]) -> Block:
    """Return a block of columns from messages, each a mapping from path to value. ``types`` are types declared by a schema.

    Raises `TopicError` if there are too many paths.
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
    """Return values as a column of this type, or else as floats or texts; empty texts if all are None."""
    try:
        column = pa.array(values, kind)
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
        are_numbers = all(isinstance(value, int | float | None) for value in values)
        convert = float if are_numbers else str
        column = pa.array([None if value is None else convert(value) for value in values])
    return pa.array([""] * len(values), pa.string()) if pa.types.is_null(column.type) else column


@dataclass(frozen=True)
class Json:
    """Decodes JSON messages. The JSON schema ``schema`` declares which values are base64."""

    schema: str

    def blocks(self, messages: Sequence[bytes]) -> Iterator[Block]:
        """Yield the columns of messages. Raises `TopicError` if one is not a JSON object."""
        encoded = self._base64_properties()
        rows: list[dict[str, Leaf]] = []
        for message in messages:
            try:
                value = json.loads(message, object_pairs_hook=_build_object)
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

    def _base64_properties(self) -> set[str]:
        """Return the names of the properties that the schema declares as base64; an empty set without a valid schema."""
        try:
            schema = json.loads(self.schema or "{}")
            return {
                name
                for name, property_schema in schema["properties"].items()
                if property_schema.get("contentEncoding") == "base64"
            }
        except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
            return set()


def _build_object(pairs: Sequence[tuple[str, Any]]) -> Values:
    """Return a JSON object from its entries. Raises `TopicError` if it repeats a name."""
    value = dict(pairs)
    if len(value) < len(pairs):
        raise TopicError("a message has two entries of the same name")
    return value


def flatten_object(nested: Values, prefix: str = "") -> dict[str, Leaf]:
    """Return nested objects and lists as values by path; a time (``sec`` and ``nsec``) becomes one value in nanoseconds.

    >>> flatten_object({"stamp": {"sec": 1, "nsec": 5}, "a": {"x": 1.5}, "l": [1, 2], "n": None})
    {'stamp': 1000000005, 'a.x': 1.5, 'l.0': 1, 'l.1': 2, 'n': None}
    """
    values: dict[str, Leaf] = {}
    for name, entry in nested.items():
        path = f"{prefix}{name}"
        is_list = isinstance(entry, list)
        value = {str(position): element for position, element in enumerate(entry)} if is_list else entry
        if not isinstance(value, dict):
            values[path] = value
            continue
        is_time = set(value) in ({"sec", "nsec"}, {"sec", "nanosec"})
        if is_time and all(isinstance(number, int) for number in value.values()):
            values[path] = value["sec"] * 10**9 + value["nsec" if "nsec" in value else "nanosec"]
        else:
            values |= flatten_object(value, f"{path}.")
    return values


def _decode_base64(value: Any) -> bytes:
    try:
        return base64.b64decode(value or "")
    except (binascii.Error, TypeError, ValueError) as error:
        raise TopicError("a value is not base64, as its schema states") from error


TIMES = ("google.protobuf.Timestamp", "google.protobuf.Duration")
_TYPES = {  # column type by a field descriptor's ``cpp_type``
    **{1: pa.int32(), 2: pa.int64(), 3: pa.uint32(), 4: pa.uint64(), 5: pa.float64(), 6: pa.float32(), 7: pa.bool_()},
    8: pa.int32(),  # enumeration
}
_MESSAGE, _TEXT, _BYTES = 10, 9, 12


@dataclass(frozen=True)
class Protobuf:
    """Decodes protobuf messages; ``schema`` is a set of file descriptors."""

    name: str
    schema: bytes

    def blocks(self, messages: Sequence[bytes]) -> Iterator[Block]:
        """Yield the columns of messages. Raises `TopicError` if they do not match the type."""
        from google.protobuf.message import DecodeError

        types: dict[str, pa.DataType] = {}
        rows = []
        for message in messages:
            try:
                rows.append(flatten_message(self._message_class.FromString(message), types))
            except (DecodeError, RecursionError) as error:
                raise TopicError(f"a message is not a {plain(self.name)}") from error
        yield block_from_rows(rows, types)

    @functools.cached_property
    def _message_class(self) -> Any:
        """The class of the messages. Raises `TopicError` if the file does not define their type."""
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


def flatten_message(message: Any, types: dict[str, pa.DataType], prefix: str = "") -> dict[str, Leaf]:
    """Return a message as values by path, and add the types of numbers to ``types``.

    Fields without presence are always included, others only if they are set.
    """
    values: dict[str, Leaf] = {}
    for descriptor in message.DESCRIPTOR.fields:
        value = getattr(message, descriptor.name)
        path = f"{prefix}{descriptor.name}"
        if descriptor.message_type is not None and descriptor.message_type.GetOptions().map_entry:
            values_by_path = {f"{path}.{key}": value[key] for key in sorted(value, key=str)}
            descriptor = descriptor.message_type.fields_by_name["value"]
        elif descriptor.is_repeated:
            values_by_path = {f"{path}.{position}": value for position, value in enumerate(value)}
        elif descriptor.has_presence and not message.HasField(descriptor.name):
            continue
        else:
            values_by_path = {path: value}
        for name, value in values_by_path.items():
            if descriptor.cpp_type != _MESSAGE:
                values[name] = value
                types[name] = pa.binary() if descriptor.type == _BYTES else _TYPES.get(descriptor.cpp_type, pa.string())
            elif descriptor.message_type.full_name in TIMES:
                values[name] = value.seconds * 10**9 + value.nanos
                types[name] = pa.int64()
            else:
                values |= flatten_message(value, types, f"{name}.")
    return values
