"""From the bytes of a link to frames: lock on repeated marks, check sums, resynchronize, account for every byte.

All framers have the same two methods, and never look at a byte one by one in Python: as long as all is well, the bytes
at hand are looked at as one array (frame, byte).

A frame is given out when it is known to be one. Where nothing but the marks speaks for it (`Framing.check` is None), or a
sum of 8 bits, that is once ``confirm`` good frames follow it: the frame before a disturbance may be a part of it. After a
disturbance a lock takes ``lock`` good frames in a row, all of which are then given out.

Every byte ends up in a frame, in a `Loss`, or in what is still pending; `Account` holds the sums.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Times = NDArray[np.int64]

START = "start"  # bytes before the first frame: recording began in the middle of one
NOISE = "noise"  # bytes between whole frames
CUT = "cut"  # a frame that began and is not whole
GARBLED = "garbled"  # bytes as many as frames should have, but their sum or marks are wrong
UNCONFIRMED = "unconfirmed"  # a frame right before a disturbance or at the end, for which nothing but its marks spoke
MALFORMED = "malformed"  # a packet that is none of this protocol
AMBIGUOUS = 64  # frames that are kept while marks repeat in more than one place
MOST_BYTES = 1 << 23  # looked at in one go, which bounds the memory of a check


@dataclass(frozen=True)
class Chunks:
    """What a link gave: the bytes as they came, and when. For links of packets each chunk is one."""

    t_ns: Times  # (chunk,), arrival
    size: NDArray[np.int64]  # (chunk,), bytes
    data: bytes

    @classmethod
    def of(cls, chunks: Iterable[tuple[int, bytes]]) -> Chunks:
        """Return what was read as (arrival in ns, bytes) pairs."""
        pairs = list(chunks)
        stamps = np.array([t_ns for t_ns, _ in pairs], dtype=np.int64)
        sizes = np.array([len(data) for _, data in pairs], dtype=np.int64)
        return cls(stamps, sizes, b"".join(data for _, data in pairs))

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
    """Bytes that are no frame, what became of them, and how many frames are lost for it as far as the bytes tell."""

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
    """What cuts bytes into frames."""

    account: Account

    def feed(self, chunks: Chunks) -> tuple[list[Run], list[Loss]]:
        """Take what a link gave; return the frames that are complete now, and what was lost."""

    def flush(self) -> tuple[list[Run], list[Loss]]:
        """Return what is left when nothing more comes, which ends the framer's work."""


@dataclass(frozen=True)
class Framing:
    """How frames look in a stream of bytes."""

    marker: bytes = b""  # that each begins with
    tail: bytes = b""  # that each ends with
    size: int | None = None  # of the whole frame in bytes, where all have the same
    header: int = 0  # bytes from which ``sizes`` tells the size, the marker included
    sizes: Callable[[Bytes], NDArray[np.integer[Any]]] | None = None  # (frame, header) to (frame,), whole sizes
    most: int = 4096  # largest size; a frame that says more of itself is none
    check: Callable[[Bytes], NDArray[np.bool_]] | None = None  # (frame, byte) to (frame,)
    lock: int = 2  # good frames in a row that it takes to lock
    confirm: int = 0  # good frames that must follow one before it is given out
    weak: bool = (
        False  # ``check`` is no sum: frames that are none may pass it again and again while a payload holds still
    )

    @property
    def summed(self) -> bool:
        """Whether one frame alone can be known to be one."""
        return self.check is not None and not self.weak


@dataclass
class _Text:
    """A growing stretch of bytes with the arrival of each, cut off at the front."""

    data: bytes = b""
    base: int = 0  # how many bytes were cut off
    ends: list[NDArray[np.int64]] = field(default_factory=list)  # of chunks, counted from the very first byte
    stamps: list[Times] = field(default_factory=list)

    def append(self, chunks: Chunks) -> None:
        if len(chunks.size):
            self.ends.append(self.base + len(self.data) + np.cumsum(chunks.size))
            self.stamps.append(chunks.t_ns)
            self.data = self.data + chunks.data if self.data else chunks.data

    def arrival(self, last: NDArray[np.int64]) -> Times:
        """Return the arrival of the bytes at ``last`` (byte,), counted within ``data``."""
        if len(self.ends) > 1:
            self.ends, self.stamps = [np.concatenate(self.ends)], [np.concatenate(self.stamps)]
        stamps: Times = self.stamps[0][np.searchsorted(self.ends[0], last + self.base, side="right")]
        return stamps

    def cut(self, count: int) -> None:
        if not count:
            return
        self.data = self.data[count:]
        self.base += count
        if len(self.ends) > 1:
            self.ends, self.stamps = [np.concatenate(self.ends)], [np.concatenate(self.stamps)]
        gone = int(np.searchsorted(self.ends[0], self.base, side="right")) if self.ends else 0
        if gone:
            self.ends, self.stamps = [self.ends[0][gone:]], [self.stamps[0][gone:]]


