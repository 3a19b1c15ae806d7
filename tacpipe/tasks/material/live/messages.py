"""Declare the messages of a session with a model of materials: the material of a slide while it lasts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tacpipe.arrays import Float32s
from tacpipe.io import Json
from tacpipe.live import messages
from tacpipe.live.messages import VERSION, Sizes, head_values
from tacpipe.sensors.live import LSL, Declaration, LiveColumn, MessageSizes, Value, latency_values

WAITING, SLIDING, ENDED, FINAL = "waiting", "sliding", "ended", "final"  # states of a slide
MATERIAL = "material"  # the recorded stream
RECORDED = (MATERIAL, LSL)
MIN_SEEN = 0.25  # default of the fraction of a slide before which its material is unknown


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
        Value("probability", "its probability, or its score where the model has no probabilities", "number"),
        Value("probabilities", "probability of each material by name", "object", attribute="probabilities_by_name"),
        Value("state", "waiting, sliding, ended or final", "string"),
        Value("slide", "number of the slide in its recording, from 1", "integer"),
        Value("rows", "rows of the slide so far", "integer", streams=RECORDED, quantity=MATERIAL),
        Value(
            "seen",
            "part of the rows that the model reads, 0 to 1",
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
    """The material of a slide so far, or why none is named."""

    seq: int
    t_ns: int  # time up to which samples were read, UTC as the recording has it
    names: tuple[str, ...]  # names of the classes
    probabilities: Float32s | None  # (class,); None: no material is named
    state: str = WAITING  # state of the slide; final: nothing more comes, and `tacpipe predict` gives the same
    rows: int = 0  # rows of the slide so far
    seen: float = 0.0  # fraction of the rows that the model reads
    cause: str = ""  # why no material is named
    made_from_t_ns: int = 0  # arrival of the newest sample that was read
    latency_ms: float = math.nan
    compute_ms: float = math.nan
    skipped: int = 0
    late: int = 0
    slide: int = 1  # number of the slide in its recording
    declaration: ClassVar[Declaration] = DECLARATION

    @property
    def class_number(self) -> int:
        """The number of the material among the model's classes, -1 for none."""
        return -1 if self.probabilities is None else int(self.probabilities.argmax())

    @property
    def material(self) -> str:
        """The name of the material, or unknown."""
        return "unknown" if self.probabilities is None else self.names[self.class_number]

    @property
    def probability(self) -> float | None:
        """The probability of the material."""
        return None if self.probabilities is None else self.probabilities.tolist()[self.class_number]

    @property
    def probabilities_by_name(self) -> dict[str, float] | None:
        """The probability of each material."""
        return None if self.probabilities is None else dict(zip(self.names, self.probabilities.tolist(), strict=True))

    @property
    def probability_columns(self) -> Float32s:
        """The probability of each material (class,), or NaN if none is named."""
        unknown = np.full(len(self.names), np.nan, np.float32)
        return unknown if self.probabilities is None else self.probabilities.astype(np.float32)

    @property
    def ended(self) -> bool:
        """True if the slide is over."""
        return self.state in (ENDED, FINAL)

    @property
    def answers(self) -> bool:
        """True if a material is named."""
        return self.probabilities is not None

    @property
    def states(self) -> Mapping[str, str]:
        """The material with its probability."""
        if self.probabilities is None:
            return {"material": "unknown"}
        return {"material": f"{self.material} ({self.probability:.2f})"}


@dataclass(frozen=True)
class MaterialDescription(messages.Description):
    """Describes the messages of a session with a model of materials."""

    channels: tuple[str, ...]  # names of the materials
    sensor: str
    frames: int  # rows of a slide that the model reads
    any_length: bool  # True: it reads fewer, too
    confidence: str  # probability: what the model was trained to state; order: scores of no scale, which only order
    rate_hz: float  # messages a second
    model: str
    declaration: ClassVar[Declaration] = DECLARATION
    answers: ClassVar[str] = "materials named"

    @property
    def sizes(self) -> Sizes:
        """The names of the materials."""
        return Sizes(self.channels)

    def to_dict(self) -> Json:
        """Return the description as JSON and msgpack hold it."""
        return {
            "version": VERSION,
            "kind": "description",
            "of": self.kind,
            "materials": list(self.channels),
            "sensor": self.sensor,
            "frames": self.frames,
            "any_length": self.any_length,
            "confidence": self.confidence,
            "rate_hz": self.rate_hz,
            "model": self.model,
        }
