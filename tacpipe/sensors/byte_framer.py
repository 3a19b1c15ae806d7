"""Cut a stream of bytes, or lines and packets of text, into frames: lock on marks, check sums, resynchronize.

No byte is looked at by itself in Python: as long as all is well, the bytes at hand are one array (frame, byte).

A frame is given out when it is known to be one. Where nothing but the marks speaks for it (`Framing.check` is None), or a
sum of 8 bits, that is once ``confirm`` good frames follow it: the frame before a disturbance may be a part of it. After a
disturbance a lock takes ``lock`` good frames in a row, all of which are then given out.

A frame of text is recognised by its content. A sensor that checks many texts at once, faster, states as ``check_all``
whether all of them are frames; a text that is none is then found by halving.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from tacpipe.arrays import Bools, Bytes
from tacpipe.sensors.framing import (
    CUT,
    GARBLED,
    MALFORMED,
    NOISE,
    START,
    UNCONFIRMED,
    Account,
    Chunks,
    FrameRun,
    Framing,
    FramingLoss,
    Pending,
)

AMBIGUOUS = 64  # frames that are kept while marks repeat in more than one place
MOST_BYTES = 1 << 23  # looked at in one go, which bounds the memory of a check
Span = tuple[int, int, int]  # frames of one size that follow one another: where they start, their size, how many


class ByteFramer:
    """Cuts a stream of bytes into frames as a `Framing` states."""

    def __init__(self, framing: Framing) -> None:
        self.framing = framing
        self.account = Account()
        self._text = Pending()
        self._locked = False
        self._has_frames = False  # True after the first frame
        self._broken_at: int | None = None  # place, from the first byte, where an expected frame did not begin
        self._barred = -1  # place where the broken chain must not begin again
        self._usual = framing.size or 0  # size of the last good frame
        self._marked: tuple[int, list[tuple[int, bytes]]] = (0, [])  # marks of frames of the last size, see `_marks`
        self._last_header = (b"", 0)  # the last header whose size was computed, and the size
        self._follows_tail = False  # True where the buffered bytes begin right after a tail that was cut off
        self._ruined: set[int] = set()  # places, from the first byte, where no chain begins

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Take what a link gave; return the frames that are complete now, and what was lost."""
        self.account.received += len(chunks.data)
        self._text.append(chunks)
        return self._scan(at_end=False)

    def flush(self) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return what is left when nothing more comes: frames with a sum are good, others lack what confirms them."""
        runs, losses = self._scan(at_end=True)
        remaining = len(self._text.data)
        if remaining:
            complete = self._locked and bool(self._usual) and remaining >= self._usual
            losses.append(self._lose(0, remaining, UNCONFIRMED if complete else CUT if self._has_frames else START))
            self._text.cut(remaining)
        return runs, losses

    def _scan(self, *, at_end: bool) -> tuple[list[FrameRun], list[FramingLoss]]:
        runs: list[FrameRun] = []
        losses: list[FramingLoss] = []
        place, size = 0, len(self._text.data)
        while place < size:
            if not self._locked:
                start, retained = self._search(place, at_end=at_end)
                if start is None:
                    place = self._skip(place, retained, losses) if retained - place > self.framing.most else place
                    break
                place = self._skip(place, start, losses)
                self._locked = self._has_frames = True
                self._ruined.clear()
                self._broken_at = None
            spans, stop, broken = self._chain(place)
            unconfirmed = 0 if at_end and not broken and self.framing.summed else self.framing.confirm
            place = self._give(spans, unconfirmed, runs, place)
            if not broken:
                break
            self._locked, self._broken_at, self._barred = False, self._text.base + stop, self._text.base + place
        if place:
            tail = self.framing.tail
            self._follows_tail = bool(tail) and self._text.data[max(0, place - len(tail)) : place] == tail
        self._text.cut(place)
        return runs, losses

    def _give(self, spans: Sequence[Span], unconfirmed: int, runs: list[FrameRun], place: int) -> int:
        """Append the runs of a chain but for its last ``unconfirmed`` frames; return where those begin."""
        give = -unconfirmed
        for _, _, count in spans:
            give += count
        for start, size, count in spans:
            count = min(count, give)
            if count <= 0:
                break
            give -= count
            place = start + count * size
            runs.append(
                FrameRun(self._frames(start, size, count), self._text.arrivals(range(start + size - 1, place, size)))
            )
            self.account.framed += count * size
            self._usual = size
        return place

    def _chain(self, place: int, limit: int | None = None) -> tuple[list[Span], int, bool]:
        """Return the good frames that follow one another from ``place``: spans of (start, size, count).

        Return also where they end, and whether it is certain that no frame begins there. ``limit`` is the largest count.
        """
        spans: list[Span] = []
        size_of_text = len(self._text.data)
        limit = size_of_text if limit is None else limit
        while limit > 0:
            size = self._size(place)
            if size is None or place + size > size_of_text:
                return spans, place, False
            if size == 0:
                return spans, place, True
            count = max(1, min((size_of_text - place) // size, MOST_BYTES // size, limit))
            run = self._good(place, size, count)
            if run:
                spans.append((place, size, run))
                place += run * size
                limit -= run
            if run < count and (run == 0 or self._size(place) == size):
                return spans, place, True
        return spans, place, False

    def _size(self, place: int) -> int | None:
        """Return the size of the frame that begins at ``place``, 0 if none does, None if too few bytes are there."""
        text, framing = self._text.data, self.framing
        if not text.startswith(framing.marker, place):
            mark = text[place : place + len(framing.marker)]
            if len(mark) == len(framing.marker) or not framing.marker.startswith(mark):
                return 0
        if framing.size is not None:
            return framing.size
        if framing.sizes is None:
            return self._size_to_tail(place)
        head = text[place : place + framing.header]
        if len(head) < framing.header:
            return None
        if head != self._last_header[0]:
            size = int(framing.sizes(np.frombuffer(head, np.uint8)[None])[0])
            self._last_header = head, size if framing.header <= size <= framing.most else 0
        return self._last_header[1]

    def _size_to_tail(self, place: int) -> int | None:
        """Return how many bytes there are up to the next tail: the usual number if that gives a tail as well."""
        text, tail = self._text.data, self.framing.tail
        if self._usual and text[place + self._usual - len(tail) : place + self._usual] == tail:
            return self._usual
        tail_at = place + len(self.framing.marker) - 1
        while (tail_at := text.find(tail, tail_at + 1, place + self.framing.most)) >= 0:
            stop = tail_at + len(tail)
            frame = np.frombuffer(text, np.uint8, stop - place, place)[None]  # (1, byte)
            if self.framing.check is None or self.framing.check(frame)[0]:
                return stop - place
            if text.startswith(self.framing.marker, stop) and stop < len(text):
                return 0  # another frame begins right behind, so this was the tail, and the sum is wrong
        return 0 if len(text) - place >= self.framing.most else None

    def _good(self, place: int, size: int, count: int) -> int:
        """Return how many of ``count`` frames from ``place`` on, up to the first that has not, have marks, size and sum."""
        framing, text = self.framing, self._text.data
        for at, mark in self._marks(size):
            column = text[place + at : place + count * size : size]  # the mark's byte of each frame
            count -= len(column.lstrip(mark))
        if framing.sizes is not None and count > 1:  # the first was asked for its size
            count = _leading(framing.sizes(self._frames(place, size, count)[:, : framing.header]) == size)
        if framing.check is not None and count:
            count = _leading(framing.check(self._frames(place, size, count)))
        return count

    def _marks(self, size: int) -> list[tuple[int, bytes]]:
        """Return where in a frame of so many bytes its marks are, byte by byte."""
        if size != self._marked[0]:
            framing = self.framing
            places = [*range(len(framing.marker)), *range(size - len(framing.tail), size)]
            marks = framing.marker + framing.tail
            self._marked = size, [(at, marks[row : row + 1]) for row, at in enumerate(places)]
        return self._marked[1]

    def _frames(self, place: int, size: int, count: int) -> Bytes:
        """Return frames of one size as an array (frame, byte), without a copy."""
        return np.frombuffer(self._text.data, np.uint8, count * size, place).reshape(count, size)

    def _search(self, place: int, *, at_end: bool) -> tuple[int | None, int]:
        """Return the first place from ``place`` on at which ``lock`` good frames follow one another, or None.

        And the first place at which they still may, once more bytes are there.
        """
        possible: int | None = None
        size_of_text = len(self._text.data)
        enough = 1 if at_end and self.framing.summed else self.framing.lock
        base = self._text.base
        self._ruined = {start for start in self._ruined if start >= base + place}
        for start in self._candidates(place):
            if base + start in self._ruined:
                continue
            spans, stop, ruined = self._chain(start, self.framing.lock)
            count = sum(frames for _, _, frames in spans)
            if count >= enough and (count >= self.framing.lock or (stop == size_of_text and not ruined)):
                return self._phase(start)
            if ruined:
                self._ruined.add(base + start)
            elif possible is None:
                possible = start
        return None, size_of_text if possible is None else possible

    def _phase(self, start: int) -> tuple[int | None, int]:
        """Return of the places within a frame from ``start`` on the one at which marks repeat for longest, as `_search`.

        A payload that holds still may show the marker in every frame. Where marks alone speak for frames, only its change
        states the true place.
        """
        size = self.framing.size
        if self.framing.summed or size is None:
            return start, start
        places = [start]
        for candidate in self._candidates(start + 1):
            if candidate >= start + size:
                break
            places.append(candidate)
        size_of_text = len(self._text.data)
        chains = [self._chain(place, AMBIGUOUS) for place in places]
        alive = [place for place, (_, _, ruined) in zip(places, chains, strict=True) if not ruined]
        complete = [place for place in alive if place + size * self.framing.lock <= size_of_text]
        if len(complete) > 1:
            return None, max(start, size_of_text - AMBIGUOUS * size)
        longest = max(range(len(places)), key=lambda number: chains[number][1] - places[number])
        chosen = complete[0] if complete else places[longest]
        return chosen, chosen

    def _candidates(self, place: int) -> Iterable[int]:
        """Yield where a frame may begin: at markers, or behind tails; not where the chain that broke began."""
        text, framing = self._text.data, self.framing
        mark = framing.marker or framing.tail
        shift = 0 if framing.marker else len(mark)
        barred = self._barred - self._text.base
        if shift and self._follows_tail and place == 0 != barred:
            yield 0
        mark_at = text.find(mark, max(0, place - shift))
        while mark_at >= 0:
            if mark_at + shift >= place and mark_at + shift != barred:
                yield mark_at + shift
            mark_at = text.find(mark, mark_at + 1)
        for length in range(len(mark) - 1, 0, -1):  # a mark of which the end is not there yet
            start = len(text) - length
            if start >= place and start != barred and text.endswith(mark[:length]):
                yield start

    def _skip(self, place: int, start: int, losses: list[FramingLoss]) -> int:
        if start > place:
            losses.append(self._lose(place, start, self._cause(place, start)))
        return start

    def _cause(self, place: int, start: int) -> str:
        """Return what became of the bytes from ``place`` to ``start``, between good frames."""
        if not self._has_frames:
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

    def _lose(self, start: int, stop: int, cause: str) -> FramingLoss:
        self.account.lost += stop - start
        usual = self._usual or stop - start
        frames = 0 if cause in (START, NOISE) else max(1, round((stop - start) / usual))
        return FramingLoss(self._text.arrival(stop - 1), cause, frames, stop - start)


def _leading(good: Bools) -> int:
    """Return how many frames are good (frame,) before the first that is not."""
    first = int(good.argmin())
    return len(good) if good[first] else first


FEW = 8  # texts that are looked at one by one
Check = Callable[[bytes], bool]
CheckOfAll = Callable[[Sequence[bytes]], bool]


class TextFramer:
    """Takes each packet of a link for a frame of text: those that ``check`` takes."""

    def __init__(self, check: Check, check_all: CheckOfAll | None = None) -> None:
        self.check, self.check_all = check, check_all
        self.account = Account()

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the packets that are frames, as a list of bytes, and the others as losses."""
        packets = chunks.packets()
        good = _good(packets, self.check, self.check_all)
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
        """Return nothing: a packet is whole or it is none."""
        return [], []


