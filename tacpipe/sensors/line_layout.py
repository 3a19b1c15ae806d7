"""Describe the layout of a line of text by its cells, and parse lines of that layout.

Integers have digits; floats may also have a decimal mark and an exponent. Signs, and spaces around a cell, are allowed. All
other lines, and values outside of the range of their column, are rejected. Many lines are parsed at once, and unusual lines
one by one by the same rules.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tacpipe.arrays import AnyArray, Bools, Int64s
from tacpipe.errors import UsageError
from tacpipe.sensors import layout, number_texts, sensor

Type = Literal["u8", "i8", "u16", "i16", "u32", "i32", "u64", "i64", "f32", "f64"]
NAME = re.compile(r"[a-z][a-z0-9_]*")
BRACES = re.compile(r"\{(?:(\d{1,6})\.\.(\d{1,6})|([A-Za-z0-9_]+(?:,[A-Za-z0-9_]+)*))\}")
MAX_CELLS = 4096


@dataclass(frozen=True)
class LineColumn:
    """One column of the lines, or an array of columns."""

    name: str  # name of the channel; in taxel{1..4}_{x,y,z}, an array, the last braces vary fastest
    type: Type = "f32"  # u unsigned, i signed, f floating point, followed by the number of bits
    unit: str = "1"  # unit of the channel
    # quantity of the channel, one of docs/reference/recordings.md; if empty, tactile for names with
    # taxel, state for others
    quantity: str = ""
    label: str = ""  # text before each number, such as "x:"; it may contain the braces of the name
    skip: bool = False  # True if the column is not a channel; it may then contain any text


@dataclass(frozen=True)
class LineSequence:
    """The column that counts the lines."""

    column: str  # name of the column that contains it
    modulus: int = 0  # modulus of the counter; 0: the range of its type
    step: int = 1  # increment per line


@dataclass(frozen=True)
class LineClock:
    """The column that contains the device's time."""

    column: str  # name of the column that contains it
    unit: Literal["ns", "us", "ms", "s"]  # unit of that column
    modulus: int = 0  # modulus of the clock in its unit; 0: the range of its type


@dataclass(frozen=True)
class LineSum:
    """The checksum at the end of a line."""

    kind: Literal["sum8", "lrc", "xor8", "crc8", "sum16", "crc16-modbus", "crc16-ccitt", "crc32"]  # algorithm
    mark: str = "*"  # text before the checksum; its last occurrence in the line counts
    digits: Literal["hex", "decimal"] = "hex"  # notation of the checksum
    begin: str = ""  # text at the start of lines that is not summed, such as the $ of NMEA 0183
    mark_summed: bool = False  # True if the mark is summed, too

    @property
    def width(self) -> int:
        """Bytes of the checksum."""
        return layout.SUMS[self.kind][1]


@dataclass(frozen=True)
class LineCell:
    """One cell of a line."""

    name: str
    type: Type
    label: str
    skip: bool
    metadata: Mapping[str, str]

    @property
    def kind(self) -> np.dtype[Any]:
        """The numpy type of the channel."""
        return dtype(self.type)


def dtype(kind: str) -> np.dtype[Any]:
    """Return the numpy type for a letter and a number of bits.

    >>> dtype("u16")
    dtype('uint16')
    """
    return np.dtype(f"{kind[0]}{int(kind[1:]) // 8}")


def layout_cells(columns: tuple[LineColumn, ...]) -> tuple[LineCell, ...]:
    """Return the cells of a line in order.

    Raises `UsageError` for invalid or repeated names, invalid braces, and if no column is a channel.

    >>> [cell.name for cell in layout_cells((LineColumn("t", "u32"), LineColumn("taxel{1..2}_{x,y}", "u16")))]
    ['t', 'taxel01_x', 'taxel01_y', 'taxel02_x', 'taxel02_y']
    """
    by_name: dict[str, LineCell] = {}
    for column in columns:
        for cell in _expand(column):
            if not NAME.fullmatch(cell.name):
                _refuse(
                    f"{cell.name!r} is not a valid name; use lower-case letters, digits and _, such as taxel{{1..16}}"
                )
            if cell.name in by_name:
                _refuse(f"two columns are named {cell.name}; names must be unique")
            by_name[cell.name] = cell
            sensor.check_range("lines", "count of columns", len(by_name), 1, MAX_CELLS)
    if not any(not cell.skip for cell in by_name.values()):
        _refuse("no column is a channel; list all columns of a line, in order, in columns")
    return tuple(by_name.values())


