"""What the table of a stream holds: its rate, its columns of a quantity, and which are ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import AnyArray, Indices, Int64s, Times
    from tacpipe.io.columns import Columns

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

    None where there are no times, or too few rows.
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
    """Return the rows of a stream before which samples are missing: by the device's own counter where there is one, else by
    steps above three times the median one, which is that of the table unless it is given.
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


def signal(streams: Mapping[str, pa.Table], quantity: str) -> tuple[Int64s, AnyArray] | None:
    """Return stamps (time,) and values (time, channel) of the first stream with ``quantity``; None if there is none."""
    import numpy as np

    for table in streams.values():
        names = of_quantity(table, quantity)
        if names:
            values = np.column_stack([table.column(name).to_numpy() for name in names])
            return table.column("t_ns").to_numpy(), values
    return None