class ByteFramer:
    """Cuts a stream of bytes into frames as a `Framing` tells."""

    def __init__(self, framing: Framing) -> None:
        self.framing = framing
        self.account = Account()
        self._text = _Text()
        self._locked = False
        self._begun = False  # whether any frame was found yet
        self._broken_at: int | None = None  # where a frame should have begun that did not; counted from the first byte
        self._barred = -1  # where the chain that broke could begin once more, which it must not
        self._usual = framing.size or 0  # size of the last good frame

    def feed(self, chunks: Chunks) -> tuple[list[Run], list[Loss]]:
        """Take what a link gave; return the frames that are complete now, and what was lost."""
        self.account.received += len(chunks.data)
        self._text.append(chunks)
        return self._scan(ended=False)

    def flush(self) -> tuple[list[Run], list[Loss]]:
        """Return what is left when nothing more comes: frames with a sum are good, others lack what confirms them."""
        runs, losses = self._scan(ended=True)
        left = len(self._text.data)
        if left:
            whole = self._locked and bool(self._usual) and left >= self._usual
            losses.append(self._lose(0, left, UNCONFIRMED if whole else CUT if self._begun else START))
            self._text.cut(left)
        return runs, losses

    def _scan(self, *, ended: bool) -> tuple[list[Run], list[Loss]]:
        runs: list[Run] = []
        losses: list[Loss] = []
        data = np.frombuffer(self._text.data, dtype=np.uint8)
        place = 0
        while place < len(data):
            if not self._locked:
                found, kept = self._search(data, place, ended=ended)
                if found is None:
                    place = self._skip(place, kept, losses) if kept - place > self.framing.most else place
                    break
                place = self._skip(place, found, losses)
                self._locked = self._begun = True
                self._broken_at = None
            spans, stop, broken = self._chain(data, place)
            held = 0 if ended and not broken and self.framing.summed else self.framing.confirm
            place = self._give(data, spans, held, runs, place)
            if not broken:
                break
            self._locked, self._broken_at, self._barred = False, self._text.base + stop, self._text.base + place
        self._text.cut(place)
        return runs, losses

    def _give(self, data: Bytes, spans: Sequence[tuple[int, int, int]], held: int, runs: list[Run], place: int) -> int:
        """Append the runs of a chain but for its last ``held`` frames; return where those begin."""
        give = sum(count for _, _, count in spans) - held
        for start, size, count in spans:
            count = min(count, give)
            if count <= 0:
                break
            give -= count
            place = start + count * size
            frames = data[start:place].reshape(count, size)  # (frame, byte)
            runs.append(Run(frames, self._text.arrival(start + size * np.arange(1, count + 1) - 1)))
            self.account.framed += count * size
            self._usual = size
        return place

    def _chain(self, data: Bytes, place: int, most: int | None = None) -> tuple[list[tuple[int, int, int]], int, bool]:
        """Return the good frames that follow one another from ``place``: spans of (start, size, count).

        And where they end, and whether it is certain that no frame begins there. With ``most``, no more than so many.
        """
        spans: list[tuple[int, int, int]] = []
        left = most if most is not None else len(data)
        while left > 0:
            size = self._size(data, place)
            if size is None or place + (size or 0) > len(data):
                return spans, place, False
            if size == 0:
                return spans, place, True
            count = max(1, min((len(data) - place) // size, MOST_BYTES // size, left))
            good = self._good(data[place : place + count * size].reshape(count, size))
            run = count if good.all() else int(good.argmin())
            if run:
                spans.append((place, size, run))
                place += run * size
                left -= run
            if run < count and (run == 0 or self._size(data, place) == size):
                return spans, place, True
        return spans, place, False

    def _size(self, data: Bytes, place: int) -> int | None:
        """Return the size of the frame that begins at ``place``, 0 if none does, None if too few bytes are there."""
        framing = self.framing
        there = data[place : place + max(framing.header, len(framing.marker))]
        marker = framing.marker[: len(there)]
        if there[: len(marker)].tobytes() != marker:
            return 0
        if framing.size is not None:
            return framing.size
        if framing.sizes is not None:
            if len(there) < framing.header:
                return None
            size = int(framing.sizes(there[None])[0])
            return size if framing.header <= size <= framing.most else 0
        return self._size_to_tail(place)

    def _size_to_tail(self, place: int) -> int | None:
        """Return how many bytes there are up to the next tail: the usual number if that gives a tail as well."""
        text, tail = self._text.data, self.framing.tail
        if self._usual and text[place + self._usual - len(tail) : place + self._usual] == tail:
            return self._usual
        found = place + len(self.framing.marker) - 1
        while (found := text.find(tail, found + 1, place + self.framing.most)) >= 0:
            stop = found + len(tail)
            frame = np.frombuffer(text, np.uint8, stop - place, place)[None]  # (1, byte)
            if self.framing.check is None or self.framing.check(frame)[0]:
                return stop - place
            if text.startswith(self.framing.marker, stop) and stop < len(text):
                return 0  # another frame begins right behind, so this was the tail, and the sum is wrong
        return 0 if len(text) - place >= self.framing.most else None

    def _good(self, frames: Bytes) -> NDArray[np.bool_]:
        """Return which frames (frame, byte) have their marks, size and sum."""
        framing = self.framing
        good = np.ones(len(frames), dtype=bool)
        for position, value in enumerate(framing.marker):
            good &= frames[:, position] == value
        for position, value in enumerate(framing.tail):
            good &= frames[:, frames.shape[1] - len(framing.tail) + position] == value
        if framing.sizes is not None:
            good &= framing.sizes(frames[:, : framing.header]) == frames.shape[1]
        if framing.check is not None and good.any():
            good &= framing.check(frames)
        return good

    def _search(self, data: Bytes, place: int, *, ended: bool) -> tuple[int | None, int]:
        """Return the first place from ``place`` on at which ``lock`` good frames follow one another, or None.

        And the first place at which they still may, once more bytes are there.
        """
        possible: int | None = None
        enough = 1 if ended and self.framing.summed else self.framing.lock
        for start in self._candidates(place):
            spans, stop, ruined = self._chain(data, start, self.framing.lock)
            count = sum(found for _, _, found in spans)
            if count >= enough and (count >= self.framing.lock or (stop == len(data) and not ruined)):
                return self._phase(data, start)
            if not ruined and possible is None:
                possible = start
        return None, len(data) if possible is None else possible

    def _phase(self, data: Bytes, start: int) -> tuple[int | None, int]:
        """Return of the places within a frame from ``start`` on the one at which marks repeat for longest, as `_search`.

        A payload that holds still may show the marker in every frame. Where marks alone speak for frames, only its change
        tells the true place.
        """
        size = self.framing.size
        if self.framing.summed or size is None:
            return start, start
        places = [start]
        for other in self._candidates(start + 1):
            if other >= start + size:
                break
            places.append(other)
        chains = [self._chain(data, place, AMBIGUOUS) for place in places]
        alive = [place for place, (_, _, ruined) in zip(places, chains, strict=True) if not ruined]
        whole = [place for place in alive if place + size * self.framing.lock <= len(data)]
        if len(whole) > 1:
            return None, max(start, len(data) - AMBIGUOUS * size)
        longest = max(range(len(places)), key=lambda number: chains[number][1] - places[number])
        found = whole[0] if whole else places[longest]
        return found, found

    def _candidates(self, place: int) -> Iterable[int]:
        """Yield where a frame may begin: at markers, or behind tails; not where the chain that broke began."""
        text, framing = self._text.data, self.framing
        mark = framing.marker or framing.tail
        shift = 0 if framing.marker else len(mark)
        barred = self._barred - self._text.base
        found = text.find(mark, max(0, place - shift))
        while found >= 0:
            if found + shift >= place and found + shift != barred:
                yield found + shift
            found = text.find(mark, found + 1)
        for there in range(len(mark) - 1, 0, -1):  # a mark of which the end is not there yet
            start = len(text) - there
            if start >= place and start != barred and text.endswith(mark[:there]):
                yield start

    def _skip(self, place: int, start: int, losses: list[Loss]) -> int:
        if start > place:
            losses.append(self._lose(place, start, self._cause(place, start)))
        return start

    def _cause(self, place: int, start: int) -> str:
        """Return what became of the bytes from ``place`` to ``start``, between good frames."""
        if not self._begun:
            return START
        broken = place if self._broken_at is None else max(place, self._broken_at - self._text.base)
        between, usual = start - broken, self._usual
        if between <= 0:
            return UNCONFIRMED
        if usual and between % usual == 0:
            return GARBLED
        marker = self.framing.marker
        begins = bool(marker) and self._text.data.startswith(marker, broken)
        if between < usual:
            return CUT if begins or not marker or place < broken else NOISE
        return GARBLED

    def _lose(self, start: int, stop: int, cause: str) -> Loss:
        self.account.lost += stop - start
        usual = self._usual or stop - start
        frames = 0 if cause in (START, NOISE) else max(1, round((stop - start) / usual))
        last = np.array([stop - 1])
        return Loss(int(self._text.arrival(last)[0]), cause, frames, stop - start)


class PacketFramer:
    """Takes each packet of a link for a frame: those of a known size whose check is right."""

    def __init__(self, sizes: Sequence[int], check: Callable[[Bytes], NDArray[np.bool_]] | None = None) -> None:
        self.sizes, self.check = frozenset(sizes), check
        self.account = Account()

    def feed(self, chunks: Chunks) -> tuple[list[Run], list[Loss]]:
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
                runs.append(Run(frames if good.all() else frames[good], chunks.t_ns[rows[good]]))
            losses += [Loss(int(t_ns), MALFORMED, 1, size) for t_ns in chunks.t_ns[rows[~good]]]
            self.account.framed += int(good.sum()) * size
            self.account.lost += int((~good).sum()) * size
        return runs, losses

    def flush(self) -> tuple[list[Run], list[Loss]]:
        """Return nothing: a packet is whole or it is none."""
        return [], []


class TextFramer:
    """Takes each packet of a link for a frame of text: those that ``check`` takes."""

    def __init__(self, check: Callable[[bytes], bool]) -> None:
        self.check = check
        self.account = Account()

    def feed(self, chunks: Chunks) -> tuple[list[Run], list[Loss]]:
        """Return the packets that are frames, as a list of bytes, and the others as losses."""
        self.account.received += len(chunks.data)
        kept, stamps, losses = [], [], []
        for packet, t_ns in zip(chunks.packets(), chunks.t_ns.tolist(), strict=True):
            if self.check(packet):
                kept.append(packet)
                stamps.append(t_ns)
                self.account.framed += len(packet)
            else:
                losses.append(Loss(t_ns, MALFORMED, 1, len(packet)))
                self.account.lost += len(packet)
        return ([Run(kept, np.array(stamps, dtype=np.int64))] if kept else []), losses

    def flush(self) -> tuple[list[Run], list[Loss]]:
        """Return nothing: a packet is whole or it is none."""
        return [], []


class LineFramer:
    """Cuts a stream of text into its lines, without their ends; ``check`` tells which are frames."""

    def __init__(self, check: Callable[[bytes], bool], most: int = 4096) -> None:
        self.check, self.most = check, most
        self.account = Account()
        self._text = _Text()
        self._begun = False

    def feed(self, chunks: Chunks) -> tuple[list[Run], list[Loss]]:
        """Return the lines that are complete now, and those that are no frames as losses."""
        self.account.received += len(chunks.data)
        self._text.append(chunks)
        text = self._text.data
        stop = text.rfind(b"\n") + 1
        if not stop:
            return [], (self._drop(len(text)) if len(text) > self.most else [])
        lines = text[: stop - 1].split(b"\n")
        sizes = np.array([len(line) + 1 for line in lines])
        ends = np.cumsum(sizes)
        arrival = self._text.arrival(ends - 1)
        good = np.array(
            [self._begun and self.check(line.strip()) for line in lines[:1]]
            + [self.check(line.strip()) for line in lines[1:]]
        )
        losses = [
            Loss(
                int(arrival[row]),
                GARBLED if self._begun or row else START,
                int(self._begun or row > 0),
                int(sizes[row]),
            )
            for row in np.flatnonzero(~good)
        ]
        self._begun = True
        kept = [line.strip() for line, fine in zip(lines, good, strict=True) if fine]
        self.account.framed += int(sizes[good].sum())
        self.account.lost += int(sizes[~good].sum())
        self._text.cut(stop)
        return ([Run(kept, arrival[good])] if kept else []), losses

    def flush(self) -> tuple[list[Run], list[Loss]]:
        """Return what is left of a line that has no end."""
        return [], self._drop(len(self._text.data))

    def _drop(self, count: int) -> list[Loss]:
        if not count:
            return []
        last_ns = int(self._text.arrival(np.array([count - 1]))[0])
        self.account.lost += count
        self._text.cut(count)
        return [Loss(last_ns, CUT if self._begun else START, int(self._begun), count)]
