"""ATI Net F/T boxes: force and torque by UDP at up to 7000 Hz (RDT, raw data transfer).

A request has 8 bytes: 0x1234, a command, and the number of records (0: unlimited). A record has 36 bytes, big-endian: a
counter of sent records, a counter of measured samples, a status, and six int32 counts. The box's configuration page shows
the counts per newton and newton metre. Source: ATI, Net F/T manual 9620-05-net ft, section 10.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray, Bytes, Floats
from tacpipe.channels import schema
from tacpipe.errors import UsageError
from tacpipe.sensors.framing import Framer, PacketFramer
from tacpipe.sensors.sensor import Ask, Dialogue, LocalAddress, Samples, Sensor

REQUEST = struct.Struct(">HHI")  # 0x1234, command, records
MAGIC = 0x1234
STOP, START, BIAS = 0, 2, 0x42
RECORD = np.dtype([("rdt_seq", ">u4"), ("ft_seq", ">u4"), ("status", ">u4"), ("counts", ">i4", 6)])
BIAS_S = 0.1  # time that the box needs to zero its load


@dataclass(frozen=True)
class AtiNetFT(Sensor):
    """A force-torque sensor behind an ATI Net F/T box.

    If the box sends only every n-th sample (``decimation``), its counter of samples is divided by n, so that both
    counters increase by one per record.
    """

    summary: ClassVar[str] = "ATI 6-axis force-torque sensors behind a Net F/T box."
    links: ClassVar[tuple[str, ...]] = ("udp",)
    counter: ClassVar[int | None] = 1 << 32
    exclusive: ClassVar[str] = "The box sends to one program: if another requests records, they stop here."

    # RDT output rate on the box's communications page: internal_hz, or that divided by a whole number
    rate_hz: float = 7000.0
    internal_hz: float = 7000.0  # internal sampling rate in Hz: 7000 for a Net F/T, 7912 for an Ethernet Axia
    counts_per_force: float = 0.0  # counts per newton on the box's configuration page; 0: counts are not converted
    counts_per_torque: float = 0.0  # counts per newton metre; 0: counts are not converted

    def __post_init__(self) -> None:
        if not 1 <= self.rate_hz <= self.internal_hz:
            raise UsageError(
                f"ati-netft: rate_hz is {self.rate_hz:g}; it must be between 1 and {self.internal_hz:g} (internal_hz)."
            )
        if (self.counts_per_force > 0) != (self.counts_per_torque > 0) or self.counts_per_force < 0:
            raise UsageError(
                f"ati-netft: counts_per_force is {self.counts_per_force:g} and counts_per_torque "
                f"{self.counts_per_torque:g}; give both, from the box's configuration page, or neither."
            )
        object.__setattr__(self, "device_counter", (1 << 32) // self.decimation)

    @property
    def decimation(self) -> int:
        """The number of samples that the box measures per sample that it sends."""
        return max(1, round(self.internal_hz / self.rate_hz))

    def fields(self) -> list[pa.Field]:
        """Return ``status`` (uint32, 0: no error) and the load: int32 counts, or N and N m if counts per unit are set."""
        status = pa.field("status", pa.uint32(), metadata={"unit": "1", "quantity": "status"})
        if self.counts_per_force:
            return [status, *schema.wrench_fields()]
        return [status] + [
            pa.field(f"{kind}_{axis}", pa.int32(), metadata={"unit": "count", "quantity": kind, "component": axis})
            for kind in ("force", "torque")
            for axis in schema.AXES
        ]

    def framer(self) -> Framer:
        """Return a framer for packets with the size of a record; UDP has its own checksum."""
        return PacketFramer([RECORD.itemsize])

    def decode(self, frames: Bytes) -> Samples:
        """Return status and load, with the counters of sent records and of measured samples."""
        records = np.ascontiguousarray(frames).view(RECORD)[:, 0]
        load: AnyArray = records["counts"].astype(np.int32)  # (frame, axis)
        if self.counts_per_force:
            load = load / self._scale
        return Samples(
            (records["status"].astype(np.uint32)[:, None], load),
            seq=records["rdt_seq"].astype(np.int64),
            device_seq=records["ft_seq"].astype(np.int64) // self.decimation,
        )

    def encode(self, samples: Samples) -> Bytes:
        """Return the records of these samples."""
        status, load = samples.values
        assert samples.seq is not None and samples.device_seq is not None
        records = np.zeros(len(load), RECORD)
        records["rdt_seq"] = samples.seq % (1 << 32)
        records["ft_seq"] = samples.device_seq * self.decimation % (1 << 32)
        records["status"] = status[:, 0]
        records["counts"] = np.rint(load * self._scale) if self.counts_per_force else load
        return records.view(np.uint8).reshape(len(load), RECORD.itemsize)

    @property
    def _scale(self) -> Floats:
        return np.repeat([self.counts_per_force, self.counts_per_torque], 3)  # (axis,)

    def opening(self, local: LocalAddress) -> Dialogue:
        """Request an unlimited number of records. The first record is the reply."""
        yield Ask(request(START))

    def closing(self) -> bytes:
        """Stop the stream."""
        return request(STOP)

    def taring(self) -> Dialogue:
        """Zero the load."""
        yield Ask(request(BIAS), pause_s=BIAS_S)


def request(command: int, records: int = 0) -> bytes:
    """Return a request to the box for ``records`` records; 0 means unlimited.

    >>> request(START).hex(" ")
    '12 34 00 02 00 00 00 00'
    """
    return REQUEST.pack(MAGIC, command, records)
