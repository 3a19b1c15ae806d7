"""Define chunks of bytes, the description of frames in them, losses, and the interface of framers.

Every framer accounts for every byte: it ends up in a frame, in a `FramingLoss`, or in what is still pending; `Account`
holds the sums. `ByteFramer` is for streams of bytes, `LineFramer` for lines of text, `PacketFramer` and `TextFramer`
for links that give packets.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from tacpipe.arrays import Bools, Bytes, Int64s, Ints, Times

START = "start"  # bytes before the first frame: recording began in the middle of one
NOISE = "noise"  # bytes between whole frames
CUT = "cut"  # a frame that began and is not whole
GARBLED = "garbled"  # bytes as many as frames should have, but their sum or marks are wrong
UNCONFIRMED = "unconfirmed"  # a frame right before a disturbance or at the end, for which nothing but its marks spoke
MALFORMED = "malformed"  # a packet that is none of this protocol


@dataclass(frozen=True)
class Chunks:
    """The bytes of a link as they arrived, with their arrivals. Each chunk of a link of packets is one packet."""

    t_ns: Times  # (chunk,), arrival
    size: Int64s  # (chunk,), bytes
    data: bytes

    @classmethod
    def of(cls, chunks: Iterable[tuple[int, bytes]]) -> Chunks:
        """Return what was read as (arrival in ns, bytes) pairs."""
        pairs = list(chunks)
        stamps = np.array([t_ns for t_ns, _ in pairs], dtype=np.int64)
        sizes = np.array([len(data) for _, data in pairs], dtype=np.int64)
        return cls(stamps, sizes, b"".join(data for _, data in pairs))

    @classmethod
    def joined(cls, parts: Sequence[Chunks]) -> Chunks:
        """Return several as one."""
        stamps = np.concatenate([part.t_ns for part in parts]) if parts else np.zeros(0, dtype=np.int64)
        sizes = np.concatenate([part.size for part in parts]) if parts else np.zeros(0, dtype=np.int64)
        return cls(stamps, sizes, b"".join(part.data for part in parts))

    def since(self, t_ns: int) -> Chunks:
        """Return the chunks that arrived at a moment or later."""
        first = int(np.searchsorted(self.t_ns, t_ns))
        return Chunks(self.t_ns[first:], self.size[first:], self.data[int(self.size[:first].sum()) :])

    def packets(self) -> list[bytes]:
        """Return the chunks one by one."""
        ends = np.cumsum(self.size).tolist()
        return [self.data[stop - size : stop] for stop, size in zip(ends, self.size.tolist(), strict=True)]


@dataclass(frozen=True)
class FrameRun:
    """Frames of one size in the order of their arrival: bytes (frame, byte), or a list of text frames."""

    frames: Any
    t_ns: Times  # (frame,), arrival of the last byte of each


@dataclass(frozen=True)
class FramingLoss:
    """Bytes that are not a frame, what became of them, and how many frames are lost for it as far as the bytes state."""

    t_ns: int
    cause: str
    frames: int
    bytes: int


@dataclass
class Account:
    """Bytes that came in, that are in frames, and that were thrown away; the rest is pending."""

    received: int = 0
    framed: int = 0
    lost: int = 0

    @property
    def pending(self) -> int:
        """How many bytes are not decided yet."""
        return self.received - self.framed - self.lost


class Framer(Protocol):
    """An object that cuts bytes into frames."""

    account: Account

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Take what a link gave; return the frames that are complete now, and what was lost."""

    def flush(self) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return what is left when nothing more comes, which ends the framer's work."""


@dataclass(frozen=True)
class Framing:
    """How frames look in a stream of bytes."""

    marker: bytes = b""  # first bytes of each frame
    tail: bytes = b""  # last bytes of each frame
    size: int | None = None  # size of a frame in bytes, where all have the same
    header: int = 0  # bytes from which ``sizes`` states the size, the marker included
    sizes: Callable[[Bytes], Ints] | None = None  # (frame, header) to (frame,), whole sizes
    most: int = 4096  # largest size; a frame that states more of itself is none
    check: Callable[[Bytes], Bools] | None = None  # (frame, byte) to (frame,)
    lock: int = 2  # good frames in a row that it takes to lock
    confirm: int = 0  # good frames that must follow one before it is given out
    weak: bool = (
        False  # ``check`` is not a sum: frames that are none may pass it again and again while a payload holds still
    )

    @property
    def summed(self) -> bool:
        """Return whether a single frame can be recognised."""
        return self.check is not None and not self.weak


class Pending:
    """A stretch of bytes that grows at its end and is cut off at its front. Places are counted within ``data``.

    The chunks at hand are few as long as all is well, so they stand in lists: these are faster than arrays then.
    """

    def __init__(self) -> None:
        self.data = b""
        self.base = 0  # how many bytes were cut off
        self._ends: list[int] = []  # ends of chunks, counted from the first byte of the link
        self._stamps: list[int] = []  # (chunk,), arrival

    def append(self, chunks: Chunks) -> None:
        """Take what came."""
        end = self.base + len(self.data)
        if len(chunks.size) == 1:
            self._ends.append(end + len(chunks.data))
            self._stamps.append(int(chunks.t_ns[0]))
        else:
            self._ends += (end + np.cumsum(chunks.size)).tolist()
            self._stamps += chunks.t_ns.tolist()
        self.data = self.data + chunks.data if self.data else chunks.data

    def arrival(self, place: int) -> int:
        """Return the arrival of the byte at ``place`` in ns."""
        return self._stamps[bisect_right(self._ends, self.base + place)]

    def arrivals(self, places: Times | range) -> Times:
        """Return the arrival (byte,) of the bytes at ``places`` (byte,), one or more in rising order."""
        first = bisect_right(self._ends, self.base + int(places[0]))
        last = bisect_right(self._ends, self.base + int(places[-1]), first)
        if first == last:  # all in one chunk
            arrivals_ns = np.empty(len(places), dtype=np.int64)
            arrivals_ns.fill(self._stamps[first])
            return arrivals_ns
        if isinstance(places, range):
            places = np.arange(places.start, places.stop, places.step)
        chunks = np.array(self._ends[first:last]).searchsorted(self.base + places, side="right")
        return np.array(self._stamps[first : last + 1], dtype=np.int64)[chunks]

    def cut(self, count: int) -> None:
        """Cut the first ``count`` bytes off."""
        self.data = self.data[count:]
        self.base += count
        removed = bisect_right(self._ends, self.base)
        del self._ends[:removed], self._stamps[:removed]


class PacketFramer:
    """Takes each packet of a link for a frame: those of a known size whose check is right."""

    def __init__(self, sizes: Sequence[int], check: Callable[[Bytes], Bools] | None = None) -> None:
        self.sizes, self.check = frozenset(sizes), check
        self.account = Account()

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the packets that are frames, those of one size together, and the others as losses."""
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
        """Return nothing: a packet is whole or it is none."""
        return [], []
