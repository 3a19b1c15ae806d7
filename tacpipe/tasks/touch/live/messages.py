"""What is published of candidate grasps: the touch that is predicted of each, and their ranking."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from tacpipe.arrays import Float32s, Floats
from tacpipe.channels import biotac_sp
from tacpipe.live.messages import VERSION, known, properties

COLUMNS = tuple(name for target in biotac_sp.TARGETS for name in biotac_sp.value_columns(target))  # of a touch


@dataclass
class TouchMessage:
    """The ranking of the candidates of one request, or why there is none."""

    seq: int
    t_ns: int  # arrival of the request, UTC as the recording has it
    request: int  # its number, as it was sent
    criterion: str
    touch: Floats | None = None  # (grasp, value), `COLUMNS` in device counts; NaN for what the model does not predict
    levels: Floats = field(default_factory=lambda: np.zeros((0, 2)))  # (grasp, finger)
    scores: Floats = field(default_factory=lambda: np.zeros(0))  # (grasp,)
    ranks: tuple[int, ...] = ()  # of each grasp, 1 for the best
    cause: str = ""  # why nothing is ranked
    made_from_t_ns: int = 0
    latency_ms: float = math.nan
    compute_ms: float = math.nan
    skipped: int = 0
    late: int = 0

    @property
    def answers(self) -> bool:
        """Whether candidates are ranked."""
        return self.touch is not None

    @property
    def states(self) -> Mapping[str, str]:
        """Which grasp of which request is best."""
        best = f"grasp {self.ranks.index(1)} of {len(self.ranks)}" if self.ranks else "unknown"
        return {f"request {self.request}": best}

    def to_dict(self) -> dict[str, Any]:
        """Return the message as JSON and msgpack hold it; what is not known is null."""
        return {
            "version": VERSION,
            "kind": "touch",
            "seq": self.seq,
            "t_ns": self.t_ns,
            "request": self.request,
            "criterion": self.criterion,
            "best": self.ranks.index(1) if self.ranks else None,
            "candidates": None if self.touch is None else [self._candidate(row) for row in range(len(self.touch))],
            "cause": self.cause,
            "latency_ms": known(self.latency_ms),
            "skipped": self.skipped,
        }

    def _candidate(self, row: int) -> dict[str, Any]:
        assert self.touch is not None
        values = [None if math.isnan(one) else one for one in self.touch[row].astype(np.float32).tolist()]
        thumb, middle = (known(one) for one in self.levels[row].tolist())
        about = {"grasp": row, "rank": self.ranks[row], "score": known(float(self.scores[row]))}
        return {**about, "level_th": thumb, "level_mf": middle, "touch": dict(zip(COLUMNS, values, strict=True))}

    def columns(self) -> Float32s:
        """Return number of the request, its best grasp with score and levels, and how many there are."""
        if not self.ranks:
            return np.array([self.request, -1, np.nan, np.nan, np.nan, 0], np.float32)
        best = self.ranks.index(1)
        return np.array([self.request, best, self.scores[best], *self.levels[best], len(self.ranks)], np.float32)

    def outputs(self, output: str) -> tuple[Any, ...] | None:
        """Return the numbers of the session's stream ``touch``, a row a grasp, or ``latency``."""
        if output == "touch":
            if self.touch is None:
                return None
            order = np.array([[self.request, row, rank] for row, rank in enumerate(self.ranks)], np.int64)
            worth = np.column_stack([self.scores, self.levels]).astype(np.float32)
            return (order, np.hstack([worth, self.touch.astype(np.float32)]))
        numbers = (self.latency_ms, math.nan, self.compute_ms, 0, self.skipped, self.late)
        return (np.array([numbers], dtype=np.float32),)


@dataclass(frozen=True)
class TouchDescription:
    """What the messages of a session with a model of touch are."""

    targets: tuple[str, ...]
    criterion: str
    model: str
    kind: ClassVar[str] = "touch"
    rate_hz: ClassVar[float] = 0.0  # an answer a request

    def columns(self) -> list[tuple[str, str]]:
        """Return the columns of `TouchMessage.columns`."""
        return [(name, "1") for name in ("request", "best", "score", "level_th", "level_mf", "grasps")]

    def schema(self) -> dict[str, Any]:
        """Return the properties of a message, as JSON schema has them."""
        texts = dict.fromkeys(("kind", "criterion", "cause"), "string")
        named = properties("version", "seq", "t_ns", "request", "best", "skipped", **texts, latency_ms="number")
        return {**named, "candidates": {"type": "array", "items": {"type": "object"}}}

    def to_dict(self) -> dict[str, Any]:
        """Return the description as JSON and msgpack hold it."""
        return {
            "version": VERSION,
            "kind": "description",
            "of": self.kind,
            "targets": list(self.targets),
            "unit": "count",
            "criterion": self.criterion,
            "model": self.model,
        }
