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
from tacpipe.formats.bags.storages import Channel, Damage, Message, Record
from tacpipe.io import memory, regular
from tacpipe.printable import excerpt, plain

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, CHUNK, CONNECTION = 2, 3, 5, 7
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
        seen: set[int] = set()
        try:
            yield from _records(path, file, path.stat().st_size, seen)
        except _BrokenError as error:
            yield Damage(f"{path}: {error}.")


def _records(path: Path, file: BinaryIO, size: int, seen: set[int], begin: int = 0) -> Iterator[Record]:
    """Yield the records of a file, or of what a chunk holds."""
    while file.tell() < size:
        header = _header(_sized(file, size, MOST_HEADER))
        kind = header["op"][0] if header.get("op") else None
        if kind == BAG and header.get("encryptor"):
            raise _BrokenError(f"it is encrypted with {excerpt(header['encryptor'])}; decrypt it first")
        if kind not in (MESSAGE, CHUNK, CONNECTION):
            _pass(file, size)
            continue
        if kind == CHUNK:
            content, whole = _content(path, file, size)
            inside = _decompressed(header.get("compression", b"none"), content, _word(header, "size"), path)
            try:
                yield from _records(path, io.BytesIO(inside), len(inside), seen)
            except _BrokenError:
                if whole and len(inside) == _word(header, "size"):
                    raise
            if not whole or len(inside) < _word(header, "size"):
                raise _BrokenError(CUT_OFF if not whole else f"a chunk of {len(content)} bytes is damaged")
            continue
        content = _sized(file, size)
        number = _word(header, "conn")
        if kind == CONNECTION:
            if number not in seen:
                seen.add(number)
                yield _channel(number, header, _header(content))
            continue
        second, nanosecond = struct.unpack("<II", header.get("time", bytes(8))[:8])
        log_ns = second * 10**9 + nanosecond
        yield Message(number, log_ns, log_ns, content)


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


def _content(path: Path, file: BinaryIO, size: int) -> tuple[bytes, bool]:
    """Return what follows its own length, or as much as is there, and whether it is all."""
    length = _length(file)
    there = min(length, size - file.tell())
    memory.require(there, f"A chunk of {path}")
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


def _decompressed(compression: bytes, content: bytes, size: int, path: Path) -> bytes:
    """Return what a chunk holds, or as much of it as can be unpacked."""
    memory.require(size, f"A chunk of {path}")
    if compression == b"none":
        return content
    try:
        if compression == b"bz2":
            return bz2.BZ2Decompressor().decompress(content, size)
        if compression == b"lz4":
            import lz4.frame

            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(content, size))
    except (OSError, RuntimeError, EOFError):
        return b""
    raise _BrokenError(f"its chunks are compressed with {plain(compression.decode(errors='replace'))}, not bz2 or lz4")
