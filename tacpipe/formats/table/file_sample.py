"""Read the first rows of a file, and guess its dialect, its timestamps and the quantities of its columns."""

from __future__ import annotations

import codecs
import csv
import datetime
import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from tacpipe.channels import schema
from tacpipe.errors import TacpipeError
from tacpipe.formats.faults import explaining
from tacpipe.formats.table import binary, column_names, label_table, stamps, text
from tacpipe.formats.table.binary import STREAM_COLUMNS, ArrayMember
from tacpipe.formats.table.columns import MAX_EXACT, TYPES
from tacpipe.formats.table.layout import EXTENSIONS, UNKNOWN, StreamLayout, extension, quoted
from tacpipe.formats.table.text import Workbook

SAMPLE_LINES = 200  # number of lines sampled per file
HEAD_BYTES = 1 << 20  # maximum number of bytes sampled per file
SEPARATORS = (",", ";", "\t", "|", " ")
COMMENTS = ("#", "%", "//")
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?")
_WHOLE = re.compile(r"[-+]?\d{1,20}")
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
    rows: tuple[tuple[str, ...], ...] = field(repr=False)  # cells below the header
    missing: tuple[str, ...] = ()  # values of MISSING that occur
    units: tuple[str, ...] = ()  # units of the columns, if the row below the header contains them

    @property
    def entries(self) -> dict[str, Any]:
        """The entries of a layout that describe the text, except its encoding and missing values."""
        names = ("separator", "decimal", "comment", "skip_lines", "header")
        return {name: getattr(self, name) for name in names}

    def number(self, cell: str) -> float | None:
        """Return the number in a cell, an int if it is written as one, or None if it is not a number.

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
    """Return the encoding of a text file from its first bytes: UTF-16 by its mark, UTF-8, or else that of Windows."""
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
    """Return the first lines of a text file, without an incomplete last one."""
    with text.open_text(path, encoding) as file:
        content = file.read(HEAD_BYTES)
    lines = content.decode(errors="replace").splitlines(keepends=True)
    return lines[: min(SAMPLE_LINES, len(lines) - (len(content) == HEAD_BYTES and len(lines) > 1))]


def detect_dialect(lines: Sequence[str]) -> Dialect:
    """Return the dialect of the first lines of a file.

    >>> dialect = detect_dialect(["# made by x", "t;fx", "0,1;3,5", "0,2;4"])
    >>> dialect.separator, dialect.decimal, dialect.comment, dialect.header, dialect.names
    (';', ',', '#', True, ('t', 'fx'))
    >>> detect_dialect(["1.5,2", "2.5,3"]).names
    ('column1', 'column2')
    """
    line_texts = [line.rstrip("\r\n").removeprefix("\ufeff") for line in lines]
    used_marks = [mark for mark in COMMENTS if any(text.lstrip().startswith(mark) for text in line_texts)]
    comment = used_marks[0] if used_marks else ""
    data_lines = [text for text in line_texts if text.strip() and not (comment and text.lstrip().startswith(comment))]
    separator, width = _guess_separator(data_lines)
    cells = [tuple(cell.strip() for cell in next(csv.reader([text], delimiter=separator))) for text in data_lines]
    header_row = next((number for number, row in enumerate(cells) if len(row) == width), 0)
    rows = [row for row in cells[header_row:] if len(row) == width]
    decimal = _guess_decimal(rows, separator)
    probe = Dialect(separator, decimal, comment, 0, False, (), ())
    header = bool(rows) and _is_header(rows, probe)
    names = rows[0] if header else tuple(f"column{number}" for number in range(1, width + 1))
    units: tuple[str, ...] = ()
    if header and len(rows) > 2 and _is_text(rows[1], probe) and not _is_text(rows[2], probe):
        units, rows = rows[1], [rows[0], *rows[2:]]
    data_rows = rows[1:] if header else rows
    missing = sorted({cell for row in data_rows for cell in row if cell in MISSING})
    skip_lines = 0
    if units:  # the first row after the units
        skip_lines = next(number for number, text in enumerate(line_texts) if text == data_lines[header_row + 1]) + 1
    elif header_row:  # number of lines before the header, including comments and blank lines
        skip_lines = next(number for number, text in enumerate(line_texts) if text == data_lines[header_row])
    return Dialect(
        separator, decimal, comment, skip_lines, header, tuple(names), tuple(data_rows), tuple(missing), units
    )


def _is_text(row: Sequence[str], probe: Dialect) -> bool:
    """Return whether no cell of a row is a number."""
    return all(probe.number(cell) is None for cell in row)


def _guess_separator(data_lines: Sequence[str]) -> tuple[str, int]:
    """Return the separator with which most lines have the same number of cells, and that number.

    Without such a separator, it is a comma and one cell.
    """
    best = (0.0, 0, ",", 1)
    for rank, separator in enumerate(SEPARATORS):
        widths = Counter(len(next(csv.reader([text], delimiter=separator), [])) for text in data_lines)
        several_cells = Counter({width: count for width, count in widths.items() if width > 1})
        if not several_cells:
            continue
        width, count = several_cells.most_common(1)[0]
        score = count / len(data_lines)
        if separator == "," and score < 1 and any(";" in text for text in data_lines):
            score /= 2  # commas may be decimal signs
        best = max(best, (score, -rank, separator, width))
    return best[2], best[3]


def _guess_decimal(rows: Sequence[tuple[str, ...]], separator: str) -> Literal[".", ","]:
    cells = [cell for row in rows for cell in row]
    commas = sum("," in cell and bool(_COMMA_NUMBER.fullmatch(cell)) for cell in cells)
    points = sum("." in cell and bool(_NUMBER.fullmatch(cell)) for cell in cells)
    return "," if separator != "," and commas > points else "."


def _is_header(rows: Sequence[tuple[str, ...]], probe: Dialect) -> bool:
    """Return whether the first row contains names: fewer numbers than the rows below it."""
    is_number = [probe.number(cell) is not None for cell in rows[0]]
    if not any(not number and cell not in MISSING for number, cell in zip(is_number, rows[0], strict=True)):
        return False
    if len(rows) == 1:
        return not any(is_number)
    is_number_below = [probe.number(cell) is not None for cell in rows[1]]
    return sum(is_number) < sum(is_number_below) or not any(is_number)


@dataclass(frozen=True)
class FileSample:
    """The columns and first rows of a file."""

    names: tuple[str, ...]
    values: Mapping[str, tuple[Any, ...]]  # first rows by column
    text: Dialect | None = None  # None if it is not a text file
    encoding: str = "utf-8"
    arrays: Mapping[str, ArrayMember] = field(default_factory=dict)  # arrays of a file of arrays; otherwise empty
    wide_arrays: tuple[str, ...] = ()  # arrays with too many values per row to be channels
    units: Mapping[str, str] = field(default_factory=dict)  # units by column, from a row below the header
    frames: int | None = None  # number of frames of a video or a folder of images

    @property
    def row_count(self) -> int | None:
        """Return the number of rows of the arrays, or of frames, or None for other files."""
        return next((array.rows for array in self.arrays.values()), self.frames)

    def stated_unit(self, column: str) -> str:
        """Return a column's unit from the header or the row below it, or "" if neither contains one."""
        base, unit = column_names.split_unit(column)
        text = self.units.get(column, "") or (unit if base else "")
        return schema.unit_from_text(text.strip().strip("[]()"))

    def only(self, arrays: Sequence[str]) -> FileSample:
        """Return the sample of some of the file's arrays."""
        names = [name for name in self.names if any(belongs_to(name, array) for array in arrays)]
        values = {name: self.values[name] for name in names}
        return replace(self, names=tuple(names), values=values, arrays={name: self.arrays[name] for name in arrays})


