"""Compute tactile channels from frames one after another: changes of brightness, and displacements of markers.

A row depends on the frames up to it only, so a recording and a live session give the same values.
"""

from __future__ import annotations

from itertools import product
from typing import Any, Protocol

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyFloats, Bytes, Float32s, Floats
from tacpipe.errors import TacpipeError
from tacpipe.video.decoding import GREY, FrameDecoder, cell_means, has_lost_block, padded_packet
from tacpipe.video.encoding import RGB
from tacpipe.video.lattice import MIN_DOTS
from tacpipe.video.markers import GridSearch, MarkerTracker, Polarity, use_one_thread
from tacpipe.video.stream import PACKET, VideoFormat

COLOURS = ("red", "green", "blue")
DETECTED_RATIO = "detected_ratio"  # column with the fraction of markers that are found
CLOCKS = ("t_ns", "t_device_ns", "seq")  # columns that a stream of channels has from its stream of frames


class FrameChannels(Protocol):
    """The channels of one stream of frames."""

    @property
    def grey(self) -> bool:
        """Whether images are grey (height, width) instead of (height, width, rgb)."""

    def fields(self) -> list[pa.Field]:
        """Return the fields of the channels."""

    def values(self, image: Bytes) -> AnyFloats:
        """Return the channels of the next frame (field,), NaN for missing values."""

    def skip(self) -> None:
        """Leave out the next frame, which is damaged. Raises `TacpipeError` if the untouched gel is then unknown."""


class UntouchedGel:
    """The mean of the first ``frames``, which show the untouched gel. ``place`` names the stream in errors."""

    def __init__(self, frames: int, place: str) -> None:
        self._left, self._place = frames, place
        self._sum, self._count = np.zeros(1), 0

    def update(self, means: Floats) -> Floats:
        """Return the mean of the first frames up to the next one, whose means (row, column, colour) are given."""
        if self._left:
            self._sum, self._count = self._sum + means, self._count + 1
            self._left -= 1
        return self._sum / self._count

    def skip(self) -> None:
        """Leave out the next frame. Raises `TacpipeError` if all of the first frames are damaged."""
        self._left = max(0, self._left - 1)
        if not self._left and not self._count:
            raise TacpipeError(
                f"{self._place}: all frames that show the untouched gel are damaged. Give more with --reference-frames, or "
                f"leave the recording out with --skip-bad."
            )


class DifferenceChannels:
    """The mean brightness of each cell of a grid and colour, minus that of the first frames if there are any.

    ``place`` names the stream in errors.
    """

    grey = False

    def __init__(self, rows: int, columns: int, reference_frames: int, place: str) -> None:
        self._rows, self._columns = rows, columns
        self._untouched = UntouchedGel(reference_frames, place) if reference_frames else None

    def fields(self) -> list[pa.Field]:
        """Return the fields ``taxel0101_red`` …, named by row and column from 1 and colour, as float32 grey levels."""
        return [
            pa.field(
                f"taxel{row:02d}{column:02d}_{colour}",
                pa.float32(),
                metadata={"unit": "count", **cell_metadata(row, column, self._columns), "component": colour},
            )
            for row, column, colour in product(range(1, self._rows + 1), range(1, self._columns + 1), COLOURS)
        ]

    def values(self, image: Bytes) -> AnyFloats:
        """Return the brightness of the next frame, less the mean of the first frames, flat (cell and colour,)."""
        means = cell_means(image, self._rows, self._columns)
        return (means - self._untouched.update(means) if self._untouched else means).ravel()

    def skip(self) -> None:
        """Leave out the next frame. Raises `TacpipeError` if all frames that show the untouched gel are damaged."""
        if self._untouched:
            self._untouched.skip()


