"""A board that prints lines of numbers, such as an Arduino, ESP32 or Teensy, described in the rig file.

[stream.options]
rate_hz = 100
separator = ","
columns = [
    { name = "count", type = "u32" },
    { name = "millis", type = "u32" },
    { name = "taxel{1..16}", type = "u16", unit = "count" },
]
sequence = { column = "count" }
clock = { column = "millis", unit = "ms" }
sum = { kind = "xor8", mark = "*" }

Lines that do not match the description are counted as lost. Without a checksum, a changed or missing digit is not detected.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Int64s
from tacpipe.errors import UsageError
from tacpipe.sensors import layout, line_layout, sensor
from tacpipe.sensors.byte_framer import LineFramer, TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.layout import DescribedSensor, device_ns
from tacpipe.sensors.line_layout import LineCell, LineClock, LineColumn, LineNumbers, LineSum, Parser, line_sums
from tacpipe.sensors.line_layout import LineSequence as Counter
from tacpipe.sensors.sensor import Ask, Dialogue, Frames, LocalAddress, Samples

MAX_SIZE = 1 << 16  # maximum size of a line in bytes
ParsedBatch = tuple[Int64s | None, LineNumbers]  # indices of lines with a sample (None: all), and their numbers
CACHED = 4  # number of cached batches of lines, because the framer and the decoder parse the same batches


@dataclass(frozen=True, kw_only=True)
class Lines(DescribedSensor):
    """A board whose lines the rig file describes."""

    summary: ClassVar[str] = "Custom boards that print lines of numbers, which the rig file describes."
    links: ClassVar[tuple[str, ...]] = ("serial", "tcp", "udp")
    described: ClassVar[bool] = True
    guesses: ClassVar[Mapping[str, str]] = {
        "rate_hz": "as measured",
        "columns": "names, units and types are guesses: correct them",
        "sequence": "a guess: it increases by the same amount with each line",
        "clock": "a guess: it increases with time",
        "sum": "matches every received line",
    }

    rate_hz: float  # lines per second
    columns: tuple[LineColumn, ...]  # columns of a line, in order
    separator: str = ","  # character between columns, which may have spaces around it; a space means spaces or tabs
    decimal: Literal[".", ","] = "."  # decimal mark of floats
    missing: tuple[str, ...] = ()  # text of a missing value, such as "nan", or "" for an empty cell; it becomes NaN
    prefix: str = ""  # text at the start of each line, such as "$SKIN,"
    suffix: str = ""  # text at the end of each line, before the checksum, such as "," after the last number
    comments: tuple[str, ...] = ()  # start of lines without a sample, such as "#"
    sum: LineSum | None = None  # the checksum at the end of a line
    sequence: Counter | None = None  # the column that counts the lines
    clock: LineClock | None = None  # the column that contains the device's time
    packets: bool = False  # each packet of the link is one line (udp), which needs no line end
    start: str = ""  # text that starts the stream, such as "s\n"; empty: the board streams by itself
    stop: str = ""  # text that stops the stream
    baud: int = 115_200  # baud rate of a serial port

    def __post_init__(self) -> None:
        """Raise `UsageError` if options are invalid or contradict each other."""
        sensor.check_positive("lines", rate_hz=self.rate_hz, baud=self.baud)
        if not self.separator.isascii() or len(self.separator.strip()) > 1 or not self.separator:
            _refuse(f"separator is {self.separator!r}; it must be one character; a space means spaces or tabs")
        if self.separator.strip() and (
            self.separator.strip() in "+-eE0123456789" or self.separator.strip() == self.decimal
        ):
            _refuse(f"separator is {self.separator!r}, which occurs in numbers; choose another character")
        for name in ("prefix", "suffix", "start", "stop"):
            if not getattr(self, name).isascii():
                _refuse(f"{name} is {getattr(self, name)!r}; it must be ASCII")
        if any(not comment.strip() or not comment.isascii() for comment in self.comments):
            _refuse("comments contains an empty text; give the start of comment lines, such as #")
        if any(set(word) & set("0123456789") or not word.isascii() for word in self.missing):
            _refuse('missing contains a text with digits; give words such as "nan", or "" for an empty cell')
        if self.sum is not None and not (self.sum.mark and self.sum.mark.isascii() and self.sum.begin.isascii()):
            _refuse('the sum has no mark; give the text before it, such as "*"')
        self._check_roles()

    def _check_roles(self) -> None:
        """Raise `UsageError` unless sequence and clock have a suitable column each. Set the clock's wrap."""
        names = [role.column for role in (self.sequence, self.clock) if role is not None]
        for role, option in (("sequence", self.sequence), ("clock", self.clock)):
            if option is None:
                continue
            cell = self._cells_by_name.get(option.column)
            if cell is None:
                _refuse(
                    f"{role} refers to the column {option.column!r}, which does not exist; there are "
                    f"{', '.join(self._cells_by_name)}"
                )
            elif cell[1].skip or names.count(option.column) > 1:
                _refuse(
                    f"{role} refers to the column {option.column}, which is skipped or has two roles; choose another one"
                )
            elif role == "sequence" and cell[1].type not in ("u8", "u16", "u32"):
                _refuse(
                    f"sequence refers to the column {option.column} of type {cell[1].type}; it must be u8, u16 or u32"
                )
            elif option.modulus and not 2 <= option.modulus <= _value_count(cell[1]):
                _refuse(
                    f"{role} has modulus = {option.modulus}; it must be between 2 and {_value_count(cell[1])}, or 0 for "
                    f"{_value_count(cell[1])}"
                )
        if self.sequence is not None:
            sensor.check_range("lines", "step of the sequence", self.sequence.step, 1, self.counter_modulus - 1)
        if not self._channels:
            _refuse("no column is a channel; list the measured values in columns")
        if self.clock is not None:
            clock_cell = self._cells_by_name[self.clock.column][1]
            is_unsigned = clock_cell.kind.kind == "u" and clock_cell.kind.itemsize < 8
            ticks = self.clock.modulus or (_value_count(clock_cell) if is_unsigned else 0)
            wrap_ns = ticks * layout.UNITS_NS[self.clock.unit]  # a u32 in microseconds wraps after 71.6 minutes
            object.__setattr__(self, "device_wrap_ns", wrap_ns or None)

    @functools.cached_property
    def _cells(self) -> tuple[LineCell, ...]:
        return line_layout.layout_cells(self.columns)

    @functools.cached_property
    def _cells_by_name(self) -> dict[str, tuple[int, LineCell]]:
        return {cell.name: (position, cell) for position, cell in enumerate(self._cells)}

    @functools.cached_property
    def _channels(self) -> list[int]:
        roles = {role.column for role in (self.sequence, self.clock) if role is not None}
        return [position for position, cell in enumerate(self._cells) if cell.name not in roles and not cell.skip]

    @functools.cached_property
    def _blocks(self) -> list[list[int]]:
        """Groups of adjacent channels of one type."""
        blocks: list[list[int]] = []
        for position in self._channels:
            if blocks and self._cells[blocks[-1][0]].kind == self._cells[position].kind:
                blocks[-1].append(position)
            else:
                blocks.append([position])
        return blocks

    @functools.cached_property
    def _parser(self) -> Parser:
        """The parser for the lines that the options describe."""
        return Parser(
            self._cells,
            self.separator.strip(" ").encode(),
            self.decimal.encode(),
            tuple(word.encode() for word in self.missing),
            self.prefix.encode(),
            self.suffix.encode(),
            tuple(comment.encode() for comment in self.comments),
            self.sum,
        )

    def _counter_option(self) -> tuple[Counter, int] | None:
        """Return the option ``sequence`` and the number of values of its type, or None if there is no such option."""
        if self.sequence is None:
            return None
        return self.sequence, _value_count(self._cells_by_name[self.sequence.column][1])

    def fields(self) -> list[pa.Field]:
        """Return one field per channel, in the order of the columns, with unit, quantity, taxel and axis."""
        cells = [self._cells[position] for position in self._channels]
        return [pa.field(cell.name, pa.from_numpy_dtype(cell.kind), metadata=dict(cell.metadata)) for cell in cells]

    def framer(self) -> Framer:
        """Return a framer for lines or packets that match the description or are comments."""
        if self.packets:
            return TextFramer(self._is_frame, check_all=self._are_frames)
        return LineFramer(self._is_frame, check_all=self._are_frames, max_size=MAX_SIZE)

    def _is_frame(self, line: bytes) -> bool:
        return self._are_frames([line])

    def _are_frames(self, lines: Sequence[bytes]) -> bool:
        return self._parse(lines) is not None

    def _parse(self, lines: Sequence[bytes]) -> ParsedBatch | None:
        return _parse(self._parser, tuple(map(bytes.strip, lines)) if self.packets else tuple(lines))

    def decode(self, frames: Frames) -> Samples:
        """Return the channels (line, channel) in one block per type, with sequence and clock. Comments have no sample.

        Raises `ValueError` if a line is invalid.
        """
        batch = self._parse(frames)
        if batch is None:
            raise ValueError("a line is not a frame")
        rows, table = batch
        values = tuple(table.block(block) for block in self._blocks)
        seq = t_device_ns = None
        if self.sequence is not None:
            seq = table.block([self._cells_by_name[self.sequence.column][0]])[:, 0].astype(np.int64)
        if self.clock is not None:
            ticks = table.block([self._cells_by_name[self.clock.column][0]])[:, 0]
            t_device_ns = device_ns(ticks, self.clock.unit)
        return Samples(values, seq=seq, t_device_ns=t_device_ns, rows=rows)

    def encode(self, samples: Samples) -> list[bytes]:
        """Return the lines of these samples without line ends, with 0 in skipped columns."""
        columns: list[AnyArray] = [np.zeros(len(samples), dtype=cell.kind) for cell in self._cells]
        for block, values in zip(self._blocks, samples.values, strict=True):
            for number, position in enumerate(block):
                columns[position] = values[:, number]
        if self.sequence is not None and samples.seq is not None:
            columns[self._cells_by_name[self.sequence.column][0]] = samples.seq % self.counter_modulus
        if self.clock is not None and samples.t_device_ns is not None:
            position, cell = self._cells_by_name[self.clock.column]
            columns[position] = self._ticks(cell, samples.t_device_ns)
        texts = [self._format_column(cell, column) for cell, column in zip(self._cells, columns, strict=True)]
        separator = self.separator
        lines = [f"{self.prefix}{separator.join(row)}{self.suffix}".encode() for row in zip(*texts, strict=True)]
        return lines if self.sum is None else _append_sums(lines, self.sum)

    def _ticks(self, cell: LineCell, t_device_ns: AnyArray) -> AnyArray:
        """Return device times in ns as numbers of the clock's unit, which wrap like the clock."""
        assert self.clock is not None
        unit_ns = layout.UNITS_NS[self.clock.unit]
        if cell.kind.kind == "f":
            return np.asarray(t_device_ns / unit_ns)
        ticks = (t_device_ns + unit_ns // 2) // unit_ns
        return np.asarray(ticks % (self.device_wrap_ns // unit_ns) if self.device_wrap_ns else ticks)

    def _format_column(self, cell: LineCell, column: AnyArray) -> list[str]:
        """Return the texts of a column's numbers, with label, decimal mark and missing values as declared."""
        words = [str(value) for value in (column.astype(cell.kind) if cell.kind.kind == "f" else column)]
        if cell.kind.kind == "f":
            words = [word.replace(".", self.decimal) for word in words]
            if self.missing:
                words = [self.missing[0] if word == "nan" else word for word in words]
        return [cell.label + word for word in words]

    def opening(self, local: LocalAddress) -> Dialogue:
        """Write ``start``."""
        if self.start:
            yield Ask(self.start.encode())

    def closing(self) -> bytes:
        """Return ``stop``."""
        return self.stop.encode()


@functools.lru_cache(maxsize=CACHED)
def _parse(parser: Parser, lines: tuple[bytes, ...]) -> ParsedBatch | None:
    """Return the parsed lines with the indices of those that are samples (None: all), or None if a line is invalid."""
    if all(lines) and not parser.comments:
        table = parser.parse_table(lines)
        return None if table is None else (None, table)
    rows = [row for row, line in enumerate(lines) if not parser.is_comment(line)]
    table = parser.parse_table([lines[row] for row in rows])
    return None if table is None else (np.array(rows, dtype=np.int64), table)


def _append_sums(lines: Sequence[bytes], total: LineSum) -> list[bytes]:
    """Return lines with their checksum appended."""
    mark, begin = total.mark.encode(), total.begin.encode()
    end = mark if total.mark_summed else b""
    totals = line_sums([line[len(begin) :] + end for line in lines], total).tolist()
    digits = f"%0{2 * total.width}X" if total.digits == "hex" else "%d"
    return [line + mark + (digits % value).encode() for line, value in zip(lines, totals, strict=True)]


def _value_count(cell: LineCell) -> int:
    """Return the number of different values of an integer column."""
    return 1 << 8 * cell.kind.itemsize if cell.kind.kind in "ui" else 1 << 62


def _refuse(problem: str) -> None:
    raise UsageError(f"lines: {problem}.")
