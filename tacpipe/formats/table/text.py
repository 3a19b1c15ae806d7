"""Read text tables (CSV, TSV and others) in blocks as numbers of declared types, and sheets of Excel workbooks (.xlsx).

Text may be compressed with gzip and have any encoding. pyarrow parses block by block on all cores; if it rejects a
block, Python reads the file again to find the line and the cell. Lines are counted from 1, as in an editor.
"""

from __future__ import annotations

import codecs
import contextlib
import csv
import gzip
import io
import itertools
import re
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, cast

import pyarrow as pa
import pyarrow.csv as pc

from tacpipe.errors import TacpipeError
from tacpipe.formats.faults import explaining
from tacpipe.formats.table import stamps
from tacpipe.formats.table.columns import RowFile
from tacpipe.formats.table.layout import GZIP, StreamLayout
from tacpipe.io import regular
from tacpipe.io.parquet import owned
from tacpipe.plugins import extras
from tacpipe.printable import excerpt, listed, plain

RECODED_BYTES = 1 << 20  # number of bytes decoded at once


@contextlib.contextmanager
def open_text(path: Path, encoding: str = "utf-8") -> Iterator[IO[bytes]]:
    """Open a file for reading as UTF-8, unpacked if its name ends with .gz, and converted from ``encoding``.

    Raises `TacpipeError` if the file cannot be read.
    """
    with (
        regular.failing(path),
        regular.opened(path) as raw,
        explaining((gzip.BadGzipFile, EOFError), f"{path} is not a whole gzip file: ", ". Copy it again."),
        explaining(UnicodeDecodeError, f"{path} is not text in {encoding}: ", ". Correct encoding."),
        contextlib.ExitStack() as stack,
    ):
        file = cast("IO[bytes]", raw)
        if path.suffix.lower() == GZIP:
            file = cast("IO[bytes]", stack.enter_context(gzip.GzipFile(fileobj=raw)))
        yield file if is_utf8(encoding) else io.BufferedReader(_Recoded(file, encoding), RECODED_BYTES)


def is_utf8(encoding: str) -> bool:
    """Return whether text in an encoding needs no conversion to UTF-8.

    >>> is_utf8("UTF8"), is_utf8("cp1252")
    (True, False)
    """
    return codecs.lookup(encoding).name == "utf-8"


class _Recoded(io.RawIOBase):
    """The text of a file as bytes in UTF-8."""

    def __init__(self, file: IO[bytes], encoding: str) -> None:
        self._file, self._decoder = file, codecs.getincrementaldecoder(encoding)()
        self._waiting = b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        """Read converted text into ``buffer`` and return the number of bytes."""
        while not self._waiting:
            block = self._file.read(RECODED_BYTES)
            self._waiting = self._decoder.decode(block, final=not block).removeprefix("\ufeff").encode()
            if not block:
                break
        count = min(len(buffer), len(self._waiting))
        buffer[:count] = self._waiting[:count]
        self._waiting = self._waiting[count:]
        return count


BLOCK_BYTES = 1 << 24  # smaller than the blocks that the C library returns to the system after each use
BOM = b"\xef\xbb\xbf"  # byte order mark that some editors write at the start
TAIL_BYTES = 1 << 16  # number of bytes examined at the end of a file
MIN_LINES = 5  # minimum number of lines for comparing the last cell
MAX_LINE_BYTES = 1 << 24  # a file with longer lines is not a text table
_NOT_BLANK = re.compile(rb"\S")


def whole_lines(
    file: IO[bytes], block_bytes: int, max_bytes: int, too_long: TacpipeError
) -> Iterator[tuple[bytes | memoryview, ...]]:
    """Yield the content of a file in blocks of whole lines, each as pieces; a block of blank lines is left out.

    Raises ``too_long`` for a line of more than ``max_bytes`` that does not end in a block.
    """
    remainder = b""
    while new := file.read(block_bytes):
        end = new.rfind(b"\n") + 1
        pieces = remainder, memoryview(new)[:end]
        if end and any(_NOT_BLANK.search(piece) for piece in pieces):
            yield pieces
        remainder = new[end:] if end else remainder + new
        if len(remainder) > max_bytes:
            raise too_long
    if _NOT_BLANK.search(remainder):
        yield (remainder,)


