"""Bring all streams of a recording onto one clock.

The output has one table for each recording, with masks of repeated samples and of gaps. It has one row for each sample of
one stream, the master, at the time when it was measured, from when all streams have started. A row contains the newest
sample of every other stream that had arrived by then, as in a live session: no row looks ahead. With ``--rate-hz`` rows
are at a constant rate. --values interpolate is for offline analysis: its rows look ahead, and live sessions refuse a
model that was trained on them. Columns to learn, such as a measured force, are ``--truth``: they are interpolated at the
times of the rows, and no stage takes them as input.

Example: tacpipe synchronize data/recordings -o data/synced
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Annotated, Literal

from tacpipe.channels import streams as masks
from tacpipe.channels.streams import EVENTS
from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import Names, PositiveFloat, Rate, Unit
from tacpipe.plugins.params import added
from tacpipe.plugins.rows import LATE, OUTSIDE, UNNEEDED, RowCounts
from tacpipe.plugins.stage import Attribute, RecordingOutput, Values, stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Bools
    from tacpipe.datasets.dataset import Recording
    from tacpipe.synchronization.streams import TimedStream


IN_MEMORY = 1 << 25  # maximum bytes of times in memory; further times are stored in a temporary file
BLOCK_BYTES = 1 << 25  # approximate size of the samples and rows that are in memory at once
Timeline = Literal["uniform", "logged", "fresh"]


@dataclass(frozen=True)
class Params(StreamSelection):
    """The rows, the clock of samples, and the definition of a gap."""

    rate_hz: Rate | None = None  # rate of the rows; without it, rows are at the timestamps of the master
    # hold: newest sample that had arrived; interpolate: between samples, which looks ahead, for offline analysis
    values: Literal["hold", "interpolate"] = "hold"
    # rows without rate_hz: logged: every sample of the master; fresh: samples that are not repeated
    grid: Literal["logged", "fresh"] = "logged"
    master: str = ""  # stream whose first sample starts the grid; empty: that of the rig file, or the first tactile one
    # maximum time between samples without a gap, marked in a mask; without it 50, below 20 Hz 2.5 periods of the stream
    gap_ms: Annotated[PositiveFloat, Unit("ms")] | None = None
    # time of a sample with --values interpolate: arrival; device: its own stamp; auto: device if there is one
    clock: Literal["auto", "device", "arrival"] = "auto"
    unwrap: bool = True  # undo the wrap-around of 16-bit tactile counts; other channels do not change
    # columns of the result to learn, with * as wildcard, as 'ft_*': interpolated in time, and no input of any stage
    truth: Names = added("")

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


@stage(version=4, reads=("master", "ended"))
def synchronize(params: Params, recording: Recording) -> RecordingOutput:
    """Resample the streams of each recording to one clock.

    Returns one table over the time that all streams cover, with masks of repeats and gaps. Streams of only images or
    text, and those of a single row, cannot be resampled and stay in the recordings. Attributes contain how far rows
    look ahead: the time in ms from a row to the arrival of the latest sample used for it.
    """
    import pyarrow as pa

    from tacpipe.arrays import to_arrow
    from tacpipe.io.spill import MappedArrays
    from tacpipe.signals.repairs import mean_rate_hz, new_frame_rate_hz
    from tacpipe.signals.resampling import default_gap_ns, median_step_ns
    from tacpipe.synchronization import streams
    from tacpipe.synchronization.columns import GridColumns, grid_ranges
    from tacpipe.synchronization.truth import TruthColumns, truth_columns, without_truth

    recorded_streams = {name: recording.columns(name) for name in sorted(recording.streams) if name != EVENTS}
    signal_streams = {
        name: columns for name, columns in recorded_streams.items() if streams.is_signal(columns)
    } or recorded_streams
    hold_values = params.values == "hold"
    clock = "arrival" if hold_values else params.clock
    storage = MappedArrays(IN_MEMORY)
    placed_streams = {
        name: streams.place_stream(recording, name, columns, clock, storage) for name, columns in signal_streams.items()
    }
    master_name = params.master or str(recording.attributes.get("master", ""))
    schemas = {name: columns.schema for name, columns in signal_streams.items()}
    truth_names = truth_columns(schemas, params.truth, recording.name)
    inputs = without_truth(placed_streams, truth_names, master_name, recording.name)
    master = inputs[streams.master(recording.name, master_name, {name: inputs[name].schema for name in inputs})]
    grid = streams.find_rows(
        recording.name, params.timeline, params.rate_hz, inputs, master, storage, hold_values=hold_values
    )
    grid_ns = grid.t_ns
    attributes: dict[str, Attribute] = {masks.GRID: params.timeline, "grid_master": master.name}
    if omitted := [name for name in recorded_streams if name not in signal_streams]:
        attributes["not_synchronized"] = streams.join_names(omitted)
    attributes["grid_rate_hz"] = round(mean_rate_hz(grid_ns), 3) if params.rate_hz is None else params.rate_hz
    if len(grid_ns) > 1:
        attributes["step_ms"] = round(median_step_ns(grid_ns, storage.release) / 1e6, 3)
    ahead_ns = storage.empty((0 if hold_values else len(grid_ns),), grid_ns.dtype)  # (grid,)
    ahead_ns[:] = 0
    gaps: dict[str, pa.Array] = {}  # masks (grid,) by name
    readers: list[GridColumns] = []
    for name, stream in inputs.items():
        exact = None if hold_values else streams.rows_at(stream.t_ns, grid_ns, storage)
        if params.unwrap:
            stream = streams.unwrap_counts(stream)
            attributes |= {f"{name}_wrapped_channels": len(stream.wraps)} if stream.wraps else {}
        gap_ns = default_gap_ns(stream.t_ns, storage.release) if params.gap_ms is None else round(params.gap_ms * 1e6)
        readers.append(GridColumns(stream, grid, exact, gap_ns, storage, hold_values=hold_values))
        if not stream.truth:
            gaps[name + masks.GAP] = to_arrow(readers[-1].gaps())
            if not hold_values:
                readers[-1].extend_look_ahead(ahead_ns)
            attributes[f"{name}{masks.GAP_MS}"] = gap_ns / 1e6
            attributes[f"{name}_rate_hz"] = round(mean_rate_hz(stream.t_ns), 3)
            attributes[f"{name}_fresh_hz"] = round(new_frame_rate_hz(stream.t_ns, stream.repeated), 3)
            attributes |= stream.attributes
        storage.release()
    truths = {
        name: TruthColumns(placed_streams[name], names, grid_ns, params.gap_ms, storage, unwrap=params.unwrap)
        for name, names in truth_names.items()
    }
    attributes |= {f"{name}{masks.WITHOUT_TRUTH}": truth.missing_rows for name, truth in truths.items()}
    at_arrival = storage.empty((len(grid_ns),), bool)
    at_arrival[:] = master.at_arrival[grid.numbers] if params.rate_hz is None else False
    attributes[masks.LOOK_AHEAD_MEAN] = round(float(ahead_ns.mean()) / 1e6, 3) if len(ahead_ns) else 0.0
    attributes[masks.LOOK_AHEAD_MAX] = round(float(ahead_ns.max(initial=0)) / 1e6, 3)
    notes = [*masks.describe_gaps(pa.Table.from_pydict(gaps)), *_time_notes(master, at_arrival, placed_streams)]
    notes += [note for truth in truths.values() for note in truth.notes()]
    fields = masks.row_fields(master.columns.schema.field("t_ns"), held=hold_values)

    def batches() -> Iterator[pa.RecordBatch]:
        for points in grid_ranges(grid_ns, list(placed_streams.values()), BLOCK_BYTES):
            arrivals = [grid.arrival_ns[points], at_arrival[points]] if hold_values else []
            columns = list(zip(fields, [grid_ns[points], *arrivals], strict=True))
            columns += [column for reader in readers for column in reader.read(points)]
            columns += [column for truth in truths.values() for column in truth.read(points)]
            arrays = [to_arrow(values, kind.type) if hasattr(values, "dtype") else values for kind, values in columns]
            yield pa.RecordBatch.from_arrays(arrays, schema=pa.schema([kind for kind, _ in columns]))
            storage.release()

    remaining = batches()
    first, second = next(remaining), next(remaining, None)
    result = pa.Table.from_batches([first])
    if second is not None:
        result = pa.RecordBatchReader.from_batches(first.schema, chain([first, second], remaining))
    rows_by_stream = {
        name: RowCounts.some_used(columns.num_rows, 0, UNNEEDED) for name, columns in recorded_streams.items()
    }
    rows_by_stream |= {name: truth.row_counts() for name, truth in truths.items()}
    for (name, stream), reader in zip(inputs.items(), readers, strict=True):
        used = reader.used_samples()
        unused = {OUTSIDE: len(stream.t_ns) - used, LATE: stream.late}
        rows_by_stream[name] = RowCounts(len(stream.t_ns) + stream.late, used, unused)
    return RecordingOutput(result, attributes, notes, rows_by_stream)


def _time_notes(master: TimedStream, at_arrival: Bools, streams: Mapping[str, TimedStream]) -> list[str]:
    """Return notes on rows without a known sampling time, ``at_arrival`` (row,), and on estimated losses of ``streams``."""
    notes = []
    if at_arrival.mean() > masks.WARNING_SHARE:
        notes.append(
            f"{at_arrival.mean():.1%} of the rows are at the arrival of their sample, because the rate of {master.name} is "
            "not known there or not constant. No model is trained or scored on them. Give --rate-hz for rows at a constant "
            "rate."
        )
    return notes + [
        f"About {stream.estimated_lost:,} samples of {name} were lost: later ones arrived as if so many were missing."
        for name, stream in streams.items()
        if stream.estimated_lost > 0
    ]
