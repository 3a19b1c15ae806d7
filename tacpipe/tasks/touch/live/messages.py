"""Define the messages of a session with a touch model: the ranking of a request's candidate grasps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, TypedDict

import numpy as np

from tacpipe.arrays import Float32s, Floats, Int64s
from tacpipe.channels import biotac_sp
from tacpipe.io import JsonObject
from tacpipe.live import messages
from tacpipe.live.messages import Sizes, head_values, rounded
from tacpipe.sensors.live import LSL, Declaration, LiveColumn, Value, latency_values

COLUMNS = tuple(name for target in biotac_sp.TARGETS for name in biotac_sp.value_columns(target))  # values of a reading
TOUCH = "touch"  # name of the recorded stream; one row per grasp
ORDER = ("request", "grasp", "rank")
SCORES = ("score", "level_th", "level_mf")


def _names(*names: str) -> list[LiveColumn]:
    return [LiveColumn(name) for name in names]


DECLARATION = Declaration(
    TOUCH,
    (
        *head_values(),
        Value("request", "number of the request, as it was sent", "integer", streams=(LSL,)),
        Value("criterion", "criterion of the ranking", "string"),
        Value("best", "number of the best grasp, from 0", "integer"),
        Value(
            "candidates",
            "grasps of the request: `grasp`, `rank`, `score`, `level_th`, `level_mf`, and `touch` by value",
            "array",
            schema=lambda sizes: {"type": "array", "items": {"type": "object"}},
        ),
        Value(
            "best_grasp",
            "best grasp, its score and levels, and the number of grasps",
            streams=(LSL,),
            columns=lambda sizes: _names("best", *SCORES, "grasps"),
        ),
        Value(
            "order",
            "request, grasp from 0, and rank from 1",
            streams=(TOUCH,),
            type="<i8",
            quantity="prediction",
            columns=lambda sizes: _names(*ORDER),
        ),
        Value(
            "grasp_scores",
            "score of the grasp, and level of each finger, 0 to 1",
            streams=(TOUCH,),
            quantity="prediction",
            columns=lambda sizes: _names(*SCORES),
        ),
        Value(
            "touch",
            "predicted touch of the grasp",
            streams=(TOUCH,),
            unit="count",
            quantity="prediction",
            columns=lambda sizes: [LiveColumn(name, sizes.unit) for name in sizes.channels],
        ),
        Value("cause", "reason why nothing is ranked", "string"),
        *latency_values("latency_ms", "skipped"),
    ),
    {TOUCH: 4},
)


class CandidateJson(TypedDict):
    """A candidate of a request, as JSON."""

    grasp: int
    rank: int
    score: float | None
    level_th: float | None
    level_mf: float | None
    touch: dict[str, float | None]  # column -> device counts


@dataclass
class TouchMessage(messages.Message):
    """The ranking of a request's candidates, or the reason why it is missing."""

    request: int  # request number from the client
    criterion: str
    touch: Floats | None = None  # (grasp, value) in the order of `COLUMNS`, device counts; NaN if not predicted
    levels: Floats = field(default_factory=lambda: np.zeros((0, 2)))  # (grasp, finger)
    scores: Floats = field(default_factory=lambda: np.zeros(0))  # (grasp,)
    ranks: tuple[int, ...] = ()  # rank of each grasp, 1 for the best
    declaration: ClassVar[Declaration] = DECLARATION

    @property
    def answers(self) -> bool:
        """Whether there is a ranking."""
        return self.touch is not None

    @property
    def sampled_ns(self) -> None:
        """None, because the cloud of a request has no time."""
        return

    @property
    def states(self) -> Mapping[str, str]:
        """The best grasp of the request, for display."""
        best = f"grasp {self.ranks.index(1)} of {len(self.ranks)}" if self.ranks else "unknown"
        return {f"request {self.request}": best}

    @property
    def best(self) -> int | None:
        """Index of the best grasp; None without ranks."""
        return self.ranks.index(1) if self.ranks else None

    @property
    def candidates(self) -> list[CandidateJson] | None:
        """All grasps, as JSON; None without predictions."""
        return None if self.touch is None else [self._candidate(row) for row in range(len(self.touch))]

    def _candidate(self, row: int) -> CandidateJson:
        """Return the JSON value of a candidate with its rank, score and predicted touch."""
        assert self.touch is not None
        values = [None if math.isnan(value) else value for value in self.touch[row].astype(np.float32).tolist()]
        thumb, middle = map(rounded, self.levels[row].tolist())
        return {
            "grasp": row,
            "rank": self.ranks[row],
            "score": rounded(float(self.scores[row])),
            "level_th": thumb,
            "level_mf": middle,
            "touch": dict(zip(COLUMNS, values, strict=True)),
        }

    @property
    def best_grasp(self) -> Float32s:
        """Index, score and levels of the best grasp, and the number of grasps (5,)."""
        best = self.best
        if best is None:
            return np.array([-1, np.nan, np.nan, np.nan, 0], np.float32)
        return np.array([best, self.scores[best], *self.levels[best], len(self.ranks)], np.float32)

    @property
    def order(self) -> Int64s:
        """Request number, index and rank of each grasp (grasp, 3)."""
        return np.array([[self.request, row, rank] for row, rank in enumerate(self.ranks)], np.int64)

    @property
    def grasp_scores(self) -> Float32s:
        """Score and levels of each grasp (grasp, 3)."""
        return np.column_stack([self.scores, self.levels]).astype(np.float32)

    def row_count(self, stream: str) -> int:
        """Return the number of grasps for the stream of rankings."""
        return len(self.ranks) if stream == TOUCH else 1


@dataclass(frozen=True)
class TouchDescription(messages.Description):
    """Description of the messages of a session with a touch model."""

    targets: tuple[str, ...]
    criterion: str
    model: str
    rate_hz: float = 0.0  # 0, because there is one response per request
    declaration: ClassVar[Declaration] = DECLARATION
    answers: ClassVar[str] = "rankings"

    @property
    def sizes(self) -> Sizes:
        """Names of the predicted values."""
        return Sizes(COLUMNS)

    @property
    def details(self) -> JsonObject:
        """What it states beside the kind of the messages."""
        return {
            "targets": list(self.targets),
            "unit": "count",
            "criterion": self.criterion,
            "model": self.model,
        }