def read_sample(path: Path) -> FileSample:
    """Return the columns and first rows of a file. Raises `TacpipeError` if it cannot be read."""
    kind = EXTENSIONS[extension(path)]
    if kind == "csv":
        encoding = detect_encoding(path)
        advice = ". Copy it again from its source, or leave it out."
        with explaining(csv.Error, f"{path} is not a table: ", advice):
            text = detect_dialect(first_lines(path, encoding))
        column_names.expect_short(text.names, path)
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
        arrays = file.arrays()
        pictures = [name for name, array in arrays.items() if array.is_pictures]
        wide = [name for name, array in arrays.items() if not array.is_pictures and array.is_wide]
        if wide and len(wide) == len(arrays):
            raise TacpipeError(f"{path} holds {arrays[wide[0]].describe_wide()}.")
        tables = {name: array for name, array in arrays.items() if name not in wide}
        return replace(_first_rows(file, [*pictures, *wide]), arrays=tables, wide_arrays=tuple(wide))
    return _first_rows(file)


def _first_rows(
    file: binary.ParquetFile | binary.NumpyArchive | binary.JsonLines | Workbook, left_out: Sequence[str] = ()
) -> FileSample:
    """Return the columns and first rows of a file that is not text, without the arrays ``left_out``."""
    names = [name for name in file.names() if not any(belongs_to(name, array) for array in left_out)]
    column_names.expect_short(names, file.path)
    if isinstance(file, binary.JsonLines):
        columns = {name: file.head().column(name) for name in file.head().column_names}
    elif isinstance(file, binary.NumpyArchive):  # the arrays of an archive may differ in length
        columns = {name: next(iter(file.batches({name: pa.null()}))).column(name) for name in names}
    else:
        block = next(iter(file.batches(dict.fromkeys(names, pa.string()))), pa.table({}))
        columns = {name: block.column(name) for name in block.column_names}
    return FileSample(
        tuple(columns), {name: tuple(column.slice(0, SAMPLE_LINES).to_pylist()) for name, column in columns.items()}
    )


