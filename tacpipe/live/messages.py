"""Messages of a live session and their formats: JSON, msgpack, and the packets of the sensor ``live``.

The values of a task's messages are declared once, in its `Declaration`. `VERSION` is raised when a field changes its meaning
or goes; fields may be added at any time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from tacpipe.arrays import AnyArray, Float32s
from tacpipe.io import Json
from tacpipe.sensors.live import LSL, Declaration, Live, MessageSizes, Value, blocks
from tacpipe.sensors.sensor import Samples

VERSION = 1
ABSENT: frozenset[str] = frozenset()


class Message:
    """A message of any task. A subclass is a dataclass that has each value of its `declaration` as an attribute."""

    declaration: ClassVar[Declaration]
    seq: int
    t_ns: int  # time that it is about, UTC as the recording has it
    cause: str  # reason why there is no answer of the model, or what it was made without
    made_from_t_ns: int  # arrival of the newest sample that was read
    latency_ms: float
    skipped: int
    late: int
    age_ms: float = math.nan
    compute_ms: float = math.nan
    flags: int = 0

    @property
    def answers(self) -> bool:
        """True for an answer of the model, False for a reason why there is none."""
        raise NotImplementedError

    @property
    def states(self) -> Mapping[str, str]:
        """The answer in words, for the view of the session."""
        raise NotImplementedError

    @property
    def absent(self) -> frozenset[str]:
        """Declared values that this message does not have."""
        return ABSENT

    def to_dict(self) -> Json:
        """Return the message as JSON and msgpack hold it; numbers that are not finite are null."""
        fields = {
            value.name: _plain(value.read(self), value.digits)
            for value in self.declaration.values
            if value.json and value.name not in self.absent
        }
        return {"version": VERSION, "kind": self.declaration.kind, **fields}

    def numbers(self, about: Description) -> Float32s:
        """Return the numbers (column,) that `Description.columns` names, or NaN if a value is None."""
        parts = []
        for value in self.declaration.recorded(LSL):
            content = value.read(self)
            width = len(value.columns_for(about.sizes))
            parts.append(np.full(width, np.nan) if content is None else np.ravel(content))
        return np.concatenate(parts).astype(np.float32)

    def stream_blocks(self, stream: str) -> tuple[AnyArray, ...] | None:
        """Return the numbers of a recorded stream as blocks (row, column) of one type; None: no row for this message."""
        values = [(value.type, value.read(self)) for value in self.declaration.recorded(stream)]
        if any(content is None for _, content in values):
            return None
        shape = (self.row_count(stream), -1)
        return blocks([(kind, np.asarray(content).reshape(shape)) for kind, content in values])

    def row_count(self, stream: str) -> int:
        """Return how many rows it gives a recorded stream."""
        return 1


@dataclass(frozen=True)
class Sizes:
    """The lists over which the values of messages repeat (`tacpipe.sensors.live.MessageSizes`)."""

    channels: tuple[str, ...] = ()
    steps: tuple[int, ...] = ()
    quantiles: tuple[int, ...] = ()
    unit: str = "1"
    alarms: tuple[str, ...] = ()


class Description:
    """Describes the messages of a session; each subscriber gets it once, before the first message."""

    declaration: ClassVar[Declaration]
    answers: ClassVar[str] = "answers"  # plural noun for answers of the model, in the lines about a session
    rate_hz: float  # messages per second; 0: irregular

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
        """Declared values that messages of this session do not have."""
        return ABSENT

    def columns(self) -> list[tuple[str, str]]:
        """Return name and unit of each of `Message.numbers`."""
        return [(column.name, column.unit) for _, column in self.declaration.columns(LSL, self.sizes)]

    def schema(self) -> Json:
        """Return the properties of `Message.to_dict`, as JSON schema has them."""
        values = [value for value in self.declaration.values if value.json and value.name not in self.absent]
        fields = {
            value.name: {"type": value.json} if value.schema is None else value.schema(self.sizes) for value in values
        }
        return {"version": {"type": "integer"}, "kind": {"type": "string"}, **fields}

    def to_dict(self) -> Json:
        """Return the description as JSON and msgpack hold it."""
        raise NotImplementedError


def head_values() -> tuple[Value, ...]:
    """Return the values that messages of every task begin with."""
    return (
        Value("seq", "number of the message, from 1", "integer"),
        Value("t_ns", "time that the message is about, UTC", "integer", unit="ns"),
    )


def to_json(content: Json) -> bytes:
    """Return a message or description as JSON."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()


def packets(message: Message, sensor: Live, seq: int) -> list[bytes]:
    """Return the packets of a message for one stream, numbered from ``seq`` on, or None if it has no row for it."""
    values = message.stream_blocks(sensor.output)
    if values is None:
        return []
    count = len(values[0])
    seqs = (seq + np.arange(count)) % (1 << 32)
    return [row.tobytes() for row in sensor.encode(Samples(values, seqs, np.full(count, message.t_ns)))]


def rounded(value: float, digits: int = 4) -> float | None:
    """Return a number to some digits, None for one that is not finite."""
    return round(value, digits) if math.isfinite(value) else None


def reference_page(declarations: Mapping[str, Declaration]) -> str:
    """Return the reference page of the messages of tasks, by the name of the task, as Markdown."""
    lines = [
        "# Live messages\n",
        "Each message is one JSON object (or the same in msgpack) with `version` 1 and its `kind`. The declarations of the "
        "tasks give the tables below, the recorded streams and the packets.\n",
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


def _plain(value: Any, digits: int | None) -> Any:
    """Return a value as JSON can hold it."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value if digits is None else rounded(value, digits)
