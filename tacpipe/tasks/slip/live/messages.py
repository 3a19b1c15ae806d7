"""Declare the messages of a session with a slip model: probability and alarm at each sample of the first finger."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from tacpipe.io import Json
from tacpipe.live import messages
from tacpipe.live.messages import Sizes, head_values
from tacpipe.sensors.live import LSL, OFF, ON, UNKNOWN, Declaration, LiveColumn, MessageSizes, Value, latency_values

SLIP = "slip"  # the recorded stream
RECORDED = (SLIP, LSL)
WORDS = {UNKNOWN: "unknown", OFF: "off", ON: "on"}
TOUCH = {"type": "object", "additionalProperties": {"type": "array", "items": {"type": "number"}}}


def _alarm_columns(sizes: MessageSizes) -> list[LiveColumn]:
    return [LiveColumn("alarm")]


DECLARATION = Declaration(
    SLIP,
    (
        *head_values(),
        Value(
            "probability",
            "probability that the object slips within the horizon; null: unknown",
            "number",
            digits=6,
            streams=RECORDED,
            type="<f8",
            quantity="prediction",
        ),
        Value(
            "score", "score that the alarm compares with its level", streams=(SLIP,), type="<f8", quantity="prediction"
        ),
        Value("alarm", "on, off or unknown", "string", attribute="alarm_word"),
        Value(
            "alarm_state",
            "1 on, 0 off, -1 unknown",
            streams=RECORDED,
            type="i1",
            quantity="alarm",
            columns=_alarm_columns,
        ),
        Value(
            "touch",
            "size of each taxel's reading by finger, scaled as in training",
            "object",
            schema=lambda sizes: TOUCH,
        ),
        Value("cause", "reason why there is no probability", "string"),
        *latency_values("latency_ms", "skipped"),
    ),
    {SLIP: 4},
)


@dataclass
class SlipMessage(messages.Message):
    """The probability of a slip at one sample, or why there is none."""

    probability: float = math.nan
    score: float = math.nan
    alarm_state: int = UNKNOWN
    touch: Mapping[str, list[float]] = field(default_factory=dict)
    declaration: ClassVar[Declaration] = DECLARATION

    @property
    def answers(self) -> bool:
        """True if there is a probability."""
        return math.isfinite(self.probability)

    @property
    def alarm_word(self) -> str:
        """The state of the alarm as a word."""
        return WORDS[self.alarm_state]

    @property
    def states(self) -> Mapping[str, str]:
        """Probability and alarm as text."""
        return {SLIP: f"{self.probability:.2f}, alarm {self.alarm_word}" if self.answers else self.cause}


@dataclass(frozen=True)
class SlipDescription(messages.Description):
    """Describes the messages of a session."""

    model: str
    rate_hz: float
    horizon_s: float
    alarms_per_minute: str
    layouts: Mapping[str, Any]  # finger -> row and column of each value of ``touch``, from 0
    declaration: ClassVar[Declaration] = DECLARATION
    answers: ClassVar[str] = "probabilities"

    @property
    def sizes(self) -> Sizes:
        """No lists: each message has one probability."""
        return Sizes()

    @property
    def details(self) -> Json:
        """What it states beside the kind of the messages."""
        return {
            "model": self.model,
            "rate_hz": self.rate_hz,
            "horizon_s": self.horizon_s,
            "alarms_per_minute": self.alarms_per_minute,
            "fingers": dict(self.layouts),
        }
