"""What the page states of touch beyond the comparison: objects, electrodes, clouds, and the paper's tables and figures."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

from tacpipe.comparison.engine import Comparison, Row
from tacpipe.comparison.runs import Run
from tacpipe.metrics import headline
from tacpipe.report import blocks, screen
from tacpipe.report.blocks import NONE, Cell, Charts, Fold
from tacpipe.report.context import Context
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.report import (
    clouds,
    curves,
    electrodes,
    forms,
    generalisation,
    pressure,
    scores,
    tables,
    uncertainty,
    wording,
)
from tacpipe.tasks.touch.report import methods as by_method
from tacpipe.tasks.touch.report.scores import Score

POOLED = (
    "PDC is the pressure of the fluid in a fingertip. RMSE is global, over all grasps and electrodes of all runs of a "
    "method, as a fraction of the target's fixed range and in device counts; batch mean is the mean RMSE of batches of 10. "
    "R² is about the mean of the evaluated grasps, so a constant lies at 0 or below. A novel object has no mean of its own: "
    "the constant represents it."
)
NO_EVIDENCE = "there is no evidence of generalisation"
MIXED = "What is marked simulated is not evidence about a real sensor."


def sentence(context: Context) -> tuple[str, str]:
    """Return the general sentence, and where no method is better than the baselines on novel objects, that this is so."""
    text, verdict = screen.sentence(context)
    novel = [one for one in context.comparisons if one.question.part.startswith("novel")]
    better = [
        comparison for comparison in novel if any(row.gain.verdict == headline.BETTER for row in comparison.models)
    ]
    if novel and not better:
        text = f"{text.removesuffix('.')}: {NO_EVIDENCE}."
    return text, verdict


def folds(context: Context) -> list[Fold]:
    """Return what touch has of its own."""
    methods = context.methods
    if not methods:
        return clouds.folds(context.others, {})
    parted = by_method.groups(methods)
    first = (context.winner(next(iter(context.parts))) if context.parts else None) or by_method.default(parted[0])
    chosen = {one.recording: f"{one.place} by error" for one in electrodes.chosen(first.details[0].predictions)}
    found: list[Fold] = []
    for group in parted:
        result = group[0].details[0]
        where = f": {wording.place(result.split, result.simulated)}" if len(parted) > 1 else ""
        found += blocks.fold(f"By object{where}", *tables.by_object(group))
        drawn = curves.charts_of(group)
        found += blocks.fold(f"Training{where}", Charts(drawn)) if drawn else []
    published = all(one.published for one in methods)
    paper = [*forms.parts(methods), *generalisation.parts(methods), *curves.figure_8(methods)]
    return [
        *pressure.folds(first),
        *electrodes.folds(first),
        *uncertainty.folds(methods),
        *clouds.folds(context.others, chosen),
        *blocks.fold("The paper's tables and figures" if published else "What settings change", *paper),
        *found,
    ]


def columns(context: Context, comparison: Comparison) -> list[tuple[str, Callable[[Row], Cell]]]:
    """Return more columns of the table of all methods: R², skill over the constant, mean absolute error and batch means."""
    target = next(name for name, title in headlines.TARGETS.items() if title == comparison.question.target)
    known = comparison.question.part.startswith(headlines.PARTS[True])

    @functools.cache
    def score(row: Row) -> Score | None:
        runs = [run.details.predictions for run in row.method.of(comparison.question)]
        return scores.score(runs, target, known, row.predictor)

    def cell(value: Callable[[Score], Cell]) -> Callable[[Row], Cell]:
        return lambda row: value(found) if (found := score(row)) else Cell(NONE)

    return [
        ("R²", cell(lambda one: Cell(blocks.fixed(one.r2, 2), value=None if math.isnan(one.r2) else one.r2))),
        ("skill over the constant", cell(lambda one: blocks.interval(*one.skill))),
        ("RMSE over runs", cell(lambda one: blocks.with_sd(one.each.mean, one.each.sd))),
        ("batch mean", cell(lambda one: Cell(blocks.fixed(one.batch_mean, 4), value=one.batch_mean))),
        ("MAE (counts)", cell(lambda one: blocks.number(scores.in_counts(one.target, one.mae), 3))),
    ]


def caveats(context: Context) -> list[str]:
    """Return what must be known about these numbers."""
    methods = context.methods
    if not methods:
        return []
    mixed = MIXED if len({one.simulated for one in methods}) > 1 else ""
    return [POOLED, *map(wording.basis, by_method.groups(methods)), wording.caution(methods), mixed]


def about_run(run: Run) -> dict[str, str | Cell]:
    """Return more columns of the table of runs."""
    trained = run.details.trained
    rsquared = []
    for known in (True, False):
        for target in run.details.predictions.targets:
            found = scores.score([run.details.predictions], target, known)
            rsquared += (
                [f"{headlines.TARGETS[target]}, {headlines.PARTS[known]}: {blocks.fixed(found.r2, 2)}"] if found else []
            )
    return {
        "split": wording.split(run.details.split),
        "trained on": NONE if trained is None else f"{trained:,}",
        "epochs": str(len(run.details.history) or NONE),
        "R²": Cell("; ".join(rsquared) or NONE),
    }
