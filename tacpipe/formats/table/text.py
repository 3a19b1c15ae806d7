"""Text tables: CSV, TSV and their like, read in blocks as numbers of declared types.

pyarrow parses block by block, with all cores; where it refuses a block, the file is gone through once more in Python to
name the line and the cell. Lines are counted from 1, as an editor shows them.
"""

from __future__ import annotations

import csv
import itertools
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

import pyarrow as pa
import pyarrow.csv as pc

from tacpipe.errors import TacpipeError
from tacpipe.formats.table import compressed, stamps
from tacpipe.formats.table.layout import Stream
from tacpipe.io.parquet import owned
from tacpipe.printable import excerpt, listed, plain

BLOCK_BYTES = 1 << 24  # below what the C library gives back to the system each time
BOM = b"\xef\xbb\xbf"  # before the text of some editors
LONGEST_LINE = 1 << 24  # bytes; a file without line ends is none
_BEGUN = re.compile(rb"\S")


@dataclass(frozen=True)
class TextTable:
    """A text file of cells, as the layout's stream describes it."""

    path: Path
    stream: Stream

    def names(self) -> list[str]:
        """Return the names of the columns: those of the header, or column1, column2, ….

        Raises `TacpipeError` for a file without a row, and for a name that comes twice.
        """
        for line, cells in self._rows():
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
            doubled = sorted(name for name, count in Counter(names).items() if count > 1)
            if doubled:
                raise TacpipeError(
                    f"{self.path}: the header has more than one column {listed(doubled, 4)}. Rename one, or set "
                    f"header = false and skip_lines = 1, after which columns are named column1, column2 and so on."
                )
            return names
        raise TacpipeError(f"{self.path} has no row. Take it away, or record it again.")

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield the columns that ``types`` names, block by block. Raises `TacpipeError`, with the line, for a wrong row."""
        names = self.names()
        parse = pc.ParseOptions(delimiter=self.stream.separator_of(self.path))
        read = pc.ReadOptions(column_names=names, use_threads=True)
        rounded_types = {name: pa.float64() for name, kind in types.items() if pa.types.is_decimal(kind)}

        def parsed(block: Sequence[bytes | memoryview], kinds: Mapping[str, pa.DataType]) -> pa.Table:
            return pc.read_csv(pa.BufferReader(owned(*block)), read, parse, self._conversion(kinds))

        for block in self._blocks():
            try:
                table = parsed(block, types)
                if rounded_types and any(
                    stamps.overflows(column).any() for column in parsed(block, rounded_types).columns
                ):
                    raise pa.ArrowInvalid("A number is too large")
            except (pa.ArrowInvalid, UnicodeDecodeError) as error:
                fault = self._fault(names, types)
                raise TacpipeError(fault or f"{self.path} cannot be read: {plain(str(error), 200)}.") from error
            yield table

    def _conversion(self, types: Mapping[str, pa.DataType]) -> pc.ConvertOptions:
        """Return how Arrow reads the columns that ``types`` names."""
        return pc.ConvertOptions(
            column_types=dict(types),
            include_columns=list(types),
            null_values=list(self.stream.missing),
            strings_can_be_null=True,
            decimal_point=self.stream.decimal,
        )

    def _expect_width(self, line: int, cells: Sequence[str]) -> None:
        """Raise `TacpipeError` where a row has another number of cells than the layout names columns."""
        if len(cells) != len(self.stream.names):
            raise TacpipeError(
                f"{self.path}, line {line} has {len(cells)} cells, and header in [streams.{self.stream.name}] names "
                f"{len(self.stream.names)} columns. Correct header."
            )

    def place(self, index: int) -> str:
        """Return the line that holds the data row ``index`` (from 0), as errors name it."""
        for position, (line, _) in enumerate(self._rows()):
            if position == index + self.stream.header:
                return f"line {line}"
        raise IndexError(f"{self.path} has no row {index}.")

    def _blocks(self) -> Iterator[tuple[bytes | memoryview, ...]]:
        """Yield the bytes below the header, whole lines at a time, without comments; each in pieces."""
        comment = self.stream.comment.encode()
        drop = re.compile(rb"^[ \t]*" + re.escape(comment) + rb".*(?:\n|\Z)", re.MULTILINE) if comment else None
        with compressed.opened(self.path, self.stream.encoding) as file:
            self._skip_header(file)
            rest = b""
            while new := file.read(BLOCK_BYTES):
                end = new.rfind(b"\n") + 1
                if end:
                    yield from self._without(drop, rest, memoryview(new)[:end])
                rest = new[end:] if end else rest + new
                if len(rest) > LONGEST_LINE:
                    raise self._endless()
            yield from self._without(drop, rest)

    def _without(
        self, drop: re.Pattern[bytes] | None, *pieces: bytes | memoryview
    ) -> Iterator[tuple[bytes | memoryview, ...]]:
        """Yield pieces that end with a line without what matches ``drop``; nothing where no line holds anything."""
        if drop is not None:
            pieces = (drop.sub(b"", b"".join(pieces)),)
        if any(_BEGUN.search(piece) for piece in pieces):
            yield pieces

    def _skip_header(self, file: IO[bytes]) -> None:
        """Read up to the first line below the header."""
        if not (self.stream.header or self.stream.skip_lines):
            if compressed.is_utf8(self.stream.encoding) and file.read(len(BOM)) != BOM:
                file.seek(0)
            return
        comment, header = self.stream.comment.encode(), self.stream.header
        for number in itertools.count():
            if number >= self.stream.skip_lines and not header:
                return
            line = file.readline(LONGEST_LINE)
            if not line:
                return
            text = (line.removeprefix(BOM) if not number else line).strip()
            commented = bool(comment) and text.startswith(comment)
            header &= number < self.stream.skip_lines or not text or commented

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the number and the cells of each line that holds some, the header among them."""
        comment = self.stream.comment
        separator = self.stream.separator_of(self.path)
        with compressed.opened(self.path, self.stream.encoding) as file:
            try:
                for number, line in enumerate(iter(partial(file.readline, LONGEST_LINE + 1), b""), 1):
                    if len(line) > LONGEST_LINE:
                        raise self._endless()
                    text = line.removeprefix(BOM if number == 1 else b"").decode(errors="replace").strip("\r\n")
                    if number <= self.stream.skip_lines or not text.strip():
                        continue
                    if comment and text.lstrip(" \t").startswith(comment):
                        continue
                    yield number, next(csv.reader([text], delimiter=separator))
            except csv.Error as error:
                raise TacpipeError(f"{self.path} cannot be read: {plain(str(error), 200)}. Copy it again.") from error

    def _endless(self) -> TacpipeError:
        return TacpipeError(f"{self.path} has a line of over {LONGEST_LINE} bytes; it is not a text table.")

    def _fault(self, names: Sequence[str], types: Mapping[str, pa.DataType]) -> str | None:
        """Return a sentence about the first row that is not as declared, or None."""
        rows = self._rows()
        if self.stream.header:
            next(rows)
        wanted = [(index, name, types[name]) for index, name in enumerate(names) if name in types]
        for line, cells in rows:
            if len(cells) != len(names):
                cause = "it was cut short" if len(cells) < len(names) else "a cell or a separator is too much"
                wide = f"{self.path}, line {line} has {len(cells)} cells instead of {len(names)}; {cause}."
                return f"{wide} Correct the line, or copy the file again."
            for index, name, kind in wanted:
                if not self._allowed(cells[index], kind):
                    place = f"{self.path}, line {line}, column {plain(name)}"
                    found = f"{place} holds {excerpt(cells[index])}, which is not {described(kind)}."
                    return f"{found} Correct the cell, or declare it in missing."
        return None

    def _allowed(self, cell: str, kind: pa.DataType) -> bool:
        if cell in self.stream.missing:
            return True

        def parse(kind: pa.DataType) -> pa.ChunkedArray:
            text = pa.BufferReader(owned(f'"{cell}"\n'.encode()))
            read = pc.ReadOptions(column_names=["x"], use_threads=False)
            options = pc.ConvertOptions(column_types={"x": kind}, null_values=[], decimal_point=self.stream.decimal)
            return pc.read_csv(text, read, convert_options=options)["x"]

        try:
            parse(kind)
            return not (pa.types.is_decimal(kind) and stamps.overflows(parse(pa.float64())).any())
        except (pa.ArrowInvalid, UnicodeDecodeError):
            return False


def described(kind: pa.DataType) -> str:
    """Return what a cell of a type is, as in "which is not …".

    >>> described(pa.uint16()), described(pa.float64())
    ('a whole number from 0 to 65535', 'a number')
    """
    if pa.types.is_integer(kind):
        bits, signed = kind.bit_width, pa.types.is_signed_integer(kind)
        least, most = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
        return f"a whole number from {least} to {most}"
    if pa.types.is_boolean(kind):
        return "true or false"
    if pa.types.is_decimal(kind):
        return f"a number that is {stamps.IN_RANGE}"
    return "text in UTF-8" if pa.types.is_string(kind) else "a number"
