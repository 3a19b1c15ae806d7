"""Define the messages of sessions with a model of quantities or of classes: an answer at each row."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.io import Json
from tacpipe.live import messages
from tacpipe.live.messages import Sizes, head_values
from tacpipe.sensors.live import LSL, Declaration, LiveColumn, MessageSizes, Value, latency_values

ESTIMATE, CLASS = "estimate", "class"  # kinds of messages and names of the recorded streams
BAND = (10, 90)  # percents of the published band
NUMBERS = {"type": "object", "additionalProperties": {"type": "number"}}


def _target_columns(sizes: MessageSizes) -> list[LiveColumn]:
    units = sizes.unit.split(",")
    return [LiveColumn(name, unit) for name, unit in zip(sizes.channels, units, strict=True)]


def _band_columns(sizes: MessageSizes) -> list[LiveColumn]:
    columns = _target_columns(sizes)
    return [LiveColumn(f"{column.name}_p{percent}", column.unit) for percent in BAND for column in columns]


def _probability_columns(sizes: MessageSizes) -> list[LiveColumn]:
    return [LiveColumn(f"probability_{name}") for name in sizes.channels]


ESTIMATES = Declaration(
    ESTIMATE,
    (
        *head_values(),
        Value(
            "values",
            "estimate of each target by name; empty: none",
            "object",
            schema=lambda sizes: NUMBERS,
            attribute="by_name",
        ),
        Value(
            "low",
            "10 % quantile of each target by name",
            "object",
            schema=lambda sizes: NUMBERS,
            attribute="low_by_name",
        ),
        Value(
            "high",
            "90 % quantile of each target by name",
            "object",
            schema=lambda sizes: NUMBERS,
            attribute="high_by_name",
        ),
        Value(
            "value_columns",
            "estimate of each target",
            streams=(ESTIMATE, LSL),
            type="<f8",
            unit="of the targets",
            quantity="prediction",
            columns=_target_columns,
        ),
        Value(
            "band_columns",
            "10 % and 90 % quantiles of each target",
            streams=(ESTIMATE, LSL),
            type="<f8",
            unit="of the targets",
            quantity="prediction",
            columns=_band_columns,
        ),
        Value("cause", "reason why there is no estimate", "string"),
        *latency_values("latency_ms", "skipped"),
    ),
    {ESTIMATE: 5},
)

CLASSES = Declaration(
    CLASS,
    (
        *head_values(),
        Value("answer", "name of the class, or unknown", "string"),
        Value("probability", "probability of the most likely class; null: none", "number", digits=6),
        Value(
            "probabilities",
            "probability of each class by name",
            "object",
            schema=lambda sizes: NUMBERS,
            attribute="by_name",
        ),
        Value(
            "class",
            "number of the answer among the classes of the model, from 0; -1: unknown",
            streams=(CLASS, LSL),
            type="<f8",
            quantity="prediction",
            attribute="number",
        ),
        Value(
            "probability_columns",
            "probability of each class",
            streams=(CLASS, LSL),
            type="<f8",
            quantity="prediction",
            columns=_probability_columns,
        ),
        Value("cause", "reason why there is no answer", "string"),
        *latency_values("latency_ms", "skipped"),
    ),
    {CLASS: 6},
)


@dataclass
class LearnedMessage(messages.Message):
    """What the messages of both kinds share."""

    names: tuple[str, ...]  # targets or classes
    values: Floats  # (name,), estimates or probabilities; NaN: none

    @property
    def answers(self) -> bool:
        """True if there is an answer."""
        return bool(np.isfinite(self.values).all())

    @property
    def by_name(self) -> dict[str, float]:
        """Estimates or probabilities by name; empty without an answer."""
        return self._named(self.values)

    def _named(self, values: Floats) -> dict[str, float]:
        return dict(zip(self.names, values.tolist(), strict=True)) if self.answers else {}


@dataclass
class EstimateMessage(LearnedMessage):
    """The estimate of quantities at one row, or why there is none."""

    band: Floats = field(default_factory=lambda: np.zeros((2, 0)))  # (end, target)
    units: tuple[str, ...] = ()
    declaration: ClassVar[Declaration] = ESTIMATES

    @property
    def low_by_name(self) -> dict[str, float]:
        """The 10 % quantile of each target by name."""
        return self._named(self.band[0])

    @property
    def high_by_name(self) -> dict[str, float]:
        """The 90 % quantile of each target by name."""
        return self._named(self.band[1])

    @property
    def value_columns(self) -> Floats:
        """The estimates (target,)."""
        return self.values

    @property
    def band_columns(self) -> Floats:
        """The quantiles (end x target,)."""
        return self.band.ravel()

    @property
    def states(self) -> Mapping[str, str]:
        """The estimates with their units as text."""
        if not self.answers:
            return {ESTIMATE: self.cause}
        named = zip(self.names, self.values.tolist(), self.units, strict=True)
        return {ESTIMATE: ", ".join(f"{name} {value:.3g} {unit}".strip() for name, value, unit in named)}


@dataclass
class ClassMessage(LearnedMessage):
    """The class at one row, or why there is none."""

    answer: str = "unknown"
    declaration: ClassVar[Declaration] = CLASSES

    @property
    def probability(self) -> float:
        """The probability of the most likely class; NaN without an answer."""
        return float(self.values.max()) if self.answers else math.nan

    @property
    def number(self) -> int:
        """The number of the answer, or -1."""
        return self.names.index(self.answer) if self.answers and self.answer in self.names else -1

    @property
    def probability_columns(self) -> Floats:
        """The probability of each class (class,)."""
        return self.values

    @property
    def states(self) -> Mapping[str, str]:
        """The answer and its probability as text."""
        return {CLASS: f"{self.answer} ({self.probability:.2f})" if self.answers else self.cause}


@dataclass(frozen=True)
class LearnedDescription(messages.Description):
    """Describes the messages of a session."""

    model: str
    names: tuple[str, ...]  # targets or classes
    units: tuple[str, ...]  # of the targets; empty for classes
    rate_hz: float

    @property
    def sizes(self) -> Sizes:
        """The names of targets or classes, and the units."""
        return Sizes(self.names, unit=",".join(self.units) if self.units else "1")

    @property
    def details(self) -> Json:
        """What it states beside the kind of the messages."""
        named = (
            {"targets": dict(zip(self.names, self.units, strict=True))} if self.units else {"classes": list(self.names)}
        )
        return {
            "model": self.model,
            "rate_hz": self.rate_hz,
            **named,
        }


@dataclass(frozen=True)
class EstimateDescription(LearnedDescription):
    """Describes estimates of quantities."""

    declaration: ClassVar[Declaration] = ESTIMATES
    answers: ClassVar[str] = "estimates"


@dataclass(frozen=True)
class ClassDescription(LearnedDescription):
    """Describes classes."""

    declaration: ClassVar[Declaration] = CLASSES
    answers: ClassVar[str] = "answers"
