"""Describe how a line of text is laid out, by its cells in their order, and parse lines of that layout.

A number is written in digits, a float also with a decimal mark and an exponent; signs, and spaces around a cell, are
allowed. Any other line, or a value beyond the type of its column, is refused. Many lines are parsed at once, odd ones one by
one, by the same rules.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Int64s
from tacpipe.errors import UsageError
from tacpipe.sensors import layout, number_texts, sensor

if TYPE_CHECKING:
    import pyarrow as pa

Type = Literal["u8", "i8", "u16", "i16", "u32", "i32", "u64", "i64", "f32", "f64"]
NAME = re.compile(r"[a-z][a-z0-9_]*")
BRACES = re.compile(r"\{(?:(\d{1,6})\.\.(\d{1,6})|([A-Za-z0-9_]+(?:,[A-Za-z0-9_]+)*))\}")
MOST_CELLS = 4096


@dataclass(frozen=True)
class LineColumn:
    """One column of the lines, or several of a kind."""

    name: str  # name of the channel; taxel{1..16} and taxel{1..4}_{x,y,z} are several, the last braces count fastest
    type: Type = "f32"  # u unsigned, i signed, f floating point, and the bits
    unit: str = "1"  # unit of the channel
    quantity: str = "tactile"  # quantity of the channel, one of docs/reference/recordings.md
    label: str = ""  # text right before each number, as "x:"; with the braces of the name
    skip: bool = False  # it is not a channel, and may hold any text


@dataclass(frozen=True)
class LineSequence:
    """The column that counts the lines."""

    column: str  # the name of the column that holds it
    modulus: int = 0  # modulus of the counter; 0: that of its type
    step: int = 1  # increment of the counter


@dataclass(frozen=True)
class LineClock:
    """The device's time of a line."""

    column: str  # the name of the column that holds it
    unit: Literal["ns", "us", "ms", "s"]  # unit of that column
    modulus: int = 0  # modulus of the clock in its unit; 0: that of its type


@dataclass(frozen=True)
class LineSum:
    """The check sum that ends a line."""

    kind: Literal["sum8", "lrc", "xor8", "crc8", "sum16", "crc16-modbus", "crc16-ccitt", "crc32"]  # how it is computed
    mark: str = "*"  # text right before it, the last such text of a line
    digits: Literal["hex", "decimal"] = "hex"  # notation of the check sum
    begin: str = ""  # start of lines that is not summed: the $ of NMEA 0183
    mark_summed: bool = False  # True where the mark is summed too

    @property
    def width(self) -> int:
        """Bytes of the sum."""
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
        """The type as which it is kept."""
        return dtype(self.type)


def dtype(kind: str) -> np.dtype[Any]:
    """Return the type that a letter and a number of bits name.

    >>> dtype("u16")
    dtype('uint16')
    """
    return np.dtype(f"{kind[0]}{int(kind[1:]) // 8}")


def layout_cells(columns: tuple[LineColumn, ...]) -> tuple[LineCell, ...]:
    """Return the cells of a line in their order.

    Raises `UsageError` for a name that cannot be a channel's or is there twice, and for braces that name nothing.

    >>> [cell.name for cell in layout_cells((LineColumn("t", "u32"), LineColumn("taxel{1..2}_{x,y}", "u16")))]
    ['t', 'taxel01_x', 'taxel01_y', 'taxel02_x', 'taxel02_y']
    """
    by_name: dict[str, LineCell] = {}
    for column in columns:
        for cell in _expanded(column):
            if not NAME.fullmatch(cell.name):
                _refuse(
                    f"{cell.name!r} cannot name a column; use lower-case letters, digits and _, as in taxel{{1..16}}"
                )
            if cell.name in by_name:
                _refuse(f"two columns are named {cell.name}; names must be unique")
            by_name[cell.name] = cell
            sensor.within("lines", "count of columns", len(by_name), 1, MOST_CELLS)
    if not any(not cell.skip for cell in by_name.values()):
        _refuse("no column is a channel; list in columns what stands in a line, in its order")
    return tuple(by_name.values())


def _expanded(column: LineColumn) -> Iterator[LineCell]:
    """Yield the cells of a column, the last braces counting fastest."""
    braces = _braces(column.name)
    if _braces(column.label) not in ([], braces):
        _refuse(f"the label {column.label!r} must have the braces of the name {column.name!r}, or none")
    for values in itertools.product(*(brace.values for brace in braces)):
        pairs = list(zip(braces, values, strict=True))
        name = _filled(column.name, [value.zfill(brace.width) for brace, value in pairs])
        label = _filled(column.label, list(values))
        metadata = {"unit": column.unit, "quantity": column.quantity, **_places(column.quantity, pairs)}
        yield LineCell(name, column.type, label, column.skip, metadata)


@dataclass(frozen=True)
class _Braces:
    """The values of braces in a pattern."""

    values: tuple[str, ...]
    numbered: bool

    @property
    def width(self) -> int:
        """Digits that a number is written with, as in the names of other tactile arrays."""
        return max(2, len(self.values[-1])) if self.numbered else 0


