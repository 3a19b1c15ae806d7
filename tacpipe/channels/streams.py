"""Find in the tables of streams: rates, columns of a quantity, ground truth, gaps, and the stream of a finger."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from tacpipe.errors import TacpipeError
from tacpipe.printable import listed, plain

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray, Bools, Indices, Int64s, Times
    from tacpipe.io.columns import Columns

Table = TypeVar("Table", "pa.Table", "pa.Table | Columns")
COUNT = "count"  # the unit of readings as a sensor gives them
EVENTS = "events"  # the stream of what went wrong while recording; no signal
TRUTH = "gt_"  # how columns with ground truth begin
_GAP_FACTOR = 3.0  # a step this many times the median step is a gap
_PIECE_ROWS = 1 << 20  # rows whose clocks are read at once


@dataclass(frozen=True)
class Clocks:
    """The clocks of a stream in brief: first and last stamp, rate, and the stamps around each gap."""

    start_ns: int
    stop_ns: int
    rate_hz: float | None  # computed by the function `rate_hz`
    gap_starts_ns: Times  # (gap,)
    gap_stops_ns: Times  # (gap,)

    @property
    def duration_s(self) -> float:
        """The time from the first to the last sample."""
        return (self.stop_ns - self.start_ns) / 1e9


def read_clocks(columns: Columns) -> Clocks | None:
    """Return the clocks of a stream; None without stamps, and for fewer than two rows.

    They are read in pieces of a million rows. Where no device counts, the median step is that of the first piece.
    """
    import numpy as np
    import pyarrow as pa

    names = [name for name in ("t_ns", "seq") if name in columns.column_names]
    if "t_ns" not in names or columns.num_rows < 2:
        return None
    pieces = (piece for piece in columns.batches(names, _PIECE_ROWS) if piece.num_rows)
    piece = next(pieces)
    first_row, rate, median_ns = piece.slice(0, 1), rate_hz(piece), float(np.median(np.diff(piece["t_ns"].to_numpy())))
    starts_ns, stops_ns = [], []
    while True:
        t_ns, rows = piece["t_ns"].to_numpy(), gaps_before(piece, median_ns)
        starts_ns.append(t_ns[rows - 1])
        stops_ns.append(t_ns[rows])
        last_row = piece.slice(piece.num_rows - 1)
        following = next(pieces, None)
        if following is None:
            break
        piece = pa.concat_tables([last_row, following])
    ends = pa.concat_tables([first_row, last_row])
    start_ns, stop_ns = ends["t_ns"].to_pylist()
    rate = rate_hz(ends) if "seq" in names else rate
    return Clocks(start_ns, stop_ns, rate, np.concatenate(starts_ns), np.concatenate(stops_ns))


def rate_hz(table: pa.Table | Columns) -> float | None:
    """Return the rate of a stream's rows: by the device's own counter where there is one, else by the median step.

    None if there are no times, or too few rows.
    """
    import numpy as np

    if "t_ns" not in table.column_names or table.num_rows < 2:
        return None
    step_ns = np.diff(table.column("t_ns").to_numpy())  # (time - 1,)
    if "seq" in table.column_names and step_ns.sum() > 0:  # the device counts: late arrivals are then no gaps
        return round(float(np.diff(table.column("seq").to_numpy()).sum() / step_ns.sum()) * 1e9, 3)
    median_ns = float(np.median(step_ns))
    return round(1e9 / median_ns, 3) if median_ns else None


def gaps_before(table: pa.Table, median_ns: float | None = None) -> Indices:
    """Return the rows of a stream before which samples are missing.

    The device's own counter shows them. A stream without a counter misses samples where a step is longer than three times
    the median step, which is that of the table unless it is given.
    """
    import numpy as np

    step_ns = np.diff(table["t_ns"].to_numpy())  # (time - 1,)
    if "seq" in table.column_names and step_ns.sum() > 0:  # the device counts: late arrivals are then no gaps
        return np.flatnonzero(np.diff(table["seq"].to_numpy()) > 1) + 1
    typical_ns = float(np.median(step_ns)) if median_ns is None else median_ns
    return np.flatnonzero(step_ns > _GAP_FACTOR * typical_ns) + 1


def of_quantity(table: pa.Table | Columns, quantity: str) -> list[str]:
    """Return the columns of a stream that hold ``quantity``."""
    return [field.name for field in table.schema if (field.metadata or {}).get(b"quantity") == quantity.encode()]


def unit_of(source: pa.Table | pa.Schema, names: Sequence[str]) -> str:
    """Return the unit of columns; the empty text where they have none, or not all the same."""
    units = {(source.field(name).metadata or {}).get(b"unit", b"").decode() for name in names}
    return next(iter(units)) if len(units) == 1 else ""


def axes_of(source: pa.Table | pa.Schema, names: Sequence[str]) -> int:
    """Return how many axes the taxels of these columns have."""
    return len({(source.field(name).metadata or {}).get(b"axis") for name in names})


def signal(streams: Mapping[str, pa.Table | Columns], quantity: str) -> tuple[Int64s, AnyArray] | None:
    """Return stamps (time,) and values (time, channel) of the first stream with ``quantity``; None if there is none."""
    import numpy as np

    for table in streams.values():
        names = of_quantity(table, quantity)
        if names:
            values = np.column_stack([table.column(name).to_numpy() for name in names])
            return table.column("t_ns").to_numpy(), values
    return None


_NO_CHANNELS = ("time", "mask", "label", "latent", "prediction")  # quantities of columns that no sensor gave
_SHOWN = 6  # quantities


def entry(stream: str) -> str:
    """Return where a layout file declares the columns of a stream.

    >>> entry("skin"), entry("")
    ('[streams.skin] columns', '[streams.…] columns')
    """
    return f"[streams.{plain(stream) if stream else '…'}] columns"


def absent(
    recording: str, quantity: str, fields: Iterable[pa.Field] | Mapping[str, Iterable[pa.Field]], *, unit: str = ""
) -> TacpipeError:
    """Return the error of a recording without a channel of ``quantity``.

    ``fields`` are those of all its columns, or of each stream. The error names the quantities that are there, the
    columns without one, and the line of a layout file that sets it.
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
    table_name = entry(streams.pop() if len(streams) == 1 else "")
    setting = f'quantity = "{quantity}"' + (f' and unit = "{unit}"' if unit else "")
    summary = ", ".join(descriptions[-_SHOWN:]) or "none"
    return TacpipeError(
        f"Recording {recording} has no channel of the quantity {quantity}; its columns are {summary}. Set "
        f"{setting} in {table_name} of the layout file, and ingest again."
    )


