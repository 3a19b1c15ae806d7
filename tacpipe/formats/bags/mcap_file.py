"""Read the records of an MCAP file sequentially, without its index, which a damaged file may lack."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import BinaryIO

from tacpipe.errors import TacpipeError
from tacpipe.formats.bags.ros_files import (
    CUT_OFF,
    PIECE_BYTES,
    BagDamage,
    BagMessage,
    BrokenRecordError,
    LostChunk,
    Metadata,
    Record,
    TopicConnection,
    declares_too_much,
    format_time,
    unpack_chunk,
)
from tacpipe.io import memory, regular
from tacpipe.printable import plain

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, ATTACHMENT = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x09
STATISTICS, METADATA, DATA_END = 0x0B, 0x0C, 0x0F
INDEX_ENTRY = 16  # size of a message's entry in a chunk index
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQI")  # first and last log time, size and checksum of the content


def read_records(path: Path) -> Iterator[Record]:
    """Yield the records of an MCAP file. Raises `TacpipeError` if it is not one."""
    with regular.failing(path), regular.opened(path) as file:
        yield from read_stream(path, file)


def read_stream(path: Path, file: BinaryIO) -> Iterator[Record]:
    """Yield the records in ``file``, an MCAP file at its first byte.

    If the file is damaged or messages are missing, the last record is a `BagDamage`. Raises the same errors as
    `read_records`.
    """
    if file.read(len(MAGIC)) != MAGIC:
        raise TacpipeError(f"{path} is not an MCAP file: it does not begin as one.")
    reader = _RecordConverter(path)
    try:
        yield from _read_data(file, reader)
    except BrokenRecordError as error:
        progress = f"; {reader.count:,} messages up to {format_time(reader.last_ns)} were read" if reader.count else ""
        yield BagDamage(f"{path}: {error}{progress}.")
        return
    declared_count = _declared_message_count(file)
    lost = 0 if declared_count is None else declared_count - reader.count
    if lost > 0:
        yield BagDamage(f"{path} states that it has {declared_count:,} messages, and {lost:,} of them are missing.")


def _read_data(file: BinaryIO, reader: _RecordConverter) -> Iterator[Record]:
    """Yield the records before the summary section. Raises `BrokenRecordError` if the file is truncated or damaged."""
    lost: LostChunk | None = None
    while True:
        kind, length = _read_head(file)
        if lost is not None and kind != MESSAGE_INDEX:
            yield lost.damage(reader.path)
            lost = None
        if kind in (FOOTER, DATA_END):
            _skip_bytes(file, length)
            return
        if kind == ATTACHMENT:
            name = _attachment_name(beginning := file.read(min(length, 4096)))
            yield BagDamage(f"{reader.path}: the attachment {name} is not read.")
            _skip_bytes(file, length - len(beginning))
        elif kind in (SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA) or (kind == MESSAGE_INDEX and lost is not None):
            content = _read_content(file, length)
            if kind == MESSAGE_INDEX and lost is not None:
                lost.count += max(len(content) - 6, 0) // INDEX_ENTRY
            elif kind == CHUNK:
                lost = yield from reader.convert_chunk(content, complete=len(content) == length)
            elif len(content) == length:
                yield from reader.convert_record(kind, memoryview(content))
            if len(content) < length:
                raise BrokenRecordError(CUT_OFF)
        else:  # an index, or an operation code of a later version
            _skip_bytes(file, length)


def _declared_message_count(file: BinaryIO) -> int | None:
    """Return the number of messages in the summary, or None if it is missing or damaged."""
    try:
        while True:
            kind, length = _read_head(file)
            if kind == STATISTICS:
                return int.from_bytes(_read_content(file, length)[:8], "little")
            _skip_bytes(file, length)
    except BrokenRecordError:
        return None


def _read_head(file: BinaryIO) -> tuple[int, int]:
    """Return the operation code and the length in bytes of the next record.

    Raises `BrokenRecordError` at the end of the file.
    """
    head = file.read(_RECORD.size)
    if len(head) < _RECORD.size:
        raise BrokenRecordError(CUT_OFF)
    kind, length = _RECORD.unpack(head)
    return kind, length


def _read_content(file: BinaryIO, length: int) -> bytes:
    """Return the next ``length`` bytes, or fewer at the end of the file; a false ``length`` costs no memory.

    Raises `BrokenRecordError` if ``length`` exceeds the memory limit.
    """
    if length > memory.MAX_BLOCK_BYTES:
        raise BrokenRecordError(
            f"a record declares {length:,} bytes, more than the {memory.MAX_BLOCK_BYTES:,} that are read"
        )
    parts: list[bytes] = []
    remaining = length
    while remaining and (part := file.read(min(remaining, PIECE_BYTES))):
        parts.append(part)
        remaining -= len(part)
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _skip_bytes(file: BinaryIO, length: int) -> None:
    """Skip ``length`` bytes. Raises `BrokenRecordError` if the file ends before."""
    if not length:
        return
    if length >= 1 << 62:
        raise BrokenRecordError(CUT_OFF)
    file.seek(length - 1, io.SEEK_CUR)
    if not file.read(1):
        raise BrokenRecordError(CUT_OFF)


class _RecordConverter:
    """Converts MCAP records to the record types of `ros_files`, and keeps the schemas that channels refer to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.count = 0  # number of messages so far
        self.last_ns = 0  # log time of the latest message
        self._schemas: dict[int, tuple[str, str, bytes]] = {0: ("", "", b"")}

    def convert_record(self, kind: int, content: memoryview) -> Iterator[Record]:
        """Yield the message, channel or metadata in a record; store a schema for later channels.

        Raises `BrokenRecordError` if the record is damaged.
        """
        if kind == MESSAGE:
            yield self._convert_message(content, 0, len(content))
            return
        from mcap import records as mcap_records
        from mcap.data_stream import ReadDataStream
        from mcap.exceptions import EndOfFile

        stream = ReadDataStream(io.BytesIO(content))
        try:
            if kind == SCHEMA:
                schema = mcap_records.Schema.read(stream)
                self._schemas[schema.id] = (schema.name, schema.encoding, schema.data)
            elif kind == CHANNEL:
                channel = mcap_records.Channel.read(stream)
                name, encoding, data = self._schemas.get(channel.schema_id, ("", "", b""))
                yield TopicConnection(
                    channel.id, channel.topic, name, channel.message_encoding, encoding, data, channel.metadata
                )
            elif kind == METADATA:
                metadata = mcap_records.Metadata.read(stream)
                yield Metadata(metadata.name, metadata.metadata)
        except (EndOfFile, struct.error, UnicodeDecodeError) as error:
            raise BrokenRecordError(f"a record of kind {kind} is damaged") from error

    def convert_chunk(self, content: bytes, complete: bool) -> Generator[Record, None, LostChunk | None]:
        """Yield the records of a chunk; if the chunk is truncated (not ``complete``), those records that are complete.

        Returns a `LostChunk` if a complete chunk is damaged, because none of its records can be trusted, else None.
        """
        if len(content) < _CHUNK.size + 4:
            return LostChunk("has no whole header") if complete else None
        first_ns, last_ns, size, check = _CHUNK.unpack_from(content)
        (length,) = struct.unpack_from("<I", content, _CHUNK.size)
        content_start = _CHUNK.size + 4 + length
        compression = bytes(content[_CHUNK.size + 4 : content_start]).decode(errors="replace")
        if problem := declares_too_much(size):
            return LostChunk(problem, first_ns, last_ns)
        unpacked = unpack_chunk(compression, content[content_start + 8 :], size, "zstd or lz4")
        view = memoryview(unpacked)
        spans, end = _record_spans(view)
        if complete and (len(unpacked) != size or end != size or (check and zlib.crc32(unpacked) != check)):
            return LostChunk(f"of {size:,} bytes is damaged", first_ns, last_ns)
        for kind, offset, length in spans:
            if kind == MESSAGE:
                yield self._convert_message(view, offset, length)
            elif kind in (SCHEMA, CHANNEL):
                yield from self.convert_record(kind, view[offset : offset + length])
        return None

    def _convert_message(self, view: memoryview, offset: int, length: int) -> BagMessage:
        """Return the message of a record at an offset, and count it. Raises `BrokenRecordError` if it is too short."""
        if length < _MESSAGE.size:
            raise BrokenRecordError("a message record is too short")
        number, _, log_ns, publish_ns = _MESSAGE.unpack_from(view, offset)
        self.count += 1
        self.last_ns = log_ns
        return BagMessage(number, log_ns, publish_ns, bytes(view[offset + _MESSAGE.size : offset + length]))


def _record_spans(view: memoryview) -> tuple[list[tuple[int, int, int]], int]:
    """Return operation code, offset and length of each complete record in a chunk, and the end of the last one."""
    spans: list[tuple[int, int, int]] = []
    end = 0
    while end + _RECORD.size <= len(view):
        kind, length = _RECORD.unpack_from(view, end)
        offset = end + _RECORD.size
        if offset + length > len(view) or (kind == MESSAGE and length < _MESSAGE.size):
            break
        spans.append((kind, offset, length))
        end = offset + length
    return spans, end


def _attachment_name(content: bytes) -> str:
    """Return the name of an attachment, which follows two timestamps and the name's length."""
    return plain(content[20 : 20 + int.from_bytes(content[16:20], "little")].decode(errors="replace"))
