"""How a line of text is laid out, as a rig file describes it: its cells in their order, and what some of them are for."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from tacpipe.errors import UsageError
from tacpipe.sensors import layout, sensor

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


def cells(columns: tuple[LineColumn, ...]) -> tuple[LineCell, ...]:
    """Return the cells of a line in their order.

    Raises `UsageError` for a name that cannot be a channel's or is there twice, and for braces that name nothing.

    >>> [cell.name for cell in cells((LineColumn("t", "u32"), LineColumn("taxel{1..2}_{x,y}", "u16")))]
    ['t', 'taxel01_x', 'taxel01_y', 'taxel02_x', 'taxel02_y']
    """
    by_name: dict[str, LineCell] = {}
    for column in columns:
        for cell in _expanded(column):
            if not NAME.fullmatch(cell.name):
                _refuse(f"{cell.name!r} cannot name a column; take small letters, digits and _, as in taxel{{1..16}}")
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
