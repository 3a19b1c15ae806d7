"""Messages of a live session and their formats: JSON, msgpack, and the packets of the sensor ``live``.

A task's `Declaration` declares the values of its messages once. `VERSION` is raised when a field is removed or changes
its meaning; fields may be added at any time.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np

from tacpipe.arrays import AnyArray, Float32s
from tacpipe.io import JsonObject
from tacpipe.sensors.live import LSL, Declaration, Live, MessageSizes, Value, blocks
from tacpipe.sensors.sensor import Samples

VERSION = 1
ABSENT: frozenset[str] = frozenset()


@dataclass
class Message:
    """A message of any task. Subclasses are dataclasses with an attribute for each value in their `declaration`."""

    declaration: ClassVar[Declaration]
    seq: int
    t_ns: int  # time that the message refers to, in the recording's UTC
    _: KW_ONLY
    cause: str = ""  # why there is no result, or which input is missing
    made_from_t_ns: int = 0  # arrival time of the newest sample used
    latency_ms: float = math.nan
    age_ms: float = math.nan
    compute_ms: float = math.nan
    skipped: int = 0
    late: int = 0
    flags: int = 0
    sent_ns: int = 0  # time of publishing, on the clock of ``t_ns``
    offset_ns: int = time.time_ns() - time.monotonic_ns()  # from the monotonic clock to that of ``t_ns``

    @property
    def arrived_ns(self) -> int | None:
        """Arrival of the newest sample, or request, that the answer uses; None without an answer."""
        return self.made_from_t_ns if self.answers and self.made_from_t_ns else None

    @property
    def sampled_ns(self) -> int | None:
        """When that sample was measured: its arrival, or the time of its row if that is earlier.

        None without an answer. Subclasses also return None for answers about no moment, such as those to a request.
        """
        return None if self.arrived_ns is None else min(self.arrived_ns, self.t_ns)

    def stamp(self, now_ns: int, offset_ns: int) -> None:
        """Write the time of publishing, given on the monotonic clock."""
        self.sent_ns, self.offset_ns = now_ns + offset_ns, offset_ns

    @property
    def answers(self) -> bool:
        """Whether this is an answer of the model rather than a reason why there is none."""
        raise NotImplementedError

    @property
    def states(self) -> Mapping[str, str]:
        """The answer as text, for the view of the session."""
        raise NotImplementedError

    @property
    def absent(self) -> frozenset[str]:
        """Declared values that this message lacks."""
        return ABSENT

    def to_dict(self) -> JsonObject:
        """Return the message for JSON and msgpack; numbers that are not finite become null."""
        fields = {
            value.name: _to_json(value.read(self), value.digits)
            for value in self.declaration.values
            if value.json and value.name not in self.absent
        }
        return {"version": VERSION, "kind": self.declaration.kind, **fields}

    def numbers(self, about: Description) -> Float32s:
        """Return the numbers (column,) that `Description.columns` lists, with NaN for None."""
        parts = []
        for value in self.declaration.values_of(LSL):
            content = value.read(self)
            width = len(value.columns_for(about.sizes))
            parts.append(np.full(width, np.nan) if content is None else np.ravel(content))
        return np.concatenate(parts).astype(np.float32)

    def stream_blocks(self, stream: str) -> tuple[AnyArray, ...] | None:
        """Return the values of a recorded stream as blocks (row, column) of one type, or None for no row."""
        values = [(value.type, value.read(self)) for value in self.declaration.values_of(stream)]
        if any(content is None for _, content in values):
            return None
        shape = (self.row_count(stream), -1)
        return blocks([(kind, np.asarray(content).reshape(shape)) for kind, content in values])

    def row_count(self, stream: str) -> int:
        """Return the number of rows for a recorded stream."""
        return 1


@dataclass(frozen=True)
class Sizes:
    """The lists over which values of messages repeat (`tacpipe.sensors.live.MessageSizes`)."""

    channels: tuple[str, ...] = ()
    steps: tuple[int, ...] = ()
    quantiles: tuple[int, ...] = ()
    unit: str = "1"


class Description:
    """The description of a session's messages, sent once to each subscriber before the first message."""

    declaration: ClassVar[Declaration]
    answers: ClassVar[str] = "answers"  # plural noun for answers of the model, used in lines about a session
    rate_hz: float  # messages per second; 0 if irregular

    @property
    def sizes(self) -> MessageSizes:
        """The lists over which the values of its messages repeat."""
        return Sizes()

    @property
    def kind(self) -> str:
        """The kind of the messages."""
        return self.declaration.kind

    @property
    def absent(self) -> frozenset[str]:
        """Declared values that messages of this session lack."""
        return ABSENT

    def columns(self) -> list[tuple[str, str]]:
        """Return name and unit of each number in `Message.numbers`."""
        return [(column.name, column.unit) for _, column in self.declaration.columns(LSL, self.sizes)]

    def schema(self) -> JsonObject:
        """Return the JSON schema properties of `Message.to_dict`."""
        values = [value for value in self.declaration.values if value.json and value.name not in self.absent]
        fields = {
            value.name: {"type": value.json} if value.schema is None else value.schema(self.sizes) for value in values
        }
        return {"version": {"type": "integer"}, "kind": {"type": "string"}, **fields}

    @property
    def details(self) -> JsonObject:
        """What it states beside the kind of the messages, for JSON and msgpack."""
        raise NotImplementedError

    def to_dict(self) -> JsonObject:
        """Return the description for JSON and msgpack."""
        return {"version": VERSION, "kind": "description", "of": self.kind, **self.details}


