"""The records of a ROS 1 bag (version 2.0), from the first byte on; its index is not needed."""

from __future__ import annotations

import bz2
import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from tacpipe.errors import TacpipeError
from tacpipe.formats.bags import ros
from tacpipe.formats.bags.storages import Channel, Damage, LostChunk, Message, Record
from tacpipe.io import memory, regular
from tacpipe.printable import excerpt, plain

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, INDEX, CHUNK, CONNECTION = 2, 3, 4, 5, 7
MOST_HEADER = 1 << 20  # bytes
CUT_OFF = "the file ends within a record: it was cut off, and what came after is missing"


class _BrokenError(Exception):
    """A record that cannot be read: why, as a clause."""


def records(path: Path) -> Iterator[Record]:
    """Yield what a bag holds. Raises `TacpipeError` where it is not one of version 2.0."""
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
            yield from _records(path, file, path.stat().st_size)
        except _BrokenError as error:
            yield Damage(f"{path}: {error}.")


def _records(path: Path, file: BinaryIO, size: int, *, within_chunk: bool = False) -> Iterator[Record]:
    """Yield the records of a file, or of what a chunk holds."""
    lost: LostChunk | None = None
    while file.tell() < size:
        header = _header(_sized(file, size, MOST_HEADER))
        kind = header["op"][0] if header.get("op") else None
        if kind == BAG and header.get("encryptor"):
            raise _BrokenError(f"it is encrypted with {excerpt(header['encryptor'])}; decrypt it first")
        if kind == INDEX and lost is not None:
            _count_lost(lost, _sized(file, size))
            continue
        if lost is not None:
            yield lost.damage(path)
            lost = None
        if kind not in (MESSAGE, CHUNK, CONNECTION):
            _pass(file, size)
            continue
        if kind == CHUNK and within_chunk:
            raise _BrokenError("a chunk lies within a chunk")
        if kind == CHUNK:
            content, complete = _content(file, size)
            inside, problem = _decompressed(header.get("compression", b"none"), content, _word(header, "size"))
            records = _records(path, io.BytesIO(inside), len(inside), within_chunk=True)
            if not complete:
                yield from records
                raise _BrokenError(CUT_OFF)
            try:
                yield from [] if problem else list(records)  # all or nothing: of a damaged one nothing can be trusted
            except _BrokenError:
                problem = f"of {len(inside):,} bytes is damaged"
            lost = LostChunk(problem) if problem else None
            continue
        content = _sized(file, size)
        number = _word(header, "conn")
        if kind == CONNECTION:
            yield _channel(number, header, _header(content))
            continue
        log_ns = _time_ns(header.get("time", bytes(8)))
        yield Message(number, log_ns, log_ns, content)
    if lost is not None:
        yield lost.damage(path)


def _count_lost(lost: LostChunk, index: bytes) -> None:
    """Add the messages of one connection that the index behind a chunk lists: times of 8 bytes, and where they lie."""
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
    name = ros.normal(about.get("type", b"").decode(errors="replace"))
    return Channel(number, topic, name, "ros1", "ros1msg", about.get("message_definition", b""))


def _word(header: dict[str, bytes], name: str) -> int:
    if len(header.get(name, b"")) != 4:
        raise _BrokenError(f"a record lacks its field {name}")
    return int.from_bytes(header[name], "little")


def _header(content: bytes) -> dict[str, bytes]:
    """Return the fields of a record's header: each is its length, its name, "=" and its value."""
    found: dict[str, bytes] = {}
    at = 0
    while at + 4 <= len(content):
        length = int.from_bytes(content[at : at + 4], "little")
        name, sign, value = content[at + 4 : at + 4 + length].partition(b"=")
        if not sign or at + 4 + length > len(content):
            raise _BrokenError("the header of a record is damaged")
        found[name.decode(errors="replace")] = value
        at += 4 + length
    return found


def _sized(file: BinaryIO, size: int, most: int | None = None) -> bytes:
    """Return what follows its own length."""
    length = _length(file)
    if most is not None and length > most:
        raise _BrokenError(f"a record has a header of {length} bytes; the file is damaged from there on")
    if file.tell() + length > size:
        raise _BrokenError(CUT_OFF)
    return file.read(length)


def _content(file: BinaryIO, size: int) -> tuple[bytes, bool]:
    """Return what follows its own length, or as much as is there, and whether it is all."""
    length = _length(file)
    there = min(length, size - file.tell())
    if there > memory.MOST_BLOCK:
        raise _BrokenError(f"a chunk declares {length:,} bytes, more than the {memory.MOST_BLOCK:,} that are read")
    content = file.read(there)
    return content, len(content) == length


def _pass(file: BinaryIO, size: int) -> None:
    length = _length(file)
    if file.tell() + length > size:
        raise _BrokenError(CUT_OFF)
    file.seek(length, io.SEEK_CUR)


def _length(file: BinaryIO) -> int:
    word = file.read(4)
    if len(word) < 4:
        raise _BrokenError(CUT_OFF)
    return int.from_bytes(word, "little")


def _decompressed(compression: bytes, content: bytes, size: int) -> tuple[bytes, str]:
    """Return what a chunk holds, as much of it as can be unpacked, and what is wrong with it, as in "a chunk …"."""
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
            raise _BrokenError(f"its chunks are compressed with {name}, not bz2 or lz4")
    except (OSError, RuntimeError, EOFError):
        inside = b""
    return inside, "" if len(inside) == size else f"of {size:,} bytes is damaged"