def _expand(column: LineColumn) -> Iterator[LineCell]:
    """Yield the cells of a column; the last braces vary fastest.

    Raises `UsageError` if the label has other braces than the name.
    """
    braces = _braces(column.name)
    if _braces(column.label) not in ([], braces):
        _refuse(f"the label {column.label!r} must contain the braces of the name {column.name!r}, or none")
    for values in itertools.product(*(brace.values for brace in braces)):
        pairs = list(zip(braces, values, strict=True))
        name = _fill(column.name, [value.zfill(brace.width) for brace, value in pairs])
        label = _fill(column.label, list(values))
        quantity = sensor.quantity_of(column.name, column.quantity)
        metadata = {"unit": column.unit, "quantity": quantity, **_position_metadata(quantity, pairs)}
        yield LineCell(name, column.type, label, column.skip, metadata)


@dataclass(frozen=True)
class _Braces:
    """The values of braces in a pattern."""

    values: tuple[str, ...]
    is_range: bool

    @property
    def width(self) -> int:
        """Digits of numbers, as in the names of other tactile arrays; 0 for words."""
        return max(2, len(self.values[-1])) if self.is_range else 0


def _braces(pattern: str) -> list[_Braces]:
    """Return the braces of a pattern with their values. Raises `UsageError` for a descending or too long range."""
    braces = []
    for first, last, words in BRACES.findall(pattern):
        if words:
            braces.append(_Braces(tuple(words.split(",")), is_range=False))
            continue
        if int(first) > int(last):
            _refuse(f"the braces {{{first}..{last}}} are descending; write {{{last}..{first}}}")
        sensor.check_range("lines", "count of columns", int(last) - int(first) + 1, 1, MAX_CELLS)
        braces.append(_Braces(tuple(map(str, range(int(first), int(last) + 1))), is_range=True))
    return braces


def _fill(pattern: str, values: list[str]) -> str:
    """Replace each pair of braces in a pattern by a value."""
    remaining = iter(values)
    return BRACES.sub(lambda _: next(remaining), pattern)


def _position_metadata(quantity: str, pairs: list[tuple[_Braces, str]]) -> dict[str, str]:
    """Return the metadata ``taxel`` and ``axis`` of a cell, and with two ranges of numbers also ``row`` and ``column``."""
    metadata, taxel, indices = {}, 0, []
    for braces, value in pairs:
        if braces.is_range:
            indices.append(braces.values.index(value))
            taxel = taxel * len(braces.values) + indices[-1]
        else:
            metadata["axis" if quantity == "tactile" else "component"] = value
    if quantity == "tactile" and indices:
        metadata["taxel"] = str(taxel + 1)
        if len(indices) == 2:
            metadata |= {"row": str(indices[0] + 1), "column": str(indices[1] + 1)}
    return metadata


def _refuse(problem: str) -> None:
    raise UsageError(f"lines: {problem}.")


INTEGER = re.compile(rb"[+-]?\d{1,20}")
FLOAT = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?")
NUMBER_CHARACTERS = b"0123456789+-.eE"
LETTER = re.compile(rb"[A-Za-z]")


@dataclass(frozen=True)
class LineNumbers:
    """The numbers of lines by type: arrays (line, cell), in the order of the cells."""

    numbers: Mapping[str, AnyArray]
    cells: tuple[LineCell, ...]

    def block(self, positions: Sequence[int]) -> AnyArray:
        """Return the numbers (line, cell) of the cells at ``positions``, which must have one type."""
        kind = self.cells[positions[0]].type
        cells_of_type = [position for position, cell in enumerate(self.cells) if cell.type == kind and not cell.skip]
        columns = [cells_of_type.index(position) for position in positions]
        span = slice(columns[0], columns[-1] + 1)
        numbers = self.numbers[kind]
        return numbers[:, span] if columns[-1] - columns[0] + 1 == len(columns) else numbers[:, columns]


