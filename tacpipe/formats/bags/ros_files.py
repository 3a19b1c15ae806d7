"""Read the records of ROS 1 bags and ROS 2 SQLite files: topics with their definitions, raw messages, metadata.

The readers of all three storages (MCAP, ROS 1, SQLite) read sequentially without the index and yield the same types. A
reader that stops early yields a `BagDamage` last.
"""

from __future__ import annotations

import bz2
import contextlib
import io
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeAlias
from urllib.parse import quote

import numpy as np

from tacpipe.errors import TacpipeError
from tacpipe.formats.bags import ros
from tacpipe.formats.faults import explaining
from tacpipe.io import memory, regular
from tacpipe.printable import excerpt, plain

PIECE_BYTES = 1 << 20  # number of bytes read or unpacked at once
CUT_OFF = "the file ends within a record: it was cut off, and what came after is missing"


class BrokenRecordError(Exception):
    """A record cannot be read; the message is a clause with the reason."""


@dataclass(frozen=True)
class TopicConnection:
    """A channel: a source of messages of one topic, with their type and encoding. A topic may have several channels."""

    number: int  # number of the channel, to which messages refer
    topic: str
    type: str  # name of the message type
    encoding: str  # message encoding: ros1, cdr, json, protobuf, …
    schema_encoding: str  # encoding of the definition: ros1msg, ros2msg, ros2idl, jsonschema, protobuf, …
    schema: bytes
    metadata: Mapping[str, str] = field(default_factory=dict)


class BagMessage(
    NamedTuple
):  # a NamedTuple, because there are millions and creating dataclass instances takes three times as long
    """A message as stored in the file."""

    channel: int
    log_ns: int
    publish_ns: int
    content: bytes


@dataclass(frozen=True)
class Metadata:
    """Metadata of the file: text values by name."""

    name: str
    values: Mapping[str, str]


@dataclass(frozen=True)
class BagDamage:
    """The reason why reading ended early, or the part that was not read, as a sentence."""

    text: str


@dataclass
class LostChunk:
    """A chunk whose messages are lost, with the facts from its header and index."""

    problem: str  # completes the sentence "a chunk …"
    first_ns: int = 0  # range of log times
    last_ns: int = 0
    count: int = 0  # number of messages, or 0 if the file does not state it

    def damage(self, path: Path) -> BagDamage:
        """Return the damage as a sentence."""
        interval = f" from {format_time(self.first_ns)} to {format_time(self.last_ns)}" if self.last_ns else ""
        count = f"its {self.count:,} messages" if self.count else "its messages, an unknown number,"
        return BagDamage(f"{path}: a chunk {self.problem}; {count}{interval} are left out.")


def format_time(time_ns: int) -> str:
    """Return a Unix time as a date in UTC.

    >>> format_time(1_700_000_000_000_000_000), format_time(2**64 - 1)
    ('2023-11-14T22:13:20.000', '18446744073709551615 ns')
    """
    if not 0 <= time_ns < 2**63:
        return f"{time_ns} ns"
    return str(np.datetime_as_string(np.datetime64(time_ns, "ns"), unit="ms"))


def declares_too_much(size: int) -> str:
    """Return a problem that completes "a chunk …" if a chunk's unpacked ``size`` in bytes exceeds the limit, or ""."""
    limit = memory.MAX_BLOCK_BYTES
    return f"declares {size:,} bytes, more than the {limit:,} that are unpacked" if size > limit else ""


def unpack_chunk(compression: str, content: bytes, size: int, accepted: str) -> bytes:
    """Return the unpacked content of a chunk, up to ``size + 1`` bytes, or the part that can be unpacked.

    Raises `BrokenRecordError` for a compression that is not one of ``accepted``, such as "zstd or lz4".
    """
    if not compression:
        return content
    if compression not in accepted.split(" or "):
        raise BrokenRecordError(f"its chunks are compressed with {plain(compression)}, not {accepted}")
    parts: list[bytes] = []
    remaining = size + 1
    if compression == "zstd":
        import zstandard

        source = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(content))
        with contextlib.suppress(zstandard.ZstdError):
            while remaining and (part := source.read(min(remaining, PIECE_BYTES))):
                parts.append(part)
                remaining -= len(part)
        return b"".join(parts)
    new_decompressor: Callable[[], Any] = bz2.BZ2Decompressor
    if compression == "lz4":
        import lz4.frame

        new_decompressor = lz4.frame.LZ4FrameDecompressor
    with contextlib.suppress(OSError, RuntimeError, EOFError):
        while content and remaining:  # each time one of several frames
            decompressor = new_decompressor()
            parts.append(bytes(decompressor.decompress(content, remaining)))
            remaining -= len(parts[-1])
            content = decompressor.unused_data or b"" if decompressor.eof else b""
    return b"".join(parts)


Record: TypeAlias = TopicConnection | BagMessage | Metadata | BagDamage

_ERRORS = (sqlite3.Error, UnicodeDecodeError)  # UnicodeDecodeError: an SQLite message may quote damaged text
SQLITE_MAGIC = b"SQLite format 3\0"


