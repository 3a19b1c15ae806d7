"""What the parts of a task's section are made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.comparison.engine import Comparison, Row
from tacpipe.comparison.runs import MODEL, Method, Run
from tacpipe.comparison.specification import TaskReport

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset


@dataclass(frozen=True)
class Context:
    """The results of one task, compared, and the datasets next to them."""

    task: TaskReport
    methods: Sequence[Method]
    comparisons: Sequence[Comparison]
    others: Sequence[Dataset] = ()  # that are not results
    bare: Sequence[Dataset] = ()  # results that hold nothing to compare
    traces: int = 0  # recordings that are drawn in full
    runs: Sequence[Run] = field(default=())

    @cached_property
    def parts(self) -> dict[str, list[Comparison]]:
        """The comparisons by part of the recordings."""
        found: dict[str, list[Comparison]] = {}
        for one in self.comparisons:
            found.setdefault(one.question.part, []).append(one)
        return found

    @property
    def simulated(self) -> bool:
        """Whether any run was evaluated on simulated recordings."""
        return any(one.simulated for one in self.runs)

    @property
    def published(self) -> bool:
        """Whether all runs were evaluated on the recordings of the task's paper."""
        return bool(self.runs) and all(one.published for one in self.runs)

    def winner(self, part: str) -> Method | None:
        """Return the method of the best mean rank over the targets of a part; of several the first by name."""
        ranks: dict[str, list[int]] = {}
        for one in self.parts[part]:
            for place, row in enumerate(one.models):
                ranks.setdefault(row.name, []).append(place)
        most = max(map(len, ranks.values()), default=0)
        held = {name: float(np.mean(places)) for name, places in ranks.items() if len(places) == most}
        best = min(held, key=lambda name: (held[name], name), default=None)
        return next((one for one in self.methods if one.name == best), None)

    def row(self, comparison: Comparison, method: Method | None) -> Row | None:
        """Return the row of a method itself in a comparison."""
        return next(
            (one for one in comparison.rows if method and one.method is method and one.name == method.name), None
        )


def median_run(method: Method, comparison: Comparison) -> Run:
    """Return the run of a method whose score is in the middle, of an even number the one below."""
    measure, question = comparison.measure, comparison.question
    runs = method.of(question)

    def place(run: Run) -> tuple[float, str]:
        return measure.score_of(run.questions[question].sums[MODEL].values()), str(run.seed)

    return sorted(runs, key=place)[(len(runs) - 1) // 2]
