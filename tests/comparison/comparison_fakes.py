"""Handmade runs, for which all results of a comparison can be computed independently."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.comparison.runs import ComparedRun, Question, ScoreTable
from tacpipe.scores.pairing import Measure

QUESTION = Question("known")


def _mean(sums: AnyFloats) -> AnyFloats:
    return np.where(sums[:, 1] > 0, sums[:, 0] / np.where(sums[:, 1] > 0, sums[:, 1], 1), np.nan)


MEAN = Measure(
    ("error",),
    "N",
    "the mean error",
    "skill",
    "recordings",
    _mean,
    lambda error, reference: 1 - error / reference,
    lambda sums: (float(sums[0] / sums[1]),),
)


def sums(errors: Sequence[float] | AnyFloats) -> dict[str, AnyFloats]:
    """One value a recording."""
    return {f"r{place:02d}": np.array([error, 1.0]) for place, error in enumerate(errors)}


def run(
    errors: Mapping[str, Sequence[float] | AnyFloats],
    method: str = "net",
    *,
    seed: int = 0,
    clusters: Mapping[str, str] | None = None,
    question: Question = QUESTION,
    **about: Any,
) -> ComparedRun:
    """A run of predictors with these errors by recording."""
    measured = ScoreTable(MEAN, {name: sums(values) for name, values in errors.items()}, clusters)
    settings = about.pop("settings", {})
    return ComparedRun(
        about.pop("dataset", None), "weighing", method, settings, {question: measured}, seed=seed, **about
    )
