"""Read the records of a ROS 1 bag (version 2.0) from the first byte on, without its index."""

from __future__ import annotations

import bz2
import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from tacpipe.errors import TacpipeError
from tacpipe.formats.bags import ros
from tacpipe.formats.bags.storages import CUT_OFF, BrokenRecordError, Channel, Damage, LostChunk, Message, Record
from tacpipe.io import memory, regular
from tacpipe.printable import excerpt, plain

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, INDEX, CHUNK, CONNECTION = 2, 3, 4, 5, 7
MAX_HEADER_BYTES = 1 << 20


def read_records(path: Path) -> Iterator[Record]:
    """Yield the records of a bag. Raises `TacpipeError` where it is not a bag of version 2.0."""
    with regular.failing(path), regular.opened(path) as file:
        magic = file.read(len(MAGIC))
        if magic != MAGIC:
            version = magic.split(b"\n")[0]
            if magic.startswith(b"#ROSBAG"):
                raise TacpipeError(
                    f"{path} is a bag of another version, {excerpt(version)}; 2.0 is read. Run `rosbag fix`."
                )
            raise TacpipeError(f"{path} is not a bag: it {'is empty' if not magic else 'does not begin as one'}.")
        try:
            yield from _read_records(path, file, path.stat().st_size)
        except BrokenRecordError as error:
            yield Damage(f"{path}: {error}.")


def _read_records(path: Path, file: BinaryIO, size: int, *, within_chunk: bool = False) -> Iterator[Record]:
    """Yield the records of a file, or of the content of a chunk."""
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
            inside, problem = _decompress(header.get("compression", b"none"), content, _field_number(header, "size"))
            read_records = _read_records(path, io.BytesIO(inside), len(inside), within_chunk=True)
            if not complete:
                yield from read_records
                raise BrokenRecordError(CUT_OFF)
            try:
                yield from (
                    [] if problem else list(read_records)
                )  # all or nothing: of a damaged one nothing can be trusted
            except BrokenRecordError:
                problem = f"of {len(inside):,} bytes is damaged"
            lost = LostChunk(problem) if problem else None
            continue
        content = _read_sized(file, size)
        number = _field_number(header, "conn")
        if kind == CONNECTION:
            yield _channel(number, header, _header_fields(content))
            continue
        log_ns = _time_ns(header.get("time", bytes(8)))
        yield Message(number, log_ns, log_ns, content)
    if lost is not None:
        yield lost.damage(path)


def _count_lost_messages(lost: LostChunk, index: bytes) -> None:
    """Add the messages of one connection that the index of a chunk lists, 8 bytes of time and 4 of offset each."""
    times = [_time_ns(index[at : at + 8]) for at in range(0, len(index) - 11, 12)]
    lost.count += len(times)
    if times:
        lost.first_ns = min(*times, lost.first_ns or times[0], times[0])
        lost.last_ns = max(*times, lost.last_ns, times[0])


def _time_ns(content: bytes) -> int:
    second, nanosecond = struct.unpack("<II", content[:8].ljust(8, b"\0"))
    return int(second) * 10**9 + int(nanosecond)


def _channel(number: int, header: dict[str, bytes], about: dict[str, bytes]) -> Channel:
    topic = header.get("topic", about.get("topic", b"")).decode(errors="replace")
    name = ros.normalize_type_name(about.get("type", b"").decode(errors="replace"))
    return Channel(number, topic, name, "ros1", "ros1msg", about.get("message_definition", b""))


def _field_number(header: dict[str, bytes], name: str) -> int:
    if len(header.get(name, b"")) != 4:
        raise BrokenRecordError(f"a record lacks its field {name}")
    return int.from_bytes(header[name], "little")


def _header_fields(content: bytes) -> dict[str, bytes]:
    """Return the fields of a record's header: each is its length, its name, "=" and its value."""
    fields: dict[str, bytes] = {}
    at = 0
    while at + 4 <= len(content):
        length = int.from_bytes(content[at : at + 4], "little")
        name, sign, value = content[at + 4 : at + 4 + length].partition(b"=")
        if not sign or at + 4 + length > len(content):
            raise BrokenRecordError("the header of a record is damaged")
        fields[name.decode(errors="replace")] = value
        at += 4 + length
    return fields


def _read_sized(file: BinaryIO, size: int, max_bytes: int | None = None) -> bytes:
    """Return the bytes that follow a word with their length."""
    length = _read_length(file)
    if max_bytes is not None and length > max_bytes:
        raise BrokenRecordError(f"a record has a header of {length} bytes; the file is damaged from there on")
    if file.tell() + length > size:
        raise BrokenRecordError(CUT_OFF)
    return file.read(length)


def _read_content(file: BinaryIO, size: int) -> tuple[bytes, bool]:
    """Return the bytes that follow a word with their length, as far as the file has them, and whether they are all."""
    length = _read_length(file)
    available = min(length, size - file.tell())
    if available > memory.MOST_BLOCK:
        raise BrokenRecordError(f"a chunk declares {length:,} bytes, more than the {memory.MOST_BLOCK:,} that are read")
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


def _decompress(compression: bytes, content: bytes, size: int) -> tuple[bytes, str]:
    """Return the unpacked content of a chunk, as far as it is intact, and a problem that completes "a chunk …"."""
    if size > memory.MOST_BLOCK:
        return b"", f"declares {size:,} bytes, more than the {memory.MOST_BLOCK:,} that are unpacked"
    inside = content
    try:
        if compression == b"bz2":
            inside = bz2.BZ2Decompressor().decompress(content, size + 1)
        elif compression == b"lz4":
            import lz4.frame

            inside = bytes(lz4.frame.LZ4FrameDecompressor().decompress(content, size + 1))
        elif compression != b"none":
            name = plain(compression.decode(errors="replace"))
            raise BrokenRecordError(f"its chunks are compressed with {name}, not bz2 or lz4")
    except (OSError, RuntimeError, EOFError):
        inside = b""
    return inside, "" if len(inside) == size else f"of {size:,} bytes is damaged"
