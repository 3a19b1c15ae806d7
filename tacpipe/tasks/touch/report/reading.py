"""Results on touch as runs of the comparison engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.channels import biotac_sp
from tacpipe.comparison.runs import Errors, Question, Run
from tacpipe.metrics import regression
from tacpipe.report.contents import counted_once
from tacpipe.tasks.touch import headline
from tacpipe.tasks.touch.report import methods, wording
from tacpipe.tasks.touch.report.methods import Result
from tacpipe.tasks.touch.result_names import PREDICTIONS

if TYPE_CHECKING:
    from tacpipe.arrays import Floats
    from tacpipe.datasets.dataset import Dataset


def read(results: Sequence[Dataset]) -> list[Run]:
    """Return the runs of results that hold predictions of grasps which the model has not seen."""
    every = [Result(one) for one in counted_once(results) if PREDICTIONS in one.recordings]
    held = [one for one in every if len(one.predictions.recordings)]
    splits = methods.splits(held)
    return [_run(*pair, splits) for pair in zip(held, methods.names(held), strict=True)]


def called(predictor: str) -> str:
    """Return what tables call a predictor.

    >>> called("object_mean"), called("nearest_neighbours")
    ('mean of the object', 'nearest neighbours')
    """
    return headline.BASELINES.get(predictor, predictor.replace("_", " "))


def _run(run: Result, name: str, splits: Sequence[tuple[str, bool]]) -> Run:
    questions = {}
    for known in (True, False):
        rows = run.predictions.of(known)
        place = 2 * splits.index((run.split, run.simulated)) + (not known)
        if not len(rows.recordings):
            continue
        objects = dict(zip(rows.recordings.tolist(), rows.objects.tolist(), strict=True))
        for target in rows.targets:
            low, high = biotac_sp.RANGES[target]
            sums = {
                name: _squared(target, rows.true[target], one[target], rows.recordings.tolist())
                for name, one in rows.predicted.items()
                if target in one
            }
            measure = headline.measure(high - low, "grasps" if known else "objects")
            part = headline.PARTS[known]
            if len(splits) > 1:
                part += f", {wording.place(run.split, run.simulated)}"
            questions[Question(part, headline.TARGETS[target], place)] = Errors(
                measure, sums, None if known else objects
            )
    return Run(
        run.dataset,
        headline.TASK,
        name,
        run.settings,
        questions,
        family=methods.NAMES.get(run.architecture, run.architecture),
        seed=run.params.get("seed"),
        simulated=run.simulated,
        published=run.published,
        details=run,
    )


def _squared(target: str, true: Floats, predicted: Floats, names: Sequence[str]) -> dict[str, Floats]:
    """Return the sum of squares in fractions of the target's range and the number of values, by grasp."""
    one, other = (biotac_sp.normalised(target, values) for values in (true, predicted))
    squared = regression.squared_sums(one, other)
    return {name: np.array([value, float(one.shape[1])]) for name, value in zip(names, squared, strict=True)}
