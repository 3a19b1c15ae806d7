"""Tables in long form, a row a channel and moment, as rows of all channels of a moment: in bounded memory.

Rows of a moment may be anywhere in the file, as where one channel follows another. So rows are put aside in runs that are
each in order of time, and merged.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Floats, Times
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.formats.table import columns, rows
from tacpipe.formats.table.columns import CellError, Chosen
from tacpipe.formats.table.layout import Stream
from tacpipe.formats.table.rows import Place, Rows
from tacpipe.io.spill import Piece, Spill, in_order
from tacpipe.plugins.stage import Shared
from tacpipe.printable import plain

RUN_ROWS = 1 << 21  # that are put in order at once
MOST_CHANNELS = 1 << 14  # of a stream; a column with more names is another one
GRID_VALUES = 1 << 22  # of moments and channels that are in memory at once
MOMENT, CHANNEL, VALUE, ROW = "t_ns", "channel", "value", "row"


@dataclass(frozen=True)
class LongForm:
    """The rows of a file in long form that were put aside: the names of the channels, in the order of their first rows."""

    file: Rows
    channels: Sequence[str]
    pieces: Sequence[Piece]
    aside: Spill

    def blocks(self, wanted: Sequence[Chosen]) -> Iterator[tuple[Times, list[pa.Array]]]:
        """Yield stamps in ns and a column a wanted channel, NaN where there is no value, moment by moment.

        Raises `TacpipeError` for two values of a channel at one moment, and as `columns.converted` does.
        """
        moments = 0
        for table in in_order(self.pieces, self.aside.read, MOMENT):
            t_ns, at = np.unique(table.column(MOMENT).to_numpy(), return_inverse=True)
            codes, values = table.column(CHANNEL).to_numpy(), table.column(VALUE).to_numpy()
            self._expect_single(at * len(self.channels) + codes, codes, table)
            step = max(1, GRID_VALUES // len(self.channels))
            for start in range(0, len(t_ns), step):
                first, last = np.searchsorted(at, [start, start + step])
                grid = np.full((len(self.channels), len(t_ns[start : start + step])), np.nan)  # (channel, time)
                grid[codes[first:last], at[first:last] - start] = values[first:last]
                yield t_ns[start : start + step], [self._column(grid, one, moments + start) for one in wanted]
            moments += len(t_ns)

    def _column(self, grid: Floats, one: Chosen, before: int) -> pa.Array:
        values = pa.chunked_array([pa.array(grid[self.channels.index(one.name)])])
        try:
            return columns.converted(values, one, nan_allowed=True)
        except CellError as error:
            where = f"{self.file.path}, channel {plain(one.name)}, moment {before + error.row + 1}"
            raise TacpipeError(f"{where} {error}.") from error

    def _expect_single(self, cells: AnyArray, codes: AnyArray, table: pa.Table) -> None:
        """Raise `TacpipeError` where two rows have the same moment and channel, ``cells``."""
        order = np.argsort(cells, kind="stable")
        doubled = np.flatnonzero(np.diff(cells[order]) == 0)
        if not len(doubled):
            return
        row_of = table.column(ROW).to_numpy()
        second = order[doubled + 1]
        found = int(second[row_of[second].argmin()])
        raise TacpipeError(
            f"{self.file.path} has two values of {plain(self.channels[codes[found]])} at one moment, the second in "
            f"{self.file.place(int(row_of[found]))}. Name the column that distinguishes them, or remove one."
        )


def read(file: Rows, stream: Stream, recording: str | None, shared: Shared | None) -> LongForm:
    """Return the rows of a table in long form. Raises as `rows.blocks` does, and for too many channels."""
    assert stream.long is not None
    if not stream.time.column:
        raise UsageError(
            f"[streams.{stream.name}] is in long form, so rows share moments: give the column of their stamps."
        )
    types = {**rows.types(file, stream), stream.long.channel: pa.string(), stream.long.value: pa.float64()}
    aside = Spill()
    codes: dict[str, int] = {}
    pieces: list[Piece] = []
    waiting: list[pa.Table] = []
    for block, in_file, place in rows.blocks(file, stream, types, recording, shared):
        made = {
            MOMENT: rows.stamped(block.column(stream.time.column), stream, place),
            CHANNEL: _coded(block.column(stream.long.channel), codes, stream, place),
            VALUE: block.column(stream.long.value).cast(pa.float64()).to_numpy(),
            ROW: np.ascontiguousarray(in_file),
        }
        if len(codes) > MOST_CHANNELS:
            raise TacpipeError(
                f"{file.path}, column {plain(stream.long.channel)} names more than {MOST_CHANNELS} channels. Correct "
                f"channel in [streams.{stream.name}] long."
            )
        waiting.append(pa.table(made))
        if sum(table.num_rows for table in waiting) >= RUN_ROWS:
            pieces += aside.add_run(pa.concat_tables(waiting), MOMENT)
            waiting = []
    pieces += aside.add_run(pa.concat_tables(waiting), MOMENT) if waiting else []
    return LongForm(file, list(codes), pieces, aside)


def _coded(column: pa.ChunkedArray, codes: dict[str, int], stream: Stream, place: Place) -> AnyArray:
    """Return the number of each row's channel (row,); new ones are added to ``codes``."""
    found = column.cast(pa.string()).fill_null("").combine_chunks().dictionary_encode()
    names = found.dictionary.to_pylist()
    if "" in names:
        row = int((found.indices.to_numpy() == names.index("")).argmax())
        assert stream.long is not None
        raise TacpipeError(
            f"{place(row)}, column {plain(stream.long.channel)}: the row names no channel. Fill the cell, or take the row "
            f"away."
        )
    own = [codes.setdefault(name, len(codes)) for name in names]
    numbers: AnyArray = np.array(own, np.int32)[found.indices.to_numpy()]
    return numbers
