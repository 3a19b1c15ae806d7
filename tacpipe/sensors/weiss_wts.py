"""Weiss Robotics WTS tactile sensors: a matrix of pressure cells over USB.

Messages in both directions are ``AA AA AA``, a number, the size of the payload (uint16), the payload, and a checksum
(uint16), little-endian. The checksum covers the full message and is computed by `crc16_wts`, which is not a standard CRC.
Frames are messages with number 0: the time (uint32, 10 µs), flags, and the cells row by row (uint16). If flag bit 0 is set,
the cells are run-length encoded: the upper 4 bits of each word are the number of consecutive cells with the value of the
lower 12 bits. A reply has the number of its command and starts with an error code (uint16, 0: no error).

Source: wts_driver (GPL-3) for messages, numbers and checksum; the tests verify its example ``AA AA AA 06 01 00 FF 2A
87``. No public source was available for run lengths, the matrix information and the tare byte, and they were not tested
with a device.

The time wraps after 11.9 hours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Bytes, Counts, Int64s
from tacpipe.errors import DeviceError, UsageError
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.checks import crc16_wts
from tacpipe.sensors.framing import Framer, Framing
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor, grid_fields

MARKER = b"\xaa\xaa\xaa"
HEADER = 6  # size in bytes: marker, number, size
FRAME, START, STOP, TARE, MATRIX = 0x00, 0x21, 0x22, 0x23, 0x30
TICK_NS = 10_000  # tick of the sensor's clock
CELLS_AT = HEADER + 5  # offset of the cells, after time and flags
RUN_LENGTH = 0x01  # flag
MAX_RUN, VALUE_MASK = 15, 0x0FFF  # largest run (4 bits), and mask of the value (12 bits)


@dataclass(frozen=True)
class WeissWts(Sensor):
    """A WTS tactile sensor."""

    summary: ClassVar[str] = "Weiss Robotics WTS tactile sensors over USB."
    device_wrap_ns: ClassVar[int | None] = TICK_NS << 32  # 11.9 hours

    rows: int = 14  # rows of the matrix; a WTS 0614 has 14 rows and 6 columns
    columns: int = 6  # columns of the matrix
    compress: bool = True  # request run-length encoded frames
    rate_hz: float = 100.0  # frames per second: 1000 divided by whole milliseconds
    baud: int = 115200  # baud rate; any rate works over USB

    def __post_init__(self) -> None:
        """Raise `UsageError` for an invalid size of the matrix or rate."""
        if self.rows < 1 or self.columns < 1:
            raise UsageError(f"weiss-wts: rows is {self.rows} and columns is {self.columns}; both must be 1 or more.")
        if not 1 <= self.rate_hz <= 1000 or abs(1000 / self.rate_hz - self.delay_ms) > 0.01:
            raise UsageError(
                f"weiss-wts: rate_hz is {self.rate_hz:g}; it must be 1000 divided by whole ms, such as 100, 50 or 25."
            )

    @property
    def cells(self) -> int:
        """The number of cells."""
        return self.rows * self.columns

    @property
    def delay_ms(self) -> int:
        """The period of frames in ms."""
        return round(1000 / self.rate_hz)

    def fields(self) -> list[pa.Field]:
        """Return ``taxel01``, … row by row, uint16 counts."""
        return grid_fields(self.rows, self.columns, pa.uint16(), "count")

    def framer(self) -> Framer:
        """Return a framer for messages with the right checksum; frames must have all cells of the matrix."""
        largest = max(CELLS_AT + 2 * self.cells + 2, 256)
        return ByteFramer(Framing(marker=MARKER, header=HEADER, sizes=_sizes, max_size=largest, check=self._are_valid))

    def _are_valid(self, frames: Bytes) -> Bools:
        """Return a mask (frame,) of the frames with the right checksum and number of cells."""
        is_valid: Bools = crc16_wts(frames[:, :-2]) == np.ascontiguousarray(frames[:, -2:]).view("<u2")[:, 0]
        rows = np.flatnonzero(is_valid & (frames[:, 3] == FRAME))
        if len(rows):
            is_valid[rows] = self._cell_counts(frames[rows]) == self.cells
        return is_valid

    def _cell_counts(self, frames: Bytes) -> Int64s:
        """Return the number of cells of each frame (frame,); -1 if it is too short."""
        size = frames.shape[1] - CELLS_AT - 2
        if size < 2 or size % 2:
            return np.full(len(frames), -1)
        words = _words(frames)
        runs = (words >> 12).sum(axis=1, dtype=np.int64)
        cells: Int64s = np.where(frames[:, HEADER + 4] & RUN_LENGTH, runs, words.shape[1])
        return cells

    def decode(self, frames: Bytes) -> Samples:
        """Return the cells (sample, cell) with the sensor's time. Replies are skipped."""
        rows = np.flatnonzero(frames[:, 3] == FRAME)
        cells = np.zeros((len(rows), self.cells), dtype=np.uint16)
        if not len(rows):
            return Samples((cells,), t_device_ns=rows, rows=rows)
        with_cells = frames[rows]
        ticks = np.ascontiguousarray(with_cells[:, HEADER : HEADER + 4]).view("<u4")[:, 0]
        is_run_length = (with_cells[:, HEADER + 4] & RUN_LENGTH).astype(bool)
        words = _words(with_cells)
        if not is_run_length.all():
            cells[~is_run_length] = words[~is_run_length]
        packed = words[is_run_length]
        cells[is_run_length] = np.repeat((packed & VALUE_MASK).ravel(), (packed >> 12).ravel()).reshape(-1, self.cells)
        return Samples((cells,), t_device_ns=ticks.astype(np.int64) * TICK_NS, rows=rows)

    def encode(self, samples: Samples) -> list[bytes]:
        """Return the frames of these samples, run-length encoded ones of different sizes. Cells above 4095 are clipped."""
        cells = np.minimum(samples.values[0], VALUE_MASK)
        assert samples.t_device_ns is not None
        ticks = (samples.t_device_ns // TICK_NS % (1 << 32)).tolist()
        flag = bytes([RUN_LENGTH if self.compress else 0])
        return [
            message(
                FRAME,
                tick.to_bytes(4, "little")
                + flag
                + (run_lengths(row) if self.compress else row).astype("<u2").tobytes(),
            )
            for tick, row in zip(ticks, cells, strict=True)
        ]

    def opening(self, local: LocalAddress) -> Dialogue:
        """Stop an earlier stream, check the size of the matrix, and start frames.

        Raises `DeviceError` if the matrix differs from the options, or the sensor refuses.
        """
        yield Ask(message(STOP), until=_reply_finder(STOP, refusable=True), what="the reply to stop")
        reply = yield Ask(message(MATRIX), until=_reply_finder(MATRIX), what="the matrix information")
        payload = reply[HEADER:-2]
        columns, rows = (int.from_bytes(payload[start : start + 2], "little") for start in (2, 4))
        if (rows, columns) != (self.rows, self.columns):
            raise DeviceError(
                f"The WTS has {rows} rows and {columns} columns, but the options declare {self.rows} and {self.columns}; "
                f"set rows = {rows} and columns = {columns}."
            )
        start = bytes([RUN_LENGTH if self.compress else 0]) + self.delay_ms.to_bytes(2, "little")
        yield Ask(message(START, start), until=_reply_finder(START), what="the reply to start")

    def closing(self) -> bytes:
        """Stop the frames."""
        return message(STOP)

    def taring(self) -> Dialogue:
        """Zero the pressure."""
        yield Ask(message(TARE, b"\x01"), until=_reply_finder(TARE), what="the reply to tare")


def message(number: int, payload: bytes = b"") -> bytes:
    r"""Return a message to or from the sensor.

    >>> message(0x06, b"\xff").hex(" ")
    'aa aa aa 06 01 00 ff 2a 87'
    """
    body = MARKER + bytes([number]) + len(payload).to_bytes(2, "little") + payload
    return body + int(crc16_wts(np.frombuffer(body, np.uint8)[None])[0]).to_bytes(2, "little")


def messages(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield (number, end offset, payload) of each complete message in ``data`` with the right checksum."""
    start = data.find(MARKER)
    while start >= 0 and len(data) >= start + HEADER:
        size = int.from_bytes(data[start + 4 : start + 6], "little")
        packet = data[start : start + HEADER + size + 2]
        if len(packet) == HEADER + size + 2 and message(packet[3], packet[HEADER:-2]) == packet:
            yield packet[3], start + len(packet), packet[HEADER:-2]
            start += len(packet) - 1
        start = data.find(MARKER, start + 1)


def run_lengths(cells: Counts) -> Counts:
    """Return cells (cell,) as run-length encoded words, with runs of at most 15 cells.

    >>> [hex(word) for word in run_lengths(np.array([0] * 17 + [7], dtype=np.uint16))]
    ['0xf000', '0x2000', '0x1007']
    """
    starts = np.flatnonzero(np.diff(cells, prepend=cells[0] ^ 1))
    lengths = np.diff(starts, append=len(cells))
    pieces = -(-lengths // MAX_RUN)  # words per run
    counts = np.full(pieces.sum(), MAX_RUN)
    counts[np.cumsum(pieces) - 1] = lengths - MAX_RUN * (pieces - 1)
    return (counts << 12 | np.repeat(cells[starts], pieces)).astype(np.uint16)


def _reply_finder(number: int, *, refusable: bool = False) -> Callable[[bytes], int | tuple[int, int]]:
    """Return a function that returns the start and stop of the reply among frames, or 0 if there is none yet.

    It raises `DeviceError` if the sensor refused the command, unless that is ``refusable``.
    """

    def find(data: bytes) -> int | tuple[int, int]:
        for packet, stop, payload in messages(data):
            if packet == number:
                code = int.from_bytes(payload[:2], "little")
                if code and not refusable:
                    raise DeviceError(
                        f"The WTS refused command {number:#04x} with error {code}; its manual lists the errors."
                    )
                return stop - HEADER - len(payload) - 2, stop
        return 0

    return find


def _words(frames: Bytes) -> Counts:
    return np.ascontiguousarray(frames[:, CELLS_AT:-2]).view("<u2")


def _sizes(head: Bytes) -> Int64s:
    return np.ascontiguousarray(head[:, 4:6]).view("<u2")[:, 0].astype(np.int64) + HEADER + 2
