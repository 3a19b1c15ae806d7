"""One stream of a recording on the host's clock, as a grid reads it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import Attribute
from tacpipe.synchronization import methods
from tacpipe.synchronization.methods import DEVICE, TRUTH, UNCERTAIN

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray, Bools, Int32s, Int64s, Times
    from tacpipe.io.columns import Columns

# quantities of streams that are no signals: times alone, and what a live session records of itself
OF_SESSIONS = ("time", "plan", "prediction", "latency", "alarm", "material")


@dataclass(frozen=True)
class Stream:
    """One stream of a recording, and when its samples were taken on the host's clock."""

    name: str
    columns: Columns
    t_ns: Times  # (time,)
    held: Bools  # (time,)
    arrival_ns: Times  # (time,), when the samples arrived, whatever the clock of `t_ns`
    attributes: dict[str, Attribute] = field(default_factory=dict)  # what the fit of its clock gave
    unwrapped: Mapping[str, Int32s] = field(default_factory=dict)  # channels whose counts had wrapped around

    @property
    def channels(self) -> list[str]:
        """The names of its channels."""
        return methods.channel_names(self.columns.schema)

    def field(self, name: str) -> pa.Field:
        """The field of a channel: of one that was unwrapped as it is then."""
        import pyarrow as pa

        found = self.columns.schema.field(name)
        return found.with_type(pa.int32()) if name in self.unwrapped else found

    def values(self, name: str) -> AnyArray:
        """A channel of numbers (time,)."""
        found = self.unwrapped.get(name)
        return self.columns.column(name).to_numpy() if found is None else found

    def at(self, name: str, rows: pa.Array) -> pa.Array:
        """A channel of any type at some rows."""
        import pyarrow as pa

        found = self.unwrapped.get(name)
        return self.columns.column(name).take(rows).combine_chunks() if found is None else pa.array(found).take(rows)

    @property
    def truth(self) -> bool:
        """Whether all of it is ground truth."""
        return all(name.startswith(TRUTH) for name in self.channels)


def is_signal(columns: Columns) -> bool:
    """Return whether a stream has numbers over time, and no column of bytes; what a model predicted is no signal."""
    return columns.num_rows != 1 and holds_signal(columns.schema)


def holds_signal(schema: pa.Schema) -> bool:
    """Return whether the columns of a stream can be a signal: `is_signal` of more than one row."""
    import pyarrow as pa

    channels = [field for field in schema if field.name not in ("t_ns", UNCERTAIN)]
    if any(pa.types.is_binary(field.type) for field in channels):
        return False
    return any(
        not pa.types.is_string(field.type) and (field.metadata or {}).get(b"quantity", b"").decode() not in OF_SESSIONS
        for field in channels
    )


def on_host_clock(recording: str, name: str, columns: Columns, clock: str) -> Stream:
    """Return a stream with its samples on the host's clock; ``clock`` names the stamps: device, arrival or auto.

    Raises `TacpipeError` for stamps that are absent, run backwards or give no clock.
    """
    arrival_ns = _stamps(recording, name, columns)
    stream = Stream(name, columns, arrival_ns, _held(columns), arrival_ns)
    if clock == "arrival" or stream.truth:
        return stream
    if DEVICE not in columns.column_names:
        if clock == "device":
            raise TacpipeError(
                f"Recording {recording}: stream {name!r} has no column {DEVICE}, and so no clock of a device. "
                f"Take `--clock auto`, which uses the device's clock where there is one, or `--clock arrival`."
            )
        return stream
    t_ns, attributes = _by_device(recording, name, columns, stream.t_ns)
    return replace(stream, t_ns=t_ns, attributes=attributes)


def _by_device(recording: str, stream: str, columns: Columns, arrival_ns: Times) -> tuple[Int64s, dict[str, Attribute]]:
    """Return when samples were taken by their device's clock, mapped to the host's, and what the fit gave."""
    import pyarrow as pa

    from tacpipe.signals.clocks import fit_clock, host_times

    column = columns.column(DEVICE)
    if column.null_count or not pa.types.is_integer(column.type):
        raise TacpipeError(
            f"Recording {recording}: {DEVICE} of stream {stream!r} is {column.type} with {column.null_count} empty rows; "
            f"it must be whole nanoseconds in each row. Repair it at the source, or take `--clock arrival`."
        )
    device_ns = column.cast(pa.int64()).to_numpy()
    try:
        fit = fit_clock(device_ns, arrival_ns, _certain(columns))
    except TacpipeError as error:
        raise TacpipeError(f"Recording {recording}, stream {stream!r}: {error}") from error
    return host_times(fit, device_ns, arrival_ns), {
        f"{stream}_clock_offset_ms": round(fit.offset_ns / 1e6, 3),
        f"{stream}_clock_drift_ppm": round(fit.drift_ppm, 1),
        f"{stream}_clock_residual_ms": round(fit.median_residual_ns / 1e6, 3),
    }


def _certain(columns: Columns) -> Bools | None:
    """Return which rows have an arrival that was recorded in time, None where all have."""
    if UNCERTAIN not in columns.column_names:
        return None
    found: Bools = columns.column(UNCERTAIN).to_numpy() == 0
    return found


def _stamps(recording: str, stream: str, columns: Columns) -> Int64s:
    """Return the stamps of a stream. Raises `TacpipeError` if there are none or where they run backwards."""
    import numpy as np

    if "t_ns" not in columns.column_names or not columns.num_rows:
        raise TacpipeError(
            f"Recording {recording}: stream {stream!r} has no rows with t_ns; nothing can be brought onto a clock. "
            f"Exclude the recording with `tacpipe label --exclude`, or record it again."
        )
    t_ns: Times = columns.column("t_ns").to_numpy()
    back = np.diff(t_ns) < 0
    if back.any():
        row = int(back.argmax()) + 1
        raise TacpipeError(
            f"Recording {recording}: the time of stream {stream!r} runs backwards at row {row} (counted from 0), from "
            f"{t_ns[row - 1]} to {t_ns[row]} ns. Repair its clock at the source, or exclude the recording."
        )
    return t_ns


def without_wraps(stream: Stream, keep: Callable[[Any], Any]) -> tuple[Stream, int]:
    """Return the stream with the wrap-around of its tactile counts undone, and in how many channels there was any.

    ``keep`` puts the values of such a channel aside and returns them.
    """
    import pyarrow as pa

    from tacpipe.signals.unwrap import unwrapped

    changed: dict[str, Int32s] = {}
    for kind in stream.columns.schema:
        tactile = (kind.metadata or {}).get(b"quantity") == b"tactile"
        if tactile and pa.types.is_integer(kind.type) and kind.type.bit_width == 16:
            values = stream.columns.column(kind.name).to_numpy()
            found = unwrapped(values)
            if found is not values:
                changed[kind.name] = keep(found)
    return replace(stream, unwrapped=changed), len(changed)


def _held(columns: Columns) -> Bools:
    """Return which rows repeat the one before in all channels but labels, which are meant to stay."""
    import numpy as np

    from tacpipe.signals.holds import held_columns

    names = [
        name for name in methods.channel_names(columns.schema) if methods.method(columns.schema, name) != "nearest"
    ]
    if not names:
        return np.zeros(columns.num_rows, dtype=bool)
    return held_columns(columns.column(name).to_numpy() for name in names)
