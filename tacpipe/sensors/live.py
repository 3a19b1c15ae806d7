"""Record the messages that `tacpipe live` publishes, as streams of a rig.

A task declares each value of its messages once (`Value`): name, type, unit and meaning. JSON, packets, columns of values_of
streams and the reference page are derived from the declaration (`Declaration`).

A packet is ``tacL``, a version, the number of its stream, a 32-bit counter and the time of the message in UTC ns,
followed by the declared values in order. All numbers are little-endian.
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
MAX_PACKET = 60_000  # bytes
LATENCY = "latency"  # stream that every session records
LATENCY_NUMBER = 2  # number of this stream in packets
LSL = "lsl"  # channels of the published LSL stream, which is not recorded


class MessageSizes(Protocol):
    """The lists whose lengths determine the columns of a message, as in `Live` and a task's `Description`."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the predicted channels or classes."""

    @property
    def steps(self) -> tuple[int, ...]:
        """Prediction horizons in rows."""

    @property
    def quantiles(self) -> tuple[int, ...]:
        """Quantile levels in percent."""

    @property
    def unit(self) -> str:
        """Unit of the channels."""


class LiveColumn(NamedTuple):
    """One number of a values_of stream."""

    name: str
    unit: str = "1"
    metadata: Mapping[str, str] = {}  # further metadata of the recorded column


@dataclass(frozen=True)
class Value:
    """One declared value of a message: a field of its JSON, columns of values_of streams, or both."""

    name: str
    meaning: str
    json: str = ""  # JSON type; empty if the value is only recorded
    digits: int | None = None  # decimals of a number in JSON; a number that is not finite becomes null
    streams: tuple[str, ...] = ()  # streams with columns of this value: recorded streams, and `LSL`
    type: str = "<f4"  # numpy type of each column
    unit: str = ""
    quantity: str = ""  # metadata of the recorded columns
    columns: Callable[[MessageSizes], list[LiveColumn]] | None = None  # None: one column with the name of the value
    schema: Callable[[MessageSizes], dict[str, Any]] | None = None  # JSON schema; None: the schema of its type
    attribute: str = ""  # attribute of the message that contains it; empty: the name of the value

    def columns_for(self, sizes: MessageSizes) -> list[LiveColumn]:
        """Return the columns of the value in a message of these sizes."""
        return [LiveColumn(self.name, self.unit or "1")] if self.columns is None else self.columns(sizes)

    def read(self, message: object) -> Any:
        """Return the value in a message."""
        return getattr(message, self.attribute or self.name)


LATENCIES = {
    "latency_ms": "time from the arrival of the newest used sample to publishing",
    "age_ms": "time from the arrival of the newest sample of the master stream to publishing",
    "compute_ms": "part of the latency spent on decoding and the model",
    "cause": "flags: reason why there is no prediction, or the missing input; 0: none",
    "skipped": "number of predictions skipped so far because of overload",
    "late": "samples so far that arrived too late to be used",
}  # meaning of the columns of the stream `LATENCY`


