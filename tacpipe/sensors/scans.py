"""Scans of a skin that come in pieces, two CAN frames a triangle, put together so that no scan is made of two.

The CAN frames of a scan have no number. They come in order, ``40`` and ``C0`` of the first triangle, then of the next,
and without a pause: where one is missing, doubled, or comes after a pause in which others may be lost, the scan is torn.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import Bools, Bytes, Int64s, Times
from tacpipe.sensors.framing import MALFORMED, START, Account, Chunks, Loss, Run

TORN = "torn"  # a scan of which CAN frames are missing
CAN = 13  # bytes of a CAN frame as a link gives it: identifier, length, 8 of data
DATA = 5  # place of the data
HEAD, TAIL = 0x40, 0xC0  # first byte of the data, of each triangle's two CAN frames
TAIL_LENGTHS = (6, 8)  # lengths of the last data, without and with diagnostics


class ScanFramer:
    """Puts the CAN frames of one scan together, and gives out whole scans alone.

    CAN frames of other identifiers are other boards': they count as framed and are left out. One that is malformed costs no
    scan by itself: the scan that it was of is torn, and counted as that.
    """

    def __init__(self, identifiers: list[int], pause_ns: int) -> None:
        self.account = Account()
        self.size = 2 * len(identifiers)  # CAN frames of a scan
        self._identifiers = np.array(identifiers, dtype=np.int64)
        self._pause_ns = pause_ns  # longer between two CAN frames of a scan, and others came between
        self._data = np.zeros((0, CAN), dtype=np.uint8)  # frames of an incomplete scan
        self._t_ns: Times = np.zeros(0, dtype=np.int64)
        self._has_scans = False
        self._place = self.size  # place of the last CAN frame that is assigned

    def feed(self, chunks: Chunks) -> tuple[list[Run], list[Loss]]:
        """Return the scans that are whole now, and what is left of torn ones as losses."""
        self.account.received += len(chunks.data)
        frames, t_ns, losses = self._can_frames(chunks)
        data, stamps = np.vstack([self._data, frames]), np.concatenate([self._t_ns, t_ns])
        places = self._places(data)
        bad = places < 0
        losses += [Loss(int(at_ns), MALFORMED, 0, CAN) for at_ns in stamps[bad]]
        starts, torn_at = self._scans(places, stamps)
        rows_of_scans = (starts[:, None] + np.arange(self.size)).ravel()
        keep = len(data) if torn_at is None else torn_at
        unassigned = np.ones(len(data), dtype=bool)
        unassigned[rows_of_scans] = unassigned[bad] = False
        first = 0 if self._has_scans else int(starts[0]) if len(starts) else keep
        losses += self._torn(unassigned[:keep], places[:keep], stamps[:keep], first)
        self._data, self._t_ns = data[keep:], stamps[keep:]
        self.account.framed += len(rows_of_scans) * CAN
        self.account.lost += sum(loss.bytes for loss in losses)
        if not len(starts):
            return [], losses
        self._has_scans = True
        return [Run(data[rows_of_scans].reshape(len(starts), -1), stamps[starts + self.size - 1])], losses

    def _can_frames(self, chunks: Chunks) -> tuple[Bytes, Times, list[Loss]]:
        """Return the CAN frames of this board (frame, 13), their arrival, and packets that are not a CAN frames as
        losses."""
        right = (chunks.size > 0) & (chunks.size % CAN == 0)  # some adapters give several at once
        losses = [
            Loss(int(at_ns), MALFORMED, 0, int(size))
            for at_ns, size in zip(chunks.t_ns[~right], chunks.size[~right], strict=True)
        ]
        data = np.frombuffer(chunks.data, np.uint8)
        frames = data[np.repeat(right, chunks.size)].reshape(-1, CAN)
        t_ns = np.repeat(chunks.t_ns[right], chunks.size[right] // CAN)
        ours = np.isin(_identifier(frames), self._identifiers)
        self.account.framed += int((~ours).sum()) * CAN
        return frames[ours], t_ns[ours], losses

    def _places(self, frames: Bytes) -> Int64s:
        """Return the place of each CAN frame in a scan (frame,), -1 where it is none of a scan."""
        tail = frames[:, DATA] == TAIL
        is_complete = np.where(tail, np.isin(frames[:, 4], TAIL_LENGTHS), frames[:, 4] == 8)
        good = is_complete & (tail | (frames[:, DATA] == HEAD))
        places = 2 * np.searchsorted(self._identifiers, _identifier(frames)) + tail
        return np.where(good, places, -1)

    def _scans(self, places: Int64s, t_ns: Times) -> tuple[Int64s, int | None]:
        """Return where whole scans begin, and where one begins that may become whole, if there is one."""
        starts = np.flatnonzero(places == 0)
        if not len(starts):
            return starts, None
        follows = np.diff(places, prepend=-2) == 1
        follows &= np.diff(t_ns, prepend=t_ns[0]) <= self._pause_ns
        breaks = np.append(np.flatnonzero(~follows), len(places))
        length = breaks[np.searchsorted(breaks, starts, side="right")] - starts
        open_at = int(starts[-1]) if starts[-1] + length[-1] == len(places) and length[-1] < self.size else None
        return starts[length >= self.size], open_at

    def _torn(self, unassigned: Bools, places: Int64s, t_ns: Times, first: int) -> list[Loss]:
        """Return a loss for each stretch of CAN frames that belong to no whole scan, and count the scans they are of.

        Those before ``first`` are what was left of a scan when recording began.
        """
        is_placed = places >= 0
        new = np.zeros(len(places), dtype=bool)
        new[is_placed] = np.diff(places[is_placed], prepend=self._place) <= 0
        if is_placed.any():
            self._place = int(places[is_placed][-1])
        rows = np.flatnonzero(unassigned)
        return [
            Loss(int(t_ns[group[-1]]), START, 0, len(group) * CAN)
            if group[0] < first
            else Loss(int(t_ns[group[-1]]), TORN, int(new[group].sum()), len(group) * CAN)
            for group in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
            if len(group)
        ]

    def flush(self) -> tuple[list[Run], list[Loss]]:
        """Return what is left of a scan that is not whole."""
        unassigned, first = np.ones(len(self._data), dtype=bool), 0 if self._has_scans else len(self._data)
        losses = self._torn(unassigned, self._places(self._data), self._t_ns, first)
        self.account.lost += len(self._data) * CAN
        self._data, self._t_ns = self._data[:0], self._t_ns[:0]
        return [], losses


def can_frame(identifier: int, data: bytes) -> bytes:
    """Return a CAN frame as links give and take it.

    >>> can_frame(0x208, bytes([7, 0])).hex(" ")
    '08 02 00 00 02 07 00 00 00 00 00 00 00'
    """
    return identifier.to_bytes(4, "little") + bytes([len(data)]) + data.ljust(8, b"\0")


def _identifier(frames: Bytes) -> Int64s:
    return np.ascontiguousarray(frames[:, :4]).view("<u4")[:, 0].astype(np.int64)
