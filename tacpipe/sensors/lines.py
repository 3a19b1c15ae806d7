"""A lab's own board that prints lines of numbers, described in the rig file: an Arduino, an ESP32, a Teensy.

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

What is not a whole line with every number in its place is no sample, and is counted. Without a sum a digit that flips is
still a digit, and a line that lost one is still a line.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from tacpipe.arrays import AnyArray, Int64s
from tacpipe.errors import UsageError
from tacpipe.sensors import layout, line_layout, sensor
from tacpipe.sensors.byte_framer import LineFramer, TextFramer
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.layout import Board, DescribedSensor, device_ns
from tacpipe.sensors.line_layout import LineCell, LineClock, LineColumn, LineNumbers, LineSum, Parser, line_sums
from tacpipe.sensors.line_layout import LineSequence as Counter
from tacpipe.sensors.sensor import Ask, Device, Dialogue, Frames, LocalAddress, Samples

if TYPE_CHECKING:
    import pyarrow as pa

MOST = 1 << 16  # bytes of a line
Read = tuple[Int64s | None, LineNumbers]  # lines with a sample (None: all), and their numbers
KEPT = 4  # batches of lines that are read once for the framer and the decoder


@dataclass(frozen=True, kw_only=True)
class Lines(DescribedSensor):
    """A board whose lines the rig file describes."""

    summary: ClassVar[str] = "A lab's own board: lines of text as the rig file describes them."
    links: ClassVar[tuple[str, ...]] = ("serial", "tcp", "udp")
    described: ClassVar[bool] = True
    guesses: ClassVar[Mapping[str, str]] = {
        "rate_hz": "as measured",
        "columns": "names, units and types are guesses: correct them",
        "sequence": "a guess: it grows by as much with each line",
        "clock": "a guess: it grows as time does",
        "sum": "fits every line that came",
    }

    rate_hz: float  # lines a second
    columns: tuple[LineColumn, ...]  # columns of a line, in their order
    separator: str = ","  # character between columns, which may have spaces around it; a space: spaces or tabs
    decimal: Literal[".", ","] = "."  # mark of a float's decimals
    missing: tuple[str, ...] = ()  # text of a value that is missing: "nan", "" for nothing; it becomes NaN
    prefix: str = ""  # text that each line begins with: "$SKIN,"
    suffix: str = ""  # text that each line ends with, before the sum: "," where one follows the last number too
    comments: tuple[str, ...] = ()  # start of lines without a sample: "#"
    sum: LineSum | None = None  # the check sum at the end
    sequence: Counter | None = None  # the column that counts the lines
    clock: LineClock | None = None  # the column that is the device's time
    packets: bool = False  # each packet of the link is a line (udp), and needs no end
    start: str = ""  # text that has the board send: "s\n"; none: it sends by itself
    stop: str = ""  # text that ends that
    baud: int = 115_200  # baud rate of a serial port

    def __post_init__(self) -> None:
        sensor.positive("lines", rate_hz=self.rate_hz, baud=self.baud)
        if not self.separator.isascii() or len(self.separator.strip()) > 1 or not self.separator:
            _refuse(f"separator is {self.separator!r}; it must be one character, or a space for spaces of any length")
        if self.separator.strip() and (
            self.separator.strip() in "+-eE0123456789" or self.separator.strip() == self.decimal
        ):
            _refuse(f"separator is {self.separator!r}, which numbers are written with; it must be another one")
        for name in ("prefix", "suffix", "start", "stop"):
            if not getattr(self, name).isascii():
                _refuse(f"{name} is {getattr(self, name)!r}; it must be ASCII")
        if any(not comment.strip() or not comment.isascii() for comment in self.comments):
            _refuse("a comment begins with nothing; name what such lines begin with, such as #")
        if any(set(word) & set("0123456789") or not word.isascii() for word in self.missing):
            _refuse('missing names what would be a number; name words such as "nan", or "" for nothing')
        if self.sum is not None and not (self.sum.mark and self.sum.mark.isascii() and self.sum.begin.isascii()):
            _refuse('the sum has no mark; name what stands right before it, such as "*"')
        self._check_roles()

    def _check_roles(self) -> None:
        """Raise `UsageError` unless sequence and clock each have a column of their own that can hold it."""
        names = [role.column for role in (self.sequence, self.clock) if role is not None]
        for role, name in (("sequence", self.sequence), ("clock", self.clock)):
            if name is None:
                continue
            cell = self._places.get(name.column)
            if cell is None:
                _refuse(
                    f"{role} refers to the column {name.column!r}, which is not there; there are {', '.join(self._places)}"
                )
            elif cell[1].skip or names.count(name.column) > 1:
                _refuse(
                    f"{role} refers to the column {name.column}, which is skipped or has two roles; give it its own"
                )
            elif role == "sequence" and cell[1].type not in ("u8", "u16", "u32"):
                _refuse(
                    f"sequence refers to the column {name.column} of type {cell[1].type}; it must be u8, u16 or u32"
                )
            elif name.modulus and not 2 <= name.modulus <= _range(cell[1]):
                _refuse(
                    f"{role} has modulus = {name.modulus}; it must be between 2 and {_range(cell[1])}, or 0 for that"
                )
        if self.sequence is not None:
            sensor.within("lines", "step of the sequence", self.sequence.step, 1, self.counter_modulus - 1)
        if not self._channels:
            _refuse("no column is a channel; list in columns what the board measures")
        if self.clock is not None:
            ticking = self._places[self.clock.column][1]
            is_unsigned = ticking.kind.kind == "u" and ticking.kind.itemsize < 8
            ticks = self.clock.modulus or (_range(ticking) if is_unsigned else 0)
            wrap_ns = ticks * layout.UNITS_NS[self.clock.unit]  # a u32 of microseconds wraps after 71.6 minutes
            object.__setattr__(self, "device_wrap_ns", wrap_ns or None)

    @functools.cached_property
    def _cells(self) -> tuple[LineCell, ...]:
        return line_layout.layout_cells(self.columns)

    @functools.cached_property
    def _places(self) -> dict[str, tuple[int, LineCell]]:
        return {cell.name: (place, cell) for place, cell in enumerate(self._cells)}

    @functools.cached_property
    def _channels(self) -> list[int]:
        roles = {role.column for role in (self.sequence, self.clock) if role is not None}
        return [place for place, cell in enumerate(self._cells) if cell.name not in roles and not cell.skip]

    @functools.cached_property
    def _blocks(self) -> list[list[int]]:
        """Neighbouring channels of one type."""
        blocks: list[list[int]] = []
        for place in self._channels:
            if blocks and self._cells[blocks[-1][0]].kind == self._cells[place].kind:
                blocks[-1].append(place)
            else:
                blocks.append([place])
        return blocks

    @functools.cached_property
    def _parser(self) -> Parser:
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

    def _counting(self) -> tuple[Counter, int] | None:
        return None if self.sequence is None else (self.sequence, _range(self._places[self.sequence.column][1]))

    def fields(self) -> list[pa.Field]:
        """Return a field a channel, in the order of the columns, with unit, quantity, taxel and axis."""
        import pyarrow as pa

        cells = [self._cells[place] for place in self._channels]
        return [pa.field(cell.name, pa.from_numpy_dtype(cell.kind), metadata=dict(cell.metadata)) for cell in cells]

    def framer(self) -> Framer:
        """Return a framer of lines, or of packets, that are well-formed or hold no sample."""
        if self.packets:
            return TextFramer(self._is_frame, check_all=self._are_frames)
        return LineFramer(self._is_frame, check_all=self._are_frames, most=MOST)

    def _is_frame(self, line: bytes) -> bool:
        return self._are_frames([line])

    def _are_frames(self, lines: Sequence[bytes]) -> bool:
        return self._read(lines) is not None

    def _read(self, lines: Sequence[bytes]) -> Read | None:
        read: Read | None = _read(self._parser, tuple(map(bytes.strip, lines)) if self.packets else tuple(lines))
        return read

    def decode(self, frames: Frames) -> Samples:
        """Return the channels (line, channel), side by side by their type, with sequence and clock; comments hold none."""
        read = self._read(frames)
        if read is None:
            raise ValueError("a line among those to decode is not a frame")
        rows, table = read
        values = tuple(table.block(block) for block in self._blocks)
        seq = t_device_ns = None
        if self.sequence is not None:
            seq = table.block([self._places[self.sequence.column][0]])[:, 0].astype(np.int64)
        if self.clock is not None:
            ticks = table.block([self._places[self.clock.column][0]])[:, 0]
            t_device_ns = device_ns(ticks, self.clock.unit)
        return Samples(values, seq=seq, t_device_ns=t_device_ns, rows=rows)

    def encode(self, samples: Samples) -> list[bytes]:
        """Return the lines of these samples without their ends, 0 in what is skipped."""
        columns: list[AnyArray] = [np.zeros(len(samples), dtype=cell.kind) for cell in self._cells]
        for block, values in zip(self._blocks, samples.values, strict=True):
            for number, place in enumerate(block):
                columns[place] = values[:, number]
        if self.sequence is not None and samples.seq is not None:
            columns[self._places[self.sequence.column][0]] = samples.seq % self.counter_modulus
        if self.clock is not None and samples.t_device_ns is not None:
            place, cell = self._places[self.clock.column]
            columns[place] = self._ticks(cell, samples.t_device_ns)
        texts = [self._format_column(cell, column) for cell, column in zip(self._cells, columns, strict=True)]
        between = self.separator
        lines = [f"{self.prefix}{between.join(row)}{self.suffix}".encode() for row in zip(*texts, strict=True)]
        return lines if self.sum is None else _summed(lines, self.sum)

    def _ticks(self, cell: LineCell, t_device_ns: AnyArray) -> AnyArray:
        assert self.clock is not None
        unit_ns = layout.UNITS_NS[self.clock.unit]
        if cell.kind.kind == "f":
            return np.asarray(t_device_ns / unit_ns)
        ticks = (t_device_ns + unit_ns // 2) // unit_ns
        return np.asarray(ticks % (self.device_wrap_ns // unit_ns) if self.device_wrap_ns else ticks)

    def _format_column(self, cell: LineCell, column: AnyArray) -> list[str]:
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

    def device(self) -> Device:
        """Return a board that sends from the start, or from when it hears ``start`` until it hears ``stop``."""
        start, stop = self.start.encode(), self.stop.encode()
        return Board(streaming=not start, start=start, stop=stop)


@functools.lru_cache(maxsize=KEPT)  # kept between the framer's look at them and their decoding
def _read(parser: Parser, lines: tuple[bytes, ...]) -> Read | None:
    """Return what lines hold; None where one is not a frame."""
    if all(lines) and not parser.comments:
        table = parser.table(lines)
        return None if table is None else (None, table)
    rows = [row for row, line in enumerate(lines) if not parser.is_chatter(line)]
    table = parser.table([lines[row] for row in rows])
    return None if table is None else (np.array(rows, dtype=np.int64), table)


def _summed(lines: Sequence[bytes], total: LineSum) -> list[bytes]:
    mark, begin = total.mark.encode(), total.begin.encode()
    end = mark if total.mark_summed else b""
    totals = line_sums([line[len(begin) :] + end for line in lines], total).tolist()
    digits = f"%0{2 * total.width}X" if total.digits == "hex" else "%d"
    return [line + mark + (digits % value).encode() for line, value in zip(lines, totals, strict=True)]


def _range(cell: LineCell) -> int:
    """Return how many values a column of whole numbers can have."""
    return 1 << 8 * cell.kind.itemsize if cell.kind.kind in "ui" else 1 << 62


def _refuse(what: str) -> None:
    raise UsageError(f"lines: {what}.")