@dataclass(frozen=True, eq=False)  # hashed by identity: the cache of parsed batches uses it as a key
class Parser:
    """A parser of lines. Its texts are those of the rig file as bytes."""

    cells: tuple[LineCell, ...]
    separator: bytes = b""  # one byte; empty: spaces or tabs
    decimal: bytes = b"."
    missing: tuple[bytes, ...] = ()
    prefix: bytes = b""
    suffix: bytes = b""
    comments: tuple[bytes, ...] = ()
    sum: LineSum | None = None

    def is_comment(self, line: bytes) -> bool:
        """Return whether a line is empty or a comment, which contains no sample.

        A comment must contain a letter, so that a line of numbers with a flipped bit does not count as one.
        """
        return not line or bool(self.comments and line.startswith(self.comments) and LETTER.search(line))

    def parse_table(self, lines: Sequence[bytes]) -> LineNumbers | None:
        """Return the numbers of lines by type, or None if a line is invalid."""
        bodies = self._strip_affixes(lines)
        if bodies is None:
            return None
        parsed = None if self._has_labels else self._parse_batch(bodies)
        if parsed is None:
            parsed = self._parse_one_by_one(bodies)
        if parsed is None:
            return None
        numbers = {kind: _cast_checked(values, kind) for kind, values in parsed.items()}
        complete = {kind: values for kind, values in numbers.items() if values is not None}
        return LineNumbers(complete, self.cells) if len(complete) == len(numbers) else None

    @cached_property
    def _channels(self) -> list[int]:
        return [position for position, cell in enumerate(self.cells) if not cell.skip]

    @cached_property
    def _channels_by_type(self) -> dict[str, list[int]]:
        """The positions among the channels of the numbers of each type."""
        types = [self.cells[position].type for position in self._channels]
        return {
            kind: [row for row, kind_of_cell in enumerate(types) if kind_of_cell == kind]
            for kind in dict.fromkeys(types)
        }

    @cached_property
    def _has_labels(self) -> bool:
        return any(cell.label for cell in self.cells)

    @cached_property
    def _labels(self) -> list[bytes]:
        return [cell.label.encode() for cell in self.cells]

    def _strip_affixes(self, lines: Sequence[bytes]) -> list[bytes] | None:
        """Return the lines without checksum, prefix and suffix, or None if a line lacks one or its checksum is wrong."""
        bodies = list(lines) if self.sum is None else _strip_checksums(lines, self.sum)
        if bodies is None or not (self.prefix or self.suffix):
            return bodies
        smallest, stop = len(self.prefix) + len(self.suffix), -len(self.suffix) or None
        if not all(
            len(body) >= smallest and body.startswith(self.prefix) and body.endswith(self.suffix) for body in bodies
        ):
            return None
        return [body[len(self.prefix) : stop] for body in bodies]

    def _parse_batch(self, lines: Sequence[bytes]) -> dict[str, AnyArray] | None:
        """Return the numbers by type, or None if a line is invalid or needs `_parse_one_by_one`."""
        texts = number_texts.cells(lines, len(self.cells), self.separator)
        if texts is None:
            return None
        if len(self._channels) < len(self.cells):
            texts = number_texts.select(texts, _cell_indices(len(lines), len(self.cells), self._channels))
        absent = None
        if self.missing:
            texts, absent = _fill_missing(texts, self.missing)
        joined = number_texts.concatenate(texts)
        if joined.translate(None, NUMBER_CHARACTERS.replace(b".", self.decimal)):
            return None
        if self.decimal != b".":
            texts = number_texts.with_content(texts, joined.replace(self.decimal, b"."))
        columns = {}
        for kind, positions in self._channels_by_type.items():
            numbers = self._cast(texts, absent, kind, positions, len(lines))
            if numbers is None:
                return None
            columns[kind] = numbers
        return columns

    def _cast(
        self, texts: pa.Array, absent: Bools | None, kind: str, positions: Sequence[int], count: int
    ) -> AnyArray | None:
        """Return the numbers (line, cell) of the channels at ``positions``, or None if a text is not a ``kind``.

        ``texts`` are those of all channels (line × channel). Those that are ``absent`` become NaN, which only floats
        can be.
        """
        texts_of_type = texts
        if len(positions) < len(self._channels):
            texts_of_type = number_texts.select(texts, _cell_indices(count, len(self._channels), positions))
        numbers = number_texts.cast(texts_of_type, _parsed_type(kind))
        if numbers is None:
            return None
        numbers = numbers.reshape(count, len(positions))
        is_missing = None if absent is None else absent.reshape(count, len(self._channels))[:, positions]
        if is_missing is None or not is_missing.any():
            return numbers
        return np.where(is_missing, np.nan, numbers) if kind[0] == "f" else None

    def _parse_one_by_one(self, lines: Sequence[bytes]) -> dict[str, AnyArray] | None:
        """Return the numbers by type like `_parse_batch`, for any valid lines, or None if a line is invalid."""
        rows = []
        for line in lines:
            row = self._parse_line(line)
            if row is None:
                return None
            rows.append(row)
        numbers = {}
        for kind, columns in self._channels_by_type.items():
            try:
                selected = np.array([[row[column] for column in columns] for row in rows], dtype=_parsed_type(kind))
            except OverflowError:
                return None
            numbers[kind] = selected.reshape(-1, len(columns))
        return numbers

    def _parse_line(self, line: bytes) -> list[float | int] | None:
        """Return the numbers of the channels in a line, or None if it is invalid."""
        words = [word.strip(b" \t") for word in line.split(self.separator)] if self.separator else line.split()
        if len(words) != len(self.cells):
            return None
        numbers: list[float | int] = []
        for position in self._channels:
            cell, label, word = self.cells[position], self._labels[position], words[position]
            if not word.startswith(label):
                return None
            word = word[len(label) :].strip(b" \t") if label else word
            if cell.kind.kind == "f" and word in self.missing:
                numbers.append(np.nan)
            elif cell.kind.kind == "f":
                if b"." in word and self.decimal != b".":
                    return None
                word = word.replace(self.decimal, b".")
                if not FLOAT.fullmatch(word):
                    return None
                numbers.append(float(word))
            elif INTEGER.fullmatch(word):
                numbers.append(int(word))
            else:
                return None
        return numbers


