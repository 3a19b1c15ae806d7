"""Decode the messages of a topic in batches and collect the rows in a spill file, ordered by one clock.

JSON and protobuf messages of an MCAP file get one column per path, such as ``pose.position.x``.
"""

from __future__ import annotations

import base64
import binascii
import functools
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tacpipe.arrays import Int64s
from tacpipe.formats.bags.headers import HeaderStamps
from tacpipe.formats.container import Batched, Time, json_object
from tacpipe.io import spill
from tacpipe.io.spill import Piece, Spill
from tacpipe.plugins.stage import Values
from tacpipe.printable import listed, plain

LOG, HEADER, PUBLISH, FRAME = "t_log_ns", "t_header_ns", "t_publish_ns", "frame_id"
ABOUT_TIME = {"unit": "ns", "quantity": "time"}


@dataclass(frozen=True)
class TopicStream:
    """A stream of a topic: its rows in time order, and the name of the time column."""

    suffix: str
    content: Batched
    time: Time
    delay_ns: float = 0.0  # median delay of its times behind the log times
    log_span_ns: tuple[int, int] = (0, 0)  # first and last log time
    notes: Sequence[str] = ()  # clauses about the times


class TopicRows:
    """Collects the rows of one stream in ``spill``, and the properties shared by all rows."""

    def __init__(self, spill: Spill, about: Mapping[str, Mapping[str, str]]) -> None:
        """Create an empty stream whose rows are stored in ``spill``. ``about`` has the field metadata by column."""
        self._spill, self._about = spill, about
        self._pieces: list[Piece] = []
        self._schema: pa.Schema = pa.schema([])
        self._absent: set[str] = set()  # columns that are missing in some rows
        self._headers = HeaderStamps()
        self.log_span_ns = (2**63, -(2**63))  # first and last log time
        self._published_apart = False  # True if a publish time differs from its log time
        self.frames: set[str] = set()  # frame names, at most two

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
            self._headers.add(table.column(HEADER).to_numpy(), log_ns)
        self.log_span_ns = min(self.log_span_ns[0], int(log_ns.min())), max(self.log_span_ns[1], int(log_ns.max()))
        self._published_apart |= not table.column(PUBLISH).equals(table.column(LOG))
        if len(self.frames) < 2:
            self.frames |= set(_frames(table))
        self._pieces.append(self._spill.add(table, orders))

    def finish(self, suffix: str) -> TopicStream:
        """Return a stream of the rows, ordered by their clock. ``suffix`` is the stream's suffix after the topic.

        Columns of constant or redundant times and frames are left out.
        """
        has_headers = HEADER in self._schema.names and HEADER not in self._absent
        counts, problem = self._headers.counts, self._headers.problem() if has_headers else ""
        clock = HEADER if has_headers and not problem else LOG
        left_out = set() if self._published_apart else {PUBLISH}
        if has_headers and counts["unset"] == counts["rows"]:
            left_out.add(HEADER)
        notes = [f"{problem}; its log times are used"] if problem and HEADER not in left_out else []
        metadata = {name: dict(values) for name, values in self._about.items()}
        metadata |= {name: dict(ABOUT_TIME) for name in (LOG, PUBLISH, HEADER)}
        metadata[clock]["clock"] = "header stamp" if clock == HEADER else "log time"
        if FRAME in self._schema.names and len(self.frames) == 1:
            (frame,) = self.frames
            if frame:
                metadata[clock]["frame"] = plain(frame)
            left_out.add(FRAME)
        kinds = {column.name: _column_type(column.type, column.name in self._absent) for column in self._schema}
        schema = pa.schema(
            [pa.field(name, kind, metadata=metadata.get(name)) for name, kind in kinds.items() if name not in left_out]
        )

        def read(piece: Piece) -> pa.Table:
            table = self._spill.read(piece)
            if clock == HEADER:
                times = pc.min_element_wise(table.column(HEADER), table.column(LOG))
                table = table.set_column(table.column_names.index(HEADER), HEADER, times)
            return pa.table([_fill_nulls(table, field) for field in schema], schema)

        pieces = self._pieces
        if clock == HEADER:
            pieces = [replace(piece, minima={HEADER: min(piece.minima.values())}) for piece in pieces]
            notes += self._headers.notes()
        content = Batched(schema, sum(piece.rows for piece in pieces), lambda: spill.in_order(pieces, read, clock))
        delay_ns = self._headers.delay_ns if clock == HEADER else 0.0
        return TopicStream(suffix, content, Time(clock, "ns"), delay_ns, self.log_span_ns, notes)

    def take(self, source: TopicRows) -> None:
        """Add the rows of another collection in the same spill."""
        for piece in source._pieces:
            self.add(self._spill.read(piece))


