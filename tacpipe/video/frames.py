"""Read the images of some rows of a stream of frames, in one pass or at random."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.channels.schema import DAMAGED
from tacpipe.errors import TacpipeError
from tacpipe.io.columns import RowRanges
from tacpipe.video.decoding import COLOUR_PIXELS, GREY_PIXELS, Pixels, decoded_columns, raw_frames, read_batches
from tacpipe.video.stream import (
    BATCH_ROWS,
    DTS,
    KEY_FRAME,
    PACKET,
    VideoFormat,
    decodable_ranges,
    group_bounds,
    read_format,
)

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Bools, Bytes, Int64s
    from tacpipe.io.columns import Columns
    from tacpipe.io.spill import MappedArrays

READ_ROWS = 4  # number of packets that a reader reads at once, as it may need few


def read_frames(columns: Columns, rows: Sequence[int], *, grey: bool = False) -> dict[int, Bytes]:
    """Return the images of some rows of a stream of frames by row, uint8 (height, width, rgb), or (height, width) if grey.

    The stream is read once, and decoding starts at the key frame before each row. Raises `TacpipeError` if the stream
    has no frames. Damaged frames and rows without an image are missing.
    """
    stream, packets = _FrameIndex(columns), RowRanges(columns, decoded_columns(columns), BATCH_ROWS)
    wanted, pixels = set(rows), GREY_PIXELS if grey else COLOUR_PIXELS
    images: dict[int, Bytes] = {}
    for start, stop in decodable_ranges(stream.dts, stream.key_frame, np.array(sorted(wanted), np.int64)).tolist():
        batches = (packets.read(row, min(row + BATCH_ROWS, stop)) for row in range(start, stop, BATCH_ROWS))
        for index, frame in raw_frames(stream.format, batches):
            if start + index in wanted and frame is not None:
                images[start + index] = pixels.of(frame)
    return images


class FrameReader:
    """The frames of a stream, of which any can be read at any time, because the packets are kept.

    A decoder stays at the last row, so rows that follow in the same group of pictures are decoded once.
    """

    def __init__(self, columns: Columns, name: str, storage: MappedArrays, pixels: Pixels = COLOUR_PIXELS) -> None:
        """Keep the packets of a stream in ``storage``; ``name`` is the stream's in errors.

        Raises `TacpipeError` if the stream has no frames.
        """
        self._stream, self._name, self._pixels = _FrameIndex(columns), name, pixels
        self._keys = np.flatnonzero(self._stream.key_frame)
        self._groups = group_bounds(self._stream.dts, self._stream.key_frame)
        self._batches, masks = [], [np.zeros(0, bool)]
        for batch in read_batches(columns):
            self._batches.append(storage.keep(_to_bytes(batch)))
            masks.append(_has_image(batch))
        self.has_image: Bools = np.concatenate(masks)  # (row,), False for a row without an image or with a damaged one
        self._latest: dict[int, Bytes] = {}  # images of the last call
        self._frames: Iterator[tuple[int, Any]] = iter(())  # its next frame is that of `_next_row`
        self._start = self._next_row = self._stop = -1  # rows of the packets for the decoder

    def read(self, rows: Sequence[int]) -> Bytes:
        """Return the images of some rows, uint8 (row, height, width, rgb).

        Images that the previous call returned are not decoded again. Raises `TacpipeError` for a row without an image
        and a damaged frame.
        """
        previous = self._latest
        self._latest = {row: previous[row] if row in previous else self._decode(row) for row in sorted(set(rows))}
        return np.stack([self._latest[row] for row in rows])

    def _decode(self, row: int) -> Bytes:
        earlier_keys = int(np.searchsorted(self._keys, row, side="right"))
        start = int(self._keys[earlier_keys - 1]) if earlier_keys else row
        if not (start <= self._next_row <= row < self._stop):
            self._start, self._stop = start, int(self._groups[np.searchsorted(self._groups, row, side="right")])
            self._frames = raw_frames(self._stream.format, self._read_packets(self._start, self._stop))
        for index, frame in self._frames:
            self._next_row = self._start + index + 1
            if self._next_row == row + 1 and frame is not None:
                return self._pixels.of(frame)
            if self._next_row > row:
                break
        raise TacpipeError(f"Frame {row} of {self._name} has no image, or is damaged. Leave the recording out.")

    def _read_packets(self, start: int, stop: int) -> Iterator[pa.Table]:
        import pyarrow as pa

        for number in range(start // BATCH_ROWS, -(-stop // BATCH_ROWS)):
            table = pa.ipc.open_stream(pa.py_buffer(self._batches[number])).read_all()
            first = number * BATCH_ROWS
            for row in range(max(first, start), min(first + BATCH_ROWS, stop), READ_ROWS):
                yield table.slice(row - first, min(READ_ROWS, stop - row))


class _FrameIndex:
    """Format, decoding order and key frames of a stream of frames. Raises `TacpipeError` if it has no frames."""

    def __init__(self, columns: Columns) -> None:
        video_format = read_format(columns)
        if video_format is None:
            raise TacpipeError("This stream holds no frames. Give the stream of a camera.")
        clocks = columns.read([DTS, KEY_FRAME])
        self.format: VideoFormat = video_format
        self.dts: Int64s = clocks[DTS].to_numpy()
        self.key_frame: Bools = clocks[KEY_FRAME].to_numpy()


def _to_bytes(batch: pa.Table) -> Bytes:
    """Return a table as the bytes of an Arrow stream (byte,)."""
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema) as writer:
        writer.write_table(batch)
    return np.frombuffer(sink.getvalue(), np.uint8)


def _has_image(batch: pa.Table) -> Bools:
    """Return whether each row (row,) has a packet and is not marked as damaged."""
    import pyarrow.compute as pc

    has_packet: Bools = pc.binary_length(batch.column(PACKET)).fill_null(0).to_numpy() > 0
    return has_packet & ~batch.column(DAMAGED).to_numpy() if DAMAGED in batch.column_names else has_packet
