"""Define chunks of bytes, the description of frames in them, losses, and the interface of framers.

Every framer accounts for every byte: it ends up in a frame, in a `Loss`, or in what is still pending; `Account` holds the
sums. `ByteFramer` is for streams of bytes, `LineFramer` for lines of text, `PacketFramer` and `TextFramer` for links that
give packets.
"""

from __future__ import annotations

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
class Run:
    """Frames of one size in the order of their arrival: bytes (frame, byte), or a list of text frames."""

    frames: Any
    t_ns: Times  # (frame,), arrival of the last byte of each


@dataclass(frozen=True)
class Loss:
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

    def feed(self, chunks: Chunks) -> tuple[list[Run], list[Loss]]:
        """Take what a link gave; return the frames that are complete now, and what was lost."""

    def flush(self) -> tuple[list[Run], list[Loss]]:
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
