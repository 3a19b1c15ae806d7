"""Define the messages of a session with a material model: the material of a slide during the slide."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tacpipe.arrays import Float32s
from tacpipe.io import JsonObject
from tacpipe.live import messages
from tacpipe.live.messages import Sizes, head_values
from tacpipe.sensors.live import LSL, Declaration, LiveColumn, MessageSizes, Value, latency_values

WAITING, SLIDING, ENDED, FINAL = "waiting", "sliding", "ended", "final"  # states of a slide
MATERIAL = "material"  # name of the recorded stream
RECORDED = (MATERIAL, LSL)
MIN_SEEN = 0.25  # default for the minimum fraction of a slide before its material is predicted


def _probability_columns(sizes: MessageSizes) -> list[LiveColumn]:
    return [LiveColumn(f"probability_{name}", "1", {"material": name}) for name in sizes.channels]


DECLARATION = Declaration(
    MATERIAL,
    (
        *head_values(),
        Value(
            "class",
            "number of the material among those of the model, from 0; -1: unknown",
            streams=RECORDED,
            quantity=MATERIAL,
            attribute="class_number",
        ),
        Value("material", "name of the material, or unknown", "string"),
        Value("probability", "its probability, or its score if the model has no probabilities", "number"),
        Value("probabilities", "probability of each material by name", "object", attribute="probabilities_by_name"),
        Value("state", "waiting, sliding, ended or final", "string"),
        Value("slide", "number of the slide in its recording, from 1", "integer"),
        Value("rows", "rows of the slide so far", "integer", streams=RECORDED, quantity=MATERIAL),
        Value(
            "seen",
            "fraction of the required rows that have arrived, 0 to 1",
            "number",
            digits=4,
            streams=RECORDED,
            quantity=MATERIAL,
        ),
        Value("ended", "1: the slide is over", streams=RECORDED, quantity=MATERIAL),
        Value("slide", "number of the slide in its recording, from 1", streams=RECORDED, quantity=MATERIAL),
        Value(
            "probability_columns",
            "probability of each material",
            streams=RECORDED,
            quantity=MATERIAL,
            columns=_probability_columns,
        ),
        Value("cause", "reason why no material is named", "string"),
        *latency_values("latency_ms", "skipped"),
    ),
    {MATERIAL: 3},
)


@dataclass
class MaterialMessage(messages.Message):
    """The material of the slide so far, or the reason why it is unknown."""

    names: tuple[str, ...]  # class names
    probabilities: Float32s | None  # (class,); None if no material is predicted
    state: str = WAITING  # state of the slide; final if it equals the result of `tacpipe predict`
    rows: int = 0  # number of rows of the slide so far
    seen: float = 0.0  # fraction of the model's input rows
    slide: int = 1  # index of the slide in its recording
    declaration: ClassVar[Declaration] = DECLARATION

    @property
    def class_number(self) -> int:
        """Class number of the material, or -1 if unknown."""
        return -1 if self.probabilities is None else int(self.probabilities.argmax())

    @property
    def material(self) -> str:
        """Name of the material, or unknown."""
        return "unknown" if self.probabilities is None else self.names[self.class_number]

    @property
    def probability(self) -> float | None:
        """Probability of the material; None without a prediction."""
        return None if self.probabilities is None else self.probabilities.tolist()[self.class_number]

    @property
    def probabilities_by_name(self) -> dict[str, float] | None:
        """Probability of each material; None without a prediction."""
        return None if self.probabilities is None else dict(zip(self.names, self.probabilities.tolist(), strict=True))

    @property
    def probability_columns(self) -> Float32s:
        """Probability of each material (class,), or NaN if there is no prediction."""
        unknown = np.full(len(self.names), np.nan, np.float32)
        return unknown if self.probabilities is None else self.probabilities.astype(np.float32)

    @property
    def ended(self) -> bool:
        """Whether the slide has ended."""
        return self.state in (ENDED, FINAL)

    @property
    def answers(self) -> bool:
        """Whether a material is predicted."""
        return self.probabilities is not None

    @property
    def sampled_ns(self) -> int | None:
        """When the newest sample was measured; None for a slide that has ended, whose answer stays valid."""
        return None if self.ended else super().sampled_ns

    @property
    def states(self) -> Mapping[str, str]:
        """The material and its probability, for display."""
        if self.probabilities is None:
            return {"material": "unknown"}
        return {"material": f"{self.material} ({self.probability:.2f})"}


@dataclass(frozen=True)
class MaterialDescription(messages.Description):
    """Description of the messages of a session with a material model."""

    channels: tuple[str, ...]  # names of the materials
    sensor: str
    frames: int  # number of rows that the model reads of a slide
    any_length: bool  # whether the model accepts fewer rows
    confidence: str  # probability: as the model was trained; order: scores without a scale, which only rank classes
    rate_hz: float  # messages per second
    model: str
    declaration: ClassVar[Declaration] = DECLARATION
    answers: ClassVar[str] = "materials named"

    @property
    def sizes(self) -> Sizes:
        """Names of the materials."""
        return Sizes(self.channels)

    @property
    def details(self) -> JsonObject:
        """What it states beside the kind of the messages."""
        return {
            "materials": list(self.channels),
            "sensor": self.sensor,
            "frames": self.frames,
            "any_length": self.any_length,
            "confidence": self.confidence,
            "rate_hz": self.rate_hz,
            "model": self.model,
        }
