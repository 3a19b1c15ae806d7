"""What live sessions publish, and its formats: JSON, msgpack, and the packets of the sensor ``live``.

The fields are those of `Published.to_dict`; docs/howto/live.md describes them. `VERSION` is raised when one changes its
meaning or goes; new ones may come at any time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from tacpipe.arrays import Float32s
from tacpipe.sensors.live import Live
from tacpipe.sensors.sensor import Samples

VERSION = 1


class Published(Protocol):
    """A message of any kind: what publishers and the session's own streams read of it."""

    t_ns: int
    cause: str
    latency_ms: float

    @property
    def answers(self) -> bool:
        """Whether there is an answer of the model in it, rather than why there is none."""

    @property
    def states(self) -> Mapping[str, str]:
        """What it states, in words, for the view of the session."""

    def to_dict(self) -> dict[str, Any]:
        """Return the message as JSON and msgpack hold it."""

    def columns(self) -> Float32s:
        """Return the message as numbers (column,), those that `About.columns` names."""

    def outputs(self, output: str) -> tuple[Any, ...] | None:
        """Return the blocks of numbers that the session's stream of an output holds; None: nothing now."""


class About(Protocol):
    """What the numbers of messages of one kind are: sent once to each subscriber, before the first message."""

    @property
    def kind(self) -> str:
        """The kind of the messages, as forecast."""

    @property
    def rate_hz(self) -> float:
        """Messages a second."""

    def columns(self) -> list[tuple[str, str]]:
        """Return name and unit of each of `Published.columns`."""

    def schema(self) -> dict[str, Any]:
        """Return the properties of `Published.to_dict`, as JSON schema has them."""

    def to_dict(self) -> dict[str, Any]:
        """Return the description as JSON and msgpack hold it."""


def to_json(content: Mapping[str, Any]) -> bytes:
    """Return a message or description as JSON."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()


def packets(message: Published, sensor: Live, seq: int) -> list[bytes]:
    """Return the packets of a message for one output, numbered from ``seq`` on; none of a forecast where there is none."""
    values = message.outputs(sensor.output)
    if values is None:
        return []
    count = len(values[0])
    seqs = (seq + np.arange(count)) % (1 << 32)
    return [row.tobytes() for row in sensor.encode(Samples(values, seqs, np.full(count, message.t_ns)))]


def properties(*integers: str, **types: str) -> dict[str, Any]:
    """Return properties of JSON schema by their types; those named alone are integers."""
    return {name: {"type": kind} for name, kind in {**dict.fromkeys(integers, "integer"), **types}.items()}


def known(value: float) -> float | None:
    """Return a number to four digits, None for one that is not finite."""
    return round(value, 4) if math.isfinite(value) else None
