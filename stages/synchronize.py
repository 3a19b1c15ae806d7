"""Resample all streams of a recording onto one clock.

The output has one table a recording and one row a grid point, over the time that all streams cover, with masks of
repeated samples and of gaps. With ``--causal`` no grid point looks ahead: it has the newest sample of each stream that
had arrived by then, as a live session has, and the table ends where the last stream does.

Example: tacpipe synchronize data/recordings -o data/synced
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tacpipe.channels.streams import EVENTS
from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import PositiveFloat, Rate, Unit
from tacpipe.plugins.params import added
from tacpipe.plugins.stage import Attribute, RecordingOutput, stage
from tacpipe.plugins.stream_selection import StreamSelection

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Int64s, Times
    from tacpipe.datasets.dataset import Recording
    from tacpipe.synchronization.streams import Stream


@dataclass(frozen=True)
class Params(StreamSelection):
    """The grid, the clock that places samples on it, and what counts as a gap."""

    rate_hz: Rate = 50.0  # rate of the uniform grid
    # uniform; logged: at the master's own stamps; fresh: at those whose rows are not repeated samples
    grid: Literal["uniform", "logged", "fresh"] = "uniform"
    master: str = ""  # stream whose first sample starts the grid; empty: the rig file's, or the first tactile one
    # longest time between samples without a gap, marked in a mask; without it 50, below 20 Hz 2.5 periods of the stream
    gap_ms: Annotated[PositiveFloat, Unit("ms")] | None = None
    # time of a sample: device: its own stamp; arrival: when it came; auto: the device's where there is one
    clock: Literal["auto", "device", "arrival"] = "auto"
    unwrap: bool = True  # undo the wrap-around of tactile counts of 16 bits; channels without any stay as they are
    # no grid point looks ahead: newest sample that had arrived, gaps by its age, clock of arrival
    causal: bool = added(False)

    def check(self) -> None:
        """Refuse the clocks of devices where nothing looks ahead: their fit reads the whole recording."""
        if self.causal and self.clock == "device":
            raise UsageError(
                "clock is device, whose fit reads the whole recording, and causal looks at no later sample; "
                "leave --clock out, for the time of arrival, or --causal."
            )


@stage(version=3, reads=("master",))
def synchronize(params: Params, recording: Recording) -> RecordingOutput:
    """Bring the streams of each recording onto one clock.

    Returns one table over the time that all streams cover, one row a grid point, with masks of repeats and gaps. Streams of
    images or text alone, and those of a single row, have no values between their samples: they stay in the recordings.
    """
    import pyarrow as pa

    from tacpipe.channels import masks
    from tacpipe.signals.holds import fresh_rate_hz, mean_rate_hz
    from tacpipe.signals.resampling import default_gap_ns
    from tacpipe.synchronization import grids, streams
    from tacpipe.synchronization.methods import listed

    every = {name: recording.columns(name) for name in sorted(recording.streams) if name != EVENTS}
    found = {name: columns for name, columns in every.items() if streams.is_signal(columns)} or every
    placed: dict[str, Stream] = {}
    for name, stored in found.items():
        placed[name] = streams.on_host_clock(recording.name, name, stored, "arrival" if params.causal else params.clock)
        stored.forget()
    wanted = params.master or str(recording.attributes.get("master", ""))
    schemas = {name: columns.schema for name, columns in found.items()}
    master = placed[grids.master(recording.name, wanted, schemas)]
    grid_ns, rows = grids.grid(recording.name, params.grid, params.rate_hz, placed, master, causal=params.causal)
    columns: list[tuple[pa.Field, Any]] = [(master.columns.schema.field("t_ns"), grid_ns)]
    attributes: dict[str, Attribute] = {"grid": params.grid, "grid_master": master.name}
    if left := [name for name in every if name not in found]:
        attributes["not_synchronized"] = listed(left)
    attributes["grid_rate_hz"] = params.rate_hz if params.grid == "uniform" else round(mean_rate_hz(grid_ns), 3)
    for name, stream in placed.items():
        exact = None if params.causal else grids.rows_at(stream.t_ns, grid_ns, rows)
        if params.unwrap:
            stream, wrapped = streams.without_wraps(stream)
            attributes |= {f"{name}_wrapped_channels": wrapped} if wrapped else {}
        gap_ns = default_gap_ns(stream.t_ns) if params.gap_ms is None else round(params.gap_ms * 1e6)
        columns += _on_grid(params, stream, grid_ns, exact, gap_ns)
        if not stream.truth:
            attributes[f"{name}{masks.GAP_MS}"] = gap_ns / 1e6
            attributes[f"{name}_rate_hz"] = round(mean_rate_hz(stream.t_ns), 3)
            attributes[f"{name}_fresh_hz"] = round(fresh_rate_hz(stream.t_ns, stream.held), 3)
            attributes |= stream.attributes
        stream.columns.forget()
    arrays = [pa.array(values, kind.type) for kind, values in columns]
    table = pa.Table.from_arrays(arrays, schema=pa.schema([kind for kind, _ in columns]))
    return RecordingOutput(table, attributes, masks.describe_gaps(table))


def _on_grid(
    params: Params, stream: Stream, grid_ns: Times, exact: Int64s | None, gap_ns: int
) -> list[tuple[pa.Field, Any]]:
    """Return field and values of a stream's channels on the grid, and of its masks; ground truth has none."""
    from tacpipe.synchronization import columns

    if params.causal:
        masks = [] if stream.truth else columns.causal_masks(stream, grid_ns, gap_ns)
        return columns.causal_channels(stream, grid_ns) + masks
    masks = [] if stream.truth else columns.masks(stream, grid_ns, exact, gap_ns)
    return columns.channels(stream, grid_ns, exact) + masks
