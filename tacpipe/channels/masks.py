"""Which rows of a synchronized table follow one another, and which fall into a gap of a stream."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Bools, Int64s
    from tacpipe.io.columns import Columns

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


def apart(attributes: Mapping[str, Any]) -> float:
    """Return how many times the median step two rows of a recording may be apart with no row missing between."""
    return _APART.get(str(attributes.get(GRID, "uniform")), _UNIFORM)


def times(table: pa.Table) -> Int64s:
    """Return the rows' times in ns, shape (time,). Raises `TacpipeError` where there are none."""
    import numpy as np

    if "t_ns" not in table.column_names:
        raise TacpipeError("There is no column t_ns, so the order of the rows in time is unknown.")
    return np.asarray(table.column("t_ns").to_numpy(), dtype=np.int64)
