"""Bring all streams of a recording onto one clock.

The output has one table for each recording, over the time that all streams cover, with masks of repeated samples and of
gaps. Rows are at the stamps of one stream, the master, and contain the newest sample of every other stream that had
arrived by then, as in a live session: no row looks ahead. With ``--rate-hz`` rows are at a constant rate. --values
interpolate is for offline analysis: its rows look ahead, and live sessions refuse a model that was trained on them.

Example: tacpipe synchronize data/recordings -o data/synced
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tacpipe.channels.streams import EVENTS
from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import PositiveFloat, Rate, Unit
from tacpipe.plugins.stage import Attribute, RecordingOutput, Values, stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray, Int64s, Times
    from tacpipe.datasets.dataset import Recording
    from tacpipe.synchronization.streams import TimedStream


IN_MEMORY = 1 << 25  # maximum bytes of finished columns in memory; further columns are stored in a temporary file
BATCH_ROWS = 1 << 15  # rows per batch of a long table
Timeline = Literal["uniform", "logged", "fresh"]


@dataclass(frozen=True)
class Params(StreamSelection):
    """The rows, the clock of samples, and the definition of a gap."""

    rate_hz: Rate | None = None  # rate of the rows; without it they are at the stamps of the master
    # hold: newest sample that had arrived; interpolate: between samples, which looks ahead, for offline analysis
    values: Literal["hold", "interpolate"] = "hold"
    # rows without rate_hz: logged: every sample of the master; fresh: samples that are not repeated
    grid: Literal["logged", "fresh"] = "logged"
    master: str = ""  # stream whose first sample starts the grid; empty: that of the rig file, or the first tactile one
    # maximum time between samples without a gap, marked in a mask; without it 50, below 20 Hz 2.5 periods of the stream
    gap_ms: Annotated[PositiveFloat, Unit("ms")] | None = None
    # time of a sample: arrival; device: its own stamp; auto: arrival for hold, else device if there is one
    clock: Literal["auto", "device", "arrival"] = "auto"
    unwrap: bool = True  # undo the wrap-around of 16-bit tactile counts; other channels do not change

    def check(self) -> None:
        """Raise an error for two grids, and for held values on device clocks, whose fit reads the whole recording."""
        if self.values == "hold" and self.clock == "device":
            raise UsageError(
                "clock is device, whose fit reads the whole recording, and held values read no later sample; leave --clock "
                "out, for the time of arrival, or give --values interpolate."
            )
        if self.rate_hz is not None and self.grid == "fresh":
            raise UsageError(
                "grid is fresh, which are rows at the stamps of the master; leave --rate-hz or --grid out."
            )

    @property
    def timeline(self) -> Timeline:
        """The kind of rows, as in the attribute ``grid``."""
        return self.grid if self.rate_hz is None else "uniform"

    @staticmethod
    def upgrade(stored: Values) -> Values:
        """Return stored params of any version with current names; values were interpolated before version 3."""
        if "values" in stored:
            return dict(stored)
        current = {name: value for name, value in stored.items() if name not in ("causal", "grid", "rate_hz")}
        grid = stored.get("grid", "uniform")
        return {
            **current,
            "rate_hz": stored.get("rate_hz", 50.0) if grid == "uniform" else None,
            "grid": "logged" if grid == "uniform" else grid,
            "values": "hold" if stored.get("causal") else "interpolate",
        }


@stage(version=3, reads=("master",))
def synchronize(params: Params, recording: Recording) -> RecordingOutput:
    """Resample the streams of each recording to one clock.

    Returns one table over the time that all streams cover, with masks of repeats and gaps. Streams of only images or
    text, and those of a single row, cannot be resampled and stay in the recordings. Attributes contain how far rows
    look ahead: the time in ms from a row to the arrival of the latest sample used for it.
    """
    import numpy as np
    import pyarrow as pa

    from tacpipe.channels import streams as masks
    from tacpipe.io.columns import release
    from tacpipe.io.spill import MappedArrays
    from tacpipe.signals.repairs import mean_rate_hz, new_frame_rate_hz
    from tacpipe.signals.resampling import default_gap_ns
    from tacpipe.synchronization import streams
    from tacpipe.synchronization import streams as grids
    from tacpipe.synchronization.columns import look_ahead_ns
    from tacpipe.synchronization.streams import join_names

    recorded_streams = {name: recording.columns(name) for name in sorted(recording.streams) if name != EVENTS}
    signal_streams = {
        name: columns for name, columns in recorded_streams.items() if streams.is_signal(columns)
    } or recorded_streams
    hold_values = params.values == "hold"
    storage = MappedArrays(IN_MEMORY)
    placed: dict[str, TimedStream] = {}
    for name, stored in signal_streams.items():
        placed[name] = streams.to_host_clock(recording.name, name, stored, "arrival" if hold_values else params.clock)
        stored.forget()
    master_name = params.master or str(recording.attributes.get("master", ""))
    schemas = {name: columns.schema for name, columns in signal_streams.items()}
    master = placed[grids.master(recording.name, master_name, schemas)]
    grid_ns, rows = grids.grid(recording.name, params.timeline, params.rate_hz, placed, master, hold_values=hold_values)
    columns: list[tuple[pa.Field, Any]] = [(master.columns.schema.field("t_ns"), grid_ns)]
    attributes: dict[str, Attribute] = {masks.GRID: params.timeline, "grid_master": master.name}
    if omitted := [name for name in recorded_streams if name not in signal_streams]:
        attributes["not_synchronized"] = join_names(omitted)
    attributes["grid_rate_hz"] = round(mean_rate_hz(grid_ns), 3) if params.rate_hz is None else params.rate_hz
    if len(grid_ns) > 1:
        attributes["step_ms"] = round(float(np.median(np.diff(grid_ns))) / 1e6, 3)
    ahead_ns = np.zeros(len(grid_ns), np.int64)  # (grid,)
    for name in list(placed):
        stream = placed.pop(name)
        exact = None if hold_values else grids.rows_at(stream.t_ns, grid_ns, rows)
        if params.unwrap:
            stream, wrapped = streams.unwrap_counts(stream, storage.put_aside)
            attributes |= {f"{name}_wrapped_channels": wrapped} if wrapped else {}
        gap_ns = default_gap_ns(stream.t_ns) if params.gap_ms is None else round(params.gap_ms * 1e6)
        columns += _stream_on_grid(params, stream, grid_ns, exact, gap_ns, storage.put_aside)
        if not stream.truth:
            if not hold_values:
                ahead_ns = np.maximum(ahead_ns, look_ahead_ns(stream, grid_ns, exact))
            attributes[f"{name}{masks.GAP_MS}"] = gap_ns / 1e6
            attributes[f"{name}_rate_hz"] = round(mean_rate_hz(stream.t_ns), 3)
            attributes[f"{name}_fresh_hz"] = round(new_frame_rate_hz(stream.t_ns, stream.repeated), 3)
            attributes |= stream.attributes
        stream.columns.forget()
        if not storage.in_memory:
            release()
    attributes[masks.LOOK_AHEAD_MEAN] = round(float(ahead_ns.mean()) / 1e6, 3)
    attributes[masks.LOOK_AHEAD_MAX] = round(float(ahead_ns.max()) / 1e6, 3)
    schema = pa.schema([kind for kind, _ in columns])

    def table(rows: slice) -> pa.Table:
        return pa.Table.from_arrays([_column(values[rows], kind.type) for kind, values in columns], schema=schema)

    def batches() -> Iterator[pa.RecordBatch]:
        for first in range(0, len(grid_ns), BATCH_ROWS):
            yield from (batch := table(slice(first, first + BATCH_ROWS))).to_batches()
            storage.read(batch.nbytes)

    gaps = pa.Table.from_pydict(
        {kind.name: _column(values, kind.type) for kind, values in columns if kind.name.endswith(masks.GAP)}
    )
    result = table(slice(None)) if storage.in_memory else pa.RecordBatchReader.from_batches(schema, batches())
    return RecordingOutput(result, attributes, masks.describe_gaps(gaps))


def _column(values: AnyArray | pa.Array, kind: pa.DataType) -> pa.Array:
    """Return values that are an array of numpy or of pyarrow as a column of type ``kind``."""
    from tacpipe.arrays import to_arrow

    return to_arrow(values, kind) if hasattr(values, "dtype") else values


def _stream_on_grid(
    params: Params, stream: TimedStream, grid_ns: Times, exact: Int64s | None, gap_ns: int, keep: Callable[[Any], Any]
) -> list[tuple[pa.Field, Any]]:
    """Return fields and values of a stream's channels on the grid, and of its masks; ground truth has no masks."""
    from tacpipe.synchronization import columns

    if params.values == "hold":
        channels = columns.online_channels(stream, grid_ns, keep)
        masks = [] if stream.truth else columns.online_masks(stream, grid_ns, gap_ns)
    else:
        channels = columns.channels(stream, grid_ns, exact, keep)
        masks = [] if stream.truth else columns.masks(stream, grid_ns, exact, gap_ns)
    return channels + [(field, keep(values)) for field, values in masks]
