"""A stream of Lab Streaming Layer (LSL), whose outlet describes its channels.

The link (`tacpipe.links.lsl`) returns three kinds of packets: ``D`` with the stream's description in XML, once after
opening; ``S`` with samples of numbers; ``T`` with markers as JSON. Each packet of samples contains the timestamps on the
sender's clock, and the correction that LSL measured last: the value to add to a timestamp to convert it to this
computer's clock.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Floats, Times
from tacpipe.channels import lsl
from tacpipe.channels.lsl import LslChannel
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.plugins.fields import is_encodable
from tacpipe.sensors.byte_framer import TextFramer
from tacpipe.sensors.framing import Chunks, Framer
from tacpipe.sensors.sensor import Options, Samples, Sensor

DESCRIPTION, NUMBERS, TEXTS = b"D", b"S", b"T"
HEAD = struct.Struct("<cdI")  # kind, correction in s (NaN before the first measurement), number of samples
CORRECTION = "lsl_correction_s"
RESERVED = ("t_ns", "t_device_ns", "seq", "device_seq", "t_uncertain_ns", CORRECTION)
Format = Literal["float32", "double64", "int8", "int16", "int32", "int64", "string"]


@dataclass(frozen=True)
class Lsl(Sensor):
    """An LSL stream. Omitted options are taken from the outlet when `tacpipe acquire` starts."""

    summary: ClassVar[str] = "A Lab Streaming Layer (LSL) stream of numbers or markers."
    links: ClassVar[tuple[str, ...]] = ("lsl",)
    described: ClassVar[bool] = True
    lossless: ClassVar[bool] = True
    guesses: ClassVar[Mapping[str, str]] = {
        "channels": "from the outlet; omit them to use those that it declares when a recording starts",
    }

    channels: tuple[LslChannel, ...] = ()  # channels of the stream, in order; if empty, those of the outlet
    format: Format = "float32"  # LSL's name of the value type; taken from the outlet together with the channels
    rate_hz: float = 0.0  # samples per second; 0: irregular

    def __post_init__(self) -> None:
        """Raise `UsageError` for invalid or repeated channel names and for a negative rate."""
        names = [channel.name for channel in self.channels]
        for name in names:
            if lsl.identifiers([name]) != [name] or name in RESERVED or names.count(name) > 1:
                raise UsageError(
                    f"lsl: {name!r} is not a valid channel name; use unique names of lower-case letters, digits and _, "
                    f"and none of {', '.join(RESERVED)}."
                )
        if not 0 <= self.rate_hz < float("inf"):
            raise UsageError(f"lsl: rate_hz is {self.rate_hz:g}; it must be 0 or above.")

    @property
    def incomplete(self) -> bool:  # type: ignore[override]
        """True if the channels come from the outlet."""
        return not self.channels

    @property
    def _is_text(self) -> bool:
        return self.format == "string"

    @property
    def _dtype(self) -> np.dtype[Any]:
        return np.dtype(lsl.FORMATS[self.format]).newbyteorder("<")

    def fields(self) -> list[pa.Field]:
        """Return one field per channel, and ``lsl_correction_s``, the offset from the sender's to this computer's clock."""
        kind = pa.string() if self._is_text else pa.from_numpy_dtype(self._dtype.newbyteorder("="))
        fields = []
        for channel in self.channels:
            unit, quantity = channel.unit or "1", channel.quantity or ("text" if self._is_text else "state")
            fields.append(
                pa.field(channel.name, kind, metadata={**channel.metadata, "unit": unit, "quantity": quantity})
            )
        return [*fields, pa.field(CORRECTION, pa.float64(), metadata={"unit": "s", "quantity": "time"})]

    def framer(self) -> Framer:
        """Return a framer for the link's packets."""
        return TextFramer(self._is_valid)

    def _is_valid(self, packet: bytes) -> bool:
        if packet[:1] == DESCRIPTION:
            return _parse_description(packet) is not None
        unpacked = self._unpack(packet)
        return unpacked is not None and bool((np.abs(unpacked[1]) < lsl.MAX_TIME_S).all())

    def _unpack(self, packet: bytes) -> tuple[float, Floats, AnyArray] | None:
        """Return the clock correction in s, timestamps (sample,) in s and values (sample, channel); None without samples."""
        if packet[:1] == (TEXTS if self._is_text else NUMBERS) and len(packet) >= HEAD.size:
            _, correction, count = HEAD.unpack_from(packet)
            stop = HEAD.size + 8 * count
            if self._is_text:
                values = _texts(packet[stop:], count, len(self.channels))
            elif len(packet) == stop + count * len(self.channels) * self._dtype.itemsize:
                values = np.frombuffer(packet, self._dtype, offset=stop).reshape(count, len(self.channels))
            else:
                values = None
            if values is not None and count:
                return correction, np.frombuffer(packet, "<f8", count, HEAD.size), values
        return None

    def decode(self, frames: Sequence[bytes]) -> Samples:
        """Return the samples in packets: channels, clock corrections, and timestamps as sent.

        Packets without samples are skipped.
        """
        unpacked = [(row, self._unpack(frame)) for row, frame in enumerate(frames)]
        parts = [(row, packet) for row, packet in unpacked if packet is not None]
        counts = [len(block[1]) for _, block in parts]
        corrections = np.repeat([block[0] for _, block in parts], counts).astype(np.float64)[:, None]
        kind = object if self._is_text else self._dtype.newbyteorder("=")
        empty = np.zeros((0, len(self.channels)), dtype=kind)
        values = np.concatenate([empty, *(block[2] for _, block in parts)]).astype(kind)
        stamps = np.concatenate([np.zeros(0), *(block[1] for _, block in parts)])
        blocks = (values, corrections) if self.channels else (corrections,)
        return Samples(
            (np.hstack(blocks),) if values.dtype == corrections.dtype else blocks,
            t_device_ns=lsl.nanoseconds(stamps),
            rows=np.repeat([row for row, _ in parts], counts).astype(np.int64),
        )

    def encode(self, samples: Samples) -> list[bytes]:
        """Return one packet per sample."""
        assert samples.t_device_ns is not None
        corrections = samples.values[-1][:, -1].tolist()
        stamps: Times = samples.t_device_ns
        return [
            pack_samples(
                samples.values[0][row : row + 1, : len(self.channels)], stamps[row : row + 1] / 1e9, corrections[row]
            )
            for row in range(len(samples))
        ]