def _time_axis(arrays: Mapping[str, ArrayMember]) -> int:
    """Return the axis of the rows of arrays.

    It is the first axis, unless the only array has another one so much longer that the first must belong to the sensor,
    and rows along it have no more values than a table has columns.
    """
    shape = next(iter(arrays.values())).shape if len(arrays) == 1 else ()
    if len(shape) < 2:
        return 0
    is_table = max(shape) > 0 and math.prod(shape) // max(shape) <= STREAM_COLUMNS
    return column_names.longer_axis(shape) if is_table else 0


def belongs_to(column: str, array: str) -> bool:
    """Return whether a column belongs to an array."""
    return column == array or (column.startswith(f"{array}_") and column[len(array) + 1 :].isdigit())


def _parse_cell(cell: str, text: Dialect) -> float | str | None:
    number = text.number(cell)
    return number if number is not None else (None if cell in MISSING else cell)


_LARGE_INTEGERS = (("int64", -(2**63), 2**63 - 1), ("uint64", 0, 2**64 - 1))
_INTEGERS = (("uint16", 0, 2**16 - 1), ("int16", -(2**15), 2**15 - 1), ("int32", -(2**31), 2**31 - 1))


def column_entries(sample: FileSample, reserved: set[str]) -> list[str]:
    """Return the layout entries for the columns of a file that are not in ``reserved``, those of arrays first."""
    rules, array_columns = _array_entries(sample)
    names = [name for name in sample.names if name not in reserved | array_columns]
    return [*rules, *_column_entries(sample, names)]


def _array_entries(sample: FileSample) -> tuple[list[str], set[str]]:
    """Return the column rules for arrays with several values per row, and the columns of these arrays."""
    rules = []
    array_columns: set[str] = set()
    shaped_arrays = [name for name, array in sample.arrays.items() if _shape(name, array)]
    for name in shaped_arrays:
        array = sample.arrays[name]
        shape = _shape(name, array)
        kind = array.dtype.name if array.dtype.name in TYPES else "float64"
        axes = ["x", "y", "z"] if shape[-1] == 3 else []
        quantity, unit = column_names.meaning(name, kind)
        if quantity == UNKNOWN and shape == (3,):
            quantity, unit = column_names.meaning(f"{name}_x", kind)
        suffix = "_{axis}" if axes else ""
        needs_name = len(shaped_arrays) > 1 and quantity == "tactile"
        name_entry = f'name = "{name}{{taxel}}{suffix}", ' if needs_name else ""
        rule = f"match = {quoted(f'{name}_*')}, {name_entry}quantity = {quoted(quantity)}, unit = {quoted(unit)}"
        rule += f", type = {quoted(kind)}, shape = {list(shape)}" + (f", axes = {json.dumps(axes)}" if axes else "")
        rules.append(f"{{ {rule} }},")
        array_columns |= {column for column in sample.names if belongs_to(column, name)}
    return rules, array_columns


