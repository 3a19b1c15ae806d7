"""Tactile channels of a long recording: kept as they are stored, above rest where they are looked at."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyFloats, Bools
from tacpipe.codecs import tactile

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pyarrow as pa

    from tacpipe.io.columns import Columns
    from tacpipe.io.mapped import MappedArrays

BLOCK_ROWS = 1 << 14  # looked at at once
_EXACT_BITS = 16  # bits of an integer that float32 holds exactly


class Levels:
    """Levels above rest (time, channel), of which rows are computed when they are indexed, as of an array.

    An hour at 50 Hz is half as large as an array of float64. What is returned has the values of
    ``(stored.astype(float64) - rest).astype(dtype)``.
    """

    def __init__(self, stored: AnyFloats, rest_counts: AnyFloats, dtype: type[np.floating[Any]] = np.float64) -> None:
        self.stored = stored  # (time, channel), in the precision in which the recording has it
        self.rest_counts = rest_counts  # (channel,)
        self.dtype = dtype

    def __len__(self) -> int:
        return len(self.stored)

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and channels."""
        return self.stored.shape

    def __getitem__(self, at: Any) -> AnyFloats:
        """Return the levels at an index of rows, or of rows and channels."""
        rest_counts = self.rest_counts[at[1]] if isinstance(at, tuple) else self.rest_counts
        levels: AnyFloats = np.subtract(self.stored[at], rest_counts, dtype=np.float64)
        return levels.astype(self.dtype, copy=False)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> AnyFloats:
        return self[:].astype(dtype or self.dtype, copy=False)

    def of_type(self, dtype: type[np.floating[Any]]) -> Levels:
        """Return the same levels in another precision."""
        return Levels(self.stored, self.rest_counts, dtype)

    def between(self, first: int, last: int) -> Levels:
        """Return the levels of the rows from ``first`` to before ``last``."""
        return Levels(self.stored[first:last], self.rest_counts, self.dtype)

    def put_aside(self, mapped: MappedArrays) -> Levels:
        """Return the same levels, whose rows lie in ``mapped``."""
        return Levels(mapped.kept(self.stored), self.rest_counts, self.dtype)

    def finite(self) -> Bools:
        """Return for each row (time,) whether all its levels are finite."""
        finite = np.ones(len(self), dtype=bool)
        for first in range(0, len(self), BLOCK_ROWS):
            block = slice(first, first + BLOCK_ROWS)
            finite[block] = np.isfinite(self.stored[block] - self.rest_counts).all(axis=1)
        return finite


def above_rest(table: pa.Table | Columns, channels: Sequence[str]) -> Levels:
    """Return the levels of the channels above rest. Raises `TacpipeError` where one has no rest level."""
    rest_counts = tactile.rest_counts(table.schema, channels)
    narrow = all(_is_narrow(table.schema.field(name).type) for name in channels)
    stored = np.empty((table.num_rows, len(channels)), np.float32 if narrow else np.float64)
    for index, name in enumerate(channels):
        stored[:, index] = table.column(name).to_numpy()
    return Levels(stored, rest_counts)


def _is_narrow(kind: pa.DataType) -> bool:
    """Return whether float32 holds every value of a column's type."""
    import pyarrow as pa

    small = pa.types.is_integer(kind) and kind.bit_width <= _EXACT_BITS
    return bool(small or pa.types.is_float32(kind) or pa.types.is_float16(kind))