def _braces(pattern: str) -> list[_Braces]:
    """Return the braces of a pattern."""
    braces = []
    for first, last, words in BRACES.findall(pattern):
        if words:
            braces.append(_Braces(tuple(words.split(",")), numbered=False))
            continue
        if int(first) > int(last):
            _refuse(f"the braces {{{first}..{last}}} count down; write {{{last}..{first}}}")
        sensor.within("lines", "count of columns", int(last) - int(first) + 1, 1, MOST_CELLS)
        braces.append(_Braces(tuple(map(str, range(int(first), int(last) + 1))), numbered=True))
    return braces


def _filled(pattern: str, values: list[str]) -> str:
    """Return a pattern with a value for each of its braces."""
    remaining = iter(values)
    return BRACES.sub(lambda _: next(remaining), pattern)


def _places(quantity: str, pairs: list[tuple[_Braces, str]]) -> dict[str, str]:
    """Return which taxel and axis a cell is: of one range of numbers the taxel, of two also the row and the column."""
    by_taxel, taxel, places = {}, 0, []
    for braces, value in pairs:
        if braces.numbered:
            places.append(braces.values.index(value))
            taxel = taxel * len(braces.values) + places[-1]
        else:
            by_taxel["axis" if quantity == "tactile" else "component"] = value
    if quantity == "tactile" and places:
        by_taxel["taxel"] = str(taxel + 1)
        if len(places) == 2:
            by_taxel |= {"row": str(places[0] + 1), "column": str(places[1] + 1)}
    return by_taxel


def _refuse(what: str) -> None:
    raise UsageError(f"lines: {what}.")


WHOLE = re.compile(rb"[+-]?\d{1,20}")
FLOAT = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?")
WRITTEN = b"0123456789+-.eE"  # characters of numbers
LETTER = re.compile(rb"[A-Za-z]")


@dataclass(frozen=True)
class LineNumbers:
    """The numbers of lines: those of each type side by side (line, cell), in the order of the cells."""

    numbers: Mapping[str, AnyArray]
    cells: tuple[LineCell, ...]

    def block(self, places: Sequence[int]) -> AnyArray:
        """Return the numbers (line, cell) of some cells of one type."""
        kind = self.cells[places[0]].type
        mine = [place for place, cell in enumerate(self.cells) if cell.type == kind and not cell.skip]
        columns = [mine.index(place) for place in places]
        span = slice(columns[0], columns[-1] + 1)
        numbers = self.numbers[kind]
        return numbers[:, span] if columns[-1] - columns[0] + 1 == len(columns) else numbers[:, columns]


