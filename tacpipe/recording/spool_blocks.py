"""Encode and decode the blocks of a spool: a mark, a check sum, and the chunks of one stream or a note."""

from __future__ import annotations

import errno
import json
import mmap
import os
import struct
import zlib
from dataclasses import dataclass

import numpy as np

from tacpipe.sensors.framing import Chunks

MARK = b"tacB"
HEAD = struct.Struct("<4sIBBHII")  # mark, check sum of all that follows, kind, stream, 0, chunks, bytes of the body
CHUNKS, NOTE = 0, 1  # kinds of blocks
WHOLE = 255  # stream number of a note on the recording, whose stream is ""


@dataclass(frozen=True)
class Note:
    """An event of a stream, such as a link that opened or was lost. ``what`` names it."""

    t_ns: int
    stream: str
    what: str
    detail: str = ""


def pack_block(kind: int, stream: int, count: int, body: bytes) -> bytes:
    """Return a block with ``body``, which has ``count`` chunks of the stream of this number."""
    covered = HEAD.pack(MARK, 0, kind, stream, 0, count, len(body))[8:]
    return MARK + struct.pack("<I", zlib.crc32(body, zlib.crc32(covered))) + covered + body


def find_end(content: mmap.mmap, place: int) -> int | None:
    """Return where the block at ``place`` ends, or None if no complete and undamaged block starts there."""
    if place + HEAD.size > len(content) or content[place : place + 4] != MARK:
        return None
    _, check, _, _, _, _, size = HEAD.unpack_from(content, place)
    stop = place + HEAD.size + int(size)
    if stop > len(content):
        return None
    with memoryview(content) as view, view[place + 8 : stop] as covered:
        return stop if zlib.crc32(covered) == check else None


def find_next(handle: int, content: mmap.mmap, place: int) -> int:
    """Return the next place after ``place`` where a block may begin. Holes of the file are skipped unread."""
    try:
        data = os.lseek(handle, place, os.SEEK_DATA)
        if data > place:
            return min(data, len(content))
        stop = min(os.lseek(handle, place, os.SEEK_HOLE), len(content))
    except OSError as error:
        if error.errno == errno.ENXIO:  # nothing follows but a hole
            return len(content)
        stop = len(content)  # the file system reports no holes
    mark = content.find(MARK, place + 1, stop)
    return stop if mark < 0 else mark


def unpack_block(kind: int, stream: str, count: int, body: bytes) -> Chunks | Note | None:
    """Return the content of a block, or None where its check sum is right but another program wrote it."""
    try:
        if kind == NOTE:
            entry = json.loads(body)
            return Note(int(entry["t_ns"]), stream, str(entry["what"]), str(entry["detail"]))
        stamps = np.frombuffer(body, "<i8", count)
        sizes = np.frombuffer(body, "<u4", count, 8 * count).astype(np.int64)
    except (ValueError, LookupError, TypeError, RecursionError, OverflowError):
        return None
    if kind != CHUNKS or not count or int(sizes.sum()) != len(body) - 12 * count:
        return None
    return Chunks(stamps.astype(np.int64), sizes, body[12 * count :])
