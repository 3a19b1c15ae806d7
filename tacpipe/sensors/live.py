"""What `tacpipe live` publishes, as a stream of a rig: its forecasts, its alarms, or how long they took.

A packet is ``tacL``, the version, what it holds (0 forecast, 1 alarm, 2 latency, 3 material, 4 touch), a counter of 32 bits
and the time of the grid point in UTC ns, and then numbers, all little-endian: of a forecast float32 by step and channel,
and the same of each quantile that is published, of
alarms a state and a score each, of latencies the numbers of `LATENCY`, of materials those of `SLIDE` and a probability each,
of a grasp's touch `ORDER`, `WORTH` and the predicted values. So what a session publishes is recorded like any sensor, by any
computer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Bytes
from tacpipe.errors import UsageError
from tacpipe.sensors.framing import Framer
from tacpipe.sensors.packet_framer import PacketFramer
from tacpipe.sensors.sensor import Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

Output = Literal["forecast", "alarm", "latency", "material", "touch"]

MAGIC, VERSION = b"tacL", 1
KINDS: dict[str, int] = {"forecast": 0, "alarm": 1, "latency": 2, "material": 3, "touch": 4}
HEAD = np.dtype([("magic", "S4"), ("version", "u1"), ("kind", "u1"), ("rest", "<u2"), ("seq", "<u4"), ("t_ns", "<i8")])
UNKNOWN, OFF, ON = -1, 0, 1  # states of an alarm
MOST = 60_000  # bytes of a packet
LATENCY = {  # column to unit
    "latency_ms": "ms",  # from the arrival of the newest sample that was read to when the forecast was published
    "age_ms": "ms",  # from the arrival of the newest sample of the master to the same moment
    "compute_ms": "ms",  # of it, what rows, model and alarms took
    "cause": "1",  # flags of `tacpipe.tasks.forward.live.chain.Cause`
    "skipped": "1",  # grid points so far whose forecast was left out under overload
    "late": "1",  # samples so far that came after the row that they belong to
}
ORDER = ("request", "grasp", "rank")  # of a touch, 1 for the best of a request
WORTH = ("score", "level_th", "level_mf")  # of a touch
SLIDE = {  # column to unit
    "class": "1",  # number of the material among those of the model, from 0; -1: unknown
    "rows": "1",  # rows of the slide so far
    "seen": "1",  # of the rows that the model reads, the fraction that has come
    "ended": "1",  # whether the slide is over
    "slide": "1",  # number of the slide in its recording, from 1
}


@dataclass(frozen=True, kw_only=True)
class Live(Sensor):
    """One of the outputs of a live session."""

    summary: ClassVar[str] = "Forecasts, alarms, materials, rankings or latencies that `tacpipe live` publishes by UDP."
    links: ClassVar[tuple[str, ...]] = ("udp",)
    listens: ClassVar[bool] = True
    steady: ClassVar[bool] = False
    counter: ClassVar[int | None] = 1 << 32

    output: Output = "latency"  # what the packets hold: forecast, alarm, latency, material or touch
    # of a forecast and of touch: what is predicted; of materials: their names
    channels: tuple[str, ...] = ()
    steps: tuple[int, ...] = ()  # of a forecast: how many rows ahead
    quantiles: tuple[int, ...] = ()  # of a forecast: levels in percent
    unit: str = "count"  # of the channels
    alarms: tuple[str, ...] = ()  # of alarms: their names
    rate_hz: float = 0.0  # packets a second; 0: they come when they come

    def __post_init__(self) -> None:
        missing = {
            "forecast": not (self.channels and self.steps),
            "alarm": not self.alarms,
            "latency": False,
            "material": not self.channels,
            "touch": not self.channels,
        }
        if missing[self.output]:
            needed = {"forecast": "channels and steps", "alarm": "alarms"}.get(self.output, "channels")
            raise UsageError(f"live: a stream of the output {self.output} needs {needed}.")
        if self.size > MOST:
            raise UsageError(
                f"live: {len(self.channels)} channels at {len(self.steps)} steps with {len(self.quantiles)} quantiles make "
                f"packets of {self.size} bytes, and UDP carries {MOST}. Give fewer --steps."
            )

    @property
    def size(self) -> int:
        """Bytes of a packet."""
        return HEAD.itemsize + self._rows(0).itemsize

    def _rows(self, count: int) -> AnyArray:
        """Return the numbers of ``count`` packets, zeros."""
        values = len(self.channels) * len(self.steps)
        levels = [("quantiles", "<f4", (len(self.quantiles) * values,))] if self.quantiles else []
        parts = {
            "forecast": [("values", "<f4", (values,)), *levels],
            "alarm": [("state", "i1", (len(self.alarms),)), ("score", "<f4", (len(self.alarms),))],
            "latency": [("values", "<f4", (len(LATENCY),))],
            "touch": [("order", "<i8", (len(ORDER),)), ("values", "<f4", (len(WORTH) + len(self.channels),))],
            "material": [("slide", "<f4", (len(SLIDE),)), ("probability", "<f4", (len(self.channels),))],
        }
        return np.zeros(count, dtype=parts[self.output])

    def fields(self) -> list[pa.Field]:
        """Return a field for each step and channel and for each quantile of these, for state and score of each alarm, for
        each of `LATENCY`, or for each of `SLIDE` and the probability of each material.
        """
        import pyarrow as pa

        if self.output == "latency":
            return [
                pa.field(name, pa.float32(), metadata={"unit": unit, "quantity": "latency"})
                for name, unit in LATENCY.items()
            ]
        if self.output == "alarm":
            about = {"unit": "1", "quantity": "alarm"}
            states = [pa.field(f"{name}_state", pa.int8(), metadata=about) for name in self.alarms]
            return states + [pa.field(f"{name}_score", pa.float32(), metadata=about) for name in self.alarms]
        if self.output == "touch":
            about = {"unit": "1", "quantity": "prediction"}
            order = [pa.field(name, pa.int64(), metadata=about) for name in ORDER]
            worth = [pa.field(name, pa.float32(), metadata=about) for name in WORTH]
            touch = [pa.field(name, pa.float32(), metadata={**about, "unit": self.unit}) for name in self.channels]
            return [*order, *worth, *touch]
        if self.output == "material":
            about = {"unit": "1", "quantity": "material"}
            slide = [pa.field(name, pa.float32(), metadata=about) for name in SLIDE]
            return slide + [
                pa.field(f"probability_{name}", pa.float32(), metadata={**about, "material": name})
                for name in self.channels
            ]
        found = []
        for level in (None, *self.quantiles):
            ending, about = ("", {}) if level is None else (f"_q{level}", {"quantile": f"{level / 100:g}"})
            found += [
                pa.field(
                    f"{channel}_t{step}{ending}",
                    pa.float32(),
                    metadata={"unit": self.unit, "quantity": "prediction", "step": str(step), **about},
                )
                for step in self.steps
                for channel in self.channels
            ]
        return found

    def framer(self) -> Framer:
        """Return a framer that takes packets of this output and size."""
        return PacketFramer([self.size], self._is_right)

    def _is_right(self, packets: Bytes) -> Bools:
        heads = np.ascontiguousarray(packets[:, : HEAD.itemsize]).view(HEAD)[:, 0]
        found: Bools = (
            (heads["magic"] == MAGIC)
            & (heads["version"] == VERSION)
            & (heads["kind"] == KINDS[self.output])
            & (heads["rest"] == 0)
        )
        return found

    def decode(self, frames: Bytes) -> Samples:
        """Return a sample a packet; the time of the grid point is the device's time."""
        heads = np.ascontiguousarray(frames[:, : HEAD.itemsize]).view(HEAD)[:, 0]
        rows = np.ascontiguousarray(frames[:, HEAD.itemsize :]).view(self._rows(0).dtype)[:, 0]
        values = tuple(rows[name] for name in rows.dtype.names or ())
        return Samples(values, heads["seq"].astype(np.int64), heads["t_ns"].astype(np.int64))

    def encode(self, samples: Samples) -> Bytes:
        """Return the packets of samples."""
        heads = np.zeros(len(samples), dtype=HEAD)
        heads["magic"], heads["version"], heads["kind"] = MAGIC, VERSION, KINDS[self.output]
        heads["seq"], heads["t_ns"] = samples.seq, samples.t_device_ns
        rows = self._rows(len(samples))
        for name, block in zip(rows.dtype.names or (), samples.values, strict=True):
            rows[name] = block
        return np.hstack([one.view(np.uint8).reshape(len(samples), -1) for one in (heads, rows)])
