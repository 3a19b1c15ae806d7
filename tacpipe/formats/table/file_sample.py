"""Read the first rows of a file, for a guessed layout, and detect how a text file is written."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa

from tacpipe.channels import vocabulary
from tacpipe.formats.table import binary, column_names, text
from tacpipe.formats.table.binary import ArrayMember
from tacpipe.formats.table.layout import EXTENSIONS, StreamLayout, extension
from tacpipe.formats.table.workbook import Workbook

SAMPLE_LINES = 200  # lines sampled per file
HEAD_BYTES = 1 << 20  # bytes sampled per file, at most
SEPARATORS = (",", ";", "\t", "|", " ")
COMMENTS = ("#", "%", "//")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_WHOLE = re.compile(r"[-+]?\d{1,18}")
_COMMA_NUMBER = re.compile(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?")
MISSING = ("", "NA", "N/A", "nan", "NaN", "null", "None", "-")


@dataclass(frozen=True)
class Dialect:
    """Separator, decimal sign, comments and header of a text file, with the cells of the sampled lines."""

    separator: str
    decimal: Literal[".", ","]
    comment: str
    skip_lines: int
    header: bool
    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...] = field(repr=False)  # below the header
    missing: tuple[str, ...] = ()  # cells of MISSING that are there
    units: tuple[str, ...] = ()  # units of the columns, if the row below the header holds them

    def number(self, cell: str) -> float | None:
        """Return the number that a cell holds, an int where it is written as one, None where it holds none.

        >>> detect_dialect(["a;b", "1,5;x"]).number("1,5"), detect_dialect(["1,2.0"]).number("2.0")
        (1.5, 2.0)
        """
        text = cell.strip()
        if _WHOLE.fullmatch(text):
            return int(text)
        if self.decimal == ",":
            return float(text.replace(",", ".")) if _COMMA_NUMBER.fullmatch(text) else None
        return float(text) if _NUMBER.fullmatch(text) else None


def detect_encoding(path: Path) -> str:
    """Return the encoding of a text file, from its first bytes: UTF-16 by its mark, UTF-8, or else that of Windows."""
    with text.open_text(path) as file:
        content = file.read(HEAD_BYTES)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(content)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def first_lines(path: Path, encoding: str = "utf-8") -> list[str]:
    """Return the first lines of a text file, without one that is cut."""
    with text.open_text(path, encoding) as file:
        content = file.read(HEAD_BYTES)
    lines = content.decode(errors="replace").splitlines(keepends=True)
    return lines[: min(SAMPLE_LINES, len(lines) - (len(content) == HEAD_BYTES and len(lines) > 1))]


def detect_dialect(lines: Sequence[str]) -> Dialect:
    """Return the dialect of the first lines of a file.

    >>> found = detect_dialect(["# made by x", "t;fx", "0,1;3,5", "0,2;4"])
    >>> found.separator, found.decimal, found.comment, found.header, found.names
    (';', ',', '#', True, ('t', 'fx'))
    >>> detect_dialect(["1.5,2", "2.5,3"]).names
    ('column1', 'column2')
    """
    texts = [line.rstrip("\r\n").removeprefix("\ufeff") for line in lines]
    comment = next((mark for mark in COMMENTS if any(text.lstrip().startswith(mark) for text in texts)), "")
    data_lines = [text for text in texts if text.strip() and not (comment and text.lstrip().startswith(comment))]
    separator, width = _guess_separator(data_lines)
    cells = [tuple(cell.strip() for cell in next(csv.reader([text], delimiter=separator))) for text in data_lines]
    skip = next((number for number, row in enumerate(cells) if len(row) == width), 0)
    rows = [row for row in cells[skip:] if len(row) == width]
    decimal = _guess_decimal(rows, separator)
    probe = Dialect(separator, decimal, comment, 0, False, (), ())
    header = bool(rows) and _is_header(rows, probe)
    names = rows[0] if header else tuple(f"column{number}" for number in range(1, width + 1))
    units: tuple[str, ...] = ()
    if header and len(rows) > 2 and _is_text(rows[1], probe) and not _is_text(rows[2], probe):
        units, rows = rows[1], [rows[0], *rows[2:]]
    below = rows[1:] if header else rows
    missing = sorted({cell for row in below for cell in row if cell in MISSING})
    before = 0
    if units:  # the first row below them
        before = next(number for number, text in enumerate(texts) if text == data_lines[skip + 1]) + 1
    elif skip:  # lines of the file before the header, comments and blank ones among them
        before = next(number for number, text in enumerate(texts) if text == data_lines[skip])
    return Dialect(separator, decimal, comment, before, header, tuple(names), tuple(below), tuple(missing), units)


def _is_text(row: Sequence[str], probe: Dialect) -> bool:
    """Return whether no cell of a row holds a number."""
    return all(probe.number(cell) is None for cell in row)


def _guess_separator(data_lines: Sequence[str]) -> tuple[str, int]:
    """Return the separator that gives most lines the same number of cells, and that number."""
    best = (0.0, 0, ",", 1)
    for rank, separator in enumerate(SEPARATORS):
        widths = Counter(len(next(csv.reader([text], delimiter=separator), [])) for text in data_lines)
        wide = Counter({width: count for width, count in widths.items() if width > 1})
        if not wide:
            continue
        width, count = wide.most_common(1)[0]
        score = count / len(data_lines)
        if separator == "," and score < 1 and any(";" in text for text in data_lines):
            score /= 2  # commas may be decimal ones
        best = max(best, (score, -rank, separator, width))
    return best[2], best[3]


def _guess_decimal(rows: Sequence[tuple[str, ...]], separator: str) -> Literal[".", ","]:
    cells = [cell for row in rows for cell in row]
    commas = sum("," in cell and bool(_COMMA_NUMBER.fullmatch(cell)) for cell in cells)
    points = sum("." in cell and bool(_NUMBER.fullmatch(cell)) for cell in cells)
    return "," if separator != "," and commas > points else "."


def _is_header(rows: Sequence[tuple[str, ...]], probe: Dialect) -> bool:
    """Return whether the first row holds names: fewer numbers than the rows below it."""
    first = [probe.number(cell) is not None for cell in rows[0]]
    if not any(not number and cell not in MISSING for number, cell in zip(first, rows[0], strict=True)):
        return False
    if len(rows) == 1:
        return not any(first)
    below = [probe.number(cell) is not None for cell in rows[1]]
    return sum(first) < sum(below) or not any(first)


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


def read_sample(path: Path) -> FileSample:
    """Return the columns and first rows of a file. Raises `TacpipeError` where it cannot be read."""
    kind = EXTENSIONS[extension(path)]
    if kind == "csv":
        encoding = detect_encoding(path)
        text = detect_dialect(first_lines(path, encoding))
        columns = list(zip(*text.rows, strict=True)) or [()] * len(text.names)
        values = {
            name: tuple(_parse_cell(cell, text) for cell in cells)
            for name, cells in zip(text.names, columns, strict=True)
        }
        return FileSample(text.names, values, text, encoding, units=dict(zip(text.names, text.units, strict=False)))
    if kind == "xlsx":
        return _first_rows(Workbook(path, StreamLayout("table", format="xlsx")))
    file = binary.open_table(path, kind)
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
        tuple(columns), {name: tuple(column.slice(0, SAMPLE_LINES).to_pylist()) for name, column in columns.items()}
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


def _parse_cell(cell: str, text: Dialect) -> float | str | None:
    number = text.number(cell)
    return number if number is not None else (None if cell in MISSING else cell)
