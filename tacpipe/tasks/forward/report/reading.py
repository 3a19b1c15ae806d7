"""Results of forecasts as runs of the comparison engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tacpipe.comparison.runs import Errors, Question, Run
from tacpipe.comparison.specification import Kind
from tacpipe.report.contents import counted_once
from tacpipe.tasks.forward import headline, units
from tacpipe.tasks.forward.headline import BASELINE
from tacpipe.tasks.forward.report import methods
from tacpipe.tasks.forward.report.methods import Result

if TYPE_CHECKING:
    from tacpipe.arrays import AnyFloats
    from tacpipe.datasets.dataset import Dataset

ORACLES = ("codec", "codec_anchored")  # of what knows the true future


def read(results: Sequence[Dataset]) -> list[Run]:
    """Return the runs of results that hold error sums of recordings which the model has not seen."""
    every = [Result(one) for one in counted_once(results) if methods.comparable(one)]
    runs = [one for one in every if one.errors.recordings]
    if not runs:
        return []
    steps = shown_steps(runs)
    usual = methods.main_timeline(runs)
    return [_run(one, steps, usual) for one in runs]


def kind(predictor: str) -> Kind:
    """Return what a predictor is.

    >>> [kind(one) for one in ("model", "model_anchored", "ridge", "codec", "codec_persistence PCA-20")]
    ['model', 'variant', 'baseline', 'oracle', 'control']
    """
    if predictor.startswith("model"):
        return "model" if predictor == "model" else "variant"
    return (
        "oracle" if predictor.split(" ")[0] in ORACLES else "control" if predictor.startswith("codec") else "baseline"
    )


def called(predictor: str) -> str:
    """Return what tables call a predictor: its name in ``metrics.json`` with spaces.

    >>> called("model_anchored"), called("codec_persistence PCA-20")
    ('anchored', 'codec persistence PCA-20')
    """
    return predictor.removeprefix("model_").replace("_", " ")


def through(predictor: str, codec: str) -> str:
    """Return the name of a predictor among several representations: those that go through a codec state which.

    >>> through("ridge", "PCA-20"), through("codec_persistence", "PCA-20")
    ('ridge', 'codec_persistence PCA-20')
    """
    return f"{predictor} {codec}" if predictor.startswith("codec") else predictor


def shown_steps(runs: Sequence[Result]) -> tuple[int, ...]:
    """Return the steps to report on, those that all runs predict."""
    return headline.shown(sorted(set.intersection(*(set(run.errors.steps) for run in runs))))


def sums(
    run: Result, predictor: str, steps: Sequence[int], known: bool | None = None, group: str = "both"
) -> dict[str, AnyFloats]:
    """Return what `headline.sums` adds up, by recording; empty where a predictor has no errors in a group of channels."""
    errors = run.errors
    found, still = errors.of(predictor, group), errors.of(BASELINE, group)
    if found is None or still is None:
        return {}
    at, width = [errors.steps.index(step) for step in steps], errors.channels[group]
    return {
        name: headline.sums(
            (found[0][place, at], found[1][place, at]),
            (still[0][place, at], still[1][place, at]),
            float(errors.windows[place]) * width,
        )
        for place, name in enumerate(errors.recordings)
        if errors.windows[place] and (known is None or bool(errors.known[place]) == known)
    }  # fmt: skip


def clusters(run: Result, known: bool | None) -> dict[str, str] | None:
    """Return the object of each recording of unseen objects, which is what chance draws there; None of other recordings."""
    errors = run.errors
    if known is not False or not errors.objects:
        return None
    return {name: errors.objects.get(name, name) for name in errors.recordings}


def _run(run: Result, steps: Sequence[int], usual: str) -> Run:
    config = run.config
    elsewhere = run.timeline != usual
    other = f"{run.timeline} timeline" if elsewhere else ""
    questions = {}
    for known in (True, False) if run.errors.named else (None,):
        by_predictor = {
            through(name, str(config["codec"]["name"])): one
            for name in run.errors.predictors
            if (one := sums(run, name, steps, known))
        }
        if by_predictor:
            part = ", ".join(filter(None, (headline.PARTS[known], other)))
            objects = clusters(run, known)
            cluster = headline.OBJECTS if objects else headline.RECORDINGS
            measure = headline.measure(steps, units.of_model(config), cluster)
            questions[Question(part, place=2 * elsewhere + (known is False))] = Errors(measure, by_predictor, objects)
    return Run(
        run.dataset,
        headline.TASK,
        run.name(usual),
        run.settings,
        questions,
        family=str(config["architecture"]).replace("_", " "),
        seed=run.given.get("seed"),
        simulated=run.simulated,
        published=run.published,
        control=run.actions == "shuffled",
        details=run,
    )
