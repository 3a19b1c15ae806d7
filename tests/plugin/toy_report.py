"""Compare and report results of a task of another package: the weights of things."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.comparison.runs import ComparedRun, Question, ScoreTable
from tacpipe.report.context import TaskReport
from tacpipe.scores.pairing import Measure

if TYPE_CHECKING:
    from tacpipe.arrays import AnyFloats
    from tacpipe.datasets.dataset import Dataset


def error(sums: AnyFloats) -> AnyFloats:
    """Return the mean absolute error (draw,) from sums (draw, 2): sum of errors in grams, number of errors."""
    mean: AnyFloats = sums[:, 0] / sums[:, 1]
    return mean


WEIGHT = Measure(
    columns=("MAE (g)",),
    unit="grams",
    ranked_by="the mean absolute error",
    name="skill",
    cluster="things",
    error=error,
    gain=lambda model_error, baseline_error: 1 - model_error / baseline_error,
    values=lambda sums: (float(sums[0] / sums[1]),),
    scored="MAE (g)",
)


class WeighingReport(TaskReport):
    """The report of the task ``weighing``."""

    title = "weights of things"

    def read(self, results: Sequence[Dataset]) -> list[ComparedRun]:
        """Return one run per result: the errors of the model and of each baseline on each thing."""
        runs = []
        for result in results:
            config, errors = (json.loads(result.files[name]) for name in ("config.json", "errors.json"))
            sums = {
                predictor: {name: np.array([grams, 1.0]) for name, grams in by_thing.items()}
                for predictor, by_thing in errors.items()
            }
            about = {"method": config["architecture"], "settings": config["params"], "seed": config.get("seed")}
            runs.append(
                ComparedRun(result, self.name, **about, questions={Question("light things"): ScoreTable(WEIGHT, sums)})
            )
        return runs
