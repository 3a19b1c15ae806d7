"""Record what `tacpipe live` publishes, as streams of a rig.

A task declares each value of its messages once (`Value`): name, type, unit and meaning. The JSON, the packets, the columns
of the recorded streams and the reference page follow from the declaration (`Declaration`).

A packet is ``tacL``, a version, the number of its stream, a counter of 32 bits and the time of the message in UTC ns. The
declared values follow, in their order. All numbers are little-endian.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Bytes
from tacpipe.errors import UsageError
from tacpipe.plugins import registry
from tacpipe.printable import listed, plain
from tacpipe.sensors.framing import Framer, PacketFramer
from tacpipe.sensors.sensor import Samples, Sensor

if TYPE_CHECKING:
    import pyarrow as pa

MAGIC, VERSION = b"tacL", 1
HEAD = np.dtype([("magic", "S4"), ("version", "u1"), ("kind", "u1"), ("rest", "<u2"), ("seq", "<u4"), ("t_ns", "<i8")])
UNKNOWN, OFF, ON = -1, 0, 1  # states of an alarm
LARGEST_PACKET = 60_000  # bytes
LATENCY = "latency"  # stream that every session records
LATENCY_NUMBER = 2  # its number in packets
LSL = "lsl"  # channels of the published LSL stream; not recorded


class MessageSizes(Protocol):
    """Lists over which the values of a message repeat; the sensor `Live` and a task's `Description` have them."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the predicted channels or classes."""

    @property
    def steps(self) -> tuple[int, ...]:
        """Rows ahead that are predicted."""

    @property
    def quantiles(self) -> tuple[int, ...]:
        """Levels of quantiles, percent."""

    @property
    def unit(self) -> str:
        """Unit of the channels."""

    @property
    def alarms(self) -> tuple[str, ...]:
        """Names of the alarms."""


class LiveColumn(NamedTuple):
    """One number of a recorded stream."""

    name: str
    unit: str = "1"
    metadata: Mapping[str, str] = {}  # further metadata of the recorded column


@dataclass(frozen=True)
class Value:
    """One declared value of a message: a field of its JSON, columns of recorded streams, or both."""

    name: str
    meaning: str
    json: str = ""  # its JSON type; empty: it is recorded only
    digits: int | None = None  # digits of a number in JSON, which is null where it is not finite
    # streams whose columns it gives: recorded ones, and `LSL`
    streams: tuple[str, ...] = ()
    type: str = "<f4"  # type of each column, as numpy names it
    unit: str = ""
    quantity: str = ""  # metadata of the recorded columns
    columns: Callable[[MessageSizes], list[LiveColumn]] | None = None  # None: one column with the value's name
    schema: Callable[[MessageSizes], dict[str, Any]] | None = None  # its JSON schema; None: that of its type
    attribute: str = ""  # attribute of the message that holds it; empty: its name

    def columns_for(self, sizes: MessageSizes) -> list[LiveColumn]:
        """Return its columns in a message of these sizes."""
        return [LiveColumn(self.name, self.unit or "1")] if self.columns is None else self.columns(sizes)

    def read(self, message: object) -> Any:
        """Return the value that a message holds."""
        return getattr(message, self.attribute or self.name)


LATENCIES = {
    "latency_ms": "time from the arrival of the newest sample that was read to publishing",
    "age_ms": "time from the arrival of the newest sample of the master stream to publishing",
    "compute_ms": "part of the latency that decoding and the model took",
    "cause": "flags that state why there is no answer, or what it was made without; 0: none",
    "skipped": "answers so far that were left out under overload",
    "late": "samples so far that came too late to be read",
}  # meaning of the columns of the stream `LATENCY`


def latency_values(*in_json: str) -> tuple[Value, ...]:
    """Return the values of the stream `LATENCY`, with those that JSON holds as well."""
    values = []
    for name, meaning in LATENCIES.items():
        is_time = name.endswith("_ms")
        json = ("number" if is_time else "integer") if name in in_json else ""
        values.append(
            Value(
                name,
                meaning,
                json,
                digits=4 if is_time else None,
                streams=(LATENCY,),
                unit="ms" if is_time else "1",
                quantity=LATENCY,
                attribute="flags" if name == "cause" else "",
            )
        )
    return tuple(values)


@dataclass(frozen=True)
class Declaration:
    """The messages of one task: their values in order, and the recorded streams that hold them."""

    kind: str  # kind of the messages, as JSON names it
    values: tuple[Value, ...]
    numbers: Mapping[str, int] = field(default_factory=dict)  # number in packets of each stream but `LATENCY`

    @property
    def streams(self) -> dict[str, int]:
        """The number in packets of each recorded stream."""
        return {**self.numbers, LATENCY: LATENCY_NUMBER}

    def recorded(self, stream: str) -> list[Value]:
        """Return the values of a stream, in the order of its columns."""
        return [value for value in self.values if stream in value.streams]

    def columns(self, stream: str, sizes: MessageSizes) -> list[tuple[Value, LiveColumn]]:
        """Return the columns of a stream in messages of these sizes, each with its value."""
        return [(value, column) for value in self.recorded(stream) for column in value.columns_for(sizes)]


