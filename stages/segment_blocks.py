"""Cut each recording into equal blocks.

Each block is a recording, such as ``press-block-3``, so that a split can test the last part of each recording, and no
window crosses a border. A synchronized recording is cut into blocks of equally many rows, others into equal times across
all streams; streams of a single row, such as a plan, are in every block. Blocks have the attributes of the recording, and
the labels ``recording``, its name, and ``block``, from 1. `tacpipe split --scheme leave-one-out --by block` tests one
block of each recording in each fold: the last in the last fold.

Example: tacpipe segment blocks data/synced --parts 5 -o data/blocks
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tacpipe.errors import TacpipeError
from tacpipe.plugins.constraints import Range
from tacpipe.plugins.rows import RowCounts, count_rows
from tacpipe.plugins.stage import RecordingOutput, Result, stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Times
    from tacpipe.datasets.dataset import Dataset, Recording

RECORDING, BLOCK = "recording", "block"  # labels of a block


@dataclass(frozen=True)
class Params(StreamSelection):
    """The number of blocks."""

    parts: Annotated[int, Range(2)] = 5  # number of blocks of each recording


@stage(version=1)
def blocks(params: Params, recordings: Dataset) -> Result:
    """Return the blocks of all recordings."""
    outputs: dict[str, RecordingOutput] = {}
    for recording in map(params.narrow, recordings.recordings.values()):
        if BLOCK in recording.attributes:
            raise TacpipeError(
                f"Recording {recording.name} has the label {BLOCK} already. Give the recordings that it was cut from, or "
                f"rename the label."
            )
        counts = {stream: recording.columns(stream).num_rows for stream in recording.streams}
        edges = _edges(recording, counts, params.parts)
        for part in range(params.parts):
            spans = {
                stream: (edges[stream][part], edges[stream][part + 1]) if stream in edges else (0, count)
                for stream, count in counts.items()
            }
            name = f"{recording.name}-block-{part + 1:0{len(str(params.parts))}}"
            outputs[name] = RecordingOutput(
                {stream: _read_rows(recording, stream, *span) for stream, span in spans.items() if span[0] < span[1]},
                {**recording.attributes, RECORDING: recording.name, BLOCK: part + 1},
            )
        for stream, count in counts.items():
            count_rows(recording.name, stream, RowCounts.all_used(count))
    return Result(outputs)


def _edges(recording: Recording, counts: Mapping[str, int], parts: int) -> dict[str, list[int]]:
    """Return the first row of each block and the end of the last, by stream, except for streams of a single row.

    ``counts`` are the rows by stream. Raises `TacpipeError` if a recording has fewer rows than blocks, or if a video cannot
    be cut there.
    """
    import numpy as np

    times = {stream: _times(recording, stream) for stream, count in counts.items() if count > 1}
    longest = max((len(t_ns) for t_ns in times.values()), default=0)
    if longest < parts:
        raise TacpipeError(
            f"Recording {recording.name} has {max(counts.values(), default=0)} rows, and {parts} blocks need at least one "
            f"each. Give fewer --parts, or exclude the recording."
        )
    if set(times) == {""}:
        return {"": [round(part * longest / parts) for part in range(parts + 1)]}
    start_ns = min(int(t_ns[0]) for t_ns in times.values())
    stop_ns = max(int(t_ns[-1]) for t_ns in times.values())
    inner_ns = [start_ns + part * (stop_ns - start_ns) // parts for part in range(1, parts)]
    edges = {}
    for stream, t_ns in times.items():
        edges[stream] = [0, *np.searchsorted(t_ns, inner_ns).tolist(), len(t_ns)]
        _expect_key_frames(recording, stream, edges[stream])
    return edges


def _times(recording: Recording, stream: str) -> Times:
    """Return the times (row,) of a stream. Raises `TacpipeError` if it has none, or they decrease."""
    import numpy as np

    from tacpipe.arrays import from_arrow

    columns = recording.columns(stream)
    place = f"Recording {recording.name}" + (f", stream {stream}" if stream else "")
    if "t_ns" not in columns.column_names:
        raise TacpipeError(f"{place}: there is no column t_ns, by which rows belong to a block. Exclude the stream.")
    t_ns = from_arrow(columns.column("t_ns"))
    if (np.diff(t_ns) < 0).any():
        raise TacpipeError(f"{place}: the times of its rows decrease. Repair its clock at the source.")
    return t_ns


def _expect_key_frames(recording: Recording, stream: str, edges: Sequence[int]) -> None:
    """Raise `TacpipeError` if a block of a video would begin with a frame that needs earlier ones."""
    from tacpipe.video.stream import KEY_FRAME

    columns = recording.columns(stream)
    if KEY_FRAME not in columns.column_names:
        return
    is_key = columns.column(KEY_FRAME).to_pylist()
    for first in edges[1:-1]:
        if first < len(is_key) and not is_key[first]:
            raise TacpipeError(
                f"Recording {recording.name}: a block of the video {stream} would begin with frame {first + 1}, which needs "
                f"earlier frames. Cut after `tacpipe extract`, whose channels are rows of their own."
            )


def _read_rows(recording: Recording, stream: str, first: int, stop: int) -> pa.Table | pa.RecordBatchReader:
    """Return rows of a stream; those of a long one are read on demand."""
    import pyarrow as pa

    from tacpipe.io.parquet import SOME_ROWS

    if recording.columns(stream).num_rows <= SOME_ROWS:
        return recording.table(stream).slice(first, stop - first).combine_chunks()

    def read_batches() -> Iterator[pa.RecordBatch]:
        start = 0
        for table in recording.columns(stream).batches():
            rows = table.slice(max(0, first - start), max(0, min(stop, start + table.num_rows) - max(first, start)))
            yield from rows.combine_chunks().to_batches()
            start += table.num_rows
            if start >= stop:
                return

    return pa.RecordBatchReader.from_batches(recording.columns(stream).schema, read_batches())