def latency_values(*in_json: str) -> tuple[Value, ...]:
    """Return the values of the stream `LATENCY`. ``in_json`` are those that the JSON messages contain, too."""
    values = []
    for name, meaning in LATENCIES.items():
        is_time = name.endswith("_ms")
        json_type = "number" if is_time else "integer"
        values.append(
            Value(
                name,
                meaning,
                json_type if name in in_json else "",
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
    """The messages of one task: their values in order, and the values_of streams that contain them."""

    kind: str  # ``kind`` in JSON
    values: tuple[Value, ...]
    numbers: Mapping[str, int] = field(default_factory=dict)  # number in packets by stream, without `LATENCY`

    @property
    def streams(self) -> dict[str, int]:
        """The number in packets, by values_of stream."""
        return {**self.numbers, LATENCY: LATENCY_NUMBER}

    def values_of(self, stream: str) -> list[Value]:
        """Return the values of a stream, in the order of its columns."""
        return [value for value in self.values if stream in value.streams]

    def columns(self, stream: str, sizes: MessageSizes) -> list[tuple[Value, LiveColumn]]:
        """Return the columns of a stream in messages of these sizes, each with its value."""
        return [(value, column) for value in self.values_of(stream) for column in value.columns_for(sizes)]


COMMON = Declaration("", latency_values())  # the stream that every session records


def blocks(values: Sequence[tuple[str, AnyArray]]) -> tuple[AnyArray, ...]:
    """Join arrays (row, column) to one block per run of equal types. ``values`` are pairs of type and array."""
    return tuple(
        np.hstack([array.astype(kind) for _, array in run])
        for kind, run in itertools.groupby(values, key=lambda typed: typed[0])
    )


@dataclass(frozen=True, kw_only=True)
class Live(Sensor):
    """One stream of a live session."""

    summary: ClassVar[str] = "Messages that `tacpipe live` publishes over UDP: answers of a model, alarms or latencies."
    links: ClassVar[tuple[str, ...]] = ("udp",)
    listens: ClassVar[bool] = True
    steady: ClassVar[bool] = False
    counter: ClassVar[int | None] = 1 << 32

    task: str = ""  # task of the messages; required for all outputs except latency
    output: str = LATENCY  # the stream of that task's messages
    channels: tuple[str, ...] = ()  # names of the predicted channels or classes
    steps: tuple[int, ...] = ()  # prediction horizons in rows
    quantiles: tuple[int, ...] = ()  # quantile levels in percent
    unit: str = "count"  # unit of the channels
    rate_hz: float = 0.0  # packets per second; 0: irregular

    def __post_init__(self) -> None:
        if not self._columns:
            raise UsageError(f"live: a stream of the output {self.output} needs channels and steps.")
        if self.size > MAX_PACKET:
            raise UsageError(
                f"live: {len(self.channels)} channels at {len(self.steps)} steps with {len(self.quantiles)} quantiles need "
                f"packets of {self.size} bytes; UDP allows {MAX_PACKET}. Give fewer --steps."
            )

    @functools.cached_property
    def _declaration(self) -> Declaration:
        """The declared messages of the task. Raises `UsageError` if they do not include the output."""
        live = registry.load_task(self.task).live if self.task else None
        declaration: Declaration = COMMON if live is None else live.declaration
        if self.output not in declaration.streams:
            owner = f"messages of the task {plain(self.task)}" if self.task else "a session without a task"
            raise UsageError(
                f"live: there is no output {plain(self.output)} in {owner}; there are {listed(declaration.streams)}."
            )
        return declaration

    @functools.cached_property
    def _columns(self) -> list[tuple[Value, LiveColumn]]:
        return self._declaration.columns(self.output, self)

    @functools.cached_property
    def _row(self) -> np.dtype[Any]:
        """The structured type of a packet's values: one field per run of columns of one type."""
        runs = itertools.groupby(value.type for value, _ in self._columns)
        return np.dtype([(f"block{number}", kind, (len(list(run)),)) for number, (kind, run) in enumerate(runs)])

    @property
    def size(self) -> int:
        """Bytes of a packet."""
        return HEAD.itemsize + self._row.itemsize

    def fields(self) -> list[pa.Field]:
        """Return one field per declared column, with its unit and quantity."""
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
        """Return a framer for packets of this output and size."""
        return PacketFramer([self.size], self._are_valid)

    def _are_valid(self, packets: Bytes) -> Bools:
        """Return a mask (packet,) of the packets with the head of this output."""
        heads = np.ascontiguousarray(packets[:, : HEAD.itemsize]).view(HEAD)[:, 0]
        is_valid: Bools = (
            (heads["magic"] == MAGIC)
            & (heads["version"] == VERSION)
            & (heads["kind"] == self._declaration.streams[self.output])
            & (heads["rest"] == 0)
        )
        return is_valid

    def decode(self, frames: Bytes) -> Samples:
        """Return one sample per packet. The time of the message is the device's time."""
        heads = np.ascontiguousarray(frames[:, : HEAD.itemsize]).view(HEAD)[:, 0]
        rows = np.ascontiguousarray(frames[:, HEAD.itemsize :]).view(self._row)[:, 0]
        values = tuple(rows[name] for name in rows.dtype.names or ())
        return Samples(values, heads["seq"].astype(np.int64), heads["t_ns"].astype(np.int64))

    def encode(self, samples: Samples) -> Bytes:
        """Return the packets of these samples."""
        heads = np.zeros(len(samples), dtype=HEAD)
        heads["magic"], heads["version"], heads["kind"] = MAGIC, VERSION, self._declaration.streams[self.output]
        heads["seq"], heads["t_ns"] = samples.seq, samples.t_device_ns
        rows = np.zeros(len(samples), dtype=self._row)
        for name, block in zip(rows.dtype.names or (), samples.values, strict=True):
            rows[name] = block
        return np.hstack([part.view(np.uint8).reshape(len(samples), -1) for part in (heads, rows)])
