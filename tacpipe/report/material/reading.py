"""Results on materials as runs of the comparison engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.comparison.runs import Errors, Question
from tacpipe.comparison.runs import Run as Compared
from tacpipe.comparison.specification import Kind
from tacpipe.report.material import grouping
from tacpipe.report.material.accuracy import named_right
from tacpipe.report.material.methods import Method, Run, base_name, shown
from tacpipe.report.material.predictions import LAST, LEVEL, MODEL, SHUFFLED, SWAPPED
from tacpipe.tasks.material import headline

if TYPE_CHECKING:
    from tacpipe.arrays import AnyFloats
    from tacpipe.datasets.dataset import Dataset

USUAL = grouping.USUAL
CALLED = {
    LEVEL: headline.BASELINES[LEVEL],
    SHUFFLED: "trained on shuffled labels",
    SWAPPED: "classifiers exchanged",
    LAST: "last epoch",
}
KINDS: dict[str, Kind] = {MODEL: "model", LEVEL: "baseline", headline.CHANCE: "baseline", SHUFFLED: "control"}


def read(results: Sequence[Dataset]) -> list[Compared]:
    """Return the runs of results that hold predictions of slides which the model has not seen."""
    runs = [Run.read(one) for one in results if "predictions" in one.recordings]
    methods = grouping.grouped([run for run in runs if run.sensors])
    found = {id(run.dataset): _run(run, method) for method in methods for run in method.runs}
    return [found[id(one)] for one in results if id(one) in found]


def kind(predictor: str) -> Kind:
    """Return what a predictor is."""
    return KINDS.get(predictor, "variant")


def called(predictor: str) -> str:
    """Return what tables call a predictor."""
    return CALLED.get(predictor, predictor.replace("_", " "))


def _run(run: Run, method: Method) -> Compared:
    settings = method.settings
    other = " · ".join(str(settings[name]) for name in ("split", "layout")) if settings["elsewhere"] else ""
    classes = len(run.config.get("classes", ()))
    questions = {}
    for sensor in run.sensors:
        sums: dict[str, dict[str, AnyFloats]] = {
            predictor: {name: np.array([right, 1.0]) for name, right in named_right(run, sensor, predictor).items()}
            for predictor in run.predictions.predicted
        }
        if classes:
            sums[headline.CHANCE] = dict.fromkeys(sums[MODEL], np.array([1 / classes, 1.0]))
        part = ", ".join(filter(None, (shown(sensor), other)))
        questions[Question(part, place=int(settings["elsewhere"]))] = Errors(
            headline.MEASURE, {name: one for name, one in sums.items() if one}
        )
    return Compared(
        run.dataset,
        headline.TASK,
        base_name(settings),
        settings,
        questions,
        family=method.kind,
        seed=run.params.get("seed"),
        fold=run.config.get("fold"),
        simulated=run.simulated,
        published=run.published,
        control=not (method.plain or method.differs_only("elsewhere")),
        details=run,
    )