def _frames(table: pa.Table) -> list[str]:
    """Return the names of the frames in a table; messages without a frame have the name ""."""
    frames = table.column(FRAME).unique().to_pylist() if FRAME in table.column_names else [""]
    return list(dict.fromkeys(frame or "" for frame in frames))


def _split_by_frame(table: pa.Table) -> Iterator[tuple[str, pa.Table]]:
    """Yield the rows of each frame; all rows, under the name of the first, if there are more than `MAX_SENSORS`."""
    frames = _frames(table)
    if not 1 < len(frames) <= MAX_SENSORS:
        yield frames[0], table
        return
    for frame in frames:
        part = table.filter(pc.equal(table.column(FRAME).fill_null(""), frame))
        yield frame, part.select([name for name in part.column_names if part.column(name).null_count < part.num_rows])


def _finish_frames(suffix: str, rows_by_frame: Mapping[str, TopicRows]) -> list[TopicStream]:
    """Return a stream for each frame if the frames are those of several sensors, otherwise one stream.

    Messages of several sensors alternate. A frame that follows another one is a change of a setting, and many frames
    are numbers or names of objects.
    """
    first, *remaining = rows_by_frame.values()
    spans_ns = sorted(rows.log_span_ns for rows in rows_by_frame.values())
    alternate = all(start < stop for (_, stop), (start, _) in itertools.pairwise(spans_ns))
    if (
        len(rows_by_frame) <= MAX_SENSORS
        and alternate
        and all(len(rows.frames) == 1 for rows in rows_by_frame.values())
    ):
        streams = [
            rows.finish(":".join(filter(None, [suffix, frame if remaining else ""])))
            for frame, rows in rows_by_frame.items()
        ]
        note = (
            f"has messages of {len(streams)} sensors, the frames {listed(rows_by_frame, MAX_SENSORS)}: each is a stream"
        )
        return [replace(streams[0], notes=[note, *streams[0].notes]), *streams[1:]] if remaining else streams
    for rows in remaining:
        first.take(rows)
    return [first.finish(suffix)]


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
MAX_SENSORS = 16  # maximum number of frames on one topic that are read as one stream each


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
        self._streams: dict[str, dict[str, TopicRows]] = {}  # rows by stream suffix and frame
        self._about: dict[str, dict[str, Mapping[str, str]]] = {}  # field metadata by stream suffix and column
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
        return [
            stream
            for suffix, rows_by_frame in self._streams.items()
            for stream in _finish_frames(suffix, rows_by_frame)
        ]

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
            rows_by_frame = self._streams.setdefault(suffix, {})
            about = self._about.setdefault(suffix, {})
            tables = []
            for block in suffix_blocks:
                stamps = {LOG: pa.array(log_ns[block.rows]), PUBLISH: pa.array(publish_ns[block.rows])}
                tables.append(pa.table({**stamps, **block.columns}))
                about |= {name: values for name, values in block.about.items() if name not in about}
                if len(about) > MAX_STREAM_COLUMNS:
                    raise TopicError(f"its messages have more than {MAX_STREAM_COLUMNS} values")
            table = pa.concat_tables(tables, promote_options="permissive")
            rows = np.concatenate([block.rows for block in suffix_blocks])
            if (np.diff(rows) < 0).any():
                table = table.combine_chunks().take(pa.array(np.argsort(rows, kind="stable")))
            try:
                for frame, part in _split_by_frame(table):
                    rows_by_frame.setdefault(frame, TopicRows(self._spill, about)).add(part)
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
        properties = json_object(self.schema).get("properties")
        named = properties.items() if isinstance(properties, dict) else ()
        return {name for name, about in named if isinstance(about, dict) and about.get("contentEncoding") == "base64"}


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
