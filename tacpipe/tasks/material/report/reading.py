"""Results on materials as runs of the comparison engine: a question is the slides of a sensor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.comparison.runs import Errors, Question, Run
from tacpipe.comparison.specification import Kind
from tacpipe.report.contents import counted_once
from tacpipe.tasks.material import headline
from tacpipe.tasks.material.report import methods
from tacpipe.tasks.material.report.methods import Result
from tacpipe.tasks.material.report.predictions import (
    LAST,
    LEVEL,
    LEVEL_ONLY,
    LEVEL_REMOVED,
    MODEL,
    NOTHING,
    SHUFFLED,
    SWAPPED,
)

if TYPE_CHECKING:
    from tacpipe.arrays import AnyFloats
    from tacpipe.datasets.dataset import Dataset

CALLED = {
    LEVEL: headline.BASELINES[LEVEL],
    LEVEL_ONLY: headline.BASELINES[LEVEL_ONLY],
    LEVEL_REMOVED: "same readout, level removed",
    SHUFFLED: "trained on shuffled labels",
    SWAPPED: "classifiers exchanged",
    LAST: "last epoch",
}
KINDS: dict[str, Kind] = {
    MODEL: "model",
    LEVEL: "baseline",
    LEVEL_ONLY: "baseline",
    headline.CHANCE: "baseline",
    SHUFFLED: "control",
    LEVEL_REMOVED: "control",
}


def read(results: Sequence[Dataset]) -> list[Run]:
    """Return the runs of results that hold predictions of slides which the model has not seen."""
    every = [Result(one) for one in counted_once(results) if "predictions" in one.recordings]
    held = [one for one in every if one.sensors]
    return [_run(*pair) for pair in zip(held, methods.settings(held), strict=True)]


def kind(predictor: str) -> Kind:
    """Return what a predictor is."""
    return KINDS.get(predictor, "variant")


def called(predictor: str) -> str:
    """Return what tables call a predictor."""
    return CALLED.get(predictor, predictor.replace("_", " "))


def question(run: Run, sensor: str) -> Question | None:
    """Return the question that a run answers on slides of a sensor."""
    return next((one for one in run.questions if one.part.split(", ")[0] == methods.shown(sensor)), None)


def right(result: Result, sensor: str, predictor: str) -> dict[str, AnyFloats]:
    """Return whether each slide of a sensor was named right, 1 or 0, and 1, by recording."""
    rows = result.predictions.of(sensor)
    triples = zip(rows.recordings, rows.predicted[predictor], rows.materials, strict=True)
    return {str(name): np.array([named == truth, 1.0]) for name, named, truth in triples if named != NOTHING}


def _run(result: Result, settings: dict[str, Any]) -> Run:
    other = " · ".join(str(settings[name]) for name in ("split", "layout")) if settings["elsewhere"] else ""
    classes = len(result.config.get("classes", ()))
    questions = {}
    for sensor in result.sensors:
        sums = {predictor: right(result, sensor, predictor) for predictor in result.predictions.predicted}
        if classes:
            sums[headline.CHANCE] = dict.fromkeys(sums[MODEL], np.array([1 / classes, 1.0]))
        part = ", ".join(filter(None, (methods.shown(sensor), other)))
        questions[Question(part, place=int(settings["elsewhere"]))] = Errors(
            headline.MEASURE, {name: one for name, one in sums.items() if one}
        )
    return Run(
        result.dataset,
        headline.TASK,
        methods.base_name(settings),
        settings,
        questions,
        family=methods.base_name(settings, variants=False),
        seed=result.params.get("seed"),
        fold=result.config.get("fold"),
        simulated=result.simulated,
        published=result.published,
        control=not methods.plain(settings, "elsewhere"),
        details=result,
    )