class MarkerChannels:
    """The displacement of each marker since the first frames, and the fraction of markers that are found.

    The grid is found in the first ``reference_frames`` frames, as `GridSearch` describes. ``place`` names the stream in
    errors.
    """

    grey = True

    def __init__(
        self, rows: int, columns: int, pitch_mm: float, reference_frames: int, polarity: Polarity, place: str
    ) -> None:
        self._rows, self._columns, self._pitch_mm, self._place = rows, columns, pitch_mm, place
        self._search = GridSearch(rows, columns, polarity, reference_frames)
        self._tracker: MarkerTracker | None = None
        use_one_thread()  # a stage uses one core per recording

    def fields(self) -> list[pa.Field]:
        """Return the fields ``taxel0101_x``, ``taxel0101_y`` …, float32 px or mm, and ``detected_ratio``."""
        unit = "mm" if self._pitch_mm else "px"
        displacements = [
            pa.field(
                f"taxel{row:02d}{column:02d}_{axis}",
                pa.float32(),
                metadata={"unit": unit, **cell_metadata(row, column, self._columns), "axis": axis},
            )
            for row, column, axis in product(range(1, self._rows + 1), range(1, self._columns + 1), ("x", "y"))
        ]
        quality = pa.field(DETECTED_RATIO, pa.float32(), metadata={"unit": "1", "quantity": "quality"})
        return [*displacements, quality]

    def values(self, image: Bytes) -> AnyFloats:
        """Return the displacements in the next frame (marker and axis,), and the fraction of markers that are found.

        Until the grid is known, displacements are NaN and the fraction is 0. Raises `TacpipeError` if the first frames
        have no grid of markers.
        """
        self._look(image)
        if self._tracker is None:
            return np.append(np.full(2 * self._rows * self._columns, np.nan), 0)
        grid = self._tracker.grid
        moved_px = self._tracker.step(image) - grid.positions_px  # (marker, xy)
        ratio = np.count_nonzero(~np.isnan(moved_px[:, 0])) / np.count_nonzero(grid.exists)
        return np.append(moved_px.ravel() * (self._pitch_mm / grid.pitch_px if self._pitch_mm else 1.0), ratio)

    def skip(self) -> None:
        """Leave out the next frame. Raises `TacpipeError` if the first frames have no grid of markers."""
        self._look(None)

    def _look(self, image: Bytes | None) -> None:
        """Look for the grid of markers in the next frame, None for a damaged one, until it is known."""
        if self._tracker is not None:
            return
        search = self._search
        if grid := search.add(image):
            self._tracker = MarkerTracker(grid)
        elif search.frames_left <= 0:
            raise TacpipeError(f"{self._place}: {_describe_failure(search)}")


def _describe_failure(search: GridSearch) -> str:
    """Return why the first frames have no grid of markers, and what to do."""
    if search.frames == 0:
        return (
            "all frames that show the untouched gel are damaged. Give more with --reference-frames, or leave the "
            "recording out with --skip-bad."
        )
    if search.dots < MIN_DOTS:
        return (
            "no markers are seen in the first frames. Give more with --reference-frames if the recording starts dark, or "
            "use `tacpipe extract difference` for a gel without markers."
        )
    return (
        f"at most {search.dots} dots are seen in the first frames, and {search.marker_count} of them are in a grid of "
        f"{search.rows} x {search.columns} markers, less than half. Choose --rows and --columns of the gel. Only "
        f"regular grids, rectangular or hexagonal, are supported."
    )


def cell_metadata(row: int, column: int, columns: int) -> dict[str, str]:
    """Return the metadata of a tactile channel in a grid cell; rows and columns start at 1."""
    return {"quantity": "tactile", "row": str(row), "column": str(column), "taxel": str((row - 1) * columns + column)}


class IntraDecoder:
    """Decodes the packets of a live camera, each of which is a complete image."""

    def __init__(self, video_format: VideoFormat, *, grey: bool) -> None:
        self._format, self._decoder = video_format, FrameDecoder(video_format)
        self._pixels = GREY if grey else RGB

    def decode(self, packet: bytes) -> Bytes | None:
        """Return the image of a packet, or None for a damaged one or one of another size."""
        frames, is_damaged = self._decoder.decode(padded_packet(packet))
        if is_damaged or not frames or frames[0].is_corrupt or has_lost_block(self._format.codec, packet):
            return None
        if (frames[0].width, frames[0].height) != (self._format.width_px, self._format.height_px):
            return None
        image: Bytes = frames[0].to_ndarray(format=self._pixels, threads=1)
        return image


class FrameBatch(Protocol):
    """A batch of frames: a table or record batch of pyarrow, or arrays by name."""

    def column(self, place: Any, /) -> Any:
        """Return a column by its name."""


class LiveChannels:
    """The channels of a live camera: takes batches of frames, and returns tables of channels."""

    def __init__(self, channels: FrameChannels, schema: pa.Schema, video_format: VideoFormat) -> None:
        self._channels, self.schema = channels, channels_schema(schema, channels)
        self._decoder = IntraDecoder(video_format, grey=channels.grey)

    def push(self, frames: FrameBatch) -> pa.Table:
        """Return the rows of the frames that can be decoded, with their clocks; others are omitted.

        Raises the errors of the channels' ``values`` and ``skip``.
        """
        rows: list[int] = []
        values: list[AnyFloats] = []
        packets = frames.column(PACKET)
        for row, packet in enumerate(packets.tolist() if isinstance(packets, np.ndarray) else packets.to_pylist()):
            image = self._decoder.decode(packet) if packet else None
            if image is not None:
                rows.append(row)
                values.append(self._channels.values(image))
            elif packet:
                self._channels.skip()
        clocks = [pa.array(np.asarray(frames.column(name))[rows]) for name in self.schema.names if name in CLOCKS]
        matrix: Float32s = np.array(values, np.float32).reshape(len(rows), len(self.schema) - len(clocks))
        return pa.table([*clocks, *map(pa.array, np.ascontiguousarray(matrix.T))], schema=self.schema)


def channels_schema(frames: pa.Schema, channels: FrameChannels) -> pa.Schema:
    """Return the schema of the channels of a stream of frames, with its clocks."""
    return pa.schema([*(frames.field(name) for name in CLOCKS if name in frames.names), *channels.fields()])
