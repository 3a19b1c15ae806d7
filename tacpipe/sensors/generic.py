"""A lab's own board, described in the rig file and nowhere else: its frame, number by number, and what they are for.

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
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Bytes, Int64s
from tacpipe.errors import UsageError
from tacpipe.sensors import layout, sensor
from tacpipe.sensors.byte_framer import ByteFramer
from tacpipe.sensors.framing import Framer, Framing, PacketFramer
from tacpipe.sensors.layout import Board, Clock, DescribedSensor, Length, Number, Order, Place, Sequence, Sum, device_ns
from tacpipe.sensors.sensor import Ask, Device, Dialogue, LocalAddress, Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

MOST = 4096  # bytes of a frame


@dataclass(frozen=True, kw_only=True)
class Generic(DescribedSensor):
    """A board that the rig file describes."""

    summary: ClassVar[str] = "A lab's own board: binary frames as the rig file describes them."
    links: ClassVar[tuple[str, ...]] = ("serial", "tcp", "udp", "hid")

    rate_hz: float  # frames a second
    numbers: tuple[Number, ...]  # the numbers between marker and tail, in their order, without gaps
    marker: str = ""  # bytes that each frame begins with, in hexadecimal: "AA 55"
    tail: str = ""  # bytes that each frame ends with, in hexadecimal: "0D 0A"
    order: Order = "little"  # byte order of numbers: little or big, the end that comes first
    sum: Sum | None = None  # how a frame is summed, and which number holds that
    sequence: Sequence | None = None  # the number that counts the frames
    clock: Clock | None = None  # the number that is the device's time
    length: Length | None = None  # the number that states the size of a frame; none: all have the same
    packets: bool = False  # each packet of the link is a frame (udp, hid), which then needs no marker
    start: str = ""  # bytes that start the stream, in hexadecimal; none: the board streams by itself
    stop: str = ""  # bytes that stop the stream, in hexadecimal
    baud: int = 115_200  # baud rate of a serial port

    def __post_init__(self) -> None:
        sensor.positive("generic", rate_hz=self.rate_hz, baud=self.baud)
        for name in ("marker", "tail", "start", "stop"):
            _bytes(name, getattr(self, name))
        if not (self.marker or self.tail or self.packets):
            raise UsageError(
                'generic: no option marks where a frame begins; give marker or tail, such as marker = "AA 55", or '
                "packets = true where each packet of the link is a frame."
            )
        if self.size > MOST:
            raise UsageError(f"generic: a frame has {self.size} bytes; it must be {MOST} at most.")
        if not self._channels:
            raise UsageError("generic: no number is a channel; list in numbers what the board measures.")
        self._check_names()
        self._check_roles()
        place = self._places[self.clock.number] if self.clock is not None else None
        if self.clock is not None and place is not None and place.kind.kind in "ui" and place.width < 8:
            wrap_ns = place.range * layout.UNITS_NS[self.clock.unit]  # a u32 of microseconds wraps after 71.6 minutes
            object.__setattr__(self, "device_wrap_ns", wrap_ns)

    def _check_names(self) -> None:
        names = [name for place in self._channels for name, _ in _names(place.number)]
        if repeated := next((name for name in names if names.count(name) > 1), None):
            raise UsageError(f"generic: two channels are named {repeated}; give the numbers other names.")

    def _check_roles(self) -> None:
        """Raise `UsageError` unless sum, sequence, clock and length each have a number of their own that can hold it."""
        roles = [role for role in (self.sum, self.sequence, self.clock, self.length) if role is not None]
        numbers = [role.number for role in roles]
        if repeated := next((name for name in numbers if numbers.count(name) > 1), None):
            raise UsageError(
                f"generic: the number {repeated} has two roles; each of sum, sequence, clock, length needs its own."
            )
        if self.sum is not None:
            layout.summed(self.sum, layout.referred(self._places, "sum", self.sum.number), self.size)
        if self.sequence is not None:
            place = layout.referred(self._places, "sequence", self.sequence.number)
            sensor.within("generic", "width of the sequence in bits", 8 * place.width, 8, 32)
            if not (self.sequence.modulus == 0 or 2 <= self.sequence.modulus <= place.range):
                raise UsageError(
                    f"generic: the sequence has modulus = {self.sequence.modulus}; its number is {place.number.type}, so it "
                    f"must be between 2 and {place.range}, or 0 for that."
                )
            sensor.within("generic", "step of the sequence", self.sequence.step, 1, self.counter_modulus - 1)
        if self.clock is not None:
            layout.referred(self._places, "clock", self.clock.number, "uif")
        if self.length is not None:
            place = layout.referred(self._places, "length", self.length.number)
            if not 0 <= self.size - self.length.plus < place.range:
                raise UsageError(
                    f"generic: the length would be {self.size - self.length.plus} for a frame of {self.size} bytes, of "
                    f"which it does not count {self.length.plus}, as plus states; it must be between 0 and "
                    f"{place.range - 1}."
                )

    @functools.cached_property
    def _places(self) -> dict[str, Place]:
        return layout.places(self.numbers, len(_bytes("marker", self.marker)), self.order)

    @functools.cached_property
    def size(self) -> int:
        """How many bytes a frame with a sample has."""
        last = max((place.stop for place in self._places.values()), default=len(_bytes("marker", self.marker)))
        return last + len(_bytes("tail", self.tail))

    @functools.cached_property
    def _channels(self) -> list[Place]:
        roles = {role.number for role in (self.sum, self.sequence, self.clock, self.length) if role is not None}
        return [
            place
            for name, place in self._places.items()
            if name not in roles and not place.number.skip and place.number.equals is None
        ]

    def _counting(self) -> tuple[Sequence, int] | None:
        return None if self.sequence is None else (self.sequence, self._places[self.sequence.number].range)

    def fields(self) -> list[pa.Field]:
        """Return a field a channel, in the order of the numbers, with unit, quantity, taxel and axis."""
        import pyarrow as pa

        return [
            pa.field(name, pa.from_numpy_dtype(place.kind), metadata=metadata)
            for place in self._channels
            for name, metadata in _names(place.number)
        ]

    def framer(self) -> Framer:
        """Return a framer of frames with marker, tail, sum and what is always the same."""
        fixed = [place for place in self._places.values() if place.number.equals is not None]
        check = self._is_right if self.sum or fixed else None
        if self.packets:
            return PacketFramer([self.size], self._has_marks)
        marker, tail = _bytes("marker", self.marker), _bytes("tail", self.tail)
        weak = self.sum is None
        confirm = int(layout.SUMS[self.sum.kind][1] == 1) if self.sum else int(bool(marker))
        framing = Framing(marker, tail, check=check, lock=3 if weak else 2, confirm=confirm, most=MOST, weak=weak)
        if self.length is None:
            return ByteFramer(replace(framing, size=self.size))
        header = max(self._places[self.length.number].stop, len(marker) + 1)
        return ByteFramer(replace(framing, header=header, sizes=self._sizes))

    def _sizes(self, heads: Bytes) -> Int64s:
        assert self.length is not None
        declared = self._places[self.length.number].take(heads)[:, 0]
        sizes: Int64s = np.minimum(declared.astype(np.uint64), MOST + 1).astype(np.int64) + self.length.plus
        return sizes

    def _is_right(self, frames: Bytes) -> Bools:
        """Return which frames (frame, byte) of one size have their sum, and what is always the same.

        In a frame of another size than a sample's the sum is as far from the end, and nothing else is known.
        """
        good = np.ones(len(frames), dtype=bool)
        longer = frames.shape[1] - self.size
        for place in self._places.values():
            if place.number.equals is not None and not longer:
                good &= (place.take(frames) == place.number.equals).all(axis=1)
        if self.sum is not None:
            place = self._places[self.sum.number]
            span = layout.summed(self.sum, place, self.size)
            moved = Place(place.number, place.at + longer, place.order)
            stop = span.stop + longer
            if moved.at < 0 or stop <= span.start:
                return np.zeros(len(frames), dtype=bool)
            good &= layout.SUMS[self.sum.kind][0](frames[:, span.start : stop]) == moved.take(frames)[:, 0]
        return good

    def _has_marks(self, packets: Bytes) -> Bools:
        """Return which packets (packet, byte) have marker and tail, and are right otherwise."""
        good = self._is_right(packets)
        marker, tail = _bytes("marker", self.marker), _bytes("tail", self.tail)
        good &= (packets[:, : len(marker)] == np.frombuffer(marker, np.uint8)).all(axis=1)
        good &= (packets[:, self.size - len(tail) :] == np.frombuffer(tail, np.uint8)).all(axis=1)
        return good

    def decode(self, frames: Bytes) -> Samples:
        """Return the channels (frame, channel), side by side by their type, with sequence and clock.

        Frames of another size than the numbers have together hold no sample.
        """
        if frames.shape[1] != self.size:
            frames, rows = np.zeros((0, self.size), dtype=np.uint8), np.zeros(0, dtype=np.int64)
        else:
            rows = None
        values = tuple(
            np.hstack([place.take(frames) for place in block]) if len(block) > 1 else block[0].take(frames)
            for block in self._blocks
        )
        seq = t_device_ns = None
        if self.sequence is not None:
            seq = self._places[self.sequence.number].take(frames)[:, 0].astype(np.int64)
        if self.clock is not None:
            ticks = self._places[self.clock.number].take(frames)[:, 0]
            t_device_ns = device_ns(ticks, self.clock.unit)
        return Samples(values, seq=seq, t_device_ns=t_device_ns, rows=rows)

    @functools.cached_property
    def _blocks(self) -> list[list[Place]]:
        """Neighbouring channels of one type."""
        blocks: list[list[Place]] = []
        for place in self._channels:
            if blocks and blocks[-1][0].kind == place.kind:
                blocks[-1].append(place)
            else:
                blocks.append([place])
        return blocks

    def encode(self, samples: Samples) -> Bytes:
        """Return the frames of these samples, 0 in what is skipped."""
        frames = np.zeros((len(samples), self.size), dtype=np.uint8)
        marker, tail = _bytes("marker", self.marker), _bytes("tail", self.tail)
        frames[:, : len(marker)] = np.frombuffer(marker, np.uint8)
        frames[:, self.size - len(tail) :] = np.frombuffer(tail, np.uint8)
        for block, values in zip(self._blocks, samples.values, strict=True):
            first = 0
            for place in block:
                place.put(frames, values[:, first : first + place.many])
                first += place.many
        for place in self._places.values():
            if place.number.equals is not None:
                place.put(frames, np.full((len(frames), place.many), place.number.equals, dtype=place.kind))
        if self.length is not None:
            self._put(self.length.number, frames, np.full(len(frames), self.size - self.length.plus))
        if self.sequence is not None and samples.seq is not None:
            self._put(self.sequence.number, frames, samples.seq % self.counter_modulus)
        if self.clock is not None and samples.t_device_ns is not None:
            place, unit_ns = self._places[self.clock.number], layout.UNITS_NS[self.clock.unit]
            ticks: AnyArray = samples.t_device_ns / unit_ns
            if place.kind.kind != "f":
                ticks = (samples.t_device_ns + unit_ns // 2) // unit_ns
                ticks = ticks % place.range if place.kind.kind == "u" and place.width < 8 else ticks
            self._put(self.clock.number, frames, ticks)
        if self.sum is not None:
            span = layout.summed(self.sum, self._places[self.sum.number], self.size)
            self._put(self.sum.number, frames, layout.SUMS[self.sum.kind][0](frames[:, span]))
        return frames

    def _put(self, name: str, frames: Bytes, numbers: AnyArray) -> None:
        place = self._places[name]
        place.put(frames, numbers[:, None].astype(place.kind))

    def opening(self, local: LocalAddress) -> Dialogue:
        """Write ``start``."""
        if self.start:
            yield Ask(_bytes("start", self.start))

    def closing(self) -> bytes:
        """Return ``stop``."""
        return _bytes("stop", self.stop)

    def device(self) -> Device:
        """Return a board that streams from the start, or from when it hears ``start`` until it hears ``stop``."""
        start, stop = _bytes("start", self.start), _bytes("stop", self.stop)
        return Board(streaming=not start, start=start, stop=stop)


def _names(number: Number) -> list[tuple[str, dict[str, str]]]:
    """Return name and metadata of each channel that a number is."""
    metadata = {"unit": number.unit, "quantity": number.quantity}
    channels: list[tuple[str, dict[str, str]]] = []
    names = [number.name] if number.count == 1 else sensor.numbered(number.name, number.count)
    for place, name in enumerate(names, start=1):
        mine = metadata if number.count == 1 or number.quantity != "tactile" else {**metadata, "taxel": str(place)}
        key = "axis" if number.quantity == "tactile" else "component"
        channels += [(f"{name}_{axis}", {**mine, key: axis}) for axis in number.axes] or [(name, mine)]
    return channels


def _bytes(name: str, text: str) -> bytes:
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise UsageError(f'generic: {name} is {text!r}; it must be bytes in hexadecimal, such as "AA 55".') from None


MARKER = b"\xab\xcd"
SIZE = 64
READINGS = 12
BEHIND = len(MARKER) + 2 * READINGS  # place of the first zero
FASTEST_HZ = 1000.0  # one report in each 1 ms frame of full-speed USB


@dataclass(frozen=True)
class RawHid(Sensor):
    """A self-made board on raw HID, as Teensy's RawHID: reports of 64 bytes in the layout of the published example.

    A report is ``AB CD``, twelve analog readings as big-endian uint16, zeros, and in the last two bytes a big-endian packet
    counter. There is no sum: USB guards each report with a CRC. A board with another layout is described with ``generic``.
    Source: TeensyRawHid.ino of hidapitester (public domain); 16C0:0486 is the product id of Teensy's RawHID.
    """

    summary: ClassVar[str] = "Self-made boards on raw HID (Teensy RawHID): twelve analog readings and a counter."
    links: ClassVar[tuple[str, ...]] = ("hid",)
    counter: ClassVar[int | None] = 1 << 16
    usb_ids: ClassVar[tuple[str, ...]] = ("16c0:0486",)
    usage_page: ClassVar[int | None] = 0xFFAB  # another interface of a Teensy is its console

    rate_hz: float = 1000.0  # reports a second, at most 1000

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= FASTEST_HZ:
            raise UsageError(
                f"rawhid: rate_hz is {self.rate_hz:g}; full-speed USB carries more than 0 and at most 1000 reports a second."
            )

    def fields(self) -> list[pa.Field]:
        """Return ``analog01`` to ``analog12``, uint16 counts."""
        import pyarrow as pa

        return [
            pa.field(f"analog{reading:02d}", pa.uint16(), metadata={"unit": "count", "quantity": "analog"})
            for reading in range(1, READINGS + 1)
        ]

    def framer(self) -> Framer:
        """Return a framer of reports that have their marker and zeros."""
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
        reports[:, 2:BEHIND] = np.ascontiguousarray(readings, ">u2").view(np.uint8)
        reports[:, -2:] = (samples.seq % (1 << 16)).astype(">u2")[:, None].view(np.uint8)
        return reports


def _is_report(frames: Bytes) -> Bools:
    marked = (frames[:, :2] == np.frombuffer(MARKER, np.uint8)).all(axis=1)
    zero: Bools = marked & ~frames[:, BEHIND:-2].any(axis=1)
    return zero
