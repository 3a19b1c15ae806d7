"""Numeric CSV files, read strictly: a wrong cell is an error with its file and row, never a silent NaN or shift.

pyarrow parses the file at once; only when that fails, or a value is not allowed, is it gone through again to find the
row. What pyarrow would do by itself and may not here: take empty cells, ``NA`` and ``nan`` for nulls, guess a column's
type from its first rows, and count rows without blank lines and header, so that its messages point to the wrong line.
Rows are counted as lines of the file, from 1, as an editor shows them; the header is row 1.

Unix seconds are read as decimal numbers: as float64, stamps of today with nine decimals would be rounded to 256 ns.

A row that was cut short is seen. A last *number* that was cut short (``0.1234`` of ``0.123456``) cannot be.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from tacpipe.arrays import Floats, Int64s
from tacpipe.errors import TacpipeError
from tacpipe.formats.table import stamps
from tacpipe.io import regular
from tacpipe.io.parquet import owned
from tacpipe.printable import excerpt, listed, plain

_STAMP = re.compile(r"\s*\d{1,10}(\.\d{1,9})?\s*")
_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*([eE][-+]?\d+)?|\.\d+([eE][-+]?\d+)?|nan|inf(inity)?)\s*", re.IGNORECASE)


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

    Other columns of the file must be numbers too, and are left out. ``trailing_comma`` is for files whose data rows end
    in a comma, whether the header does or not. ``seconds`` names a column of unix seconds with nine decimals at most,
    which then stands first in the table, as ``t_ns``: exact nanoseconds, int64. Blank lines hold no row. Raises
    `TacpipeError`, naming file and row, for: an empty file, one without rows, a missing or doubled column, a row of
    another width, a cell that is not a number, NaN unless ``allow_nan``, infinity, seconds that are not such time, and, with
    ``integers``, a fraction or a value out of the type's range.
    """
    names = read_header(path)
    if trailing_comma and not names[-1]:
        names = names[:-1]
    _check_header(path, names, [seconds, *columns] if seconds else columns)
    tail = [""] if trailing_comma else []
    stamps = {seconds: pa.decimal128(19, 9)} if seconds else {}
    content = regular.source(path)
    try:
        table = pc.read_csv(
            pa.BufferReader(owned(content)),
            read_options=pc.ReadOptions(column_names=[*names, *tail], skip_rows=1, use_threads=False),
            convert_options=pc.ConvertOptions(
                column_types={**dict.fromkeys(names, pa.float64()), **dict.fromkeys(tail, pa.string()), **stamps},
                null_values=[],
            ),
        )
    except (pa.ArrowInvalid, UnicodeDecodeError) as error:
        fault = _first_fault(path, names, trailing_comma, seconds)
        raise TacpipeError(fault or f"{path} is not a CSV file: {plain(str(error), 200)}.") from error
    if not table.num_rows:
        raise TacpipeError(f"{path} has a header and no rows; the recording is empty. Delete it or record it again.")
    if tail and any(cell != "" for cell in table.column(len(names)).unique().to_pylist()):
        raise TacpipeError(_first_fault(path, names, trailing_comma) or f"{path} has a cell too many in some row.")
    times = {"t_ns": pa.array(_nanoseconds(path, seconds, table.column(seconds)))} if seconds else {}
    arrays = [table.column(names.index(name)).to_numpy() for name in columns]
    for name, array in zip(columns, arrays, strict=True):
        _check_values(path, name, array, integers, allow_nan)
    kind = integers or pa.float64()
    cast = {name: pa.array(array).cast(kind) for name, array in zip(columns, arrays, strict=True)}
    return pa.table({**times, **cast})


def read_header(path: Path) -> list[str]:
    """Return the column names in the first line of a CSV file, without the spaces around them.

    Raises `TacpipeError` for a file that is empty or cannot be read.
    """
    for _, cells in _rows(path):
        return [cell.strip() for cell in cells]
    raise TacpipeError(f"{path} is empty; a header and rows were expected. Copy it again from its source.")