def _shape(name: str, array: ArrayMember) -> tuple[int, ...]:
    """Return the shape of an array's rows if it places values in a sensor or a vector, else an empty tuple."""
    is_tactile = array.width and column_names.meaning(name, "")[0] == "tactile"
    has_positions = len(array.row_shape) > 1 or array.row_shape == (3,) or is_tactile
    return array.row_shape if has_positions else ()


def _column_entries(sample: FileSample, names: Sequence[str]) -> list[str]:
    """Return one rule per set of columns whose names differ only in numbers and whose values have the same type."""
    by_rule: dict[tuple[str, ...], list[str]] = {}
    bases = {name: column_names.without_unit(name) for name in names}
    matches = {column_names.numbered_pattern(base) for base in bases.values()}
    components = {column_names.component(base) for base in bases.values()}
    for name, base in bases.items():
        kind = _kind([value for value in sample.values[name] if value is not None])
        quantity, unit = column_names.meaning(base, kind)
        unit = sample.stated_unit(name) or unit
        match, unit_text = column_names.numbered_pattern(base), name.strip()[len(base) :]
        if quantity == "tactile" and {f"{match[:-1]}{axis}" for axis in "xyz"} <= matches:
            match = f"{match[:-1]}{{axis}}"
        by_rule.setdefault((match, unit_text, quantity, unit, kind), []).append(name)
    rules = []
    for (match, unit_text, quantity, unit, kind), members in by_rule.items():
        base = bases[members[0]] if len(members) == 1 else column_names.taxel_pattern(match, quantity, kind)
        are_coordinates = {column_names.lower_name(bases[name]) for name in members} <= {"x", "y", "z"}
        if quantity == UNKNOWN and kind.startswith("float") and are_coordinates:
            quantity = "position" if components >= set("xyzw") or unit in ("m", "cm", "mm") else quantity
        if kind == "text":
            rules.append(f"{{ match = {quoted(base + unit_text)}, skip = true }},")
            continue
        new_name = column_names.identifier(base).lower() if unit_text else column_names.identifier(base)
        name = f"name = {quoted(new_name)}, " if new_name != base + unit_text else ""
        is_unlabelled_array = len(members) >= 6 and "{" in base and not (sample.text and sample.text.header)
        comment = '  # of an array: add shape = [16, 3], axes = ["x", "y", "z"]' if is_unlabelled_array else ""
        rules.append(
            f"{{ match = {quoted(base + unit_text)}, {name}quantity = {quoted(quantity)}, unit = {quoted(unit)}, "
            f"type = {quoted(kind)} }},{comment}"
        )
    return sorted(rules, key=lambda rule: rule.partition("quantity")[0].count("{"))  # exact names before patterns


def _kind(values: Sequence[float | str]) -> str:
    """Return the type of a column, inferred from its first rows."""
    if not values or any(isinstance(value, str) for value in values):
        return "text" if values else "float64"
    if any(isinstance(value, bool) for value in values):
        return "bool"
    if not all(isinstance(value, int | float) for value in values):
        return "text"
    if any(
        isinstance(value, float) for value in values
    ):  # also for values such as 2.0, because a later cell may be 2.5
        return "float64"
    numbers = [int(value) for value in values]
    exceeds_floats = max(abs(min(numbers)), max(numbers)) > MAX_EXACT
    kinds = _INTEGERS if not exceeds_floats else _LARGE_INTEGERS
    return next(
        (kind for kind, lowest, highest in kinds if lowest <= min(numbers) and max(numbers) <= highest), "float64"
    )


_DAYS = ("", "%d.%m.%Y ", "%d/%m/%Y ", "%m/%d/%Y ", "%Y/%m/%d ", "%Y-%m-%d_", "%d-%m-%Y ", "%d %b %Y ", "%b %d %Y ")
_CLOCKS = ("%H:%M:%S.%f", "%H:%M:%S,%f", "%H-%M-%S.%f", "%H:%M")
_STAMP_FORMATS = (
    *(f"{day}{clock}" for clock in _CLOCKS for day in _DAYS),
    *("%Y%m%d_%H%M%S", "%Y%m%d %H%M%S", "%Y%m%d%H%M%S"),
)
_ISO = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d.*")


