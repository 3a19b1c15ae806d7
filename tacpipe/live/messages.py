"""What is published at each grid point, and its formats: JSON, msgpack, and the packets of the sensor ``live``.

The fields are those of `Message.to_dict`; docs/howto/live.md describes them. `VERSION` is raised when one changes its
meaning or goes; new ones may come at any time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tacpipe.arrays import Float32s
from tacpipe.live.alarms import NOTHING_KNOWN, State
from tacpipe.sensors.live import Live
from tacpipe.sensors.sensor import Samples

VERSION = 1
Times = Mapping[str, float]


@dataclass
class Message:
    """A forecast with its alarms, or why there is none."""

    seq: int
    t_ns: int  # of the grid point, UTC as the recording has it
    values: Float32s | None  # (step, channel), in the channels' unit above rest; None: no forecast
    cause: str = ""  # in words: why there is no forecast, or what it was made without
    flags: int = 0  # the same as `tacpipe.live.chain.Cause`
    alarms: Mapping[str, State] = field(default_factory=lambda: dict(NOTHING_KNOWN))
    made_from_t_ns: int = 0  # arrival of the newest sample that was read
    latency_ms: float = math.nan
    age_ms: float = math.nan
    compute_ms: float = math.nan
    skipped: int = 0
    late: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Return the message as JSON and msgpack hold it; what is not known is null."""
        return {
            "version": VERSION,
            "kind": "forecast",
            "seq": self.seq,
            "t_ns": self.t_ns,
            "values": None if self.values is None else self.values.tolist(),
            "cause": self.cause,
            "alarms": {name: {"state": one.word, "score": _known(one.score)} for name, one in self.alarms.items()},
            "latency_ms": _known(self.latency_ms),
            "age_ms": _known(self.age_ms),
            "skipped": self.skipped,
        }


@dataclass(frozen=True)
class Description:
    """What the values of messages are: sent once to each subscriber, before the first message."""

    channels: tuple[str, ...]
    steps: tuple[int, ...]
    unit: str
    rate_hz: float
    model: str

    def to_dict(self) -> dict[str, Any]:
        """Return the description as JSON and msgpack hold it."""
        return {
            "version": VERSION,
            "kind": "description",
            "channels": list(self.channels),
            "steps": list(self.steps),
            "unit": self.unit,
            "rate_hz": self.rate_hz,
            "model": self.model,
        }


def to_json(content: Mapping[str, Any]) -> bytes:
    """Return a message or description as JSON."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()


def packet(message: Message, sensor: Live, seq: int) -> bytes | None:
    """Return the packet of a message for one output, numbered ``seq``; None: of a forecast where there is none."""
    values = _values(message, sensor.output)
    if values is None:
        return None
    return sensor.encode(Samples(values, np.array([seq]), np.array([message.t_ns]))).tobytes()


def _values(message: Message, output: str) -> tuple[Any, ...] | None:
    if output == "forecast":
        return None if message.values is None else (message.values.reshape(1, -1),)
    if output == "alarm":
        states = list(message.alarms.values())
        return (
            np.array([[one.state for one in states]], dtype=np.int8),
            np.array([[one.score for one in states]], dtype=np.float32),
        )
    numbers = (message.latency_ms, message.age_ms, message.compute_ms, message.flags, message.skipped, message.late)
    return (np.array([numbers], dtype=np.float32),)


def _known(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
