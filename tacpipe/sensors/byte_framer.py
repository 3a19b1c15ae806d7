"""Split a stream of bytes, lines or packets of text into frames: find marks, verify checksums, resynchronize.

Undisturbed bytes are processed as one array (frame, byte), without a Python loop over bytes.

A frame is returned as soon as it is verified. With only marks (`Framing.check` is None) or an 8-bit checksum, ``confirm``
good frames must follow it, because the last frame before a disturbance may be damaged. The end of a datagram, or of the
stream, confirms a frame that ends there. After a disturbance, the framer locks again on ``lock`` good frames in a row, which
are all returned.

A text frame is recognised by its content. A sensor that can check many texts faster at once provides ``check_all``, which
returns whether all of them are frames; texts that are not are then located by bisection.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from tacpipe.arrays import Bools, Bytes
from tacpipe.sensors.framing import (
    CUT,
    END,
    GARBLED,
    MALFORMED,
    NOISE,
    START,
    UNCONFIRMED,
    Account,
    ByteBuffer,
    Chunks,
    FrameRun,
    Framing,
    FramingLoss,
)

AMBIGUOUS = 64  # number of frames after which an ambiguous phase is decided
MAX_CHECKED_BYTES = 1 << 23  # bytes that are checked at once, which bounds the memory
Span = tuple[int, int, int]  # consecutive frames of one size: start, size, count


class ByteFramer:
    """Split a stream of bytes into the frames that a `Framing` describes."""

    def __init__(self, framing: Framing, *, datagrams: bool = False) -> None:
        """Split bytes into the frames of ``framing``; with ``datagrams``, each chunk is one datagram."""
        self.framing, self._datagrams = framing, datagrams
        self.account = Account()
        self._text = ByteBuffer()
        self._locked = False
        self._has_frames = False  # True after the first frame
        # Offsets of these attributes are counted from the first byte of the stream.
        self._broken_at: int | None = None  # offset at which an expected frame did not start
        self._excluded = -1  # offset at which the broken chain started; it must not start there again
        self._last_size = framing.size or 0  # size of the last good frame
        self._cached_marks: tuple[int, list[tuple[int, bytes]]] = (0, [])  # size and marks of the last call of `_marks`
        self._last_header = (b"", 0)  # the last header whose size was computed, and that size
        self._follows_tail = False  # True if the buffered bytes start right after a tail
        self._dead_starts: set[int] = set()  # offsets at which no chain starts

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Add bytes, and return the frames that are now complete, and the losses."""
        self.account.received += len(chunks.data)
        self._text.append(chunks)
        return self._scan(at_end=False)

    def flush(self) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the last frames and losses at the end of the stream. An incomplete last frame is no lost frame."""
        runs, losses = self._scan(at_end=True)
        remaining = len(self._text.data)
        if remaining:
            losses.append(self._lose(0, remaining, START if not self._has_frames else END if self._locked else CUT))
            self._text.cut(remaining)
        return runs, losses

    def _scan(self, *, at_end: bool) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the frames and losses in the buffered bytes, and remove these bytes.

        Frames that following bytes must confirm stay in the buffer, unless the stream is ``at_end``.
        """
        runs: list[FrameRun] = []
        losses: list[FramingLoss] = []
        offset, size = 0, len(self._text.data)
        while offset < size:
            if not self._locked:
                start, retained = self._search(offset, at_end=at_end)
                if start is None:
                    if retained - offset > self.framing.max_size:
                        offset = self._skip(offset, retained, losses)
                    break
                offset = self._skip(offset, start, losses)
                self._locked = self._has_frames = True
                self._dead_starts.clear()
                self._broken_at = None
            spans, stop, broken = self._chain(offset)
            unconfirmed = 0 if at_end and not broken else self.framing.confirm
            if unconfirmed and self._datagrams and spans and self._text.ends_chunk(stop - spans[-1][1], stop):
                unconfirmed = 0
            offset = self._add_runs(spans, unconfirmed, runs, offset)
            if not broken:
                break
            self._locked, self._broken_at, self._excluded = False, self._text.base + stop, self._text.base + offset
        if offset:
            tail = self.framing.tail
            self._follows_tail = bool(tail) and self._text.data[max(0, offset - len(tail)) : offset] == tail
        self._text.cut(offset)
        return runs, losses

    def _add_runs(self, spans: Sequence[Span], unconfirmed: int, runs: list[FrameRun], offset: int) -> int:
        """Append a chain without its last ``unconfirmed`` frames to ``runs``, and return the offset of those frames.

        The chain starts at ``offset``.
        """
        confirmed = -unconfirmed
        for _, _, count in spans:
            confirmed += count
        stop = offset
        for start, size, span_count in spans:
            count = min(span_count, confirmed)
            if count <= 0:
                break
            confirmed -= count
            stop = start + count * size
            runs.append(
                FrameRun(self._frames(start, size, count), self._text.arrivals(range(start + size - 1, stop, size)))
            )
            self.account.framed += count * size
            self._last_size = size
        return stop

    def _chain(self, offset: int, limit: int | None = None) -> tuple[list[Span], int, bool]:
        """Return the consecutive good frames from ``offset`` on, the offset after them, and whether a bad frame follows.

        Frames are spans (start, size, count). ``limit`` is the maximum number of frames.
        """
        spans: list[Span] = []
        size_of_text = len(self._text.data)
        remaining = size_of_text if limit is None else limit
        while remaining > 0:
            size = self._size(offset)
            if size is None or offset + size > size_of_text:
                return spans, offset, False
            if size == 0:
                return spans, offset, True
            count = max(1, min((size_of_text - offset) // size, MAX_CHECKED_BYTES // size, remaining))
            run = self._count_good(offset, size, count)
            if run:
                spans.append((offset, size, run))
                offset += run * size
                remaining -= run
            if run < count and (run == 0 or self._size(offset) == size):
                return spans, offset, True
        return spans, offset, False

    def _size(self, offset: int) -> int | None:
        """Return the size of the frame at ``offset``, 0 if no frame starts there, or None if more bytes are needed."""
        text, framing = self._text.data, self.framing
        if not text.startswith(framing.marker, offset):
            mark = text[offset : offset + len(framing.marker)]
            if len(mark) == len(framing.marker) or not framing.marker.startswith(mark):
                return 0
        if framing.size is not None:
            return framing.size
        if framing.sizes is None:
            return self._size_to_tail(offset)
        head = text[offset : offset + framing.header]
        if len(head) < framing.header:
            return None
        if head != self._last_header[0]:
            size = int(framing.sizes(np.frombuffer(head, np.uint8)[None])[0])
            is_valid = framing.header <= size <= framing.max_size
            self._last_header = head, (size if is_valid else 0)
        return self._last_header[1]

    def _size_to_tail(self, offset: int) -> int | None:
        """Return the size of a frame from ``offset`` to its tail, 0 if it has none, or None if more bytes are needed.

        The size of the last frame is tried first.
        """
        text, tail = self._text.data, self.framing.tail
        if self._last_size and text[offset + self._last_size - len(tail) : offset + self._last_size] == tail:
            return self._last_size
        tail_at = offset + len(self.framing.marker) - 1
        while (tail_at := text.find(tail, tail_at + 1, offset + self.framing.max_size)) >= 0:
            stop = tail_at + len(tail)
            frame = np.frombuffer(text, np.uint8, stop - offset, offset)[None]  # (1, byte)
            if self.framing.check is None or self.framing.check(frame)[0]:
                return stop - offset
            if text.startswith(self.framing.marker, stop) and stop < len(text):
                return 0  # another frame starts here, so this was the tail, and the check failed
        return 0 if len(text) - offset >= self.framing.max_size else None

    def _count_good(self, offset: int, size: int, count: int) -> int:
        """Return the number of good frames at ``offset`` before the first bad one, at most ``count``.

        A good frame has the right marks, size and checksum.
        """
        framing, text = self.framing, self._text.data
        good = count
        for at, mark in self._marks(size):
            column = text[offset + at : offset + good * size : size]  # the byte at this offset of each frame
            good -= len(column.lstrip(mark))
        if framing.sizes is not None and good > 1:  # only the size of the first frame is known to be right
            good = _count_leading(framing.sizes(self._frames(offset, size, good)[:, : framing.header]) == size)
        if framing.check is not None and good:
            good = _count_leading(framing.check(self._frames(offset, size, good)))
        return good

    def _marks(self, size: int) -> list[tuple[int, bytes]]:
        """Return the offset and value of each byte of marker and tail in frames of this size."""
        if size != self._cached_marks[0]:
            framing = self.framing
            offsets = [*range(len(framing.marker)), *range(size - len(framing.tail), size)]
            marks = framing.marker + framing.tail
            self._cached_marks = size, [(at, marks[row : row + 1]) for row, at in enumerate(offsets)]
        return self._cached_marks[1]

    def _frames(self, offset: int, size: int, count: int) -> Bytes:
        """Return frames of one size as an array (frame, byte), without copying."""
        return np.frombuffer(self._text.data, np.uint8, count * size, offset).reshape(count, size)

    def _search(self, offset: int, *, at_end: bool) -> tuple[int | None, int]:
        """Return the first offset at which ``lock`` good frames start, from ``offset`` on, or None.

        Also returns the first offset at which they may still start when more bytes arrive.
        """
        first_possible: int | None = None
        size_of_text = len(self._text.data)
        required = 1 if at_end and self.framing.has_checksum else self.framing.lock
        base = self._text.base
        self._dead_starts = {start for start in self._dead_starts if start >= base + offset}
        for start in self._candidates(offset):
            if base + start in self._dead_starts:
                continue
            spans, stop, broken = self._chain(start, self.framing.lock)
            count = sum(frames for _, _, frames in spans)
            if count >= required and (count >= self.framing.lock or (stop == size_of_text and not broken)):
                return self._choose_phase(start)
            if broken:
                self._dead_starts.add(base + start)
            elif first_possible is None:
                first_possible = start
        return None, size_of_text if first_possible is None else first_possible

    def _choose_phase(self, start: int) -> tuple[int | None, int]:
        """Return the offset within one frame from ``start`` on at which marks repeat for longest; results as of `_search`.

        A constant payload may contain the marker in every frame. Without a checksum, only a change of the payload
        reveals the true start: until then, the first result is None.
        """
        size = self.framing.size
        if self.framing.has_checksum or size is None:
            return start, start
        starts = [start]
        for candidate in self._candidates(start + 1):
            if candidate >= start + size:
                break
            starts.append(candidate)
        size_of_text = len(self._text.data)
        chains = [self._chain(candidate, AMBIGUOUS) for candidate in starts]
        unbroken = [candidate for candidate, (_, _, broken) in zip(starts, chains, strict=True) if not broken]
        complete = [candidate for candidate in unbroken if candidate + size * self.framing.lock <= size_of_text]
        if len(complete) > 1:
            return None, max(start, size_of_text - AMBIGUOUS * size)
        longest = max(range(len(starts)), key=lambda number: chains[number][1] - starts[number])
        chosen = complete[0] if complete else starts[longest]
        return chosen, chosen

    def _candidates(self, offset: int) -> Iterable[int]:
        """Yield the offsets at which a frame may start: at markers, or after tails, except the start of the broken chain."""
        text, framing = self._text.data, self.framing
        mark = framing.marker or framing.tail
        shift = 0 if framing.marker else len(mark)
        excluded = self._excluded - self._text.base
        if shift and self._follows_tail and offset == 0 != excluded:
            yield 0
        mark_at = text.find(mark, max(0, offset - shift))
        while mark_at >= 0:
            if mark_at + shift >= offset and mark_at + shift != excluded:
                yield mark_at + shift
            mark_at = text.find(mark, mark_at + 1)
        for length in range(len(mark) - 1, 0, -1):  # an incomplete mark at the end of the buffer
            start = len(text) - length
            if start >= offset and start != excluded and text.endswith(mark[:length]):
                yield start

    def _skip(self, offset: int, start: int, losses: list[FramingLoss]) -> int:
        if start > offset:
            losses.append(self._lose(offset, start, self._cause(offset, start)))
        return start

    def _cause(self, offset: int, start: int) -> str:
        """Return the cause of the loss of the bytes from ``offset`` to ``start``, between good frames."""
        if not self._has_frames:
            return START
        broken = offset if self._broken_at is None else max(offset, self._broken_at - self._text.base)
        between, frame_size = start - broken, self._last_size
        if between <= 0:
            return UNCONFIRMED
        if frame_size and between % frame_size == 0:
            return GARBLED
        marker = self.framing.marker
        has_marker = bool(marker) and self._text.data.startswith(marker, broken)
        if between < frame_size:
            return CUT if has_marker or not marker or offset < broken else NOISE
        return GARBLED

    def _lose(self, start: int, stop: int, cause: str) -> FramingLoss:
        self.account.lost += stop - start
        frame_size = self._last_size or stop - start
        frames = 0 if cause in (START, NOISE) else max(1, round((stop - start) / frame_size))
        frames = (stop - start) // frame_size if cause == END else frames
        return FramingLoss(self._text.arrival(stop - 1), cause, frames, stop - start)


def _count_leading(good: Bools) -> int:
    """Return the number of True values in the mask ``good`` (frame,) before the first False."""
    first = int(good.argmin())
    return len(good) if good[first] else first


FEW = 8  # maximum number of texts that are checked one by one
Check = Callable[[bytes], bool]
CheckAll = Callable[[Sequence[bytes]], bool]


class TextFramer:
    """Treat each packet of a link as a text frame if ``check`` accepts it."""

    def __init__(self, check: Check, check_all: CheckAll | None = None) -> None:
        self.check, self.check_all = check, check_all
        self.account = Account()

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the accepted packets as one run, and the others as losses."""
        packets = chunks.packets()
        good = _check_texts(packets, self.check, self.check_all)
        lost = int(chunks.size[~good].sum())
        self.account.received += len(chunks.data)
        self.account.framed += len(chunks.data) - lost
        self.account.lost += lost
        losses = [
            FramingLoss(t_ns, MALFORMED, 1, size)
            for t_ns, size in zip(chunks.t_ns[~good].tolist(), chunks.size[~good].tolist(), strict=True)
        ]
        accepted = _select(packets, good)
        return ([FrameRun(accepted, chunks.t_ns[good])] if accepted else []), losses

    def flush(self) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return nothing: packets are never incomplete."""
        return [], []


class LineFramer:
    """Split a stream of text into lines without their ends. Lines that ``check`` accepts are frames."""

    def __init__(self, check: Check, check_all: CheckAll | None = None, max_size: int = 4096) -> None:
        self.check, self.check_all, self.max_size = check, check_all, max_size
        self.account = Account()
        self._text = ByteBuffer()
        self._has_lines = False

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the frames among the lines that are now complete, and the other lines as losses."""
        self.account.received += len(chunks.data)
        self._text.append(chunks)
        text = self._text.data
        stop = text.rfind(b"\n") + 1
        if not stop:
            return [], (self._drop(len(text), CUT) if len(text) > self.max_size else [])
        lines = text[: stop - 1].split(b"\n")
        sizes = np.fromiter(map(len, lines), np.int64, len(lines)) + 1
        arrival = self._text.arrivals(sizes.cumsum() - 1)
        losses = []
        if not self._has_lines:  # the first line may have started before the recording
            losses = [FramingLoss(int(arrival[0]), START, 0, int(sizes[0]))]
            lines, sizes, arrival = lines[1:], sizes[1:], arrival[1:]
        lines = [line.strip() for line in lines]
        good = _check_texts(lines, self.check, self.check_all)
        bad = np.flatnonzero(~good).tolist()
        losses += [FramingLoss(int(arrival[row]), GARBLED, 1, int(sizes[row])) for row in bad]
        self._has_lines = True
        accepted = _select(lines, good)
        lost = sum(loss.bytes for loss in losses)
        self.account.framed += stop - lost
        self.account.lost += lost
        self._text.cut(stop)
        return ([FrameRun(accepted, arrival[good])] if accepted else []), losses

    def flush(self) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the incomplete last line as a loss."""
        return [], self._drop(len(self._text.data), END)

    def _drop(self, count: int, cause: str) -> list[FramingLoss]:
        """Remove ``count`` bytes without a line end, and return them as a loss."""
        if not count:
            return []
        last_ns = self._text.arrival(count - 1)
        self.account.lost += count
        self._text.cut(count)
        return [FramingLoss(last_ns, cause if self._has_lines else START, int(self._has_lines and cause == CUT), count)]


def _check_texts(texts: Sequence[bytes], check: Check, check_all: CheckAll | None) -> Bools:
    """Return a mask (text,) of the texts that are frames."""
    if check_all is None or len(texts) < FEW:
        return np.fromiter(map(check, texts), bool, len(texts))
    if check_all(texts):
        return np.ones(len(texts), dtype=bool)
    half = len(texts) // 2
    return np.concatenate([_check_texts(texts[:half], check, check_all), _check_texts(texts[half:], check, check_all)])


def _select(texts: list[bytes], good: Bools) -> list[bytes]:
    return texts if good.all() else [text for text, is_good in zip(texts, good.tolist(), strict=True) if is_good]
