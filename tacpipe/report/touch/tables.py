"""The tables in which methods and baselines are next to each other, of one way to part grasps."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tacpipe.report import markup
from tacpipe.report.markup import NONE
from tacpipe.report.touch import scores, wording
from tacpipe.report.touch.methods import Group, Method, Run
from tacpipe.report.touch.scores import Score
from tacpipe.tasks.touch.result_names import MODEL, OBJECT_MEAN

HEADS = (
    "RMSE",
    "counts",
    "R²",
    "skill",
    "RMSE over runs",
    "batch mean",
    "MAE (counts)",
    "grasps",
    "runs",
)
ROWS = ("RMSE over runs", "counts", "R²", "skill", "grasps", "runs")  # of a table in the paper's form


def errors(group: Group, known: bool) -> str:
    """Return a table a target with every method and baseline on known or on novel objects; empty where none was
    evaluated."""
    return "".join(_errors(group, target, known) for target in wording.TARGETS)


def by_object(group: Group) -> str:
    """Return errors and skill by object of one method an architecture; empty where no object was evaluated."""
    return "".join(_by_object(group, method) for method in group.main)


def every_run(methods: Sequence[Method]) -> str:
    """Return one row a run."""
    rows = []
    for method in methods:
        for run in sorted(method.runs, key=lambda run: str(run.params.get("seed", ""))):
            for known in (True, False):
                described = [scores.score([run], target, known) for target in wording.TARGETS]
                if not any(described):
                    continue
                trained = NONE if run.trained is None else f"{run.trained:,}"
                about = [method.name, wording.split(method.split), str(run.params.get("seed", NONE)), trained]
                counted = max(one.grasps for one in described if one)
                cells = [cell for one in described for cell in _short(one)]
                rows.append([*about, wording.OBJECTS[known], f"{counted:,}", *cells, str(len(run.history) or NONE)])
    parts = [f"{name} {part}" for name in wording.TARGETS.values() for part in ("RMSE", "R²")]
    heads = ["", "split", "seed", "trained on", "evaluated on", "grasps", *parts, "epochs"]
    runs = sum(len(one.runs) for one in methods)
    runs_text = f"All {runs} runs" if runs > 1 else "The run"
    return f"<details><summary>{runs_text}</summary>{markup.table('Each run', heads, rows)}</details>"


def cells(found: Score | None) -> list[str]:
    """Return what a table in the paper's form states of a score, as `ROWS` names it."""
    if found is None:
        return [NONE] * len(ROWS)
    error = markup.with_sd(found.each.mean, found.each.sd)
    counts = f"{scores.in_counts(found.target, found.each.mean):.0f}"
    return [error, counts, wording.signed(found.r2), wording.skill(found), f"{found.grasps:,}", str(found.runs)]


def baseline_rows(methods: Sequence[Method], target: str, known: bool | None) -> list[tuple[str, Score | None]]:
    """Return the mandatory baselines and any others that some methods' results hold, by what a table calls them."""
    found = []
    for predictor in dict.fromkeys([*wording.BASELINES, *scores.baselines(methods)]):
        source = scores.reference(methods, target, predictor)
        described = scores.score(source.runs, target, known, predictor) if source else None
        found.append((wording.baseline(predictor), described))
    return found


def _errors(group: Group, target: str, known: bool) -> str:
    first = scores.best(group.methods, target, known)
    if first is None:
        return ""
    every = [(method.name, scores.score(method.runs, target, known)) for method in group.methods]
    described = [one for one in every if one[1]]
    baselines = baseline_rows(group.methods, target, known)
    rows = [[name, *_cells(one)] for name, one in [*described, *baselines]]
    kinds = dict.fromkeys(range(len(described), len(rows)), "quiet")
    kinds[[name for name, _ in described].index(first.name)] = "best"
    return markup.table(f"{wording.TARGETS[target]}, {wording.OBJECTS[known]}", ["", *HEADS], rows, kinds)


def _cells(found: Score | None) -> list[str]:
    """Return what `HEADS` name."""
    if found is None:
        return [NONE] * len(HEADS)
    return [
        wording.percentage(found.rmse),
        f"{found.counts:.0f}",
        wording.signed(found.r2),
        wording.skill(found),
        markup.with_sd(found.each.mean, found.each.sd),
        wording.percentage(found.batch_mean),
        f"{scores.in_counts(found.target, found.mae):.0f}",
        f"{found.grasps:,}",
        str(found.runs),
    ]


def _by_object(group: Group, method: Method) -> str:
    targets = method.targets
    rows: list[list[str]] = []
    kinds: dict[int, str] = {}
    for known in (True, False):
        names = {str(name) for run in method.runs for name in run.predictions.of(known).objects}
        for name in sorted(names):
            runs = scores.of_object(method.runs, name)
            row = []
            for target in targets:
                row += _of_object(runs, target, known)
            counted = len({str(one) for run in runs for one in run.predictions.of(known).recordings})
            if not known:
                kinds[len(rows)] = "quiet"
            rows.append([name if known else f"{name} (novel)", f"{counted:,}", *row])
    if not rows:
        return ""
    heads = ["", "grasps", *(part for target in targets for part in (wording.TARGETS[target], "skill"))]
    return markup.table(f"By object, {method.name}: RMSE above that of the object's mean", heads, rows, kinds)


def _short(found: Score | None) -> list[str]:
    return [wording.percentage(found.rmse), wording.signed(found.r2)] if found else [NONE, NONE]


def _of_object(runs: Sequence[Run], target: str, known: bool) -> list[str]:
    """Return the RMSE on an object, above that of its mean where there is one, and the skill over the constant."""
    found, mean = (scores.score(runs, target, known, one) for one in (MODEL, OBJECT_MEAN))
    if found is None:
        return [NONE, NONE]
    below = f"<br><small>{wording.percentage(mean.rmse)}</small>" if mean and known else ""
    skill = NONE if math.isnan(found.skill.mean) else markup.decimals(found.skill.mean)
    return [markup.Markup(f"{wording.percentage(found.rmse)}{below}"), skill]