@dataclass(frozen=True)
class TextTable(RowFile):
    """A text file of cells, as described by a stream of the layout."""

    path: Path
    stream: StreamLayout

    def names(self) -> list[str]:
        """Return the column names: those declared for the stream, else of the header, else column1, column2, ….

        Raises `TacpipeError` for a file without rows, and for a header with repeated or undecodable names.
        """
        for line, cells in self.rows():
            if self.stream.names:
                self._expect_width(line, cells)
                return list(self.stream.names)
            if not self.stream.header:
                return [f"column{number}" for number in range(1, len(cells) + 1)]
            names = [cell.strip() for cell in cells]
            if any("\ufffd" in name for name in names):
                raise TacpipeError(
                    f"{self.path}, line {line}: the header is not {self.stream.encoding}. Set encoding in "
                    f'[streams.{self.stream.name}], as encoding = "cp1252".'
                )
            repeated = sorted(name for name, count in Counter(names).items() if count > 1)
            if repeated:
                raise TacpipeError(
                    f"{self.path}: the header has more than one column {listed(repeated, 4)}. Rename one, or set "
                    f"header = false and skip_lines = 1, after which columns are named column1, column2 and so on."
                )
            return names
        raise TacpipeError(f"{self.path} has no row. Remove it, or record it again.")

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield the columns in ``types`` block by block. Raises `TacpipeError` with the line of an invalid row."""
        names = self.names()
        parse_options = pc.ParseOptions(delimiter=self.stream.separator_of(self.path))
        read_options = pc.ReadOptions(column_names=names, use_threads=True)
        rounded_types = {name: pa.float64() for name, kind in types.items() if pa.types.is_decimal(kind)}

        def parse_block(block: Sequence[bytes | memoryview], kinds: Mapping[str, pa.DataType]) -> pa.Table:
            return pc.read_csv(pa.BufferReader(owned(*block)), read_options, parse_options, self._conversion(kinds))

        for block in self._blocks():
            try:
                table = parse_block(block, types)
                if rounded_types and any(
                    stamps.overflows(column).any() for column in parse_block(block, rounded_types).columns
                ):
                    raise pa.ArrowInvalid("A number is too large")
            except (pa.ArrowInvalid, UnicodeDecodeError) as error:
                fault = self._describe_first_fault(names, types)
                raise TacpipeError(fault or f"{self.path} cannot be read: {plain(str(error), 200)}.") from error
            yield table

    def _conversion(self, types: Mapping[str, pa.DataType]) -> pc.ConvertOptions:
        """Return Arrow's options for reading the columns in ``types``."""
        return pc.ConvertOptions(
            column_types=dict(types),
            include_columns=list(types),
            null_values=list(self.stream.missing),
            strings_can_be_null=True,
            decimal_point=self.stream.decimal,
        )

    def _expect_width(self, line: int, cells: Sequence[str]) -> None:
        """Raise `TacpipeError` if the number of cells in a row differs from the number of column names in the layout."""
        if len(cells) != len(self.stream.names):
            raise TacpipeError(
                f"{self.path}, line {line} has {len(cells)} cells, and header in [streams.{self.stream.name}] names "
                f"{len(self.stream.names)} columns. Correct header."
            )

    def place(self, index: int) -> str:
        """Return the line of the data row ``index`` (from 0), for errors.

        Raises `IndexError` if there is no such row.
        """
        for position, (line, _) in enumerate(self.rows()):
            if position == index + self.stream.header:
                return f"line {line}"
        raise IndexError(f"{self.path} has no row {index}.")

    def _blocks(self) -> Iterator[tuple[bytes | memoryview, ...]]:
        """Yield the bytes below the header in whole lines without comments, each as several pieces.

        Raises `TacpipeError` if a line is too long.
        """
        comment = self.stream.comment.encode()
        comment_lines = (
            re.compile(rb"^[ \t]*" + re.escape(comment) + rb".*(?:\n|\Z)", re.MULTILINE) if comment else None
        )
        with open_text(self.path, self.stream.encoding) as file:
            self._skip_header(file)
            for pieces in whole_lines(file, BLOCK_BYTES, MAX_LINE_BYTES, self._endless_line()):
                retained = pieces if comment_lines is None else (comment_lines.sub(b"", b"".join(pieces)),)
                if comment_lines is None or _NOT_BLANK.search(retained[0]):
                    yield retained

    def _skip_header(self, file: IO[bytes]) -> None:
        """Skip the lines up to the first one below the header."""
        if not (self.stream.header or self.stream.skip_lines):
            if is_utf8(self.stream.encoding) and file.read(len(BOM)) != BOM:
                file.seek(0)
            return
        comment, header = self.stream.comment.encode(), self.stream.header
        for number in itertools.count():
            if number >= self.stream.skip_lines and not header:
                return
            line = file.readline(MAX_LINE_BYTES)
            if not line:
                return
            text = (line.removeprefix(BOM) if not number else line).strip()
            is_comment = bool(comment) and text.startswith(comment)
            header &= number < self.stream.skip_lines or not text or is_comment

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield number and cells of each non-empty line, including the header.

        Raises `TacpipeError` if the file is not valid text.
        """
        comment = self.stream.comment
        separator = self.stream.separator_of(self.path)
        damaged = explaining(csv.Error, f"{self.path} cannot be read: ", ". Copy it again.")
        with open_text(self.path, self.stream.encoding) as file, damaged:
            for number, line in enumerate(iter(partial(file.readline, MAX_LINE_BYTES + 1), b""), 1):
                if len(line) > MAX_LINE_BYTES:
                    raise self._endless_line()
                text = line.removeprefix(BOM if number == 1 else b"").decode(errors="replace").strip("\r\n")
                if number <= self.stream.skip_lines or not text.strip():
                    continue
                if comment and text.lstrip(" \t").startswith(comment):
                    continue
                try:
                    yield number, next(csv.reader([text], delimiter=separator))
                except csv.Error as error:
                    if "\r" not in text:
                        raise
                    raise TacpipeError(
                        f"{self.path}, line {number}: lines end with a carriage return alone. Convert the file: "
                        f"`tr '\\r' '\\n' < {self.path.name} > NEW`."
                    ) from error

    def describe_cut(self) -> list[str]:
        """Return a note if the file ends within a line whose last cell is shorter than the others of its column."""
        with open_text(self.path, self.stream.encoding) as file:
            if isinstance(file, io.BufferedReader) and file.seekable():
                file.seek(max(0, file.seek(0, io.SEEK_END) - TAIL_BYTES))
            tail = b""
            while block := file.read(BLOCK_BYTES):
                tail = (tail + block)[-TAIL_BYTES:]
        if not tail or tail.endswith((b"\n", b"\r")):
            return []
        separator = self.stream.separator_of(self.path).encode()
        lines = [line for line in tail.splitlines()[1:] if line.strip()]
        lengths = [len(line.rpartition(separator)[2].strip()) for line in lines]
        if len(lengths) < MIN_LINES or lengths[-1] >= min(lengths[:-1]):
            return []
        cell = excerpt(lines[-1].rpartition(separator)[2].decode(errors="replace"))
        place = f"{self.path}: the last line has no end, and its last cell {cell}"
        return [f"{place} is shorter than those above it. If the file was cut, copy it again or remove the line."]

    def _endless_line(self) -> TacpipeError:
        return TacpipeError(f"{self.path} has a line of over {MAX_LINE_BYTES} bytes; it is not a text table.")

    def _describe_first_fault(self, names: Sequence[str], types: Mapping[str, pa.DataType]) -> str | None:
        """Return a sentence about the first row that does not match the declaration, or None."""
        rows = self.rows()
        if self.stream.header:
            next(rows)
        checked_columns = [(index, name, types[name]) for index, name in enumerate(names) if name in types]
        for line, cells in rows:
            if len(cells) != len(names):
                cause = "it was cut short" if len(cells) < len(names) else "a cell or a separator is too much"
                wide = f"{self.path}, line {line} has {len(cells)} cells instead of {len(names)}; {cause}."
                return f"{wide} Correct the line, or copy the file again."
            for index, name, kind in checked_columns:
                if not self._is_allowed(cells[index], kind):
                    place = f"{self.path}, line {line}, column {plain(name)}"
                    sentence = f"{place} holds {excerpt(cells[index])}, which is not {describe_type(kind)}."
                    return f"{sentence} {self.remedy(kind)}"
        return None

    def remedy(self, kind: pa.DataType) -> str:
        """Return what to do about a cell that does not match its type ``kind``."""
        return "Correct the cell, or declare it in missing."

    def _is_allowed(self, cell: str, kind: pa.DataType) -> bool:
        """Return whether a cell can be read as a value of this type, or means a missing value."""
        if cell in self.stream.missing:
            return True

        def parse_as(kind: pa.DataType) -> pa.ChunkedArray:
            text = pa.BufferReader(owned(f'"{cell}"\n'.encode()))
            read_options = pc.ReadOptions(column_names=["x"], use_threads=False)
            options = pc.ConvertOptions(column_types={"x": kind}, null_values=[], decimal_point=self.stream.decimal)
            return pc.read_csv(text, read_options, convert_options=options)["x"]

        try:
            parse_as(kind)
            return not (pa.types.is_decimal(kind) and stamps.overflows(parse_as(pa.float64())).any())
        except (pa.ArrowInvalid, UnicodeDecodeError):
            return False


def describe_type(kind: pa.DataType) -> str:
    """Return a phrase for the cells of a type, as in "which is not …".

    >>> describe_type(pa.uint16()), describe_type(pa.float64())
    ('a whole number from 0 to 65535', 'a number')
    """
    if pa.types.is_integer(kind):
        bits, signed = kind.bit_width, pa.types.is_signed_integer(kind)
        lowest, highest = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
        return f"a whole number from {lowest} to {highest}"
    if pa.types.is_boolean(kind):
        return "true or false"
    if pa.types.is_decimal(kind):
        return f"a number that is {stamps.IN_RANGE}"
    return "text in UTF-8" if pa.types.is_string(kind) else "a number"


BLOCK_ROWS = 1 << 14
CELL_TYPES = {"n", "s", "b", "d", "e", "str", "inlineStr"}  # ISO/IEC 29500, ST_CellType


@dataclass(frozen=True)
class Workbook(RowFile):
    """One sheet of a workbook, as described by a stream of the layout."""

    path: Path
    stream: StreamLayout

    def names(self) -> list[str]:
        """Return the names of the columns: those of the header or the layout, or column1, column2, ….

        Raises `TacpipeError` if a name is repeated or there is no row.
        """
        with self._open_rows() as rows:
            first = next(rows, None)
            if first is None:
                raise TacpipeError(f"{self.path} has no row. Remove it, or record it again.")
            cells = [first[1].get(column) for column in range(1, max(first[1]) + 1)]
        if self.stream.names:
            return list(self.stream.names)
        if not self.stream.header:
            return [f"column{number}" for number in range(1, len(cells) + 1)]
        names = [f"column{number}" if cell is None else str(cell).strip() for number, cell in enumerate(cells, 1)]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise TacpipeError(f"{self.path}: the header has more than one column {listed(repeated, 4)}. Rename one.")
        return names

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield the columns in ``types`` in blocks of rows. Raises `TacpipeError` for an invalid cell."""
        names = self.names()
        with self._open_rows() as rows:
            if self.stream.header:
                next(rows, None)
            while block := list(itertools.islice(rows, BLOCK_ROWS)):
                yield pa.table(
                    {name: self._column(name, kind, block, names.index(name) + 1) for name, kind in types.items()}
                )

    def place(self, index: int) -> str:
        """Return the sheet's row of the data row ``index`` (from 0), for error messages."""
        with self._open_rows() as rows:
            numbers = (number for number, _ in rows)
            return f"row {next(itertools.islice(numbers, index + self.stream.header, None))}"

    def _column(
        self, name: str, kind: pa.DataType, block: list[tuple[int, dict[int, Any]]], column_number: int
    ) -> pa.Array:
        """Return the cells of a column: strings and booleans as ``kind``, numbers as floats, timestamps as in the sheet.

        Raises `TacpipeError` for the first cell of another type.
        """
        missing = ("", *self.stream.missing)
        cells = [row_cells.get(column_number) for _, row_cells in block]
        cells = [None if isinstance(cell, str) and cell in missing else cell for cell in cells]
        if pa.types.is_string(kind) and any(isinstance(cell, str) for cell in cells):
            return pa.array([cell if cell is None else str(cell) for cell in cells], kind)
        try:
            is_number = pa.types.is_integer(kind) or pa.types.is_floating(kind)
            boolean = kind if pa.types.is_boolean(kind) else None
            return pa.array(cells, pa.float64() if is_number else boolean)
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
    def _open_rows(self) -> Iterator[Iterator[tuple[int, dict[int, Any]]]]:
        """Open the workbook in the block, and yield each nonempty row below the lines to skip: its number, and its cells.

        Cells are by the number of their column. Raises `TacpipeError` if the file is not a workbook or lacks the sheet.
        """
        with extras.explain_missing("Reading .xlsx"):
            import openpyxl
        damage = zipfile.BadZipFile, LookupError, ValueError, openpyxl.utils.exceptions.InvalidFileException
        damaged = explaining(damage, f"{self.path} is not an Excel workbook: ", ". Copy it again.")
        with damaged, regular.failing(self.path), regular.opened(self.path) as file:
            book = openpyxl.load_workbook(file, read_only=True, data_only=True)
            sheet = self.stream.sheet or book.sheetnames[0]
            if sheet not in book.sheetnames:
                raise TacpipeError(
                    f"{self.path} has no sheet {plain(sheet)}; it has {listed(book.sheetnames, 6)}. Correct sheet in "
                    f"[streams.{self.stream.name}]."
                )
            yield (
                (number, cells)
                for number, cells in self._numbered_rows(book[sheet])
                if number > self.stream.skip_lines and cells
            )

    def _numbered_rows(self, sheet: Any) -> Iterator[tuple[int, dict[int, Any]]]:
        """Yield number and cells of each row of a sheet, as `_open_rows` does.

        openpyxl leaves out rows and cells whose numbers do not increase or are outside of the range that the sheet
        states, and fills in those that are skipped. Raises `TacpipeError` for such numbers, and `IndexError` for a
        wrong number of a text.
        """
        from openpyxl.worksheet._reader import WorkSheetParser

        book = sheet.parent
        previous = 0
        with sheet._get_source() as source:
            parser = WorkSheetParser(
                source,
                _SharedTexts(sheet._shared_strings),
                data_only=True,
                epoch=book.epoch,
                date_formats=book._date_formats,
                timedelta_formats=book._timedelta_formats,
            )
            for number, row in parser.parse():
                cells = {cell["column"]: cell["value"] for cell in row}
                if unknown := {cell["data_type"] for cell in row} - CELL_TYPES:
                    raise TacpipeError(
                        f"{self.path}, row {number} has a cell of the unknown type {excerpt(min(unknown))}. Copy it again."
                    )
                if len(cells) < len(row) or {cell["row"] for cell in row} - {number} or number <= previous:
                    raise TacpipeError(
                        f"{self.path}: row {number} follows row {previous}, has a cell of another row, or has two of one "
                        f"column. Open the workbook in a spreadsheet program and save it again."
                    )
                previous = number
                yield number, {column: value for column, value in cells.items() if value is not None}


class _SharedTexts(list[str]):
    """The texts of a workbook by number, from 0."""

    def __getitem__(self, index: Any) -> Any:
        if index < 0:
            raise IndexError(f"there is no text {index}")
        return super().__getitem__(index)
