"""Which rows of a synchronized table follow one another, and which fall into a gap of a stream."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.errors import TacpipeError

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.arrays import Bools, Int64s

GRID = "grid"  # attribute of a synchronized recording: uniform, logged or fresh
GAP = "_gap"  # how the masks of gaps end
_APART = {"logged": 3.0, "fresh": 3.0}  # times the median step, by grid: further apart, rows are missing between
_UNIFORM = 1.5


def gaps(table: pa.Table) -> Bools:
    """Return for each row whether any stream had a gap there, shape (time,): a column that ends in ``_gap`` marks it."""
    gap = np.zeros(table.num_rows, dtype=bool)
    for name in table.column_names:
        if name.endswith(GAP):
            gap |= table.column(name).to_numpy().astype(bool)
    return gap


def apart(attributes: Mapping[str, Any]) -> float:
    """Return how many times the median step two rows of a recording may be apart with no row missing between."""
    return _APART.get(str(attributes.get(GRID, "uniform")), _UNIFORM)


def times(table: pa.Table) -> Int64s:
    """Return the rows' times in ns, shape (time,). Raises `TacpipeError` where there are none."""
    if "t_ns" not in table.column_names:
        raise TacpipeError("There is no column t_ns, so the order of the rows in time is unknown.")
    return np.asarray(table.column("t_ns").to_numpy(), dtype=np.int64)
