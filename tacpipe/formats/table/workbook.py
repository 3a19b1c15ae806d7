"""Sheets of Excel workbooks (.xlsx), row by row."""

from __future__ import annotations

import contextlib
import itertools
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from tacpipe.errors import TacpipeError
from tacpipe.formats.table.layout import StreamLayout
from tacpipe.formats.table.text import describe_type
from tacpipe.io import regular
from tacpipe.plugins import extras
from tacpipe.printable import excerpt, listed, plain

BLOCK_ROWS = 1 << 14


@dataclass(frozen=True)
class Workbook:
    """One sheet of a workbook, as the layout's stream describes it."""

    path: Path
    stream: StreamLayout

    def names(self) -> list[str]:
        """Return the names of the columns: those of the header or the layout, or column1, column2, …."""
        with self._rows() as rows:
            first = next(rows, None)
            if first is None:
                raise TacpipeError(f"{self.path} has no row. Take it away, or record it again.")
            cells = list(first[1])
            while cells and cells[-1] is None:
                cells.pop()
        if self.stream.names:
            return list(self.stream.names)
        if not self.stream.header:
            return [f"column{number}" for number in range(1, len(cells) + 1)]
        names = [str(cell).strip() if cell is not None else f"column{n}" for n, cell in enumerate(cells, 1)]
        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise TacpipeError(f"{self.path}: the header has more than one column {listed(doubled, 4)}. Rename one.")
        return names

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield the columns that ``types`` names, some rows at a time. Raises `TacpipeError` for a wrong cell."""
        names = self.names()
        with self._rows() as rows:
            if self.stream.header:
                next(rows, None)
            while block := list(itertools.islice(rows, BLOCK_ROWS)):
                yield pa.table(
                    {name: self._column(name, kind, block, names.index(name)) for name, kind in types.items()}
                )

    def place(self, index: int) -> str:
        """Return the row that holds the data row ``index`` (from 0), as errors name it."""
        with self._rows() as rows:
            numbers = (number for number, _ in rows)
            return f"row {next(itertools.islice(numbers, index + self.stream.header, None))}"

    def _column(self, name: str, kind: pa.DataType, block: list[tuple[int, tuple[Any, ...]]], place: int) -> pa.Array:
        """Return the cells of a column; those of stamps have the type that the sheet gives them."""
        cells = [cells[place] if place < len(cells) else None for _, cells in block]
        cells = [None if isinstance(cell, str) and cell in ("", *self.stream.missing) else cell for cell in cells]
        if pa.types.is_string(kind) and any(isinstance(cell, str) for cell in cells):
            return pa.array([cell if cell is None else str(cell) for cell in cells], kind)
        try:
            is_number = pa.types.is_integer(kind) or pa.types.is_floating(kind)
            return pa.array(cells, pa.float64() if is_number else kind if pa.types.is_boolean(kind) else None)
        except (pa.ArrowInvalid, pa.ArrowTypeError):
            row, cell = next(
                (row, cell)
                for (row, _), cell in zip(block, cells, strict=True)
                if not isinstance(cell, int | float | None)
            )
            raise TacpipeError(
                f"{self.path}, row {row}, column {plain(name)} holds {excerpt(cell)}, which is not {describe_type(kind)}. "
                f"Correct the cell, or declare it in missing."
            ) from None

    @contextlib.contextmanager
    def _rows(self) -> Iterator[Iterator[tuple[int, tuple[Any, ...]]]]:
        """Yield the number and the cells of each row that holds some, below the lines to skip."""
        with extras.named("Reading .xlsx"):
            import openpyxl
        try:
            with regular.failing(self.path), regular.opened(self.path) as file:
                book = openpyxl.load_workbook(file, read_only=True, data_only=True)
                sheet = self.stream.sheet or book.sheetnames[0]
                if sheet not in book.sheetnames:
                    raise TacpipeError(
                        f"{self.path} has no sheet {plain(sheet)}; it has {listed(book.sheetnames, 6)}. Correct sheet in "
                        f"[streams.{self.stream.name}]."
                    )
                rows = enumerate(book[sheet].iter_rows(values_only=True), 1)
                yield (
                    (number, cells)
                    for number, cells in rows
                    if number > self.stream.skip_lines and any(cell is not None for cell in cells)
                )
        except (zipfile.BadZipFile, KeyError, ValueError, openpyxl.utils.exceptions.InvalidFileException) as error:
            raise TacpipeError(
                f"{self.path} is not an Excel workbook: {plain(str(error), 200)}. Copy it again."
            ) from error
