"""The tables in which methods and baselines are next to each other, of one way to part grasps."""

from __future__ import annotations

from collections.abc import Sequence

from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Cell, Table
from tacpipe.report.touch import scores, wording
from tacpipe.report.touch.methods import Group, Method, Run
from tacpipe.report.touch.scores import Score
from tacpipe.tasks.touch.result_names import MODEL, OBJECT_MEAN

ROWS = ("RMSE over runs", "counts", "R²", "skill", "grasps", "runs")  # of a table in the paper's form


def by_object(group: Group) -> list[Table]:
    """Return errors and skill by object of one method an architecture; none where no object was evaluated."""
    return [found for method in group.main if (found := _by_object(method))]


def cells(found: Score | None) -> list[str | Cell]:
    """Return what a table in the paper's form states of a score, as `ROWS` names it."""
    if found is None:
        return [NONE] * len(ROWS)
    error = blocks.with_sd(found.each.mean, found.each.sd)
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


def _by_object(method: Method) -> Table | None:
    targets = method.targets
    rows: list[list[str | Cell]] = []
    kinds: dict[int, str] = {}
    for known in (True, False):
        names = {str(name) for run in method.runs for name in run.predictions.of(known).objects}
        for name in sorted(names):
            runs = scores.of_object(method.runs, name)
            row: list[str | Cell] = []
            for target in targets:
                row += _of_object(runs, target, known)
            counted = len({str(one) for run in runs for one in run.predictions.of(known).recordings})
            if not known:
                kinds[len(rows)] = "quiet"
            rows.append([name if known else f"{name} (novel)", f"{counted:,}", *row])
    if not rows:
        return None
    heads = ["", "grasps", *(part for target in targets for part in (wording.TARGETS[target], "skill"))]
    return blocks.table(f"By object, {method.name}: RMSE above that of the object's mean", heads, rows, kinds)


def _of_object(runs: Sequence[Run], target: str, known: bool) -> list[str | Cell]:
    """Return the RMSE on an object, above that of its mean where there is one, and the skill over the constant."""
    found, mean = (scores.score(runs, target, known, one) for one in (MODEL, OBJECT_MEAN))
    if found is None:
        return [NONE, NONE]
    below = wording.percentage(mean.rmse) if mean and known else ""
    return [Cell(wording.percentage(found.rmse), below, found.rmse), blocks.signed(found.skill.mean)]