def finger(name: str, streams: Mapping[str, Table]) -> Table:
    """Return the only stream with tactile channels. Raises `TacpipeError`, naming the recording, for none or several."""
    tactile_streams = [stream for stream, table in streams.items() if of_quantity(table, "tactile")]
    if not tactile_streams:
        raise absent(name, "tactile", {stream: table.schema for stream, table in streams.items()})
    if len(tactile_streams) != 1:
        raise TacpipeError(
            f"Recording {name} has {len(tactile_streams)} streams with tactile channels: {', '.join(tactile_streams)}; a "
            f"slide is cut from one. Give recordings of one finger, or of one patch of skin."
        )
    return streams[tactile_streams[0]]


def without_spikes(
    table: pa.Table, rows: int, deviations: float, floor_count: float, names: Sequence[str] | None = None
) -> tuple[pa.Table, Int64s]:
    """Return the stream with spikes of its tactile channels removed, and how many each row had (time,); see `hampel`.

    Of the tactile channels only ``names`` are repaired where they are given.
    """
    import numpy as np
    import pyarrow as pa

    from tacpipe.signals.repairs import hampel

    names = of_quantity(table, "tactile") if names is None else list(names)
    if not names:
        return table, np.zeros(table.num_rows, np.int64)
    values = np.column_stack([table.column(name).to_numpy() for name in names])  # (time, channel)
    spikes, repaired = hampel(values, rows, deviations, floor_count)
    for channel in np.flatnonzero(spikes.any(axis=0)):
        field = table.schema.field(names[channel])
        column = pa.array(repaired[:, channel].copy(), field.type)
        table = table.set_column(table.column_names.index(field.name), field, column)
    return table, spikes.sum(axis=1)


GRID = "grid"  # attribute of a synchronized recording: uniform, logged or fresh
GAP = "_gap"  # how the masks of gaps end
GAP_MS = "_gap_ms"  # how the attributes of a synchronized recording end that hold the longest time without a gap
LOOK_AHEAD_MEAN, LOOK_AHEAD_MAX = "look_ahead_mean_ms", "look_ahead_max_ms"  # attributes of a synchronized recording
MANY = 0.05  # fraction of rows in gaps of a stream, above which a user is warned
_APART = {"logged": 3.0, "fresh": 3.0}  # times the median step, by grid: further apart, rows are missing between
_UNIFORM = 1.5


def gaps(table: pa.Table) -> Bools:
    """Return for each row whether any stream had a gap there, shape (time,): a column that ends in ``_gap`` marks it."""
    import numpy as np

    gap = np.zeros(table.num_rows, dtype=bool)
    for name in table.column_names:
        if name.endswith(GAP):
            gap |= table.column(name).to_numpy().astype(bool)
    return gap


def gap_shares(table: pa.Table | Columns) -> dict[str, float]:
    """Return the fraction of rows that lie in a gap of each stream, by the name of the stream."""
    masks = [name for name in table.column_names if name.endswith(GAP)]
    return {name.removesuffix(GAP): float(table.column(name).to_numpy().mean()) for name in masks if table.num_rows}


def describe_gaps(*tables: pa.Table | Columns) -> list[str]:
    """Return one sentence for each stream with more than 5 % of its rows in gaps, in any of some recordings."""
    shares: dict[str, float] = {}
    for table in tables:
        for stream, share in gap_shares(table).items():
            shares[stream] = max(share, shares.get(stream, 0.0))
    return [
        f"More than {MANY:.0%} of the rows lie in gaps of stream {stream}, and no window crosses a gap; `tacpipe show` "
        f"prints the fraction. Synchronize with a longer --gap-ms if its samples come that slowly."
        for stream, share in shares.items()
        if share > MANY
    ]


def apart(attributes: Mapping[str, str | float | bool | None]) -> float:
    """Return how many times the median step two rows of a recording may be apart with no row missing between."""
    return _APART.get(str(attributes.get(GRID, "uniform")), _UNIFORM)


def times(table: pa.Table) -> Int64s:
    """Return the rows' times in ns, shape (time,). Raises `TacpipeError` if there are none."""
    import numpy as np

    if "t_ns" not in table.column_names:
        raise TacpipeError("There is no column t_ns, so the order of the rows in time is unknown.")
    return np.asarray(table.column("t_ns").to_numpy(), dtype=np.int64)
