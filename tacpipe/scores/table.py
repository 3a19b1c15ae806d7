"""Hold the scores of all predictors on one question, and compute headlines and metrics from them.

A table of scores has a row for each predictor and recording: the sums of its errors. Its declaration is the `Measure`, which
computes errors from sums, and the clusters, which are the units of the intervals. Evaluations write their headlines and
metrics from such tables, and comparisons and reports read the same tables from results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.printable import round_to
from tacpipe.scores import pairing
from tacpipe.scores.headline import Headline
from tacpipe.scores.intervals import Estimate
from tacpipe.scores.pairing import Gain, Measure, Sums

MODEL = "model"  # name of a run's own predictor


@dataclass(frozen=True)
class Question:
    """The subject of a comparison: recordings ("unseen objects"), and one of several targets ("PDC thumb"), as text."""

    part: str = ""
    target: str = ""
    place: int = 0  # order among the questions of a task; 0 is the main question

    @property
    def where(self) -> str:
        """Part and target as text."""
        return ", ".join(filter(None, (self.target, self.part))) or "all recordings"


@dataclass(frozen=True)
class ScoreTable:
    """The scores of a run's predictors on one question."""

    measure: Measure
    # error sums (part,), as defined by `measure`, by predictor and recording
    sums: Mapping[str, Mapping[str, AnyFloats]]
    clusters: Mapping[str, str] | None = None  # cluster of each recording for resampling; None if each is its own
    # predictors that are baselines of headlines, and their names there; None: all but the model
    baselines: Mapping[str, str] | None = None

    @classmethod
    def from_rows(
        cls,
        measure: Measure,
        recordings: Sequence[str],
        parts: Mapping[str, AnyFloats],
        clusters: Mapping[str, str] | None = None,
    ) -> ScoreTable:
        """Return the table of parts (row, part) by predictor, which are added over the rows of each recording."""
        names, owners = np.unique(np.array(recordings), return_inverse=True)
        sums_by_predictor = {}
        for predictor, rows in parts.items():
            sums = np.zeros((len(names), rows.shape[1]))
            np.add.at(sums, owners, rows)
            sums_by_predictor[predictor] = dict(zip(names.tolist(), sums, strict=True))
        return cls(measure, sums_by_predictor, clusters)

    def sums_of(self, predictor: str) -> Sums:
        """Return the sums of a predictor as those of a run with one seed."""
        return {(0, recording): sums for recording, sums in self.sums.get(predictor, {}).items()}

    def score(self, predictor: str) -> Estimate:
        """Return the score of a predictor with its interval."""
        return pairing.score(self.measure, self.sums_of(predictor), self.clusters)

    def gain_over(self, baseline: str) -> Gain:
        """Return the gain of the model over a baseline."""
        return pairing.difference(self.measure, self.sums_of(MODEL), self.sums_of(baseline), self.clusters)

    def headline(self, task: str, method: str, question: Question) -> Headline | None:
        """Return the comparison of the model with its baselines, or None if it has no recordings."""
        names = self.baselines
        if names is None:
            names = {name: name.replace("_", " ") for name in self.sums if name != MODEL}
        baselines = {text: self.sums_of(name) for name, text in names.items() if self.sums.get(name)}
        return pairing.headline(
            task,
            method,
            self.measure,
            self.sums_of(MODEL),
            baselines,
            part=question.part,
            target=question.target,
            clusters=self.clusters,
        )

    def to_json(self) -> dict[str, Any]:
        """Return the values of each predictor by column, and the interval of its score."""
        values_by_predictor: dict[str, Any] = {}
        for name, by_recording in self.sums.items():
            values = self.measure.values(np.sum(list(by_recording.values()), axis=0))
            columns = {column: rounded(value) for column, value in zip(self.measure.columns, values, strict=True)}
            score = self.score(name)
            values_by_predictor[name] = {**columns, "interval": [rounded(score.low), rounded(score.high)]}
        return values_by_predictor


ScoreTables = Mapping[Question, ScoreTable]


def headlines(task: str, method: str, tables: ScoreTables) -> list[Headline]:
    """Return the comparison of a model with its baselines on each question that has recordings."""
    compared = [table.headline(task, method, question) for question, table in tables.items()]
    return [headline for headline in compared if headline is not None]


def rounded(value: float) -> float | None:
    """Return a value with the six digits of ``metrics.json``, or None if it is not finite."""
    return round_to(value, 6) if np.isfinite(value) else None
