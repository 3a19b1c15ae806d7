"""The records of an MCAP file, from the first byte on: indexes are not needed, so a file without them reads as well."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from tacpipe.errors import TacpipeError
from tacpipe.formats.bags.storages import Channel, Damage, Message, Metadata, Record
from tacpipe.io import memory, regular
from tacpipe.printable import plain

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, ATTACHMENT = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x09
METADATA, DATA_END = 0x0C, 0x0F
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQI")  # first and last time, size and check sum of what is inside
CUT_OFF = "the file ends within a record: it was cut off, and what came after is missing"


class _BrokenError(Exception):
    """A record that cannot be read: why, as a clause."""


def records(path: Path) -> Iterator[Record]:
    """Yield what an MCAP file holds. Raises `TacpipeError` where it is not one."""
    with regular.failing(path), regular.opened(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise TacpipeError(f"{path} is not an MCAP file: it does not begin as one.")
        size = path.stat().st_size
        reader = _Reader(path)
        ended = False
        try:
            while not ended:
                head = file.read(_RECORD.size)
                if len(head) < _RECORD.size:
                    raise _BrokenError(CUT_OFF)
                kind, length = _RECORD.unpack(head)
                if kind not in (SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA):  # an index, an attachment, what is newer
                    ended = kind in (FOOTER, DATA_END)
                    if file.tell() + length > size:
                        raise _BrokenError(CUT_OFF)
                    end = file.tell() + length
                    if kind == ATTACHMENT:
                        yield Damage(f"{path}: the attachment {_attached(file.read(min(length, 4096)))} is not read.")
                    file.seek(end)
                    continue
                there = min(length, size - file.tell())
                memory.require(there, f"A record of {path}")
                content = file.read(there)
                if kind == CHUNK:
                    yield from reader.chunk(content, whole=len(content) == length)
                elif len(content) == length:
                    yield from reader.record(kind, memoryview(content))
                if len(content) < length:
                    raise _BrokenError(CUT_OFF)
        except _BrokenError as error:
            yield Damage(f"{path}: {error}.")


class _Reader:
    """Records in the words of `storages`; keeps schemas, which channels name by number."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._schemas: dict[int, tuple[str, str, bytes]] = {0: ("", "", b"")}
        self._channels: set[int] = set()

    def record(self, kind: int, content: memoryview) -> Iterator[Record]:
        """Yield what a record is, if it is one that counts."""
        if kind == MESSAGE:
            yield _message(content, 0, len(content))
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
                if channel.id in self._channels:  # a chunk repeats those of its messages
                    return
                self._channels.add(channel.id)
                name, encoding, data = self._schemas.get(channel.schema_id, ("", "", b""))
                yield Channel(
                    channel.id, channel.topic, name, channel.message_encoding, encoding, data, channel.metadata
                )
            elif kind == METADATA:
                found = mcap_records.Metadata.read(stream)
                yield Metadata(found.name, found.metadata)
        except (EndOfFile, struct.error, UnicodeDecodeError) as error:
            raise _BrokenError(f"a record of kind {kind} is damaged") from error

    def chunk(self, content: bytes, whole: bool) -> Iterator[Record]:
        """Yield the records of a chunk, of one that was cut off as many as are there."""
        if len(content) < _CHUNK.size + 4:
            return
        *_, size, check = _CHUNK.unpack_from(content)
        (length,) = struct.unpack_from("<I", content, _CHUNK.size)
        begin = _CHUNK.size + 4 + length
        compression = bytes(content[_CHUNK.size + 4 : begin]).decode(errors="replace")
        memory.require(size, f"A chunk of {self.path}")
        inside = _decompressed(compression, content[begin + 8 :], size)
        if whole and check and zlib.crc32(inside) != check:
            yield Damage(f"{self.path}: the check sum of a chunk of {size} bytes is wrong; its messages are left out.")
            return
        view, at = memoryview(inside), 0
        while at + _RECORD.size <= len(view):
            kind, length = _RECORD.unpack_from(view, at)
            at += _RECORD.size
            if at + length > len(view):
                break
            if kind == MESSAGE:
                yield _message(view, at, length)
            elif kind in (SCHEMA, CHANNEL):
                yield from self.record(kind, view[at : at + length])
            at += length


def _attached(content: bytes) -> str:
    """Return the name in an attachment: after two times, and its length."""
    return plain(content[20 : 20 + int.from_bytes(content[16:20], "little")].decode(errors="replace"))


def _message(view: memoryview, at: int, length: int) -> Message:
    if length < _MESSAGE.size:
        raise _BrokenError("a message record is too short")
    number, _, log_ns, publish_ns = _MESSAGE.unpack_from(view, at)
    return Message(number, log_ns, publish_ns, bytes(view[at + _MESSAGE.size : at + length]))


def _decompressed(compression: str, content: bytes, size: int) -> bytes:
    """Return what a chunk holds, or as much of it as can be unpacked."""
    if compression == "":
        return content[:size]
    if compression == "zstd":
        import zstandard

        source: BinaryIO = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(content))
    elif compression == "lz4":
        import lz4.frame

        source = lz4.frame.LZ4FrameFile(io.BytesIO(content))
    else:
        raise _BrokenError(f"its chunks are compressed with {plain(compression)}, not zstd or lz4")
    parts: list[bytes] = []
    left = size
    try:
        while left and (part := source.read(min(left, 1 << 20))):
            parts.append(part)
            left -= len(part)
    except Exception:
        pass
    return b"".join(parts)
