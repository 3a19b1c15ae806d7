"""What is published of a slide while it lasts: which material it is on, how sure that is, and how much was seen."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from tacpipe.arrays import Float32s
from tacpipe.live.messages import VERSION, known, properties

WAITING, SLIDING, ENDED, FINAL = "waiting", "sliding", "ended", "final"  # states of a slide


@dataclass
class MaterialMessage:
    """The material of a slide so far, or why none is named."""

    seq: int
    t_ns: int  # up to which samples were read, UTC as the recording has it
    names: tuple[str, ...]  # of the classes
    probabilities: Float32s | None  # (class,); None: no material is named
    state: str = WAITING  # of the slide; final: nothing more comes, and `tacpipe predict` gives the same
    rows: int = 0  # of the slide so far
    seen: float = 0.0  # fraction of the rows that the model reads
    cause: str = ""  # why no material is named
    made_from_t_ns: int = 0  # arrival of the newest sample that was read
    latency_ms: float = math.nan
    compute_ms: float = math.nan
    skipped: int = 0
    late: int = 0
    slide: int = 1  # number of the slide in its recording

    @property
    def named(self) -> int:
        """The number of the material among the model's classes, -1 for none."""
        return -1 if self.probabilities is None else int(self.probabilities.argmax())

    @property
    def answers(self) -> bool:
        """Whether a material is named."""
        return self.probabilities is not None

    @property
    def states(self) -> Mapping[str, str]:
        """The material with its probability."""
        if self.probabilities is None:
            return {"material": "unknown"}
        return {"material": f"{self.names[self.named]} ({self.probabilities[self.named]:.2f})"}

    def to_dict(self) -> dict[str, Any]:
        """Return the message as JSON and msgpack hold it; what is not known is null."""
        several = None if self.probabilities is None else self.probabilities.tolist()
        return {
            "version": VERSION,
            "kind": "material",
            "seq": self.seq,
            "t_ns": self.t_ns,
            "material": "unknown" if several is None else self.names[self.named],
            "probability": None if several is None else several[self.named],
            "probabilities": None if several is None else dict(zip(self.names, several, strict=True)),
            "state": self.state,
            "slide": self.slide,
            "rows": self.rows,
            "seen": round(self.seen, 4),
            "cause": self.cause,
            "latency_ms": known(self.latency_ms),
            "skipped": self.skipped,
        }

    def columns(self) -> Float32s:
        """Return `tacpipe.sensors.live.SLIDE` and the probability of each material, NaN where none is named."""
        return np.concatenate([self._slide(), self._probabilities()])

    def outputs(self, output: str) -> tuple[Any, ...] | None:
        """Return the numbers of the session's stream ``material`` or ``latency``."""
        if output == "material":
            return (self._slide()[None], self._probabilities()[None])
        numbers = (self.latency_ms, math.nan, self.compute_ms, 0, self.skipped, self.late)
        return (np.array([numbers], dtype=np.float32),)

    def _slide(self) -> Float32s:
        return np.array([self.named, self.rows, self.seen, self.state in (ENDED, FINAL), self.slide], np.float32)

    def _probabilities(self) -> Float32s:
        found = np.full(len(self.names), np.nan, np.float32) if self.probabilities is None else self.probabilities
        return found.astype(np.float32)


@dataclass(frozen=True)
class MaterialDescription:
    """What the messages of a session with a model of materials are."""

    names: tuple[str, ...]
    sensor: str
    frames: int  # rows of a slide that the model reads
    any_length: bool  # whether it reads fewer
    confidence: str  # probability: what the model was trained to state; order: scores of no scale, which only order
    rate_hz: float  # messages a second
    model: str
    kind: ClassVar[str] = "material"

    def columns(self) -> list[tuple[str, str]]:
        """Return the columns of `MaterialMessage.columns`."""
        from tacpipe.sensors.live import SLIDE

        return [*SLIDE.items(), *((f"probability_{name}", "1") for name in self.names)]

    def schema(self) -> dict[str, Any]:
        """Return the properties of a message, as JSON schema has them."""
        texts = dict.fromkeys(("kind", "material", "state", "cause"), "string")
        numbers = dict.fromkeys(("probability", "seen", "latency_ms"), "number")
        return properties(
            "version", "seq", "t_ns", "slide", "rows", "skipped", **texts, **numbers, probabilities="object"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the description as JSON and msgpack hold it."""
        return {
            "version": VERSION,
            "kind": "description",
            "of": self.kind,
            "materials": list(self.names),
            "sensor": self.sensor,
            "frames": self.frames,
            "any_length": self.any_length,
            "confidence": self.confidence,
            "rate_hz": self.rate_hz,
            "model": self.model,
        }
