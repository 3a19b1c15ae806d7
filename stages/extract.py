"""Compute tactile channels from the frames of cameras behind a gel. Rows do not look ahead, and memory does not grow."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.constraints import PositiveInt
from tacpipe.plugins.stage import RecordingOutput, stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Bytes, Floats
    from tacpipe.datasets.dataset import Recording
    from tacpipe.io.columns import Columns
    from tacpipe.video.stream import VideoFormat

COLOURS = ("red", "green", "blue")
MAX_CELLS = 10_000  # cells of a grid; each has three columns


@dataclass(frozen=True)
class Params(StreamSelection):
    """The grid, and the frames that show the untouched gel."""

    rows: PositiveInt = 6  # rows of the grid
    columns: PositiveInt = 8  # columns of the grid
    reference_frames: PositiveInt = 5  # first frames, of which the mean is the untouched gel

    def check(self) -> None:
        """Refuse a grid with more cells than a table should have columns."""
        if self.rows * self.columns > MAX_CELLS:
            raise UsageError(
                f"A grid of {self.rows} x {self.columns} cells has more than {MAX_CELLS:,}. Choose fewer rows or columns."
            )


@stage(version=1)
def difference(params: Params, recording: Recording) -> RecordingOutput:
    """Measure how the brightness of a gel changes on a grid.

    Each stream of frames becomes a stream of tactile channels with a row per frame: the mean of each cell and colour, in
    grey levels of 0 to 255, less that of the untouched gel. The first frames of a recording show the untouched gel, so
    start a recording before contact. Until there are as many frames as ``--reference-frames``, those so far are taken:
    no row looks ahead. Streams without frames stay as they are.

    Example: tacpipe extract difference data/gels -o data/difference
    """
    from tacpipe.video.stream import read_format

    streams: dict[str, pa.Table | pa.RecordBatchReader] = {}
    formats: dict[str, VideoFormat] = {}
    for name in recording.streams:
        columns = recording.columns(name)
        video_format = read_format(columns)
        if video_format is None:
            streams[name] = _copied(columns)
        else:
            formats[name] = video_format
            _require_pixels(recording.name, name, video_format, params)
            streams[name] = _differences(columns, video_format, params)
    if not formats:
        raise TacpipeError(
            f"Recording {recording.name} has no stream of frames; its streams are {', '.join(recording.streams)}. Give the "
            f"recording of a camera, as `tacpipe ingest` or `tacpipe acquire` wrote it."
        )
    return RecordingOutput(streams)


def cell_means(image: Bytes, rows: int, columns: int) -> Floats:
    """Return the mean of each cell and colour (row, column, colour) of an image (height, width, colour).

    Where the height or width cannot be divided evenly, cells differ by a pixel.

    >>> cell_means(np.arange(12, dtype=np.uint8).reshape(2, 6, 1), 1, 2).tolist()
    [[[4.0], [7.0]]]
    """
    height, width, _ = image.shape
    tops = np.arange(rows) * height // rows
    lefts = np.arange(columns) * width // columns
    row_sums = np.add.reduceat(image, tops, axis=0, dtype=np.uint32)  # (row, width, colour), below 2^32
    sums = np.add.reduceat(row_sums, lefts, axis=1, dtype=np.int64)
    areas = np.outer(np.diff([*tops, height]), np.diff([*lefts, width]))  # (row, column)
    means: Floats = sums / areas[:, :, None]
    return means


def _require_pixels(recording: str, stream: str, video_format: VideoFormat, params: Params) -> None:
    """Raise `TacpipeError` where a cell of the grid would be smaller than a pixel."""
    if params.rows > video_format.height_px or params.columns > video_format.width_px:
        raise TacpipeError(
            f"Recording {recording}, stream {stream}: frames have {video_format.width_px} x {video_format.height_px} "
            f"pixels, and the grid {params.columns} x {params.rows} cells. Choose fewer with --columns and --rows."
        )


def _copied(columns: Columns) -> pa.RecordBatchReader:
    """Return a stream as it is, read by batches."""
    import pyarrow as pa

    batches = (batch for rows in columns.batches() for batch in rows.to_batches())
    return pa.RecordBatchReader.from_batches(columns.schema, batches)


def _differences(columns: Columns, video_format: VideoFormat, params: Params) -> pa.RecordBatchReader:
    """Return the stream of differences of a stream of frames, computed as it is read."""
    import pyarrow as pa

    from tacpipe.video.decoding import decode_frames, read_batches
    from tacpipe.video.stream import BATCH_ROWS

    clock_names = [name for name in ("t_ns", "t_device_ns", "seq") if name in columns.column_names]
    clocks = columns.read(clock_names)
    schema = pa.schema([*clocks.schema, *_fields(params)])

    def table(rows: list[int], values: list[Floats]) -> pa.RecordBatch:
        table = clocks.take(rows).combine_chunks()
        cells = np.array(values, np.float32).reshape(len(rows), -1)  # (time, cell and colour)
        arrays = [*(table.column(name).chunk(0) for name in clock_names), *map(pa.array, cells.T)]
        return pa.RecordBatch.from_arrays(arrays, schema=schema)

    def batches() -> Iterator[pa.RecordBatch]:
        rows: list[int] = []
        values: list[Floats] = []
        reference_sum, reference_count = np.zeros((params.rows, params.columns, len(COLOURS))), 0
        for row, image in decode_frames(video_format, read_batches(columns)):
            means = cell_means(image, params.rows, params.columns)
            if reference_count < params.reference_frames:
                reference_sum, reference_count = reference_sum + means, reference_count + 1
            rows.append(row)
            values.append(means - reference_sum / reference_count)
            if len(rows) == BATCH_ROWS:
                yield table(rows, values)
                rows, values = [], []
        if rows:
            yield table(rows, values)

    return pa.RecordBatchReader.from_batches(schema, batches())


def _fields(params: Params) -> list[pa.Field]:
    """Return the fields ``taxel0101_red`` …: row and column from 1 and colour, float32 grey levels."""
    import pyarrow as pa

    def metadata(row: int, column: int, colour: str) -> Mapping[str, str]:
        place = {"row": str(row), "column": str(column), "taxel": str((row - 1) * params.columns + column)}
        return {"unit": "count", "quantity": "tactile", **place, "component": colour}

    return [
        pa.field(f"taxel{row:02d}{column:02d}_{colour}", pa.float32(), metadata=metadata(row, column, colour))
        for row in range(1, params.rows + 1)
        for column in range(1, params.columns + 1)
        for colour in COLOURS
    ]