def read_sqlite_records(path: Path) -> Iterator[Record]:
    """Yield the records of a file in the order in which they were written. Raises `TacpipeError` if it is not a bag."""
    with regular.failing(path), regular.opened(path) as file:
        magic = file.read(len(SQLITE_MAGIC))
    if magic != SQLITE_MAGIC:
        raise TacpipeError(f"{path} is not a SQLite file: it {'does not begin as one' if magic else 'is empty'}.")
    with _connect(path) as connection:
        with explaining(_ERRORS, f"{path} is not a bag of ROS 2: "):
            _expect_tables(path, connection)
            yield from _read_channels(connection)
        try:
            for number, log_ns, content in connection.execute(
                "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
            ):
                if not (isinstance(number, int) and isinstance(log_ns, int) and isinstance(content, bytes)):
                    yield BagDamage(
                        f"{path} is damaged (a message has no time or no bytes): what came after is missing."
                    )
                    return
                yield BagMessage(number, log_ns, log_ns, content)
        except _ERRORS as error:
            yield BagDamage(f"{path} is damaged ({plain(str(error), 120)}): what came after is missing.")


@contextlib.contextmanager
def _connect(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database read-only in the block. If it has a write-ahead log (-wal), open a copy of both."""
    log = regular.inside(path.parent, f"{path.name}-wal")
    with tempfile.TemporaryDirectory() if log.is_file() and log.stat().st_size else contextlib.nullcontext() as copies:
        if copies is None:
            address = f"file:{quote(str(path.absolute()))}?immutable=1"
        else:
            for source in (path, log):
                shutil.copy(source, copies)
            address = f"file:{quote(str(Path(copies, path.name)))}"
        connection = sqlite3.connect(address, uri=True)
        connection.text_factory = lambda content: content.decode(errors="replace")
        try:
            yield connection
        finally:
            connection.close()


def _expect_tables(path: Path, connection: sqlite3.Connection) -> None:
    """Raise `TacpipeError` if topics or messages are not tables.

    Views and virtual tables would run queries that are stored in the file.
    """
    definitions = dict(connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
    for name in ("topics", "messages"):
        if not str(definitions.get(name, "")).upper().startswith("CREATE TABLE"):
            raise TacpipeError(
                f"{path} has no table {name}, which a bag of ROS 2 has; a view of this name is not read."
            )


def _read_channels(connection: sqlite3.Connection) -> Iterator[Record]:
    """Yield a record per topic of a database, with the definition of its type, then one with the ROS distribution."""
    definitions: dict[str, tuple[str, bytes]] = {}
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if "message_definitions" in tables:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        definitions = {str(name): (str(kind), str(text).encode()) for name, kind, text in connection.execute(query)}
    for number, topic, name, encoding in connection.execute("SELECT id, name, type, serialization_format FROM topics"):
        kind, text = definitions.get(str(name), ("ros2msg", b""))
        yield TopicConnection(number, str(topic), ros.normalize_type_name(str(name)), str(encoding), kind, text)
    if "schema" in tables:
        for (distribution,) in connection.execute("SELECT ros_distro FROM schema"):
            yield Metadata("rosbag2", {"ros_distro": str(distribution or "")})


BAG_MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, INDEX, CHUNK, CONNECTION = 2, 3, 4, 5, 7
MAX_HEADER_BYTES = 1 << 20


def read_bag_records(path: Path) -> Iterator[Record]:
    """Yield the records of a bag. Raises `TacpipeError` if it is not a bag of version 2.0."""
    with regular.failing(path), regular.opened(path) as file:
        magic = file.read(len(BAG_MAGIC))
        if magic != BAG_MAGIC:
            version = magic.split(b"\n")[0]
            if magic.startswith(b"#ROSBAG"):
                raise TacpipeError(
                    f"{path} is a bag of another version, {excerpt(version)}; 2.0 is read. Run `rosbag fix`."
                )
            raise TacpipeError(f"{path} is not a bag: it {'is empty' if not magic else 'does not begin as one'}.")
        try:
            yield from _read_records(path, file, path.stat().st_size)
        except BrokenRecordError as error:
            yield BagDamage(f"{path}: {error}.")


def _read_records(path: Path, file: BinaryIO, size: int, *, within_chunk: bool = False) -> Iterator[Record]:
    """Yield the records of a file or of a chunk, whose ``size`` is in bytes.

    Raises `BrokenRecordError` if the file is truncated, damaged or encrypted.
    """
    lost: LostChunk | None = None
    while file.tell() < size:
        header = _header_fields(_read_sized(file, size, MAX_HEADER_BYTES))
        kind = header["op"][0] if header.get("op") else None
        if kind == BAG and header.get("encryptor"):
            raise BrokenRecordError(f"it is encrypted with {excerpt(header['encryptor'])}; decrypt it first")
        if kind == INDEX and lost is not None:
            _count_lost_messages(lost, _read_sized(file, size))
            continue
        if lost is not None:
            yield lost.damage(path)
            lost = None
        if kind not in (MESSAGE, CHUNK, CONNECTION):
            _skip_content(file, size)
            continue
        if kind == CHUNK and within_chunk:
            raise BrokenRecordError("a chunk lies within a chunk")
        if kind == CHUNK:
            content, complete = _read_content(file, size)
            unpacked, problem = _unpack(header, content)
            read_records = _read_records(path, io.BytesIO(unpacked), len(unpacked), within_chunk=True)
            if not complete:
                yield from read_records
                raise BrokenRecordError(CUT_OFF)
            try:
                yield from (
                    [] if problem else list(read_records)
                )  # if a chunk is damaged, none of its records can be trusted
            except BrokenRecordError:
                problem = f"of {len(unpacked):,} bytes is damaged"
            lost = LostChunk(problem) if problem else None
            continue
        content = _read_sized(file, size)
        number = _field_number(header, "conn")
        if kind == CONNECTION:
            yield _channel(number, header, _header_fields(content))
            continue
        log_ns = _time_ns(header.get("time", bytes(8)))
        yield BagMessage(number, log_ns, log_ns, content)
    if lost is not None:
        yield lost.damage(path)


def _unpack(header: dict[str, bytes], content: bytes) -> tuple[bytes, str]:
    """Return the intact part of a chunk's unpacked content, and a problem that completes "a chunk …", or ""."""
    size = _field_number(header, "size")
    if problem := declares_too_much(size):
        return b"", problem
    compression = header.get("compression", b"none").decode(errors="replace")
    unpacked = unpack_chunk("" if compression == "none" else compression, content, size, "bz2 or lz4")
    return unpacked, "" if len(unpacked) == size else f"of {size:,} bytes is damaged"


def _count_lost_messages(lost: LostChunk, index: bytes) -> None:
    """Add the messages that an index lists to those of a lost chunk; an entry has 8 bytes of time and 4 of offset."""
    times = [_time_ns(index[offset : offset + 8]) for offset in range(0, len(index) - 11, 12)]
    lost.count += len(times)
    if times:
        lost.first_ns = min(*times, lost.first_ns or times[0], times[0])
        lost.last_ns = max(*times, lost.last_ns, times[0])


def _time_ns(content: bytes) -> int:
    second, nanosecond = struct.unpack("<II", content[:8].ljust(8, b"\0"))
    return int(second) * 10**9 + int(nanosecond)


def _channel(number: int, header: dict[str, bytes], about: dict[str, bytes]) -> TopicConnection:
    topic = header.get("topic", about.get("topic", b"")).decode(errors="replace")
    name = ros.normalize_type_name(about.get("type", b"").decode(errors="replace"))
    return TopicConnection(number, topic, name, "ros1", "ros1msg", about.get("message_definition", b""))


def _field_number(header: dict[str, bytes], name: str) -> int:
    if len(header.get(name, b"")) != 4:
        raise BrokenRecordError(f"a record lacks its field {name}")
    return int.from_bytes(header[name], "little")


def _header_fields(content: bytes) -> dict[str, bytes]:
    """Return the fields of a record header by name. Each field is its length, its name, "=" and its value.

    Raises `BrokenRecordError` if the header is damaged.
    """
    fields: dict[str, bytes] = {}
    offset = 0
    while offset + 4 <= len(content):
        length = int.from_bytes(content[offset : offset + 4], "little")
        name, sign, value = content[offset + 4 : offset + 4 + length].partition(b"=")
        if not sign or offset + 4 + length > len(content):
            raise BrokenRecordError("the header of a record is damaged")
        fields[name.decode(errors="replace")] = value
        offset += 4 + length
    return fields


def _read_sized(file: BinaryIO, size: int, max_bytes: int | None = None) -> bytes:
    """Return the bytes after a length word. Raises `BrokenRecordError` if there are fewer, or more than ``max_bytes``."""
    length = _read_length(file)
    if max_bytes is not None and length > max_bytes:
        raise BrokenRecordError(f"a record has a header of {length} bytes; the file is damaged from there on")
    if file.tell() + length > size:
        raise BrokenRecordError(CUT_OFF)
    return file.read(length)


def _read_content(file: BinaryIO, size: int) -> tuple[bytes, bool]:
    """Return the bytes after a length word that the file contains, and whether they are complete.

    Raises `BrokenRecordError` if they exceed the memory limit.
    """
    length = _read_length(file)
    available = min(length, size - file.tell())
    if available > memory.MAX_BLOCK_BYTES:
        raise BrokenRecordError(
            f"a chunk declares {length:,} bytes, more than the {memory.MAX_BLOCK_BYTES:,} that are read"
        )
    content = file.read(available)
    return content, len(content) == length


def _skip_content(file: BinaryIO, size: int) -> None:
    length = _read_length(file)
    if file.tell() + length > size:
        raise BrokenRecordError(CUT_OFF)
    file.seek(length, io.SEEK_CUR)


def _read_length(file: BinaryIO) -> int:
    word = file.read(4)
    if len(word) < 4:
        raise BrokenRecordError(CUT_OFF)
    return int.from_bytes(word, "little")
