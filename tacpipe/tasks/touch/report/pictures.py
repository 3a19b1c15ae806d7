"""Draw predicted against measured touch, and list errors by object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tacpipe.comparison.engine import Comparison, ComparisonRow
from tacpipe.report import charts
from tacpipe.report.blocks import NONE, Cell, Chart, Charts, Fold, fold, interval, number, table
from tacpipe.report.context import Context
from tacpipe.scores import pairing, regression
from tacpipe.scores.pairing import Sums
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.headline import CONSTANT, MODEL, OBJECT_MEAN

POINTS = 800  # maximum number of points in a chart


def target_of(comparison: Comparison) -> str:
    """Return the name of the target of a comparison, such as ``pdc_th``."""
    return next(name for name, title in headlines.TARGETS.items() if title == comparison.question.target)


def is_known(comparison: Comparison) -> bool:
    """Return whether a comparison is on grasps of known objects."""
    return comparison.question.part.startswith(headlines.PARTS[True])


def r2_of(comparison: Comparison, row: ComparisonRow) -> float:
    """Return R² of a predictor over the grasps of all runs, relative to their mean; NaN without predictions."""
    target, pairs = target_of(comparison), []
    for run in row.method.of(comparison.question):
        rows = run.details.predictions.rows(run.details.predictions.known == is_known(comparison))
        if target in rows.predicted.get(row.predictor, {}):
            pairs.append((rows.true[target], rows.predicted[row.predictor][target]))
    return regression.r2(*map(np.concatenate, zip(*pairs, strict=True))) if pairs else float("nan")


def scatter_folds(context: Context) -> list[Fold]:
    """Return a chart per target of predicted against measured values, for the first run of the best method."""
    method = context.winner(next(iter(context.parts))) if context.parts else None
    if method is None:
        return []
    rows = method.details[0].predictions
    drawn = []
    for target in rows.targets:
        grasps, values = np.indices(rows.true[target].shape)
        chosen = np.unique(np.linspace(0, grasps.size - 1, POINTS).astype(int))
        dots: list[charts.DataRow] = [
            {
                "name": str(rows.objects[grasp]),
                "shape": headlines.PARTS[bool(rows.known[grasp])],
                "tip": str(rows.recordings[grasp]),
                "x": float(rows.true[target][grasp, value]),
                "y": float(rows.predicted[MODEL][target][grasp, value]),
            }
            for grasp, value in zip(grasps.ravel()[chosen], values.ravel()[chosen], strict=True)
        ]
        shapes = list(dict.fromkeys(str(dot["shape"]) for dot in dots))
        shapes = shapes if len(shapes) > 1 else []
        spec = charts.scatter(dots, "measured (counts)", "predicted (counts)", diagonal=True, shapes=shapes)
        caption = f"{len(dots):,} of {grasps.size:,} values of unseen grasps of the first run. Line: equal values."
        drawn.append(Chart(headlines.TARGETS[target], spec, caption))
    return fold("Predicted and measured", Charts(drawn), about=method.name)


def object_folds(context: Context) -> list[Fold]:
    """Return a table per question of the best method's RMSE by object, next to the means of objects and of training."""
    tables = [
        table(f"{comparison.question.where}: {comparison.best.name}", HEADS, _object_rows(comparison, comparison.best))
        for comparison in context.comparisons
        if comparison.best
    ]
    return fold("By object", *tables)


HEADS = ("", "grasps", "RMSE (fraction of the range)", "mean of the object", "constant", "skill over the constant")


def _object_rows(comparison: Comparison, row: ComparisonRow) -> list[Sequence[str | Cell]]:
    """Return the cells of each object; skill has an interval over its grasps."""
    measure, question = comparison.measure, comparison.question
    objects: dict[str, str] = {}
    for run in row.method.of(question):
        predictions = run.details.predictions
        objects |= dict(zip(predictions.recordings.tolist(), predictions.objects.tolist(), strict=True))
    sums_by_predictor = {name: row.method.sums(question, name) for name in (MODEL, OBJECT_MEAN, CONSTANT)}

    def sums_of(predictor: str, name: str) -> Sums:
        return {key: sums for key, sums in sums_by_predictor[predictor].items() if objects[key[1]] == name}

    def rmse(sums: Sums) -> Cell:
        return number(measure.values(np.sum(list(sums.values()), axis=0))[0]) if sums else Cell(NONE)

    rows: list[Sequence[str | Cell]] = []
    for name in sorted({objects[recording] for _, recording in sums_by_predictor[MODEL]}):
        model, mean, constant = (sums_of(predictor, name) for predictor in (MODEL, OBJECT_MEAN, CONSTANT))
        gain = pairing.difference(measure, model, constant)
        count = len({recording for _, recording in model})
        skill = interval(gain.mean, gain.low, gain.high)
        rows.append([name, Cell(f"{count:,}", value=count), rmse(model), rmse(mean), rmse(constant), skill])
    return rows