COMMON = Declaration("", latency_values())  # declares the stream that every session records


def blocks(values: Sequence[tuple[str, AnyArray]]) -> tuple[AnyArray, ...]:
    """Return arrays (row, column) joined to one block per run of equal types; ``values`` are types and arrays."""
    return tuple(
        np.hstack([array.astype(kind) for _, array in run])
        for kind, run in itertools.groupby(values, key=lambda typed: typed[0])
    )


@dataclass(frozen=True, kw_only=True)
class Live(Sensor):
    """One of the streams of a live session."""

    summary: ClassVar[str] = "What `tacpipe live` publishes by UDP: answers of a model, alarms or latencies."
    links: ClassVar[tuple[str, ...]] = ("udp",)
    listens: ClassVar[bool] = True
    steady: ClassVar[bool] = False
    counter: ClassVar[int | None] = 1 << 32

    task: str = ""  # the task whose messages the packets hold; needed for any output but latency
    output: str = LATENCY  # the stream of that task's messages
    channels: tuple[str, ...] = ()  # names of what is predicted
    steps: tuple[int, ...] = ()  # rows ahead that are predicted
    quantiles: tuple[int, ...] = ()  # levels of quantiles, percent
    unit: str = "count"  # unit of the channels
    alarms: tuple[str, ...] = ()  # names of the alarms
    rate_hz: float = 0.0  # packets per second; 0: irregular

    def __post_init__(self) -> None:
        if not self._columns:
            raise UsageError(f"live: a stream of the output {self.output} needs channels and steps, or alarms.")
        if self.size > LARGEST_PACKET:
            raise UsageError(
                f"live: {len(self.channels)} channels at {len(self.steps)} steps with {len(self.quantiles)} quantiles make "
                f"packets of {self.size} bytes, and UDP carries {LARGEST_PACKET}. Give fewer --steps."
            )

    @functools.cached_property
    def _declaration(self) -> Declaration:
        live = registry.load_task(self.task).live if self.task else None
        declaration: Declaration = COMMON if live is None else live.declaration
        if self.output not in declaration.streams:
            owner = f"messages of the task {plain(self.task)}" if self.task else "a session without a task"
            raise UsageError(
                f"live: there is no output {plain(self.output)} of {owner}; there are {listed(declaration.streams)}."
            )
        return declaration

    @functools.cached_property
    def _columns(self) -> list[tuple[Value, LiveColumn]]:
        return self._declaration.columns(self.output, self)

    @functools.cached_property
    def _row(self) -> np.dtype[Any]:
        """The numbers of a packet: one field per run of columns of one type."""
        runs = itertools.groupby(value.type for value, _ in self._columns)
        return np.dtype([(f"block{place}", kind, (len(list(run)),)) for place, (kind, run) in enumerate(runs)])

    @property
    def size(self) -> int:
        """Bytes of a packet."""
        return HEAD.itemsize + self._row.itemsize

    def fields(self) -> list[pa.Field]:
        """Return a field for each declared column, with its unit and quantity."""
        import pyarrow as pa

        return [
            pa.field(
                column.name,
                pa.from_numpy_dtype(np.dtype(value.type)),
                metadata={"unit": column.unit, "quantity": value.quantity, **column.metadata},
            )
            for value, column in self._columns
        ]

    def framer(self) -> Framer:
        """Return a framer that takes packets of this output and size."""
        return PacketFramer([self.size], self._is_right)

    def _is_right(self, packets: Bytes) -> Bools:
        heads = np.ascontiguousarray(packets[:, : HEAD.itemsize]).view(HEAD)[:, 0]
        right: Bools = (
            (heads["magic"] == MAGIC)
            & (heads["version"] == VERSION)
            & (heads["kind"] == self._declaration.streams[self.output])
            & (heads["rest"] == 0)
        )
        return right

    def decode(self, frames: Bytes) -> Samples:
        """Return one sample per packet; the time of the message is the device's time."""
        heads = np.ascontiguousarray(frames[:, : HEAD.itemsize]).view(HEAD)[:, 0]
        rows = np.ascontiguousarray(frames[:, HEAD.itemsize :]).view(self._row)[:, 0]
        values = tuple(rows[name] for name in rows.dtype.names or ())
        return Samples(values, heads["seq"].astype(np.int64), heads["t_ns"].astype(np.int64))

    def encode(self, samples: Samples) -> Bytes:
        """Return the packets of samples."""
        heads = np.zeros(len(samples), dtype=HEAD)
        heads["magic"], heads["version"], heads["kind"] = MAGIC, VERSION, self._declaration.streams[self.output]
        heads["seq"], heads["t_ns"] = samples.seq, samples.t_device_ns
        rows = np.zeros(len(samples), dtype=self._row)
        for name, block in zip(rows.dtype.names or (), samples.values, strict=True):
            rows[name] = block
        return np.hstack([part.view(np.uint8).reshape(len(samples), -1) for part in (heads, rows)])
