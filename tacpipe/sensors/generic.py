"""A board with binary frames that the rig file describes: the numbers of a frame, and their roles.

[stream.options]
rate_hz = 500
marker = "AA 55"
numbers = [
    { name = "count", type = "u16" },
    { name = "micros", type = "u32" },
    { name = "taxel", type = "u16", count = 16, unit = "count" },
    { name = "check", type = "u8" },
]
sequence = { number = "count" }
clock = { number = "micros", unit = "us" }
sum = { kind = "sum8", number = "check", begin = 2 }
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Bools, Bytes, Int64s
from tacpipe.errors import UsageError
from tacpipe.sensors import layout, sensor
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.framing import Framer, Framing, PacketFramer
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor

MAX_SIZE = 4096  # maximum size of a frame in bytes


@dataclass(frozen=True, kw_only=True)
class Generic(layout.DescribedSensor):
    """A board whose binary frames the rig file describes."""

    summary: ClassVar[str] = "Custom boards with binary frames that the rig file describes."
    links: ClassVar[tuple[str, ...]] = ("serial", "tcp", "udp", "hid")

    rate_hz: float  # frames per second
    numbers: tuple[layout.Number, ...]  # the numbers between marker and tail, in order, without gaps
    marker: str = ""  # first bytes of each frame, in hexadecimal: "AA 55"
    tail: str = ""  # last bytes of each frame, in hexadecimal: "0D 0A"
    order: layout.Order = "little"  # byte order of numbers
    sum: layout.Sum | None = None  # the checksum of a frame, and the field that contains it
    sequence: layout.Sequence | None = None  # the field that contains the frame counter
    clock: layout.Clock | None = None  # the field that contains the device's time
    # the field that contains the size of a frame; if absent, all frames have the same size
    length: layout.Length | None = None
    packets: bool = False  # each packet of the link is one frame (udp, hid), so no marker is needed
    start: str = ""  # bytes that start the stream, in hexadecimal; empty: the board streams by itself
    stop: str = ""  # bytes that stop the stream, in hexadecimal
    baud: int = 115_200  # baud rate of a serial port

    def __post_init__(self) -> None:
        """Raise `UsageError` if options are invalid or contradict each other; set the wrap of the device's clock."""
        sensor.check_positive("generic", rate_hz=self.rate_hz, baud=self.baud)
        for name in ("marker", "tail", "start", "stop"):
            _bytes(name, getattr(self, name))
        if not (self.marker or self.tail or self.packets):
            raise UsageError(
                'generic: no option defines where a frame starts; give marker or tail, such as marker = "AA 55", or '
                "packets = true if each packet of the link is a frame."
            )
        if self.size > MAX_SIZE:
            raise UsageError(f"generic: a frame has {self.size} bytes; it must have at most {MAX_SIZE}.")
        if not self._channels:
            raise UsageError("generic: no number is a channel; list the measured values in numbers.")
        self._check_names()
        self._check_roles()
        span = self._spans[self.clock.number] if self.clock is not None else None
        if self.clock is not None and span is not None and span.dtype.kind in "ui" and span.width < 8:
            # a u32 in microseconds wraps after 71.6 minutes
            wrap_ns = span.value_count * layout.UNITS_NS[self.clock.unit]
            object.__setattr__(self, "device_wrap_ns", wrap_ns)

    def _check_names(self) -> None:
        names = [name for span in self._channels for name, _ in _channels_of_number(span.number)]
        if repeated := next((name for name in names if names.count(name) > 1), None):
            raise UsageError(f"generic: two channels are named {repeated}; give the numbers other names.")

    def _check_roles(self) -> None:
        """Raise `UsageError` unless sum, sequence, clock and length are different numbers of suitable types."""
        roles = [role for role in (self.sum, self.sequence, self.clock, self.length) if role is not None]
        numbers = [role.number for role in roles]
        if repeated := next((name for name in numbers if numbers.count(name) > 1), None):
            raise UsageError(
                f"generic: the number {repeated} has two roles; each of sum, sequence, clock, length needs its own."
            )
        if self.sum is not None:
            layout.summed_bytes(self.sum, layout.span_of_role(self._spans, "sum", self.sum.number), self.size)
        if self.sequence is not None:
            span = layout.span_of_role(self._spans, "sequence", self.sequence.number)
            sensor.check_range("generic", "width of the sequence in bits", 8 * span.width, 8, 32)
            if not (self.sequence.modulus == 0 or 2 <= self.sequence.modulus <= span.value_count):
                raise UsageError(
                    f"generic: the sequence has modulus = {self.sequence.modulus}; its number is {span.number.type}, so it "
                    f"must be between 2 and {span.value_count}, or 0 for {span.value_count}."
                )
            sensor.check_range("generic", "step of the sequence", self.sequence.step, 1, self.counter_modulus - 1)
        if self.clock is not None:
            layout.span_of_role(self._spans, "clock", self.clock.number, "uif")
        if self.length is not None:
            span = layout.span_of_role(self._spans, "length", self.length.number)
            if not 0 <= self.size - self.length.plus < span.value_count:
                raise UsageError(
                    f"generic: the length would be {self.size - self.length.plus} for a frame of {self.size} bytes with "
                    f"plus = {self.length.plus}; it must be between 0 and {span.value_count - 1}."
                )

    @functools.cached_property
    def _spans(self) -> dict[str, layout.NumberSpan]:
        return layout.number_spans(self.numbers, len(_bytes("marker", self.marker)), self.order)

    @functools.cached_property
    def size(self) -> int:
        """Bytes of a frame with a sample."""
        last = max((span.stop for span in self._spans.values()), default=len(_bytes("marker", self.marker)))
        return last + len(_bytes("tail", self.tail))

    @functools.cached_property
    def _channels(self) -> list[layout.NumberSpan]:
        """Return the numbers that are channels: without a role, not constant, and not skipped."""
        roles = {role.number for role in (self.sum, self.sequence, self.clock, self.length) if role is not None}
        return [
            span
            for name, span in self._spans.items()
            if name not in roles and not span.number.skip and span.number.equals is None
        ]

    def _counter_option(self) -> tuple[layout.Sequence, int] | None:
        return None if self.sequence is None else (self.sequence, self._spans[self.sequence.number].value_count)

    def fields(self) -> list[pa.Field]:
        """Return one field per channel, in the order of the numbers, with unit, quantity, taxel and axis."""
        return [
            pa.field(name, pa.from_numpy_dtype(span.dtype), metadata=metadata)
            for span in self._channels
            for name, metadata in _channels_of_number(span.number)
        ]

    def framer(self) -> Framer:
        """Return a framer for frames with marker, tail, checksum and constant numbers."""
        fixed = [span for span in self._spans.values() if span.number.equals is not None]
        check = self._are_valid if self.sum or fixed else None
        if self.packets:
            return PacketFramer([self.size], self._has_marks)
        marker, tail = _bytes("marker", self.marker), _bytes("tail", self.tail)
        weak = self.sum is None
        is_strong = self.sum is not None and layout.SUMS[self.sum.kind][1] > 1
        confirm = int(not is_strong and not (tail and self.length is None))
        framing = Framing(
            marker, tail, check=check, lock=3 if weak else 2, confirm=confirm, max_size=MAX_SIZE, weak=weak
        )
        if self.length is None:
            return ByteFramer(replace(framing, size=self.size), datagrams=self.datagrams)
        header = max(self._spans[self.length.number].stop, len(marker) + 1)
        return ByteFramer(replace(framing, header=header, sizes=self._sizes), datagrams=self.datagrams)

    def _sizes(self, heads: Bytes) -> Int64s:
        assert self.length is not None
        declared = self._spans[self.length.number].read(heads)[:, 0]
        return np.minimum(declared.astype(np.uint64), MAX_SIZE + 1).astype(np.int64) + self.length.plus

    def _are_valid(self, frames: Bytes) -> Bools:
        """Return a mask (frame,) of the frames (frame, byte) with the right checksum and constant numbers.

        In frames of another size than those with samples, only the checksum is tested, at the same distance from the end.
        """
        good = np.ones(len(frames), dtype=bool)
        extra = frames.shape[1] - self.size
        for span in self._spans.values():
            if span.number.equals is not None and not extra:
                good &= (span.read(frames) == span.number.equals).all(axis=1)
        if self.sum is not None:
            span = self._spans[self.sum.number]
            summed = layout.summed_bytes(self.sum, span, self.size)
            moved = layout.NumberSpan(span.number, span.start + extra, span.order)
            stop = summed.stop + extra
            if moved.start < 0 or stop <= summed.start:
                return np.zeros(len(frames), dtype=bool)
            good &= layout.SUMS[self.sum.kind][0](frames[:, summed.start : stop]) == moved.read(frames)[:, 0]
        return good

    def _has_marks(self, packets: Bytes) -> Bools:
        """Return a mask (packet,) of the valid packets (packet, byte) with marker and tail."""
        good = self._are_valid(packets)
        marker, tail = _bytes("marker", self.marker), _bytes("tail", self.tail)
        good &= (packets[:, : len(marker)] == np.frombuffer(marker, np.uint8)).all(axis=1)
        good &= (packets[:, self.size - len(tail) :] == np.frombuffer(tail, np.uint8)).all(axis=1)
        return good

    def decode(self, frames: Bytes) -> Samples:
        """Return the channels (frame, channel) in one block per type, with sequence and clock.

        Frames whose size differs from that of the numbers contain no sample.
        """
        has_samples = frames.shape[1] == self.size
        data = frames if has_samples else np.zeros((0, self.size), dtype=np.uint8)
        rows = None if has_samples else np.zeros(0, dtype=np.int64)
        values = tuple(
            np.hstack([span.read(data) for span in block]) if len(block) > 1 else block[0].read(data)
            for block in self._blocks
        )
        seq = t_device_ns = None
        if self.sequence is not None:
            seq = self._spans[self.sequence.number].read(data)[:, 0].astype(np.int64)
        if self.clock is not None:
            ticks = self._spans[self.clock.number].read(data)[:, 0]
            t_device_ns = layout.device_ns(ticks, self.clock.unit)
        return Samples(values, seq=seq, t_device_ns=t_device_ns, rows=rows)

    @functools.cached_property
    def _blocks(self) -> list[list[layout.NumberSpan]]:
        """Groups of adjacent channels of one type."""
        blocks: list[list[layout.NumberSpan]] = []
        for span in self._channels:
            if blocks and blocks[-1][0].dtype == span.dtype:
                blocks[-1].append(span)
            else:
                blocks.append([span])
        return blocks

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these samples, with 0 in skipped numbers."""
        frames = np.zeros((len(samples), self.size), dtype=np.uint8)
        marker, tail = _bytes("marker", self.marker), _bytes("tail", self.tail)
        frames[:, : len(marker)] = np.frombuffer(marker, np.uint8)
        frames[:, self.size - len(tail) :] = np.frombuffer(tail, np.uint8)
        for block, values in zip(self._blocks, samples.values, strict=True):
            first = 0
            for span in block:
                span.write(frames, values[:, first : first + span.length])
                first += span.length
        for span in self._spans.values():
            if span.number.equals is not None:
                span.write(frames, np.full((len(frames), span.length), span.number.equals, dtype=span.dtype))
        if self.length is not None:
            self._write(self.length.number, frames, np.full(len(frames), self.size - self.length.plus))
        if self.sequence is not None and samples.seq is not None:
            self._write(self.sequence.number, frames, samples.seq % self.counter_modulus)
        if self.clock is not None and samples.t_device_ns is not None:
            span, unit_ns = self._spans[self.clock.number], layout.UNITS_NS[self.clock.unit]
            ticks: AnyArray = samples.t_device_ns / unit_ns
            if span.dtype.kind != "f":
                ticks = (samples.t_device_ns + unit_ns // 2) // unit_ns
                ticks = ticks % span.value_count if span.dtype.kind == "u" and span.width < 8 else ticks
            self._write(self.clock.number, frames, ticks)
        if self.sum is not None:
            summed = layout.summed_bytes(self.sum, self._spans[self.sum.number], self.size)
            self._write(self.sum.number, frames, layout.SUMS[self.sum.kind][0](frames[:, summed]))
        return frames

    def _write(self, name: str, frames: Bytes, numbers: AnyArray) -> None:
        span = self._spans[name]
        span.write(frames, numbers[:, None].astype(span.dtype))

    def opening(self, local: LocalAddress) -> Dialogue:
        """Write ``start``."""
        if self.start:
            yield Ask(_bytes("start", self.start))

    def closing(self) -> bytes:
        """Return ``stop``."""
        return _bytes("stop", self.stop)


def _channels_of_number(number: layout.Number) -> list[tuple[str, dict[str, str]]]:
    """Return the name and metadata of each channel of a number, which may be an array with axes."""
    quantity = sensor.quantity_of(number.name, number.quantity)
    metadata = {"unit": number.unit, "quantity": quantity}
    channels: list[tuple[str, dict[str, str]]] = []
    names = [number.name] if number.count == 1 else sensor.numbered_names(number.name, number.count)
    for taxel, name in enumerate(names, start=1):
        taxel_metadata = metadata if number.count == 1 or quantity != "tactile" else {**metadata, "taxel": str(taxel)}
        key = "axis" if quantity == "tactile" else "component"
        channels += [(f"{name}_{axis}", {**taxel_metadata, key: axis}) for axis in number.axes] or [
            (name, taxel_metadata)
        ]
    return channels


def _bytes(name: str, text: str) -> bytes:
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise UsageError(f'generic: {name} is {text!r}; it must be bytes in hexadecimal, such as "AA 55".') from None


MARKER = b"\xab\xcd"
SIZE = 64
READINGS = 12
PADDING = len(MARKER) + 2 * READINGS  # offset of the first zero
MAX_HZ = 1000.0  # one report per 1 ms frame of full-speed USB


@dataclass(frozen=True)
class RawHid(Sensor):
    """A custom board on raw HID, such as Teensy's RawHID: reports of 64 bytes in the layout of the published example.

    A report is ``AB CD``, twelve analog readings as big-endian uint16, zeros, and a big-endian packet counter in the
    last two bytes. There is no checksum, because USB protects each report with a CRC. Use ``generic`` for boards with
    other layouts. Source: TeensyRawHid.ino of hidapitester (public domain); 16C0:0486 is the product id of Teensy's
    RawHID.
    """

    summary: ClassVar[str] = "Custom boards on raw HID (Teensy RawHID): twelve analog readings and a counter."
    links: ClassVar[tuple[str, ...]] = ("hid",)
    counter: ClassVar[int | None] = 1 << 16
    usb_ids: ClassVar[tuple[str, ...]] = ("16c0:0486",)
    usage_page: ClassVar[int | None] = 0xFFAB  # a Teensy has another interface for its console

    rate_hz: float = 1000.0  # reports per second, at most 1000

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= MAX_HZ:
            raise UsageError(
                f"rawhid: rate_hz is {self.rate_hz:g}; it must be above 0 and at most 1000, the limit of full-speed USB."
            )

    def fields(self) -> list[pa.Field]:
        """Return ``analog01`` to ``analog12``, uint16 counts."""
        return [
            pa.field(f"analog{reading:02d}", pa.uint16(), metadata={"unit": "count", "quantity": "analog"})
            for reading in range(1, READINGS + 1)
        ]

    def framer(self) -> Framer:
        """Return a framer for reports with marker and zeros."""
        return PacketFramer([SIZE], _is_report)

    def decode(self, frames: Bytes) -> Samples:
        """Return the readings (frame, 12) and the board's counter."""
        words = np.ascontiguousarray(frames[:, 2:]).view(">u2")  # (frame, word)
        return Samples((words[:, :READINGS].astype(np.uint16),), seq=words[:, -1].astype(np.int64))

    def encode(self, samples: Samples) -> Bytes:
        """Return the reports of these samples."""
        (readings,) = samples.values
        assert samples.seq is not None
        reports = np.zeros((len(readings), SIZE), dtype=np.uint8)
        reports[:, :2] = np.frombuffer(MARKER, np.uint8)
        reports[:, 2:PADDING] = np.ascontiguousarray(readings, ">u2").view(np.uint8)
        reports[:, -2:] = (samples.seq % (1 << 16)).astype(">u2")[:, None].view(np.uint8)
        return reports


def _is_report(frames: Bytes) -> Bools:
    has_marker = (frames[:, :2] == np.frombuffer(MARKER, np.uint8)).all(axis=1)
    is_report: Bools = has_marker & ~frames[:, PADDING:-2].any(axis=1)
    return is_report