def time_column(sample: FileSample) -> str | None:
    """Return the column named like timestamps, else the first column if its numbers increase, else None."""
    increasing = [
        name for name in sample.names if increases(sample.values[name]) and not label_table.RECORDING.fullmatch(name)
    ]
    candidates = [
        name
        for name in sample.names
        if name in increasing
        or any(isinstance(value, str | datetime.datetime | datetime.time) for value in sample.values[name])
    ]
    for time_name in (column_names.TIME_NAME, column_names.TIME_ENDING):
        for name in candidates:
            if time_name.fullmatch(column_names.without_unit(name)):
                return name
    return increasing[0] if increasing and increasing[0] == sample.names[0] else None


def increases(values: Sequence[float | str | None]) -> bool:
    """Return whether all values are numbers that never decrease, with the last above the first."""
    numbers = [value for value in values if isinstance(value, int | float)]
    return (
        len(numbers) == len(values) > 1
        and all(before <= after for before, after in itertools.pairwise(numbers))
        and numbers[-1] > numbers[0]
    )


def time_entry(sample: FileSample, column: str | None, file: str = "") -> str:
    """Return the entry ``time`` for timestamps in a column; ``file`` is the entry of a separate timestamp file."""
    if column is None:
        return f'{{ rate_hz = "{UNKNOWN}" }}  # no column rises as stamps do; write the rate'
    source = file or f"column = {quoted(column)}"
    values = sample.values[column]
    texts = [value for value in values if isinstance(value, str)]
    if any(isinstance(value, datetime.datetime | datetime.time) for value in values):
        return f"{{ {source} }}"
    if any(_ISO.match(text) for text in texts):
        return f'{{ {source}, unit = "iso8601" }}'
    if texts:
        return _text_stamp_entry(texts, source)
    usual = float(np.median([abs(value) for value in values if isinstance(value, int | float)] or [0.0]))
    suffix = re.search(r"(?:^|[_ ])(ms|us|ns|s|sec|seconds)$", column_names.without_unit(column), re.IGNORECASE)
    unit_text = sample.stated_unit(column) or schema.unit_from_text(suffix[1] if suffix else "")
    stated_s = usual * 10.0 ** (stamps.DIGITS.get(unit_text, 9) - 9)
    unix_unit = stamps.unit_of_unix_time(usual)
    if unix_unit is not None and (stated_s >= stamps.MIN_UNIX_S or unit_text not in stamps.DIGITS):
        return f'{{ {source}, unit = "{unix_unit}" }}'
    steps = np.diff([value for value in values if isinstance(value, float)])
    if not unit_text and len(steps) and 0 < float(np.median(steps)) < 0.5:
        unit_text = "s"  # in ms, steps this small would mean thousands of rows per second
    unit = unit_text if unit_text in stamps.DIGITS else UNKNOWN
    return f'{{ {source}, unit = "{unit}", origin = "start" }}  # counts from the start of the recording'


def _text_stamp_entry(texts: Sequence[str], source: str) -> str:
    """Return the entry ``time`` for text timestamps, in formats that parse all of them with dates in order."""
    fitting = []
    for stamp_format in _STAMP_FORMATS:
        t_ns, valid = stamps.parse_stamps(pa.array(texts), stamp_format)
        if valid.all():
            fitting.append((int(t_ns.max() - t_ns.min()), stamp_format))
    if not fitting:
        return f'{{ {source}, format = "{UNKNOWN}" }}  # as strptime has it, for texts such as {quoted(texts[0])}'
    best_format = min(fitting)[1]
    if not stamps.has_date(best_format):
        return f'{{ {source}, format = "{best_format}" }}  # the time of day; start = "2026-05-01" adds the day'
    alternatives = [candidate for span, candidate in fitting if candidate != best_format and span == min(fitting)[0]]
    return f'{{ {source}, format = "{best_format}" }}' + (f"  # or {', '.join(alternatives)}" if alternatives else "")
