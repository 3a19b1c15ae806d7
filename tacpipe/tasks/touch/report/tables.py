"""The tables in which methods and baselines are next to each other, of one way to part grasps."""

from __future__ import annotations

from collections.abc import Sequence

from tacpipe.comparison.runs import Method
from tacpipe.report import blocks
from tacpipe.report.blocks import NONE, Cell, Table
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.report import scores, wording
from tacpipe.tasks.touch.report.methods import main, targets
from tacpipe.tasks.touch.report.predictions import Predictions
from tacpipe.tasks.touch.report.scores import Score
from tacpipe.tasks.touch.result_names import MODEL, OBJECT_MEAN

ROWS = ("RMSE over runs", "counts", "R²", "skill", "grasps", "runs")  # of a table in the paper's form


def by_object(methods: Sequence[Method]) -> list[Table]:
    """Return errors and skill by object of one method an architecture; none where no object was evaluated."""
    return [found for method in main(methods) if (found := _by_object(method))]


def cells(found: Score | None) -> list[str | Cell]:
    """Return what a table in the paper's form states of a score, as `ROWS` names it."""
    if found is None:
        return [NONE] * len(ROWS)
    error = blocks.with_sd(found.each.mean, found.each.sd)
    counts = f"{scores.in_counts(found.target, found.each.mean):.0f}"
    return [
        error,
        counts,
        blocks.fixed(found.r2, 2),
        blocks.interval(*found.skill),
        f"{found.grasps:,}",
        str(found.runs),
    ]


def baseline_rows(methods: Sequence[Method], target: str, known: bool | None) -> list[tuple[str, Score | None]]:
    """Return the mandatory baselines and any others that some methods' results hold, by what a table calls them."""
    held = {one.name: predictions(one) for one in methods}
    others = {name for runs in held.values() for one in runs for name in one.predicted if name != MODEL}
    found = []
    for predictor in dict.fromkeys([*wording.BASELINES, *sorted(others)]):
        holding = [runs for runs in held.values() if any(target in one.predicted.get(predictor, ()) for one in runs)]
        most = max(holding, key=len, default=[])  # of the runs of one method, because a split has the same for all
        found.append((wording.baseline(predictor), scores.score(most, target, known, predictor)))
    return found


def predictions(method: Method) -> list[Predictions]:
    """Return what the runs of a method predicted."""
    return [one.predictions for one in method.details]


def _by_object(method: Method) -> Table | None:
    predicted, runs = targets(method), predictions(method)
    rows: list[list[str | Cell]] = []
    kinds: dict[int, str] = {}
    for known in (True, False):
        names = {str(name) for one in runs for name in one.of(known).objects}
        for name in sorted(names):
            own = [one.rows(one.objects == name) for one in runs]
            row = [cell for target in predicted for cell in _of_object(own, target, known)]
            counted = len({str(recording) for one in own for recording in one.of(known).recordings})
            if not known:
                kinds[len(rows)] = "quiet"
            rows.append([name if known else f"{name} (novel)", f"{counted:,}", *row])
    if not rows:
        return None
    heads = ["", "grasps", *(part for target in predicted for part in (headlines.TARGETS[target], "skill"))]
    return blocks.table(f"By object, {method.name}: RMSE above that of the object's mean", heads, rows, kinds)


def _of_object(runs: Sequence[Predictions], target: str, known: bool) -> list[str | Cell]:
    """Return the RMSE on an object, above that of its mean where there is one, and the skill over the constant."""
    found, mean = (scores.score(runs, target, known, one) for one in (MODEL, OBJECT_MEAN))
    if found is None:
        return [NONE, NONE]
    below = blocks.fixed(mean.rmse, 4) if mean and known else ""
    return [Cell(blocks.fixed(found.rmse, 4), below, found.rmse), blocks.signed(found.skill.mean)]
