"""What is published at each grid point: a forecast with its alarms."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from tacpipe.arrays import Float32s
from tacpipe.live.messages import VERSION, known, properties
from tacpipe.tasks.forward.live.alarms import NAMES, NOTHING_KNOWN, State


@dataclass
class Message:
    """A forecast with its alarms, or why there is none."""

    seq: int
    t_ns: int  # of the grid point, UTC as the recording has it
    values: Float32s | None  # (step, channel), in the channels' unit above rest; None: no forecast
    cause: str = ""  # in words: why there is no forecast, or what it was made without
    flags: int = 0  # the same as `tacpipe.tasks.forward.live.chain.Cause`
    alarms: Mapping[str, State] = field(default_factory=lambda: dict(NOTHING_KNOWN))
    made_from_t_ns: int = 0  # arrival of the newest sample that was read
    latency_ms: float = math.nan
    age_ms: float = math.nan
    compute_ms: float = math.nan
    skipped: int = 0
    late: int = 0
    levels: tuple[int, ...] = ()  # of quantiles, in percent, that the session publishes
    quantiles: Float32s | None = None  # (level, step, channel), of a forecast in a session that publishes some

    def to_dict(self) -> dict[str, Any]:
        """Return the message as JSON and msgpack hold it; what is not known is null."""
        return {
            "version": VERSION,
            "kind": "forecast",
            "seq": self.seq,
            "t_ns": self.t_ns,
            "values": None if self.values is None else self.values.tolist(),
            **({"quantiles": self._quantiles()} if self.levels else {}),
            "cause": self.cause,
            "alarms": {name: {"state": one.word, "score": known(one.score)} for name, one in self.alarms.items()},
            "latency_ms": known(self.latency_ms),
            "age_ms": known(self.age_ms),
            "skipped": self.skipped,
        }

    def _quantiles(self) -> dict[str, Any] | None:
        """Return the quantiles by level, None without a forecast."""
        if self.quantiles is None:
            return None
        return {str(level): one.tolist() for level, one in zip(self.levels, self.quantiles, strict=True)}

    @property
    def answers(self) -> bool:
        """Whether there is a forecast."""
        return self.values is not None

    @property
    def states(self) -> Mapping[str, str]:
        """The state of each alarm."""
        return {name: one.word for name, one in self.alarms.items()}

    def columns(self) -> Float32s:
        """Return values and quantiles (level x step x channel,), empty without a forecast, and the state of each alarm."""
        values = [one.ravel() for one in (self.values, self.quantiles) if one is not None]
        return np.concatenate([*values, [self.alarms[name].state for name in NAMES]]).astype(np.float32)

    def outputs(self, output: str) -> tuple[Any, ...] | None:
        """Return the numbers of the session's stream ``forecast``, ``alarm`` or ``latency``."""
        if output == "forecast":
            values = (self.values, *([self.quantiles] if self.levels else []))
            return None if self.values is None else tuple(one.reshape(1, -1) for one in values if one is not None)
        if output == "alarm":
            states = list(self.alarms.values())
            return (
                np.array([[one.state for one in states]], dtype=np.int8),
                np.array([[one.score for one in states]], dtype=np.float32),
            )
        numbers = (self.latency_ms, self.age_ms, self.compute_ms, self.flags, self.skipped, self.late)
        return (np.array([numbers], dtype=np.float32),)


@dataclass(frozen=True)
class Description:
    """What the values of messages are: sent once to each subscriber, before the first message."""

    channels: tuple[str, ...]
    steps: tuple[int, ...]
    unit: str
    rate_hz: float
    model: str
    quantiles: tuple[int, ...] = ()  # levels in percent
    kind: ClassVar[str] = "forecast"

    def columns(self) -> list[tuple[str, str]]:
        """Return each channel at each step with its unit, the same of each quantile, and the state of each alarm."""
        endings = ["", *(f"_q{level}" for level in self.quantiles)]
        names = [
            (f"{channel}_t{step}{ending}", self.unit)
            for ending in endings
            for step in self.steps
            for channel in self.channels
        ]
        return names + [(f"{alarm}_state", "1") for alarm in NAMES]

    def schema(self) -> dict[str, Any]:
        """Return the properties of a message, as JSON schema has them."""
        values = {"type": "array", "items": {"type": "array", "items": {"type": "number"}}}
        levels = {"type": "object", "properties": {str(level): values for level in self.quantiles}}
        return {
            **properties("version", "seq", "t_ns", "skipped", kind="string", cause="string"),
            "values": values,
            **({"quantiles": levels} if self.quantiles else {}),
            **properties(alarms="object", latency_ms="number", age_ms="number"),
        }

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
            **({"quantiles": list(self.quantiles)} if self.quantiles else {}),
        }