@dataclass(frozen=True, eq=False)  # one a sensor: batches of lines are remembered by it
class Parser:
    """How lines read; the texts are those of the rig file in bytes."""

    cells: tuple[LineCell, ...]
    separator: bytes = b""  # one byte; empty: spaces
    decimal: bytes = b"."
    missing: tuple[bytes, ...] = ()
    prefix: bytes = b""
    suffix: bytes = b""
    comments: tuple[bytes, ...] = ()
    sum: LineSum | None = None

    def is_chatter(self, line: bytes) -> bool:
        """Return whether a line is empty or a comment: it holds no sample, and none is lost with it.

        A comment has a letter, so that a bit that flips in a line of numbers makes none of it.
        """
        return not line or bool(self.comments and line.startswith(self.comments) and LETTER.search(line))

    def table(self, lines: Sequence[bytes]) -> LineNumbers | None:
        """Return the numbers of lines; None where a line is not well-formed."""
        bodies = self._bodies(lines)
        if bodies is None:
            return None
        numbers_at_once = None if self._labelled else self._at_once(bodies)
        if numbers_at_once is None:
            numbers_at_once = self._one_by_one(bodies)
        if numbers_at_once is None:
            return None
        numbers = {kind: _fitted(values, kind) for kind, values in numbers_at_once.items()}
        complete = {kind: values for kind, values in numbers.items() if values is not None}
        return LineNumbers(complete, self.cells) if len(complete) == len(numbers) else None

    @cached_property
    def _requested(self) -> list[int]:
        return [place for place, cell in enumerate(self.cells) if not cell.skip]

    @cached_property
    def _of_type(self) -> dict[str, list[int]]:
        """The positions of the requested cells of each type."""
        types = [self.cells[place].type for place in self._requested]
        return {
            kind: [row for row, kind_of_cell in enumerate(types) if kind_of_cell == kind]
            for kind in dict.fromkeys(types)
        }

    @cached_property
    def _labelled(self) -> bool:
        return any(cell.label for cell in self.cells)

    @cached_property
    def _labels(self) -> list[bytes]:
        return [cell.label.encode() for cell in self.cells]

    def _bodies(self, lines: Sequence[bytes]) -> list[bytes] | None:
        """Return what stands between prefix and suffix, where every line has both and its sum is right."""
        if self.sum is not None:
            summed = _without_sum(lines, self.sum)
            if summed is None:
                return None
            lines = summed
        if not (self.prefix or self.suffix):
            return list(lines)
        smallest, stop = len(self.prefix) + len(self.suffix), -len(self.suffix) or None
        if not all(
            len(line) >= smallest and line.startswith(self.prefix) and line.endswith(self.suffix) for line in lines
        ):
            return None
        return [line[len(self.prefix) : stop] for line in lines]

    def _at_once(self, lines: Sequence[bytes]) -> dict[str, AnyArray] | None:
        """Return the numbers of each type of lines that are written plainly; None where one is not, or is none."""
        texts = number_texts.cells(lines, len(self.cells), self.separator)
        if texts is None:
            return None
        if len(self._requested) < len(self.cells):
            texts = number_texts.at(texts, _placed(len(lines), len(self.cells), self._requested))
        absent = None
        if self.missing:
            texts, absent = _without_missing(texts, self.missing)
        joined = number_texts.joined(texts)
        if joined.translate(None, WRITTEN.replace(b".", self.decimal)):
            return None
        if self.decimal != b".":
            texts = number_texts.replaced(texts, joined.replace(self.decimal, b"."))
        columns = {}
        for kind, mine in self._of_type.items():
            numbers = self._cast(texts, absent, kind, mine, len(lines))
            if numbers is None:
                return None
            columns[kind] = numbers
        return columns

    def _cast(
        self, texts: pa.Array, absent: Bools | None, kind: str, mine: Sequence[int], count: int
    ) -> AnyArray | None:
        """Return texts (line times cell) as the numbers of one type (line, cell), NaN where ``absent``."""
        is_single_type = len(mine) == len(self._requested)
        chosen = texts if is_single_type else number_texts.at(texts, _placed(count, len(self._requested), mine))
        numbers = number_texts.cast(chosen, _wide(kind))
        if numbers is None:
            return None
        numbers = numbers.reshape(count, len(mine))
        lacking = None if absent is None else absent.reshape(count, len(self._requested))[:, mine]
        if lacking is None or not lacking.any():
            return numbers
        return np.where(lacking, np.nan, numbers) if kind[0] == "f" else None

    def _one_by_one(self, lines: Sequence[bytes]) -> dict[str, AnyArray] | None:
        rows = []
        for line in lines:
            row = self._row(line, self._requested)
            if row is None:
                return None
            rows.append(row)
        try:
            return {
                kind: np.array([[row[place] for place in mine] for row in rows], dtype=_wide(kind)).reshape(
                    -1, len(mine)
                )
                for kind, mine in self._of_type.items()
            }
        except OverflowError:
            return None

    def _row(self, line: bytes, requested: Sequence[int]) -> list[float | int] | None:
        words = [word.strip(b" \t") for word in line.split(self.separator)] if self.separator else line.split()
        if len(words) != len(self.cells):
            return None
        numbers: list[float | int] = []
        for place in requested:
            cell, label, word = self.cells[place], self._labels[place], words[place]
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
            elif WHOLE.fullmatch(word):
                numbers.append(int(word))
            else:
                return None
        return numbers


def _without_missing(texts: pa.Array, missing: Sequence[bytes]) -> tuple[pa.Array, Bools | None]:
    """Return texts with 0 for those that mean that there is no value, and which these are (text,); None: none."""
    import pyarrow as pa
    import pyarrow.compute as pc

    flags = pc.is_in(texts, value_set=pa.array([text.decode() for text in missing], pa.string()))
    absent = flags.to_numpy(zero_copy_only=False)
    return (pc.if_else(flags, "0", texts), absent) if absent.any() else (texts, None)


def _placed(count: int, width: int, chosen: Sequence[int]) -> Int64s:
    """Return the places of some cells of lines (line times cell)."""
    places: Int64s = np.arange(count)[:, None] * width + np.array(chosen)
    return places.ravel()


def _wide(kind: str) -> np.dtype[np.generic]:
    """Return the type as which a cell's text is read, before it is looked at whether its own type holds it."""
    if kind[0] == "f":
        return np.dtype(np.float64)
    return np.dtype(np.uint64 if kind == "u64" else np.int64)


def _fitted(numbers: AnyArray, kind: str) -> AnyArray | None:
    """Return numbers (line, cell) in their type; None where one is beyond it. NaN is a value that is missing."""
    target = dtype(kind)
    if target.kind == "f":
        beyond = bool((np.abs(numbers) > np.finfo(target).max).any())  # infinite too
    elif target.itemsize == 8 or not len(numbers):
        beyond = False
    else:
        limits = np.iinfo(target)
        beyond = int(numbers.min()) < limits.min or int(numbers.max()) > limits.max
    return None if beyond else numbers.astype(target)


def _without_sum(lines: Sequence[bytes], total: LineSum) -> list[bytes] | None:
    """Return the lines up to the mark of their sum; None where one has none or a wrong one."""
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
    """Return the sum of each text (text,), those of one length at once."""
    totals = np.zeros(len(texts), dtype=np.int64)
    rows = sorted(range(len(texts)), key=lambda row: len(texts[row]))
    for size, group in groupby(rows, key=lambda row: len(texts[row])):
        mine = list(group)
        data = np.frombuffer(b"".join(texts[row] for row in mine), np.uint8).reshape(len(mine), size)
        totals[mine] = layout.SUMS[total.kind][0](data).astype(np.int64)
    return totals
