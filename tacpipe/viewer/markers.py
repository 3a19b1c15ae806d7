"""Place the markers of a gel in the frames of its camera, from the displacements that `extract markers` wrote."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Floats, Times
from tacpipe.channels.schema import field_metadata
from tacpipe.datasets.dataset import Recording
from tacpipe.store.records import Step
from tacpipe.traces.curves import TIME
from tacpipe.video.frames import read_frames
from tacpipe.video.markers import GridSearch
from tacpipe.video.stream import read_format

STAGE = "extract.markers"
AXES = ("x", "y")
UNITS = ("px", "mm")


@dataclass(frozen=True)
class MarkerTrack:
    """The markers of one gel over time, in pixels of its frames."""

    stream: str
    t_ns: Times  # (time,)
    rest_px: Floats  # (marker, xy), NaN for a marker that was not detected
    positions_px: Floats  # (time, marker, xy), NaN for a hidden marker


def track_markers(stream: str, table: pa.Table, video: Recording, chain: Sequence[Step]) -> MarkerTrack | None:
    """Return the markers of a stream of displacements in the frames of the stream of the same name of ``video``.

    Returns None if the stream contains no marker displacements, or ``video`` has no such frames, or no grid of markers
    is found. The markers at rest are found in the first frames, as in `extract markers`.
    """
    names_by_position = _names_by_position(table)
    if not names_by_position or TIME not in table.column_names or stream not in video.streams:
        return None
    frames = video.columns(stream)
    if read_format(frames) is None or not frames.num_rows:
        return None
    rows, columns = (max(position[axis] for position in names_by_position) for axis in (0, 1))
    params: Mapping[str, Any] = next((step["params"] for step in chain if step["stage"] == STAGE), {})
    count = min(params.get("reference_frames", 1), frames.num_rows)
    images = read_frames(frames, range(count), grey=True)
    search = GridSearch(rows, columns, params.get("polarity", "dark"), count)
    grid = next(filter(None, (search.add(images.get(row)) for row in range(count))), None)
    if grid is None:
        return None
    displacements = np.full((table.num_rows, rows * columns, 2), np.nan)
    for (row, column, axis), name in names_by_position.items():
        values = table.column(name).to_numpy().astype(np.float64)
        displacements[:, (row - 1) * columns + column - 1, axis] = values
    pitch_mm = params.get("pitch_mm")
    if isinstance(pitch_mm, int | float) and pitch_mm:
        displacements *= grid.pitch_px / pitch_mm
    return MarkerTrack(stream, table.column(TIME).to_numpy(), grid.positions_px, grid.positions_px + displacements)


def _names_by_position(table: pa.Table) -> Mapping[tuple[int, int, int], str]:
    """Return the columns of displacements by row and column of the marker, from 1, and axis, from 0.

    An empty mapping if a column of displacements has no row and column.
    """
    names: dict[tuple[int, int, int], str] = {}
    for field in table.schema:
        metadata = field_metadata(field)
        if metadata.get("quantity") == "tactile" and metadata.get("unit") in UNITS and metadata.get("axis") in AXES:
            if not {"row", "column"} <= set(metadata):
                return {}
            names[int(metadata["row"]), int(metadata["column"]), AXES.index(metadata["axis"])] = field.name
    return names