def head_values() -> tuple[Value, ...]:
    """Return the first values of every task's messages."""
    return (
        Value("seq", "number of the message, from 1", "integer"),
        Value("t_ns", "time of the predicted row, slide or request, UTC", "integer", unit="ns"),
        Value(
            "sampled_ns",
            "when the newest used sample was measured, on the clock of `t_ns`; null: no answer, or about no moment",
            "integer",
            unit="ns",
        ),
        Value("arrived_ns", "when that sample, or the request, arrived; null: no answer", "integer", unit="ns"),
        Value("sent_ns", "when the message was sent", "integer", unit="ns"),
    )


def to_json(content: JsonObject) -> bytes:
    """Return a message or description as JSON."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()


def packets(message: Message, sensor: Live, seq: int) -> list[bytes]:
    """Return the packets of a message for one stream, numbered from ``seq``.

    Returns an empty list if the message has no row for the stream.
    """
    values = message.stream_blocks(sensor.output)
    if values is None:
        return []
    count = len(values[0])
    seqs = (seq + np.arange(count)) % (1 << 32)
    return [row.tobytes() for row in sensor.encode(Samples(values, seqs, np.full(count, message.t_ns)))]


def rounded(value: float, digits: int = 4) -> float | None:
    """Return a rounded number, or None if it is not finite."""
    return round(value, digits) if math.isfinite(value) else None


def reference_page(declarations: Mapping[str, Declaration]) -> str:
    """Return the Markdown reference page of messages, by task name."""
    lines = [
        "# Live messages\n",
        "Each message is one JSON object (or the same in msgpack) with `version` 1 and its `kind`. The "
        "tables come from the declarations of the tasks, which also define the recorded streams and the packets.\n",
    ]
    for task, declaration in declarations.items():
        lines += [
            f"## {task}: `{declaration.kind}`\n",
            "| value | JSON | unit | recorded in | meaning |",
            "|" + " --- |" * 5,
        ]
        for value in declaration.values:
            recorded = ", ".join(f"`{stream}`" for stream in value.streams if stream != LSL)
            json_type = value.json or "no"
            lines.append(f"| `{value.name}` | {json_type} | {value.unit} | {recorded} | {value.meaning} |")
        lines.append("")
    return "\n".join(lines)


def _to_json(value: Any, digits: int | None) -> Any:
    """Return a value that JSON can represent."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value if digits is None else rounded(value, digits)


def summarize_latencies(latency_ms: AnyArray) -> dict[str, float]:
    """Return figures of latencies: count, median, 99th percentile, maximum, and how many are above 10 and 20 ms.

    Without values, only the count is returned.

    >>> summarize_latencies(np.array([1.0, 2.0, np.nan, 12.0]))["above_10_ms"]
    1
    """
    finite = np.asarray(latency_ms, np.float64)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return {"count": 0}
    return {
        "count": len(finite),
        "median_ms": round(float(np.median(finite)), 3),
        "p99_ms": round(float(np.quantile(finite, 0.99)), 3),
        "largest_ms": round(float(finite.max()), 3),
        "above_10_ms": int((finite > 10).sum()),
        "above_20_ms": int((finite > 20).sum()),
    }
