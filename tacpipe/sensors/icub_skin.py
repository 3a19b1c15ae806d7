"""iCub skin on CAN: boards with up to 16 triangles of 12 8-bit taxels.

A board sends each triangle in two CAN frames, in the order of triangle numbers. The identifier is class << 8 | board << 4 |
triangle. The first byte is ``40``, followed by taxels 1 to 7, or ``C0``, followed by taxels 8 to 12 and two bytes of
diagnostics. The class is 4, or 3 for boards with the older configuration. Taxels 7 and 11 are thermal pads, which do not
measure pressure. A taxel reads 240 at rest and less when it is pressed.
Diagnostics, big-endian: bit 0 means that the triangle does not respond, bits 4 to 15 that one of its 12 taxels is stuck.
Source: canBusSkin of icub-main, for messages and identifiers. No source was available for the thermal taxels and the byte
order of the diagnostics, and nothing was tested with a board.

There is no counter. A scan of 16 triangles has 32 CAN frames, which `ScanFramer` joins; a scan with a pause of half a period
is incomplete. A frame is one scan: the concatenation of its CAN frames, 13 bytes each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Bytes, Int64s, Times
from tacpipe.errors import UsageError
from tacpipe.sensors.framing import MALFORMED, START, Account, Chunks, Framer, FrameRun, FramingLoss
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor

TORN = "torn"  # a scan with missing CAN frames
CAN = 13  # bytes of a CAN frame: identifier (4), length (1), data (8)
DATA = 5  # offset of the data in a CAN frame
HEAD, TAIL = 0x40, 0xC0  # first data byte of each triangle's first and second CAN frame
TAIL_LENGTHS = (6, 8)  # data lengths of the second CAN frame, without and with diagnostics


class ScanFramer:
    """Join the CAN frames of each scan, and return only complete scans.

    The CAN frames of a scan have no sequence number. They are sent in order, ``40`` and ``C0`` of the first triangle,
    then of the next, without a pause. A scan is torn if a CAN frame is missing, repeated, or follows a pause in which
    others may be lost.

    CAN frames with identifiers of other boards count as framed and are skipped. A malformed CAN frame is not counted as a
    lost scan itself; the torn scan that it belongs to is.
    """

    def __init__(self, identifiers: list[int], pause_ns: int) -> None:
        self.account = Account()
        self.size = 2 * len(identifiers)  # CAN frames of a scan
        self._identifiers = np.array(identifiers, dtype=np.int64)
        self._pause_ns = pause_ns  # longest pause between two CAN frames of a scan
        self._data = np.zeros((0, CAN), dtype=np.uint8)  # CAN frames of an incomplete scan
        self._t_ns: Times = np.zeros(0, dtype=np.int64)
        self._has_scans = False
        self._last_position = self.size  # position in its scan of the last valid CAN frame

    def feed(self, chunks: Chunks) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return the scans that are now complete, and the CAN frames of torn scans as losses.

        CAN frames of the last, incomplete scan are kept for the next call.
        """
        self.account.received += len(chunks.data)
        frames, t_ns, losses = self._can_frames(chunks)
        data, stamps = np.vstack([self._data, frames]), np.concatenate([self._t_ns, t_ns])
        positions = self._positions(data)
        is_invalid = positions < 0
        losses += [FramingLoss(int(at_ns), MALFORMED, 0, CAN) for at_ns in stamps[is_invalid]]
        starts, open_at = self._scans(positions, stamps)
        rows_of_scans = (starts[:, None] + np.arange(self.size)).ravel()
        stop = len(data) if open_at is None else open_at
        unassigned = np.ones(len(data), dtype=bool)
        unassigned[rows_of_scans] = unassigned[is_invalid] = False
        first_scan = int(starts[0]) if len(starts) else stop
        first = 0 if self._has_scans else first_scan
        losses += self._torn_losses(unassigned[:stop], positions[:stop], stamps[:stop], first)
        self._data, self._t_ns = data[stop:], stamps[stop:]
        self.account.framed += len(rows_of_scans) * CAN
        self.account.lost += sum(loss.bytes for loss in losses)
        if not len(starts):
            return [], losses
        self._has_scans = True
        return [FrameRun(data[rows_of_scans].reshape(len(starts), -1), stamps[starts + self.size - 1])], losses

    def _can_frames(self, chunks: Chunks) -> tuple[Bytes, Times, list[FramingLoss]]:
        """Return the CAN frames of this board (frame, 13), their arrivals in ns, and malformed packets as losses."""
        is_valid = (chunks.size > 0) & (chunks.size % CAN == 0)  # some adapters return several CAN frames at once
        losses = [
            FramingLoss(int(at_ns), MALFORMED, 0, int(size))
            for at_ns, size in zip(chunks.t_ns[~is_valid], chunks.size[~is_valid], strict=True)
        ]
        data = np.frombuffer(chunks.data, np.uint8)
        frames = data[np.repeat(is_valid, chunks.size)].reshape(-1, CAN)
        t_ns = np.repeat(chunks.t_ns[is_valid], chunks.size[is_valid] // CAN)
        is_from_board = np.isin(_identifier(frames), self._identifiers)
        self.account.framed += int((~is_from_board).sum()) * CAN
        return frames[is_from_board], t_ns[is_from_board], losses

    def _positions(self, frames: Bytes) -> Int64s:
        """Return the position of each CAN frame in its scan (frame,), or -1 if it is malformed."""
        tail = frames[:, DATA] == TAIL
        is_complete = np.where(tail, np.isin(frames[:, 4], TAIL_LENGTHS), frames[:, 4] == 8)
        good = is_complete & (tail | (frames[:, DATA] == HEAD))
        positions = 2 * np.searchsorted(self._identifiers, _identifier(frames)) + tail
        return np.where(good, positions, -1)

    def _scans(self, positions: Int64s, t_ns: Times) -> tuple[Int64s, int | None]:
        """Return the first row of each complete scan, and that of an incomplete last scan, or None if there is none."""
        starts = np.flatnonzero(positions == 0)
        if not len(starts):
            return starts, None
        follows = np.diff(positions, prepend=-2) == 1
        follows &= np.diff(t_ns, prepend=t_ns[0]) <= self._pause_ns
        run_ends = np.append(np.flatnonzero(~follows), len(positions))
        length = run_ends[np.searchsorted(run_ends, starts, side="right")] - starts
        incomplete_start = (
            int(starts[-1]) if starts[-1] + length[-1] == len(positions) and length[-1] < self.size else None
        )
        return starts[length >= self.size], incomplete_start

    def _torn_losses(self, unassigned: Bools, positions: Int64s, t_ns: Times, first: int) -> list[FramingLoss]:
        """Return a loss for each run of CAN frames outside of complete scans, with the number of scans in it.

        Rows before ``first`` belong to the scan during which recording started.
        """
        is_valid = positions >= 0
        starts_scan = np.zeros(len(positions), dtype=bool)
        starts_scan[is_valid] = np.diff(positions[is_valid], prepend=self._last_position) <= 0
        if is_valid.any():
            self._last_position = int(positions[is_valid][-1])
        rows = np.flatnonzero(unassigned)
        return [
            FramingLoss(int(t_ns[group[-1]]), START, 0, len(group) * CAN)
            if group[0] < first
            else FramingLoss(int(t_ns[group[-1]]), TORN, int(starts_scan[group].sum()), len(group) * CAN)
            for group in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
            if len(group)
        ]

    def flush(self) -> tuple[list[FrameRun], list[FramingLoss]]:
        """Return no scans, and the CAN frames of an incomplete scan as a loss."""
        unassigned = np.ones(len(self._data), dtype=bool)
        first = 0 if self._has_scans else len(self._data)
        losses = self._torn_losses(unassigned, self._positions(self._data), self._t_ns, first)
        self.account.lost += len(self._data) * CAN
        self._data, self._t_ns = self._data[:0], self._t_ns[:0]
        return [], losses


def can_frame(identifier: int, data: bytes) -> bytes:
    """Return a CAN frame in the format of links.

    >>> can_frame(0x208, bytes([7, 0])).hex(" ")
    '08 02 00 00 02 07 00 00 00 00 00 00 00'
    """
    return identifier.to_bytes(4, "little") + bytes([len(data)]) + data.ljust(8, b"\0")


def _identifier(frames: Bytes) -> Int64s:
    return np.ascontiguousarray(frames[:, :4]).view("<u4")[:, 0].astype(np.int64)


MAX_TRIANGLES, TAXELS, HEAD_TAXELS = 16, 12, 7
THERMAL = (7, 11)
PERIODIC, OLD_PERIODIC, POLLING = 4, 3, 2  # classes of identifiers
BOARD, TRIANGLE, TRANSMIT, OLD_TIMING, OLD_TRIANGLES = 0x4D, 0x50, 0x07, 0x4C, 0x4E  # commands
# taxel at rest, gain and offset of the converter, as in the robot's configuration files
NO_LOAD, SHIFT, OFFSET = 0xF0, 2, 0x2200


@dataclass(frozen=True)
class IcubSkin(Sensor):
    """One board of iCub skin."""

    summary: ClassVar[str] = "iCub skin on CAN: one board of up to 16 triangles."
    links: ClassVar[tuple[str, ...]] = ("can",)

    board: int = 8  # the board's address on the bus, 1 to 14
    triangles: tuple[int, ...] = tuple(range(MAX_TRIANGLES))  # numbers of the connected triangles, from 0
    old: bool = False  # True if the board has the older configuration: messages 4C and 4E, class 3
    rate_hz: float = 50.0  # scans per second: 1000 divided by whole milliseconds

    def __post_init__(self) -> None:
        if not 1 <= self.board <= 14:
            raise UsageError(f"icub-skin: board is {self.board}; it must be between 1 and 14.")
        if (
            not self.triangles
            or list(self.triangles) != sorted(set(self.triangles))
            or not set(self.triangles) <= set(range(MAX_TRIANGLES))
        ):
            raise UsageError(
                f"icub-skin: triangles is {list(self.triangles)}; it must be unique numbers from 0 to 15, ascending."
            )
        if not 1000 / 255 <= self.rate_hz <= 1000 or abs(1000 / self.rate_hz - self.period_ms) > 0.01:
            raise UsageError(
                f"icub-skin: rate_hz is {self.rate_hz:g}; it must be 1000 divided by whole milliseconds up to 255."
            )

    @property
    def period_ms(self) -> int:
        """The period of scans in ms."""
        return round(1000 / self.rate_hz)

    def fields(self) -> list[pa.Field]:
        """Return ``triangle1_taxel01``, … uint8 counts, and ``triangle1_diagnostics``, … uint16, by triangle number + 1.

        The two thermal pads of a triangle have the quantity ``temperature``.
        """
        taxels = [
            pa.field(
                f"triangle{triangle + 1}_taxel{taxel:02d}",
                pa.uint8(),
                metadata={
                    "unit": "count",
                    "quantity": "temperature" if taxel in THERMAL else "tactile",
                    "triangle": str(triangle + 1),
                    "taxel": str(taxel),
                },
            )
            for triangle in self.triangles
            for taxel in range(1, TAXELS + 1)
        ]
        status = {"unit": "1", "quantity": "status"}
        return taxels + [
            pa.field(
                f"triangle{triangle + 1}_diagnostics", pa.uint16(), metadata={**status, "triangle": str(triangle + 1)}
            )
            for triangle in self.triangles
        ]

    @property
    def identifiers(self) -> list[int]:
        """The CAN identifier of each triangle."""
        kind = OLD_PERIODIC if self.old else PERIODIC
        return [kind << 8 | self.board << 4 | triangle for triangle in self.triangles]

    def framer(self) -> Framer:
        """Return a framer that joins the CAN frames of scans."""
        return ScanFramer(self.identifiers, round(0.5e9 / self.rate_hz))

    def decode(self, frames: Bytes) -> Samples:
        """Return taxels (scan, 12 per triangle) and diagnostics (scan, triangle)."""
        data = frames.reshape(len(frames), len(self.triangles), 2, CAN)[..., DATA:]  # (scan, triangle, half, byte)
        taxels = np.concatenate([data[:, :, 0, 1:8], data[:, :, 1, 1:6]], axis=2).reshape(
            len(frames), TAXELS * len(self.triangles)
        )
        diagnostics = np.ascontiguousarray(data[:, :, 1, 6:8]).view(">u2")[..., 0].astype(np.uint16)
        return Samples((taxels, diagnostics))

    def encode(self, samples: Samples) -> Bytes:
        """Return the scans of these samples, each as the concatenation of its CAN frames."""
        taxels, diagnostics = samples.values
        scans = np.zeros((len(taxels), len(self.triangles), 2, CAN), dtype=np.uint8)
        scans[..., :4] = np.array(self.identifiers, "<u4").view(np.uint8).reshape(-1, 1, 4)
        scans[..., 4] = 8
        scans[:, :, 0, DATA], scans[:, :, 1, DATA] = HEAD, TAIL
        taxels = taxels.reshape(len(taxels), -1, TAXELS)
        scans[:, :, 0, DATA + 1 :] = taxels[..., :HEAD_TAXELS]
        scans[:, :, 1, DATA + 1 : DATA + 6] = taxels[..., HEAD_TAXELS:]
        scans[:, :, 1, DATA + 6 :] = np.ascontiguousarray(diagnostics, ">u2")[..., None].view(np.uint8)
        return scans.reshape(len(taxels), 2 * CAN * len(self.triangles))

    def opening(self, local: LocalAddress) -> Dialogue:
        """Yield the messages that configure board and triangles and start the stream."""
        if self.old:
            yield self._command(OLD_TIMING, 1, 1, 1, 0, OFFSET >> 8, 0, 0, pause_s=0.01)
            yield self._command(OLD_TRIANGLES, SHIFT, 0x22, NO_LOAD, 0, 0xFF, 0xFF, 0x0A)
            return
        yield self._command(BOARD, 0, self.period_ms, NO_LOAD)
        last = MAX_TRIANGLES - 1
        yield self._command(TRIANGLE, 0, last, SHIFT, 1, OFFSET & 0xFF, OFFSET >> 8, pause_s=0.5)
        yield self._command(TRANSMIT, 0)

    def closing(self) -> bytes:
        """Stop the stream. Boards with the older configuration have no command for it."""
        return b"" if self.old else self._command(TRANSMIT, 1).send

    def _command(self, *data: int, pause_s: float = 0.0) -> Ask:
        return Ask(can_frame(POLLING << 8 | self.board, bytes(data)), pause_s=pause_s)
