"""Read properties of stream tables: rates, columns of a quantity, ground truth, gaps, and the stream of a finger."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from tacpipe.channels.schema import is_truth
from tacpipe.errors import TacpipeError
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray, Bools, Indices, Int64s, Times
    from tacpipe.io.columns import Columns

Table = TypeVar("Table", "pa.Table", "pa.Table | Columns")
COUNT = "count"  # unit of raw readings
EVENTS = "events"  # stream of problems during recording; not a signal
_GAP_FACTOR = 3.0  # minimum gap as a multiple of the median step
_PIECE_ROWS = 1 << 20  # number of rows in memory at once


@dataclass(frozen=True)
class Clocks:
    """Start, end and rate of a stream, and the times around each gap."""

    start_ns: int
    stop_ns: int
    rate_hz: float | None  # samples per second, as the function `rate_hz` returns it
    gap_starts_ns: Times  # (gap,)
    gap_stops_ns: Times  # (gap,)

    @property
    def duration_s(self) -> float:
        """The time between the first and the last sample."""
        return (self.stop_ns - self.start_ns) / 1e9


def read_clocks(columns: Columns) -> Clocks | None:
    """Return the clocks of a stream, or None without times or with fewer than two rows.

    They are read in blocks of a million rows. Rate and median step are those of the first block; with a sample counter, the
    rate is that of the whole stream.
    """
    import numpy as np
    import pyarrow as pa

    names = [name for name in ("t_ns", "seq") if name in columns.column_names]
    if "t_ns" not in names or columns.num_rows < 2:
        return None
    blocks = (block for block in columns.batches(names, _PIECE_ROWS) if block.num_rows)
    block = next(blocks)
    first_row, rate = block.slice(0, 1), rate_hz(block)
    median_step_ns = float(np.median(np.diff(block["t_ns"].to_numpy())))
    starts_ns, stops_ns = [], []
    while True:
        t_ns, rows = block["t_ns"].to_numpy(), gaps_before(block, median_step_ns)
        starts_ns.append(t_ns[rows - 1])
        stops_ns.append(t_ns[rows])
        last_row = block.slice(block.num_rows - 1)
        next_block = next(blocks, None)
        if next_block is None:
            break
        block = pa.concat_tables([last_row, next_block])
    ends = pa.concat_tables([first_row, last_row])
    start_ns, stop_ns = ends["t_ns"].to_pylist()
    rate = rate_hz(ends) if "seq" in names else rate
    return Clocks(start_ns, stop_ns, rate, np.concatenate(starts_ns), np.concatenate(stops_ns))


def rate_hz(table: pa.Table | Columns) -> float | None:
    """Return the rate of a stream from its sample counter, or else from the median step.

    Returns None without times or with fewer than two rows.
    """
    import numpy as np

    if "t_ns" not in table.column_names or table.num_rows < 2:
        return None
    step_ns = np.diff(table.column("t_ns").to_numpy())  # (time - 1,)
    # late arrivals are not gaps if a sample counter shows that no sample is missing
    if "seq" in table.column_names and step_ns.sum() > 0:
        return round(float(np.diff(table.column("seq").to_numpy()).sum() / step_ns.sum()) * 1e9, 3)
    median_step_ns = float(np.median(step_ns))
    return round(1e9 / median_step_ns, 3) if median_step_ns else None


def gaps_before(table: pa.Table, median_ns: float | None = None) -> Indices:
    """Return the rows of a stream before which samples are missing.

    They are detected with the sample counter. Without a counter, a step longer than three times the median step is a gap;
    the default ``median_ns`` is that of the table.
    """
    import numpy as np

    step_ns = np.diff(table["t_ns"].to_numpy())  # (time - 1,)
    # late arrivals are not gaps if a sample counter shows that no sample is missing
    if "seq" in table.column_names and step_ns.sum() > 0:
        return np.flatnonzero(np.diff(table["seq"].to_numpy()) > 1) + 1
    typical_ns = float(np.median(step_ns)) if median_ns is None else median_ns
    return np.flatnonzero(step_ns > _GAP_FACTOR * typical_ns) + 1


def columns_with_quantity(table: pa.Table | Columns, quantity: str) -> list[str]:
    """Return the columns of a stream with ``quantity``, without ground truth."""
    return columns_of_schema(table.schema, quantity)


def columns_of_schema(schema: pa.Schema, quantity: str) -> list[str]:
    """Return the names of the columns with ``quantity``, in the order of ``schema``, without ground truth."""
    return [
        field.name
        for field in schema
        if (field.metadata or {}).get(b"quantity") == quantity.encode() and not is_truth(field)
    ]


def common_unit(source: pa.Table | pa.Schema, names: Sequence[str]) -> str:
    """Return the common unit of columns, or '' if they have none or different ones."""
    units = {(source.field(name).metadata or {}).get(b"unit", b"").decode() for name in names}
    return next(iter(units)) if len(units) == 1 else ""


def count_axes(source: pa.Table | pa.Schema, names: Sequence[str]) -> int:
    """Return the number of axes of the taxels in these columns."""
    return len({(source.field(name).metadata or {}).get(b"axis") for name in names})


def signal(streams: Mapping[str, pa.Table | Columns], quantity: str) -> tuple[Int64s, AnyArray] | None:
    """Return times (time,) and values (time, channel) of the first stream with ``quantity``, or None."""
    import numpy as np

    for table in streams.values():
        names = columns_with_quantity(table, quantity)
        if names:
            values = np.column_stack([table.column(name).to_numpy() for name in names])
            return table.column("t_ns").to_numpy(), values
    return None


_NO_CHANNELS = ("time", "mask", "label", "latent", "prediction")  # quantities of columns that are not from a sensor
_SHOWN = 6  # number of listed quantities


def layout_entry(stream: str) -> str:
    """Return the entry of a layout file that declares the columns of a stream.

    >>> layout_entry("skin"), layout_entry("")
    ('[streams.skin] columns', '[streams.…] columns')
    """
    return f"[streams.{plain(stream) if stream else '…'}] columns"


def missing_channel_error(
    recording: str, quantity: str, fields: Iterable[pa.Field] | Mapping[str, Iterable[pa.Field]], *, unit: str = ""
) -> TacpipeError:
    """Return the error for a recording without a channel of ``quantity``.

    ``fields`` are those of all columns, or of each stream. The error lists existing quantities and columns without a
    quantity, and how to declare it in a layout file.
    """
    undeclared: list[str] = []
    counts: dict[str, int] = {}
    streams: set[str] = set()
    owned: list[tuple[str, pa.Field]]
    if isinstance(fields, Mapping):
        owned = [(stream, field) for stream, members in fields.items() for field in members]
    else:
        owned = [("", field) for field in fields]
    for stream, field in owned:
        metadata = field.metadata or {}
        own_quantity = metadata.get(b"quantity", b"").decode()
        if own_quantity in _NO_CHANNELS or field.name in ("t_ns", "seq", "t_device_ns"):
            continue
        if own_quantity:
            counts[own_quantity] = counts.get(own_quantity, 0) + 1
        else:
            undeclared.append(field.name)
            streams.add(stream or metadata.get(b"stream", b"").decode())
    descriptions = [f"{count} of {plain(name)}" for name, count in counts.items()]
    descriptions += [f"{len(undeclared)} without a quantity ({listed(undeclared, 3)})"] if undeclared else []
    table_name = layout_entry(streams.pop() if len(streams) == 1 else "")
    setting = f'quantity = "{quantity}"' + (f' and unit = "{unit}"' if unit else "")
    summary = ", ".join(descriptions[-_SHOWN:]) or "none"
    return TacpipeError(
        f"Recording {recording} has no channel of the quantity {quantity}; its columns are {summary}. Set "
        f"{setting} in {table_name} of the layout file, and ingest again."
    )


def finger_stream(name: str, streams: Mapping[str, Table]) -> Table:
    """Return the only stream with tactile channels. Raises `TacpipeError` if there are none or several."""
    tactile_streams = [stream for stream, table in streams.items() if columns_with_quantity(table, "tactile")]
    if not tactile_streams:
        raise missing_channel_error(name, "tactile", {stream: table.schema for stream, table in streams.items()})
    if len(tactile_streams) != 1:
        raise TacpipeError(
            f"Recording {name} has {len(tactile_streams)} streams with tactile channels: {', '.join(tactile_streams)}; it "
            f"must have one. Use recordings of one finger or one patch of skin."
        )
    return streams[tactile_streams[0]]


def remove_spikes(
    table: pa.Table, rows: int, deviations: float, floor_count: float, names: Sequence[str] | None = None
) -> tuple[pa.Table, Int64s]:
    """Return a stream without spikes in its tactile channels, repaired with `hampel`, and their number in each row (time,).

    By default, all tactile channels are repaired, otherwise only ``names``. A spike deviates from the median of
    ``rows`` rows by more than ``deviations``, at least ``floor_count``.
    """
    import numpy as np
    import pyarrow as pa

    from tacpipe.signals.repairs import hampel

    repairable = columns_with_quantity(table, "tactile") if names is None else list(names)
    if not repairable:
        return table, np.zeros(table.num_rows, np.int64)
    values = np.column_stack([table.column(name).to_numpy() for name in repairable])  # (time, channel)
    spikes, repaired = hampel(values, rows, deviations, floor_count)
    repaired_table = table
    for channel in np.flatnonzero(spikes.any(axis=0)):
        field = table.schema.field(repairable[channel])
        column = pa.array(repaired[:, channel].copy(), field.type)
        repaired_table = repaired_table.set_column(table.column_names.index(field.name), field, column)
    return repaired_table, spikes.sum(axis=1)


GRID = "grid"  # attribute of synchronized recordings: uniform, logged or fresh
ARRIVAL, AT_ARRIVAL = "t_arrival_ns", "at_arrival"  # columns of synchronized recordings, beside t_ns
GAP = "_gap"  # suffix of gap masks
GAP_MS = "_gap_ms"  # suffix of attributes of synchronized recordings: longest time without a gap
WITHOUT_TRUTH = "_rows_without_truth"  # suffix of attributes of synchronized recordings: rows without measured truth
LOOK_AHEAD_MEAN, LOOK_AHEAD_MAX = "look_ahead_mean_ms", "look_ahead_max_ms"  # attributes of a synchronized recording
WARNING_SHARE = 0.05  # fraction of rows in gaps above which users are warned
_MAX_STEP = {"logged": 3.0, "fresh": 3.0}  # longest step without missing rows as a multiple of the median step, by grid
_UNIFORM = 1.5


def row_fields(master: pa.Field, *, held: bool) -> list[pa.Field]:
    """Return the fields of the times of synchronized rows: ``t_ns`` and, with ``held`` values, of two further columns.

    ``master`` is the field ``t_ns`` of the master, which may state how times without a clock were computed.
    `ARRIVAL` is when the row's samples had arrived. `AT_ARRIVAL` is True where the sampling time of the master's sample is
    unknown, so that ``t_ns`` is its arrival.
    """
    import pyarrow as pa

    time = {"unit": "ns", "quantity": "time"}
    origin = {key: value for key, value in (master.metadata or {}).items() if key == b"made"}
    fields = [pa.field("t_ns", pa.int64(), metadata={**time, **origin})]
    if held:
        fields.append(pa.field(ARRIVAL, pa.int64(), metadata=time))
        fields.append(pa.field(AT_ARRIVAL, pa.bool_(), metadata={"unit": "1", "quantity": "mask"}))
    return fields


def unusable_rows(table: pa.Table) -> Bools:
    """Return a mask of rows (time,) in a gap of any stream (columns that end in ``_gap``), or without a known time."""
    import numpy as np

    unusable = np.zeros(table.num_rows, dtype=bool)
    for name in table.column_names:
        if name.endswith(GAP) or name == AT_ARRIVAL:
            unusable |= table.column(name).to_numpy().astype(bool)
    return unusable


def gap_shares(table: pa.Table | Columns) -> dict[str, float]:
    """Return the fraction of rows in a gap of each stream, by stream."""
    from tacpipe.arrays import from_arrow

    masks = [name for name in table.column_names if name.endswith(GAP)]
    return {name.removesuffix(GAP): float(from_arrow(table.column(name)).mean()) for name in masks if table.num_rows}


def describe_gaps(*tables: pa.Table | Columns) -> list[str]:
    """Return a message for each stream with more than 5 % of its rows in gaps in any of ``tables``."""
    shares: dict[str, float] = {}
    for table in tables:
        for stream, share in gap_shares(table).items():
            shares[stream] = max(share, shares.get(stream, 0.0))
    return [
        f"More than {WARNING_SHARE:.0%} of the rows are in gaps of stream {stream}, and no window crosses a gap; "
        f"`tacpipe show` prints the fraction. Synchronize with a longer --gap-ms if its samples are that slow."
        for stream, share in shares.items()
        if share > WARNING_SHARE
    ]


def max_step(attributes: Mapping[str, str | float | bool | None]) -> float:
    """Return the longest step without missing rows as a multiple of the median step of a recording."""
    return _MAX_STEP.get(str(attributes.get(GRID, "uniform")), _UNIFORM)


def times(table: pa.Table) -> Int64s:
    """Return the times of the rows in ns (time,). Raises `TacpipeError` if there are none."""
    import numpy as np

    if "t_ns" not in table.column_names:
        raise TacpipeError("There is no column t_ns, so the times of the rows are unknown.")
    return np.asarray(table.column("t_ns").to_numpy(), dtype=np.int64)
