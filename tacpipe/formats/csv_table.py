"""Read the numeric CSV files of published data sets strictly: a wrong cell is an error with its line, never a silent NaN.

`tacpipe.formats.table.text` parses the files. The header must name all columns, each cell must be a number, no value
may be missing, and rows may end with a comma. Unix seconds are parsed as decimal numbers, because current timestamps
with nine decimals would be rounded to 256 ns as float64.

A truncated row is detected. A truncated last *number* (``0.1234`` of ``0.123456``) cannot be detected.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Floats, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.formats.table import stamps
from tacpipe.formats.table.layout import StreamLayout
from tacpipe.formats.table.text import TextTable
from tacpipe.printable import excerpt, listed, plain

SECONDS = pa.decimal128(19, 9)


@dataclass(frozen=True)
class _NumericTable(TextTable):
    """A CSV file whose first line names its columns."""

    trailing_comma: bool = False  # True: data rows end in a comma, whether the header does or not

    def names(self) -> list[str]:
        """Return the names in the header, and an empty one for the cell after a trailing comma."""
        names = self.header()
        return [*names, ""] if self.trailing_comma and names[-1] else names

    def header(self) -> list[str]:
        """Return the names in the header without the spaces around them. Raises `TacpipeError` for an empty file."""
        for _, cells in self.rows():
            return [cell.strip() for cell in cells]
        raise TacpipeError(f"{self.path} is empty; a header and rows were expected. Copy it again from its source.")

    def remedy(self, kind: pa.DataType) -> str:
        """Return what to do about a cell that is no number."""
        return "Correct the cell" + (": seconds since 1970, with nine decimals at most." if kind == SECONDS else ".")


def read_csv(
    path: Path,
    columns: Sequence[str],
    *,
    integers: pa.DataType | None = None,
    allow_nan: bool = False,
    trailing_comma: bool = False,
    seconds: str = "",
) -> pa.Table:
    """Return ``columns`` of a numeric CSV file, in this order, as float64 or as the type ``integers``.

    Other columns of the file must also be numbers, and are omitted. ``trailing_comma`` is for files whose data rows end
    with a comma, whether the header does or not. ``seconds`` names a column of Unix seconds with at most nine decimals,
    which is converted to the first column ``t_ns``, exact int64 nanoseconds. Blank lines are skipped. Raises
    `TacpipeError` with file and line for an empty file, a file without rows, a missing or duplicate column, a row of
    another width, a cell that is not a number, NaN unless ``allow_nan``, infinity, invalid seconds, and, with
    ``integers``, a fraction or a value out of range.
    """
    text_table = _table(path, trailing_comma)
    names = text_table.names()
    _check_header(path, names, [seconds, *columns] if seconds else columns)
    types = {name: pa.float64() if name or not trailing_comma else pa.string() for name in names}
    blocks = list(text_table.batches(types | ({seconds: SECONDS} if seconds else {})))
    if not blocks:
        raise TacpipeError(f"{path} has a header and no rows; the recording is empty. Delete it or record it again.")
    table = pa.concat_tables(blocks)
    if trailing_comma and any(table.column("").unique().to_pylist()):
        index, cell = next((index, cell) for index, cell in enumerate(table.column("").to_pylist()) if cell)
        raise TacpipeError(
            f"{path}, {text_table.place(index)} ends in {excerpt(cell)} and other rows in a comma; a cell is too much."
        )
    times = {"t_ns": pa.array(_nanoseconds(text_table, seconds, table.column(seconds)))} if seconds else {}
    arrays = {name: table.column(name).to_numpy() for name in columns}
    for name, array in arrays.items():
        _check_values(text_table, name, array, integers, allow_nan)
    return pa.table(
        {**times, **{name: pa.array(array).cast(integers or pa.float64()) for name, array in arrays.items()}}
    )


def read_header(path: Path) -> list[str]:
    """Return the column names in the first line of a CSV file. Raises `TacpipeError` for one that is empty or unreadable."""
    return _table(path).header()


def read_record(path: Path) -> dict[str, str]:
    """Return the only data row of a CSV file as text by column name, as in the ``meta_data.csv`` of a trial.

    Such files are partly written by hand: a row that is longer than the header because of commas in the column
    ``notes`` is joined again, empty cells at the end are dropped, and columns of missing cells at the end are omitted.
    Raises `TacpipeError` with file and line for any other width, and if there is not exactly one data row.
    """
    text_table = _table(path)
    names = text_table.header()
    rows = [(line, cells) for line, cells in text_table.rows() if any(cell.strip() for cell in cells)][1:]
    if len(rows) != 1:
        raise TacpipeError(f"{path} has {len(rows)} rows below its header; it must have one. Correct it and try again.")
    line, cells = rows[0]
    while len(cells) > len(names) and not cells[-1].strip():
        cells = cells[:-1]
    surplus = len(cells) - len(names)
    if surplus > 0 and "notes" in names:
        notes_index = names.index("notes")
        cells = [
            *cells[:notes_index],
            ",".join(cells[notes_index : notes_index + surplus + 1]),
            *cells[notes_index + surplus + 1 :],
        ]
    elif surplus > 0:
        raise TacpipeError(
            f"{path}, line {line} has {len(cells)} cells under a header of {len(names)}; "
            f"which of them is too much cannot be determined. Put quotes around text with commas."
        )
    return {name: cell.strip() for name, cell in zip(names, cells, strict=False)}


def place(path: Path, index: int) -> str:
    """Return the line of the data row ``index`` (from 0) of a CSV file for error messages: "line 3"."""
    return _table(path).place(index)


def _table(path: Path, trailing_comma: bool = False) -> _NumericTable:
    return _NumericTable(path, StreamLayout(path.stem, separator=","), trailing_comma)


def _check_header(path: Path, names: Sequence[str], columns: Sequence[str]) -> None:
    """Raise `TacpipeError` if a header repeats a name or lacks one of ``columns``."""
    repeated = sorted(name for name, count in Counter(names).items() if count > 1)
    if repeated:
        raise TacpipeError(f"{path} has more than one column {listed(repeated, 4)}; each name must be unique.")
    header_names = set(names)
    missing = [name for name in columns if name not in header_names]
    if missing:
        raise TacpipeError(
            f"{path} lacks the column {listed(missing, 4)}; its header begins with {', '.join(map(plain, names[:4]))}. "
            f"It may belong to another format."
        )


def _nanoseconds(text_table: TextTable, name: str, column: pa.ChunkedArray) -> Int64s:
    """Return decimal seconds as whole nanoseconds, int64 (time,). Raises `TacpipeError` for times outside 1970 to 2262."""
    chunk = column.combine_chunks()
    t_ns, fits = stamps.last_digits(chunk)
    bad = ~fits | (t_ns < 0)
    if bad.any():
        index = int(bad.argmax())
        raise TacpipeError(
            f"{text_table.path}, {text_table.place(index)}, column {name} holds {chunk[index].as_py():f}; it must be "
            f"seconds since 1970, which end in 2262 in nanoseconds. Correct the cell."
        )
    return t_ns


def _check_values(text_table: TextTable, name: str, array: Floats, integers: pa.DataType | None, nan: bool) -> None:
    """Raise `TacpipeError` for the first value of a column that is not finite, or not a value of the type ``integers``.

    ``nan``: NaN is allowed.
    """
    if nan:
        bad, expected = np.isinf(array), "a finite number or NaN"
    else:
        bad, expected = ~np.isfinite(array), "a finite number"
    if integers is not None and not bad.any():
        limits = np.iinfo(integers.to_pandas_dtype())
        bad = (array != np.rint(array)) | (array < limits.min) | (array > limits.max)
        expected = f"a whole number from {limits.min} to {limits.max}"
    if bad.any():
        index = int(bad.argmax())
        raise TacpipeError(
            f"{text_table.path}, {text_table.place(index)}, column {name} holds {array[index]:.12g}; it must be {expected}."
        )
