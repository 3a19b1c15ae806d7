"""Define chunks of bytes, the description of frames, losses, and the interface of framers.

A framer accounts for every byte: it is in a frame, in a `FramingLoss`, or still pending. `Account` has the totals.
`ByteFramer` is for streams of bytes, `LineFramer` for lines of text, `PacketFramer` and `TextFramer` for links with packets.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from tacpipe.arrays import Bools, Bytes, Int64s, Ints, Times

START = "start"  # bytes before the first frame, because recording started in the middle of a frame
NOISE = "noise"  # bytes between complete frames
CUT = "cut"  # an incomplete frame
END = "end"  # bytes after the last frame, because the link or the recording ended in the middle of a frame
GARBLED = "garbled"  # as many bytes as in complete frames, but with wrong checksum or marks
UNCONFIRMED = "unconfirmed"  # a frame without a strong checksum, right before a disturbance
MALFORMED = "malformed"  # a packet that does not follow the protocol


@dataclass(frozen=True)
class Chunks:
    """The bytes of a link in chunks, with arrival times. If the link is packet-based, each chunk is one packet."""

    t_ns: Times  # (chunk,), arrival in ns
    size: Int64s  # (chunk,), bytes
    data: bytes

    @classmethod
    def from_pairs(cls, chunks: Iterable[tuple[int, bytes]]) -> Chunks:
        """Return the chunks of (arrival in ns, bytes) pairs."""
        pairs = list(chunks)
        stamps = np.array([t_ns for t_ns, _ in pairs], dtype=np.int64)
        sizes = np.array([len(data) for _, data in pairs], dtype=np.int64)
        return cls(stamps, sizes, b"".join(data for _, data in pairs))

    @classmethod
    def concatenate(cls, parts: Sequence[Chunks]) -> Chunks:
        """Return the chunks of all parts, in order."""
        stamps = np.concatenate([part.t_ns for part in parts]) if parts else np.zeros(0, dtype=np.int64)
        sizes = np.concatenate([part.size for part in parts]) if parts else np.zeros(0, dtype=np.int64)
        return cls(stamps, sizes, b"".join(part.data for part in parts))

    def since(self, t_ns: int) -> Chunks:
        """Return the chunks that arrived at or after ``t_ns``. ``self.t_ns`` must be ascending."""
        first = int(np.searchsorted(self.t_ns, t_ns))
        return Chunks(self.t_ns[first:], self.size[first:], self.data[int(self.size[:first].sum()) :])

    def packets(self) -> list[bytes]:
        """Return the bytes of each chunk."""
        ends = np.cumsum(self.size).tolist()
        return [self.data[stop - size : stop] for stop, size in zip(ends, self.size.tolist(), strict=True)]


@dataclass(frozen=True)
class FrameRun:
    """Frames of one size in order of arrival: bytes (frame, byte), or a list of text frames."""

    frames: Any
    t_ns: Times  # (frame,), arrival of each frame's last byte in ns


@dataclass(frozen=True)
class FramingLoss:
    """Bytes that are not a frame, the cause, and the number of lost frames as far as the bytes show it."""

    t_ns: int
    cause: str
    frames: int
    bytes: int


@dataclass
class Account:
    """The numbers of bytes that were received, are in frames, and were discarded. The remaining bytes are pending."""

    received: int = 0
    framed: int = 0
    lost: int = 0

    @property
    def pending(self) -> int:
        """The number of bytes that are neither in a frame nor discarded yet."""
        return self.received - self.framed - self.lost


class Framer(Protocol):
    """An object that splits bytes into frames."""

    account: Account

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Add bytes, and return the frames that are now complete, and the losses."""

    def flush(self) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the last frames and losses at the end of the stream."""


@dataclass(frozen=True)
class Framing:
    """The structure of frames in a stream of bytes."""

    marker: bytes = b""  # first bytes of each frame
    tail: bytes = b""  # last bytes of each frame
    size: int | None = None  # size of a frame in bytes, if all frames have the same size
    header: int = 0  # number of bytes, including the marker, that ``sizes`` needs
    sizes: Callable[[Bytes], Ints] | None = None  # returns frame sizes (frame,) from headers (frame, header)
    max_size: int = 4096  # longer frames are invalid
    check: Callable[[Bytes], Bools] | None = None  # returns the mask (frame,) of good frames (frame, byte)
    lock: int = 2  # number of consecutive good frames needed to lock
    confirm: int = 0  # number of good frames that must follow a frame before it is returned
    # ``check`` is not a checksum: with a constant payload, bytes that are not a frame may pass repeatedly
    weak: bool = False

    @property
    def has_checksum(self) -> bool:
        """True if ``check`` is a checksum, so that a single frame can be verified."""
        return self.check is not None and not self.weak


class ByteBuffer:
    """A queue of bytes with their arrival times. Offsets are counted within ``data``.

    Usually only a few chunks are queued, so lists are faster than arrays.
    """

    def __init__(self) -> None:
        self.data = b""
        self.base = 0  # number of bytes that were removed
        self._ends: list[int] = []  # ends of chunks, counted from the first byte of the link
        self._stamps: list[int] = []  # (chunk,), arrival in ns

    def append(self, chunks: Chunks) -> None:
        """Add bytes at the end."""
        end = self.base + len(self.data)
        if len(chunks.size) == 1:
            self._ends.append(end + len(chunks.data))
            self._stamps.append(int(chunks.t_ns[0]))
        else:
            self._ends += (end + np.cumsum(chunks.size)).tolist()
            self._stamps += chunks.t_ns.tolist()
        self.data = self.data + chunks.data if self.data else chunks.data

    def arrival(self, offset: int) -> int:
        """Return the arrival of the byte at ``offset`` in ns."""
        return self._stamps[bisect_right(self._ends, self.base + offset)]

    def ends_chunk(self, start: int, stop: int) -> bool:
        """Return whether a chunk contains all bytes from ``start`` to ``stop``, and ends at ``stop``."""
        chunk = bisect_right(self._ends, self.base + start)
        return chunk < len(self._ends) and self._ends[chunk] == self.base + stop

    def arrivals(self, offsets: Times | range) -> Times:
        """Return the arrivals (byte,) in ns of the bytes at ``offsets`` (byte,), which must be ascending and not empty.

        The offsets are counted from the first byte of the buffer.
        """
        first = bisect_right(self._ends, self.base + int(offsets[0]))
        last = bisect_right(self._ends, self.base + int(offsets[-1]), first)
        if first == last:  # all in one chunk
            arrivals_ns = np.empty(len(offsets), dtype=np.int64)
            arrivals_ns.fill(self._stamps[first])
            return arrivals_ns
        positions = self.base + np.asarray(offsets)
        chunks = np.array(self._ends[first:last]).searchsorted(positions, side="right")
        return np.array(self._stamps[first : last + 1], dtype=np.int64)[chunks]

    def cut(self, count: int) -> None:
        """Remove the first ``count`` bytes."""
        self.data = self.data[count:]
        self.base += count
        removed = bisect_right(self._ends, self.base)
        del self._ends[:removed], self._stamps[:removed]


class PacketFramer:
    """Treat each packet of a link as a frame if it has one of the sizes and passes the check."""

    def __init__(self, sizes: Sequence[int], check: Callable[[Bytes], Bools] | None = None) -> None:
        self.sizes, self.check = frozenset(sizes), check
        self.account = Account()

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the accepted packets in runs of equal size, and the others as losses."""
        self.account.received += len(chunks.data)
        runs, losses = [], []
        starts = np.cumsum(chunks.size) - chunks.size
        edges = np.flatnonzero(np.diff(chunks.size)) + 1
        for rows in np.split(np.arange(len(chunks.size)), edges):
            if not len(rows):
                continue
            size, start = int(chunks.size[rows[0]]), int(starts[rows[0]])
            good = np.full(len(rows), size in self.sizes)
            frames = np.frombuffer(chunks.data, np.uint8, len(rows) * size, start).reshape(len(rows), size)
            if good[0] and self.check is not None:
                good &= self.check(frames)
            if good.any():
                runs.append(FrameRun(frames if good.all() else frames[good], chunks.t_ns[rows[good]]))
            losses += [FramingLoss(int(t_ns), MALFORMED, 1, size) for t_ns in chunks.t_ns[rows[~good]]]
            self.account.framed += int(good.sum()) * size
            self.account.lost += int((~good).sum()) * size
        return runs, losses

    def flush(self) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return nothing: packets are never incomplete."""
        return [], []