def pack_samples(values: AnyArray, stamps: Floats, correction: float) -> bytes:
    """Return a packet of samples (sample, channel) with timestamps (sample,) in s. Values of type object are texts."""
    is_text = values.dtype.kind == "O"
    head = HEAD.pack(TEXTS if is_text else NUMBERS, correction, len(stamps)) + stamps.astype("<f8").tobytes()
    if is_text:
        return head + json.dumps(values.tolist()).encode()
    return head + np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<")).tobytes()


def guess_options(data: Chunks) -> list[Options]:
    """Return the options of the stream whose description is among the packets, or an empty list without a description."""
    for packet in data.packets():
        description = _parse_description(packet) if packet[:1] == DESCRIPTION else None
        if description is not None:
            channels = [_entry(channel, text=description.is_text) for channel in description.channels]
            return [{"channels": channels, "format": description.format, "rate_hz": description.rate_hz}]
    return []


def _entry(channel: LslChannel, *, text: bool) -> dict[str, str]:
    """Return a channel as in a rig file. Metadata that is the same for all text channels is omitted."""
    name = f"{channel.name}_channel" if channel.name in RESERVED else channel.name
    return {"name": name, **({} if text else channel.metadata)}


def _parse_description(data: bytes) -> lsl.LslDescription | None:
    try:
        return lsl.parse(data[1:])
    except TacpipeError:
        return None


def _texts(data: bytes, count: int, channels: int) -> AnyArray | None:
    """Return the texts (sample, channel) in a packet, or None if it is invalid."""
    try:
        rows = json.loads(data)
    except (ValueError, RecursionError):
        return None
    if not isinstance(rows, list) or len(rows) != count:
        return None
    if not all(isinstance(row, list) and len(row) == channels for row in rows):
        return None
    if not all(isinstance(word, str) and is_encodable(word) for row in rows for word in row):
        return None
    return np.array(rows, dtype=object).reshape(count, channels)
