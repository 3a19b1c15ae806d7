"""Read the first rows of a file, for a guessed layout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from tacpipe.channels import vocabulary
from tacpipe.formats.table import binary, column_names, dialect
from tacpipe.formats.table.binary import ArrayMember
from tacpipe.formats.table.dialect import LINES, Dialect
from tacpipe.formats.table.layout import EXTENSIONS, Stream, extension
from tacpipe.formats.table.workbook import Workbook


@dataclass(frozen=True)
class FileSample:
    """The columns and first rows of a file."""

    names: tuple[str, ...]
    values: Mapping[str, tuple[Any, ...]]  # the first rows by column
    text: Dialect | None = None  # None: not a text file
    encoding: str = "utf-8"
    arrays: Mapping[str, ArrayMember] = field(default_factory=dict)  # files of arrays only
    units: Mapping[str, str] = field(default_factory=dict)  # units by column, as a row below the header states them

    @property
    def row_count(self) -> int | None:
        """Return the number of rows of the arrays, None for other files."""
        return next((array.rows for array in self.arrays.values()), None)

    def stated_unit(self, column: str) -> str:
        """Return the unit that the header or the row below it states for a column, '' where neither does."""
        match = column_names.UNIT_IN_NAME.fullmatch(column.strip())
        text = self.units.get(column, "") or (match["unit"] if match and match["base"] else "")
        return vocabulary.unit_from_text(text.strip().strip("[]()"))

    def only(self, arrays: Sequence[str]) -> FileSample:
        """Return the sample of some of the file's arrays."""
        names = [name for name in self.names if any(belongs_to(name, array) for array in arrays)]
        values = {name: self.values[name] for name in names}
        return replace(self, names=tuple(names), values=values, arrays={name: self.arrays[name] for name in arrays})


def read(path: Path) -> FileSample:
    """Return the columns and first rows of a file. Raises `TacpipeError` where it cannot be read."""
    kind = EXTENSIONS[extension(path)]
    if kind == "csv":
        encoding = dialect.encoding(path)
        text = dialect.of(dialect.first_lines(path, encoding))
        columns = list(zip(*text.rows, strict=True)) or [()] * len(text.names)
        values = {
            name: tuple(_cell_value(cell, text) for cell in cells)
            for name, cells in zip(text.names, columns, strict=True)
        }
        return FileSample(text.names, values, text, encoding, units=dict(zip(text.names, text.units, strict=False)))
    if kind == "xlsx":
        return _first_rows(Workbook(path, Stream("table", format="xlsx")))
    file = binary.opened(path, kind)
    if isinstance(file, binary.NumpyArchive):
        file = replace(file, time_axis=_time_axis(file.arrays()))
        return replace(_first_rows(file), arrays=file.arrays())
    return _first_rows(file)


def _first_rows(file: binary.ParquetFile | binary.NumpyArchive | binary.JsonLines | Workbook) -> FileSample:
    """Return the columns and first rows of a file that is not text."""
    names = file.names()
    if isinstance(file, binary.JsonLines):
        columns = {name: file.head().column(name) for name in file.head().column_names}
    elif isinstance(file, binary.NumpyArchive):  # its arrays may differ in length
        columns = {name: next(iter(file.batches({name: pa.null()}))).column(name) for name in names}
    else:
        block = next(iter(file.batches(dict.fromkeys(names, pa.string()))), pa.table({}))
        columns = {name: block.column(name) for name in block.column_names}
    return FileSample(
        tuple(columns), {name: tuple(column.slice(0, LINES).to_pylist()) for name, column in columns.items()}
    )


def _time_axis(arrays: Mapping[str, ArrayMember]) -> int:
    """Return the dimension along which the rows of arrays follow one another.

    It is the first, unless the only array has another one that is so much longer that the first is a part of the sensor.
    """
    shape = next(iter(arrays.values())).shape if len(arrays) == 1 else ()
    longest = shape.index(max(shape)) if shape else 0
    return longest if shape and len(shape) > 1 and shape[0] < 100 and shape[longest] >= 4 * shape[0] else 0


def belongs_to(column: str, array: str) -> bool:
    """Return whether a column is one of an array's."""
    return column == array or (column.startswith(f"{array}_") and column[len(array) + 1 :].isdigit())


def _cell_value(cell: str, text: Dialect) -> float | str | None:
    number = text.number(cell)
    return number if number is not None else (None if cell in dialect.MISSING else cell)
