"""Read the chunks of an XDF file (Extensible Data Format, version 1.0) and their samples.

Source: https://github.com/sccn/xdf/wiki/Specifications. The magic ``XDF:`` is followed by chunks: length, a tag of two
bytes, content. A boundary chunk every few seconds lets a reader resynchronize after damaged bytes.
"""

from __future__ import annotations

import itertools
import mmap
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from tacpipe.arrays import AnyArray, Floats
from tacpipe.errors import TacpipeError

Content = bytes | mmap.mmap
Values = TypeVar("Values")

MAGIC = b"XDF:"
FILE_HEADER, STREAM_HEADER, SAMPLES, CLOCK_OFFSET, BOUNDARY, STREAM_FOOTER = range(1, 7)
OF_A_STREAM = (STREAM_HEADER, SAMPLES, CLOCK_OFFSET, STREAM_FOOTER)
MARK = bytes.fromhex("43 A5 46 DC CB F5 41 0F B3 0E D5 46 73 83 CB E4")  # content of a boundary chunk
SIZES = {1: "<B", 4: "<I", 8: "<Q"}  # struct format of a length by the byte before it


@dataclass(frozen=True)
class Chunk:
    """A chunk. ``content`` follows the tag and the stream number, if there is one."""

    at: int  # offset of the chunk in the file
    tag: int
    stream: int | None
    content: bytes
    is_complete: bool = True  # False if the file ends in the chunk


@dataclass(frozen=True)
class DamagedChunk:
    """Bytes that are not a chunk."""

    at: int
    bytes: int


def read_chunks(data: Content) -> Iterator[Chunk | DamagedChunk]:
    """Yield the chunks and the damaged parts of a file in order.

    Raises `TacpipeError` if the file does not start like an XDF file.
    """
    if data[: len(MAGIC)] != MAGIC:
        raise TacpipeError(f"it begins with {data[:4]!r}, and an XDF file with {MAGIC!r}")
    offset = len(MAGIC)
    while offset < len(data):
        parsed = _parse_chunk(data, offset)
        if parsed is not None and parsed[0].is_complete:
            chunk, offset = parsed
            if chunk.tag != BOUNDARY:
                yield chunk
            continue
        next_mark = data.find(MARK, offset)
        if parsed is not None and next_mark < 0:  # the file is truncated
            yield parsed[0]
            return
        stop = len(data) if next_mark < 0 else next_mark + len(MARK)
        yield DamagedChunk(offset, stop - offset)
        offset = stop


def _parse_chunk(data: Content, offset: int) -> tuple[Chunk, int] | None:
    """Return the chunk at an offset and the offset after it, or None if there is no valid chunk."""
    length = read_length(data, offset)
    if length is None:
        return None
    size, content_start = length
    stop = content_start + size
    if size < 2 or content_start + 2 > len(data):
        return None
    (tag,) = struct.unpack_from("<H", data, content_start)
    header_bytes = 6 if tag in OF_A_STREAM else 2
    if not FILE_HEADER <= tag <= STREAM_FOOTER or size < header_bytes or content_start + header_bytes > len(data):
        return None
    stream = struct.unpack_from("<I", data, content_start + 2)[0] if header_bytes == 6 else None
    return Chunk(offset, tag, stream, data[content_start + header_bytes : stop], is_complete=stop <= len(data)), stop


def read_length(data: Content, offset: int) -> tuple[int, int] | None:
    r"""Return a length of 1, 4 or 8 bytes and the offset after it, or None if there is none.

    >>> read_length(b"\x01\x05...", 0), read_length(b"\x02\x05", 0)
    ((5, 2), None)
    """
    width = data[offset] if offset < len(data) else 0
    if width not in SIZES or offset + 1 + width > len(data):
        return None
    return struct.unpack_from(SIZES[width], data, offset + 1)[0], offset + 1 + width


@dataclass(frozen=True)
class ChunkSamples:
    """The samples of a chunk with their timestamps in seconds (NaN if not written), and the number of missing samples."""

    stamps: Floats  # (sample,)
    values: AnyArray  # (sample, channel)
    missing: int = 0