def read_record(path: Path) -> dict[str, str]:
    """Return the one data row of a CSV file as text by column name, as in the ``meta_data.csv`` of a trial.

    Such files are written by hand in part: a row that is longer than the header because someone wrote commas into the
    column ``notes`` is put together again, empty cells at the end are dropped, and cells that are missing at the end
    are left out. Raises `TacpipeError`, naming file and row, for any other width and for none or several data rows.
    """
    names = read_header(path)
    rows = [(line, cells) for line, cells in _rows(path) if any(cell.strip() for cell in cells)][1:]
    if len(rows) != 1:
        raise TacpipeError(
            f"{path} has {len(rows)} rows below its header; it must have one. Put it right and try again."
        )
    line, cells = rows[0]
    while len(cells) > len(names) and not cells[-1].strip():
        cells = cells[:-1]
    surplus = len(cells) - len(names)
    if surplus > 0 and "notes" in names:
        at = names.index("notes")
        cells = [*cells[:at], ",".join(cells[at : at + surplus + 1]), *cells[at + surplus + 1 :]]
    elif surplus > 0:
        raise TacpipeError(
            f"{path}, row {line} has {len(cells)} fields under a header of {len(names)}; "
            f"which of them is too much cannot be determined. Put quotes around text with commas."
        )
    return {name: cell.strip() for name, cell in zip(names, cells, strict=False)}


def file_row(path: Path, index: int) -> int:
    """Return the line, from 1, that holds the data row ``index`` (from 0) of a CSV file; for messages."""
    position = -1  # the header
    for line, _ in _rows(path):
        if position == index:
            return line
        position += 1
    raise IndexError(f"{path} has no data row {index}.")


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the cells of each line that is not blank."""
    try:
        with regular.failing(path), io.TextIOWrapper(regular.opened(path), "utf-8-sig", "replace", "") as file:
            reader = csv.reader(file)
            for cells in reader:
                if cells:
                    yield reader.line_num, cells
    except csv.Error as error:
        raise TacpipeError(
            f"{path} cannot be read: {plain(str(error), 200)}. Check the path and copy the file again."
        ) from error


def _check_header(path: Path, names: Sequence[str], columns: Sequence[str]) -> None:
    doubled = sorted(name for name, count in Counter(names).items() if count > 1)
    if doubled:
        raise TacpipeError(f"{path} has more than one column {listed(doubled, 4)}; each name may stand once.")
    header_names = set(names)
    missing = [name for name in columns if name not in header_names]
    if missing:
        raise TacpipeError(
            f"{path} lacks the column {listed(missing, 4)}; its header begins with {', '.join(map(plain, names[:4]))}. "
            f"It may belong to another format."
        )


def _first_fault(path: Path, names: Sequence[str], trailing_comma: bool, seconds: str = "") -> str | None:
    """Return a sentence about the first row that is not a row of numbers, or None."""
    rows = _rows(path)
    next(rows)
    for line, cells in rows:
        if trailing_comma and len(cells) == len(names) + 1 and not cells[-1].strip():
            cells = cells[:-1]
        elif trailing_comma and len(cells) == len(names):
            return f"{path}, row {line} does not end in a comma as the other rows do; it was cut short."
        if len(cells) != len(names):
            cause = "it was cut short" if len(cells) < len(names) else "a cell or a comma is too much"
            return f"{path}, row {line} has {len(cells)} fields instead of {len(names)}; {cause}. Copy the file again."
        for name, cell in zip(names, cells, strict=True):
            if not _NUMBER.fullmatch(cell):
                described = f"column {plain(name)} holds {excerpt(cell)}"
                return f"{path}, row {line}, {described}, which is not a number. Correct the cell."
            if name == seconds and not _STAMP.fullmatch(cell):
                return (
                    f"{path}, row {line}, column {name} holds {plain(cell)}; it must be seconds since 1970 with "
                    f"nine decimals at most. Put the cell right."
                )
    return None


def _nanoseconds(path: Path, name: str, column: pa.ChunkedArray) -> Int64s:
    """Return decimal seconds as whole nanoseconds, int64 (time,). Raises `TacpipeError` for those that are none."""
    chunk = column.combine_chunks()
    t_ns, fits = stamps.last_digits(chunk)
    bad = ~fits | (t_ns < 0)
    if bad.any():
        index = int(bad.argmax())
        raise TacpipeError(
            f"{path}, row {file_row(path, index)}, column {name} holds {chunk[index].as_py():f}; it must be seconds since "
            f"1970, which end in 2262 in nanoseconds. Put the cell right."
        )
    return t_ns


def _check_values(path: Path, name: str, array: Floats, integers: pa.DataType | None, nan: bool) -> None:
    """Raise for the first value of a column that is not allowed."""
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
            f"{path}, row {file_row(path, index)}, column {name} holds {array[index]:.12g}; it must be {expected}."
        )