def _fill_missing(texts: pa.Array, missing: Sequence[bytes]) -> tuple[pa.Array, Bools | None]:
    """Replace the texts of missing values by 0, and return a mask (text,) of them, or None if there are none."""
    flags = pc.is_in(texts, value_set=pa.array([text.decode() for text in missing], pa.string()))
    absent = flags.to_numpy(zero_copy_only=False)
    return (pc.if_else(flags, "0", texts), absent) if absent.any() else (texts, None)


def _cell_indices(count: int, width: int, columns: Sequence[int]) -> Int64s:
    """Return the indices (line × column) of some columns in the flat cells of ``count`` lines of ``width`` cells."""
    indices: Int64s = np.arange(count)[:, None] * width + np.array(columns)
    return indices.ravel()


def _parsed_type(kind: str) -> np.dtype[np.generic]:
    """Return the type with which a text is parsed before the range of its own type is checked."""
    if kind[0] == "f":
        return np.dtype(np.float64)
    return np.dtype(np.uint64 if kind == "u64" else np.int64)


def _cast_checked(numbers: AnyArray, kind: str) -> AnyArray | None:
    """Return numbers (line, cell) in their type, or None if one is out of range. NaN is a missing value."""
    target = dtype(kind)
    if target.kind == "f":
        out_of_range = bool((np.abs(numbers) > np.finfo(target).max).any())  # also True for infinity
    elif target.itemsize == 8 or not len(numbers):
        out_of_range = False
    else:
        limits = np.iinfo(target)
        out_of_range = int(numbers.min()) < limits.min or int(numbers.max()) > limits.max
    return None if out_of_range else numbers.astype(target)


def _strip_checksums(lines: Sequence[bytes], total: LineSum) -> list[bytes] | None:
    """Return the lines up to the mark of their checksum, or None if a checksum is missing or wrong."""
    mark, begin = total.mark.encode(), total.begin.encode()
    digits = re.compile(
        rb"[0-9A-Fa-f]{1,%d}" % (2 * total.width) if total.digits == "hex" else rb"\d{1,%d}" % (3 * total.width)
    )
    bodies, declared = [], []
    for line in lines:
        body, separator, digits_text = line.rpartition(mark)
        if not separator or not body.startswith(begin) or not digits.fullmatch(digits_text.strip(b" \t")):
            return None
        bodies.append(body)
        declared.append(int(digits_text, 16 if total.digits == "hex" else 10))
    end = mark if total.mark_summed else b""
    summed = [body[len(begin) :] + end for body in bodies]
    return bodies if (line_sums(summed, total) == np.array(declared)).all() else None


def line_sums(texts: Sequence[bytes], total: LineSum) -> AnyArray:
    """Return the checksum of each text (text,). Texts of one length are processed at once."""
    totals = np.zeros(len(texts), dtype=np.int64)
    rows = sorted(range(len(texts)), key=lambda row: len(texts[row]))
    for size, group in groupby(rows, key=lambda row: len(texts[row])):
        rows_of_size = list(group)
        data = np.frombuffer(b"".join(texts[row] for row in rows_of_size), np.uint8).reshape(len(rows_of_size), size)
        totals[rows_of_size] = layout.SUMS[total.kind][0](data).astype(np.int64)
    return totals