def parse_samples(content: bytes, kind: np.dtype[np.generic] | None, channels: int) -> ChunkSamples | None:
    """Return the complete samples of a chunk of numbers, or of texts if ``kind`` is None.

    Returns None if even their count is missing.
    """
    count = read_length(content, 0)
    if count is None:
        return None
    declared, begin = count
    body = content[begin:]
    if kind is None:
        stamps, texts = _read_each(body, declared, lambda at: _read_words(body, at, channels))
        words = np.array(list(itertools.chain(*texts)), dtype=object).reshape(-1, channels)
        return ChunkSamples(stamps, words, declared - len(texts))
    little_endian = kind.newbyteorder("<")
    for stamp_count in (declared, 1 if declared else 0, 0):  # all samples have a timestamp, only the first, or none
        samples = _parse_regular(body, little_endian, channels, declared, stamp_count)
        if samples is not None:
            return samples
    size = channels * kind.itemsize
    stamps, values = _read_each(
        body, declared, lambda at: (body[at : at + size], at + size) if at + size <= len(body) else None
    )
    numbers = np.frombuffer(b"".join(values), little_endian).reshape(-1, channels).astype(kind.newbyteorder("="))
    return ChunkSamples(stamps, numbers, declared - len(values))


def _read_each(
    body: bytes, count: int, read_values: Callable[[int], tuple[Values, int] | None]
) -> tuple[Floats, list[Values]]:
    """Return stamps and values of the samples before the first incomplete one, of ``count``.

    ``read_values`` returns the values of the sample at an offset, and the offset after them, or None if they are
    incomplete.
    """
    stamps: list[float] = []
    values: list[Values] = []
    offset = 0
    while len(values) < count:
        stamp = _read_stamp(body, offset)
        sample = None if stamp is None else read_values(stamp[1])
        if stamp is None or sample is None:
            break
        stamps.append(stamp[0])
        values.append(sample[0])
        offset = sample[1]
    return np.array(stamps, dtype=np.float64), values


def _parse_regular(
    body: bytes, kind: np.dtype[np.generic], channels: int, count: int, stamped: int
) -> ChunkSamples | None:
    """Return the samples if exactly the first ``stamped`` have a timestamp, or None if the bytes do not fit this."""
    with_stamp = np.dtype([("width", "u1"), ("stamp", "<f8"), ("values", kind, (channels,))])
    without_stamp = np.dtype([("width", "u1"), ("values", kind, (channels,))])
    if len(body) != stamped * with_stamp.itemsize + (count - stamped) * without_stamp.itemsize:
        return None
    first = np.frombuffer(body, with_stamp, stamped)
    unstamped = np.frombuffer(body, without_stamp, count - stamped, offset=stamped * with_stamp.itemsize)
    if (first["width"] != 8).any() or unstamped["width"].any():
        return None
    stamps = np.concatenate([first["stamp"], np.full(len(unstamped), np.nan)])
    return ChunkSamples(stamps, np.concatenate([first["values"], unstamped["values"]]).astype(kind.newbyteorder("=")))


def _read_words(content: bytes, at: int, count: int) -> tuple[list[str], int] | None:
    """Return ``count`` texts and the offset after them, or None if they are incomplete."""
    words, stop = [], at
    for _ in range(count):
        length = read_length(content, stop)
        if length is None or length[1] + length[0] > len(content):
            return None
        size, start = length
        stop = start + size
        words.append(content[start:stop].decode(errors="replace"))
    return words, stop


def _read_stamp(content: bytes, offset: int) -> tuple[float, int] | None:
    """Return a sample's timestamp (NaN if not written) and the offset of its values, or None if it is incomplete."""
    if offset >= len(content) or content[offset] not in (0, 8) or offset + 1 + content[offset] > len(content):
        return None
    if not content[offset]:
        return float("nan"), offset + 1
    return struct.unpack_from("<d", content, offset + 1)[0], offset + 9


def fill_stamps(stamps: Floats, last: float, period_s: float) -> Floats:
    """Return timestamps (sample,) with missing ones set to one period after the previous.

    >>> fill_stamps(np.array([np.nan, 5.0, np.nan]), 1.0, 0.5).tolist()
    [1.5, 5.0, 5.5]
    """
    is_missing = np.isnan(stamps)
    if not is_missing.any():
        return stamps
    filled = stamps.copy()
    stamped_rows = np.flatnonzero(~is_missing).tolist()
    previous_stamps = [last, *stamps[stamped_rows].tolist()]
    edges = [-1, *stamped_rows, len(stamps)]
    for previous, (row, stop) in zip(previous_stamps, itertools.pairwise(edges), strict=True):
        steps = np.concatenate([[previous], np.full(stop - row - 1, period_s)])
        filled[row + 1 : stop] = np.add.accumulate(steps)[1:]
    return filled