class LineFramer:
    """Cuts a stream of text into its lines, without their ends; ``check`` states which are frames."""

    def __init__(self, check: Check, check_all: CheckOfAll | None = None, most: int = 4096) -> None:
        self.check, self.check_all, self.most = check, check_all, most
        self.account = Account()
        self._text = Pending()
        self._has_lines = False

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the lines that are complete now, and those that are not frames as losses."""
        self.account.received += len(chunks.data)
        self._text.append(chunks)
        text = self._text.data
        stop = text.rfind(b"\n") + 1
        if not stop:
            return [], (self._drop(len(text)) if len(text) > self.most else [])
        lines = text[: stop - 1].split(b"\n")
        sizes = np.fromiter(map(len, lines), np.int64, len(lines)) + 1
        arrival = self._text.arrivals(sizes.cumsum() - 1)
        losses = []
        if not self._has_lines:  # the first line of all began before the recording did
            losses = [FramingLoss(int(arrival[0]), START, 0, int(sizes[0]))]
            lines, sizes, arrival = lines[1:], sizes[1:], arrival[1:]
        lines = [line.strip() for line in lines]
        good = _good(lines, self.check, self.check_all)
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
        """Return what is left of a line that has no end."""
        return [], self._drop(len(self._text.data))

    def _drop(self, count: int) -> list[FramingLoss]:
        if not count:
            return []
        last_ns = self._text.arrival(count - 1)
        self.account.lost += count
        self._text.cut(count)
        return [FramingLoss(last_ns, CUT if self._has_lines else START, int(self._has_lines), count)]


def _good(texts: Sequence[bytes], check: Check, check_all: CheckOfAll | None) -> Bools:
    """Return which texts are frames (text,)."""
    if check_all is None or len(texts) < FEW:
        return np.fromiter(map(check, texts), bool, len(texts))
    if check_all(texts):
        return np.ones(len(texts), dtype=bool)
    half = len(texts) // 2
    return np.concatenate([_good(texts[:half], check, check_all), _good(texts[half:], check, check_all)])


def _select(texts: list[bytes], good: Bools) -> list[bytes]:
    return texts if good.all() else [text for text, fine in zip(texts, good.tolist(), strict=True) if fine]
