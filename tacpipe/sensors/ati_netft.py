"""ATI Net F/T boxes: force and torque by UDP, up to 7000 times a second (RDT, raw data transfer).

A request is 8 bytes: 0x1234, a command, how many records are wanted (0: without end). A record is 36 bytes, big-endian: a
counter of records sent, a counter of samples taken, a status, six int32 counts. How many counts make a newton or a newton
metre stands on the box's configuration page. Source: ATI, Net F/T manual 9620-05-net ft, section 10.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from tacpipe.arrays import AnyArray, Bytes, Floats
from tacpipe.errors import UsageError
from tacpipe.sensors.framing import Framer, PacketFramer
from tacpipe.sensors.sensor import Ask, Device, Dialogue, LocalAddress, Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

REQUEST = struct.Struct(">HHI")  # 0x1234, command, records
MAGIC = 0x1234
STOP, START, BIAS = 0, 2, 0x42
STARTS = (1, START, 3)  # the first of newer boxes; the third buffers only where it is set up so
RECORD = np.dtype([("rdt_seq", ">u4"), ("ft_seq", ">u4"), ("status", ">u4"), ("counts", ">i4", 6)])
BIAS_S = 0.1  # time that the box needs to take its present load as zero


@dataclass(frozen=True)
class AtiNetFT(Sensor):
    """A force-torque sensor behind an ATI Net F/T box.

    The box sends every so-manieth of the samples it takes; its counter of samples is divided by that, so that it grows by
    one a record as the other does.
    """

    summary: ClassVar[str] = "ATI 6-axis force-torque sensors behind a Net F/T box."
    links: ClassVar[tuple[str, ...]] = ("udp",)
    counter: ClassVar[int | None] = 1 << 32
    exclusive: ClassVar[str] = "The box sends to one program: once another asks for records, they stop here."

    rate_hz: float = 7000.0  # RDT output rate on the box's communications page: what it takes, or a whole part of it
    internal_hz: float = 7000.0  # samples a second that the box takes: 7000 of a Net F/T, 7912 of an Ethernet Axia
    counts_per_force: float = 0.0  # counts a newton on the box's configuration page; 0: counts are kept as they are
    counts_per_torque: float = 0.0  # counts a newton metre; 0: counts are kept

    def __post_init__(self) -> None:
        if not 1 <= self.rate_hz <= self.internal_hz:
            raise UsageError(
                f"ati-netft: rate_hz is {self.rate_hz:g}; the box sends 1 to {self.internal_hz:g} a second (internal_hz)."
            )
        if (self.counts_per_force > 0) != (self.counts_per_torque > 0) or self.counts_per_force < 0:
            raise UsageError(
                f"ati-netft: counts_per_force is {self.counts_per_force:g} and counts_per_torque "
                f"{self.counts_per_torque:g}; give both as the box's configuration page states them, or neither."
            )
        object.__setattr__(self, "device_counter", (1 << 32) // self.every)

    @property
    def every(self) -> int:
        """How many samples the box takes for each that it sends."""
        return max(1, round(self.internal_hz / self.rate_hz))

    def fields(self) -> list[pa.Field]:
        """Return ``status`` (uint32, 0: all is well) and the load: int32 counts, or N and N m where those are given."""
        import pyarrow as pa

        from tacpipe.channels import schema

        status = pa.field("status", pa.uint32(), metadata={"unit": "1", "quantity": "status"})
        if self.counts_per_force:
            return [status, *schema.wrench_fields()]
        return [status] + [
            pa.field(f"{kind}_{axis}", pa.int32(), metadata={"unit": "count", "quantity": kind, "component": axis})
            for kind in ("force", "torque")
            for axis in schema.AXES
        ]

    def framer(self) -> Framer:
        """Return a framer that takes packets of a record's size; UDP has a sum of its own."""
        return PacketFramer([RECORD.itemsize])

    def decode(self, frames: Bytes) -> Samples:
        """Return status and load, with the counters of records sent and of samples taken."""
        records = np.ascontiguousarray(frames).view(RECORD)[:, 0]
        load: AnyArray = records["counts"].astype(np.int32)  # (frame, axis)
        if self.counts_per_force:
            load = load / self._scale
        return Samples(
            (records["status"].astype(np.uint32)[:, None], load),
            seq=records["rdt_seq"].astype(np.int64),
            device_seq=records["ft_seq"].astype(np.int64) // self.every,
        )

    def encode(self, samples: Samples) -> Bytes:
        """Return the records that hold these samples."""
        status, load = samples.values
        assert samples.seq is not None and samples.device_seq is not None
        records = np.zeros(len(load), RECORD)
        records["rdt_seq"] = samples.seq % (1 << 32)
        records["ft_seq"] = samples.device_seq * self.every % (1 << 32)
        records["status"] = status[:, 0]
        records["counts"] = np.rint(load * self._scale) if self.counts_per_force else load
        return records.view(np.uint8).reshape(len(load), RECORD.itemsize)

    @property
    def _scale(self) -> Floats:
        return np.repeat([self.counts_per_force, self.counts_per_torque], 3)  # (axis,)

    def opening(self, local: LocalAddress) -> Dialogue:
        """Ask for records without end; the first of them is the reply."""
        yield Ask(request(START))

    def closing(self) -> bytes:
        """Stop the stream."""
        return request(STOP)

    def taring(self) -> Dialogue:
        """Take the present load for zero."""
        yield Ask(request(BIAS), pause_s=BIAS_S)

    def device(self) -> Device:
        """Return a box that waits for a request."""
        return _Box(streaming=False)


class _Box(Device):
    """The box's side: streams without end, or as many records as it was asked for."""

    requested = 0

    def hear(self, data: bytes) -> list[bytes]:
        if len(data) != REQUEST.size:
            return []
        magic, command, count = REQUEST.unpack(data)
        if magic == MAGIC and command in STARTS:
            self.streaming, self.requested = count == 0, self.requested + count
        elif magic == MAGIC and command == STOP:
            self.streaming, self.requested = False, 0
        return []

    def polled(self) -> int:
        requested, self.requested = self.requested, 0
        return requested


def request(command: int, records: int = 0) -> bytes:
    """Return a request to the box for so many records, 0: without end.

    >>> request(START).hex(" ")
    '12 34 00 02 00 00 00 00'
    """
    return REQUEST.pack(MAGIC, command, records)
