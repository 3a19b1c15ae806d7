"""Turn texts into frames: packets of one text each, and streams of lines.

What states a frame of text from another text is its content, which takes a look at each. A sensor that can look at many at
once, and faster so, states as ``every`` whether all of them are frames; a text that is none is then found half by half.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tacpipe.arrays import Bools
from tacpipe.sensors.framing import CUT, GARBLED, MALFORMED, START, Account, Chunks, FrameRun, FramingLoss, Pending

FEW = 8  # texts that are looked at one by one
Check = Callable[[bytes], bool]
CheckOfAll = Callable[[Sequence[bytes]], bool]


class TextFramer:
    """Takes each packet of a link for a frame of text: those that ``check`` takes."""

    def __init__(self, check: Check, every: CheckOfAll | None = None) -> None:
        self.check, self.every = check, every
        self.account = Account()

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the packets that are frames, as a list of bytes, and the others as losses."""
        packets = chunks.packets()
        good = _good(packets, self.check, self.every)
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

    def __init__(self, check: Check, every: CheckOfAll | None = None, most: int = 4096) -> None:
        self.check, self.every, self.most = check, every, most
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
        good = _good(lines, self.check, self.every)
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


def _good(texts: Sequence[bytes], check: Check, every: CheckOfAll | None) -> Bools:
    """Return which texts are frames (text,)."""
    if every is None or len(texts) < FEW:
        return np.fromiter(map(check, texts), bool, len(texts))
    if every(texts):
        return np.ones(len(texts), dtype=bool)
    half = len(texts) // 2
    return np.concatenate([_good(texts[:half], check, every), _good(texts[half:], check, every)])


def _select(texts: list[bytes], good: Bools) -> list[bytes]:
    return texts if good.all() else [text for text, fine in zip(texts, good.tolist(), strict=True) if fine]
