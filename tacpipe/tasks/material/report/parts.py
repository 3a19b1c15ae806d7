"""What the page states of materials beyond the comparison: the paper's tables, joint learning, confusions and slides."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tacpipe.comparison.engine import Comparison, Row
from tacpipe.comparison.runs import Method, Run
from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Cell, Fold, Note
from tacpipe.report.context import Context
from tacpipe.tasks.material import headline
from tacpipe.tasks.material.report import (
    accuracy,
    confusion,
    curves,
    joint,
    latents,
    printed,
    profiles,
    reading,
    reduction,
    tables,
    uncertainty,
    wording,
    zero_shot,
)
from tacpipe.tasks.material.report.methods import of, sensors_of, shown
from tacpipe.tasks.material.report.predictions import LAST, LEVEL, MODEL

PAIRED = (
    "A slide that several runs evaluated counts as the fraction of runs that named it right; the interval is from drawing "
    "slides anew. McNemar's test takes a slide for right where at least half of the runs are; the t test pairs accuracies "
    "of the same fold."
)


def folds(context: Context) -> list[Fold]:
    """Return what materials have of their own."""
    methods = context.methods
    return [
        *blocks.fold(
            "Joint learning",
            *map(Note, joint.effects(methods)),
            tables.differences(methods),
            tables.swaps(methods),
            Note(PAIRED),
        ),
        *blocks.fold("Fewer slides of one sensor", *reduction.tables(methods)),
        *curves.few_slides(methods),
        *zero_shot.folds(methods),
        *confusion.folds(context),
        *uncertainty.folds(methods),
        *latents.folds(methods),
        *curves.training(methods),
        *profiles.folds(context.others),
    ]


def columns(context: Context, comparison: Comparison) -> list[tuple[str, Callable[[Row], Cell]]]:
    """Return more columns of the table of all methods: counts, the last epoch, skill over the mean level, the paper's."""
    runs = [run for run in context.runs if comparison.question in run.questions]
    asked = (one for run in runs for one in run.details.sensors if reading.question(run, one) == comparison.question)
    sensor = next(asked)

    def runs_of(row: Row) -> list[Run]:
        return row.method.of(comparison.question)

    def named_right(row: Row) -> Cell:
        counted = row.predictor != headline.CHANCE  # which names none
        return wording.fraction(accuracy.accuracy(runs_of(row), sensor, row.predictor) if counted else None)

    def last(row: Row) -> Cell:
        found = accuracy.accuracy(runs_of(row), sensor, LAST) if row.predictor == MODEL else None
        return Cell(wording.percent(found.fraction), value=found.fraction) if found else Cell(NONE)

    def paper(row: Row) -> Cell:
        value = printed.ACCURACIES.get(row.family, {}).get(sensor) if row.kind == "model" else None
        return Cell(NONE) if value is None else Cell(f"{value:.2f}", value=value)

    found: list[tuple[str, Callable[[Row], Cell]]] = [
        ("slides named right", named_right),
        (
            "skill over the mean level",
            lambda row: blocks.number(accuracy.skill(runs_of(row), sensor, row.predictor), 3),
        ),
    ]
    if any(LAST in run.details.predictions.predicted for run in runs):
        found.append(("last epoch (%)", last))
    return [*found, ("paper, Table I (%)", paper)] if context.published else found


def caveats(context: Context) -> list[str]:
    """Return what must be known about these numbers."""
    methods = context.methods
    return [_basis(methods), _pooled(methods), wording.caution(methods), _not_run(methods)] if methods else []


def _pooled(methods: Sequence[Method]) -> str:
    """Return what the table of accuracies of these methods holds."""
    runs = [run for one in methods for run in one.details]
    published = all(one.published for one in methods)
    predicted = {name for run in runs for name in run.predictions.predicted}
    described = [
        "Slides named right: accuracy ± standard deviation over runs; in small print, those of all that runs of the method "
        "were evaluated on, then the 95 % interval (Wilson) over slides, each counted once however many runs named it.",
        "Networks have the weights that did best in validation, unless the name states otherwise."
        if any(run.history for run in runs)
        else "",
        f"Last epoch: the weights of the last one{', which the paper’s code reports' if published else ''}."
        if LAST in predicted
        else "",
        "Skill is 1 − errors / errors of the mean level alone, a linear readout of the time-averaged channels."
        if LEVEL in predicted
        else "",
        "Mapping to a known space is reported for the sensor that was mapped to the other's."
        if any(one.settings["frozen_sensor"] for one in methods)
        else "",
        printed.BASIS if published else "",
    ]
    return " ".join(filter(None, described))


def _basis(methods: Sequence[Method]) -> str:
    """Return what all rests on: slides, training slides, and settings."""
    described = []
    for sensor in sensors_of(methods):
        slides = [run.details.predictions.of(sensor) for one in methods for run in of(one, sensor)]
        names = {str(name) for one in slides for name in one.recordings}
        trained = sorted({run.learned[sensor] for one in methods for run in one.details if sensor in run.learned})
        counts = f" after training on {blocks.listed([f'{count:,}' for count in trained])}" if trained else ""
        described.append(f"{len(names):,} slides of {sensor}{counts}")
    settings, runs = {}, [run for one in methods for run in one.details]
    for name in ("seed", "epochs"):
        values = {run.params[name] for run in runs if name in run.params and (name == "seed" or run.history)}
        if values:
            settings[name] = ", ".join(str(value) for value in sorted(values))
    shown = "; ".join(f"{name} {values}" for name, values in settings.items())
    return f"Evaluated on {blocks.listed(described)}.{f' Settings: {shown}.' if shown else ''}"


def _not_run(methods: Sequence[Method]) -> str:
    """Return what the paper printed of methods that were not run, where the slides are the paper's."""
    if not all(one.published for one in methods):
        return ""
    missing = [name for name in printed.ACCURACIES if all(one.family != name for one in methods)]
    missed = [
        f"{name}: {', '.join(f'{shown(sensor)} {value:.2f} %' for sensor, value in printed.ACCURACIES[name].items())}"
        for name in missing
    ]
    return f"In the paper's Table I and not run here: {'; '.join(missed)}." if missed else ""
