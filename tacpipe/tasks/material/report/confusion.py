"""Which materials are taken for which."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tacpipe.arrays import Ints
from tacpipe.comparison.runs import Method
from tacpipe.report import charts
from tacpipe.report.blocks import Chart, Charts, Fold, Note, fold, listed
from tacpipe.report.context import Context
from tacpipe.tasks.material.report import comparison
from tacpipe.tasks.material.report.methods import of, plain, sensors_of, shown
from tacpipe.tasks.material.report.predictions import MODEL, NOTHING

MOST_PAIRS = 3  # pairs of materials in words
NOTE = "Unseen slides. Blue: named right; orange: wrong. The stronger, the larger the fraction of a material's slides."


def folds(context: Context) -> list[Fold]:
    """Return the confusions of the best method and of the joint one, a chart a sensor."""
    drawn = []
    joint = comparison.main(context.methods)
    for sensor in sensors_of([one for one in context.methods if plain(one.settings)]):
        compared = next((one for one in context.comparisons if one.question.part == shown(sensor)), None)
        best = compared.best.method if compared and compared.best else None
        chosen = dict.fromkeys(one for one in (best, joint) if one and of(one, sensor))
        drawn += [_chart(one, sensor) for one in chosen]
    return fold("Which materials are confused", Charts(drawn), Note(NOTE)) if drawn else []


def counted(method: Method, sensor: str) -> tuple[Ints, list[int] | list[str]]:
    """Return how often each material was taken for each, pooled over runs, (material, named), and the materials."""
    import pandas as pd

    tables = []
    for run in of(method, sensor):
        rows = run.details.predictions.of(sensor)
        described = rows.predicted[MODEL] != NOTHING
        truth, named = (rows.named(one[described]) for one in (rows.materials, rows.predicted[MODEL]))
        tables.append(pd.DataFrame({"truth": truth, "named": named}))
    every = pd.concat(tables)
    materials = sorted({*every["truth"], *every["named"]})
    counts = pd.crosstab(every["truth"], every["named"]).reindex(index=materials, columns=materials, fill_value=0)
    return counts.to_numpy(dtype=np.int64), materials


def worst(counts: Ints, materials: Sequence[int | str]) -> str:
    """Return the materials most often taken for another, in words."""
    wrong = counts - np.diag(np.diag(counts))
    order = np.argsort(-wrong, axis=None, kind="stable")[:MOST_PAIRS]
    described = []
    for place in order:
        row, column = np.unravel_index(place, wrong.shape)
        if wrong[row, column]:
            described.append(f"{materials[row]} for {materials[column]} ({wrong[row, column]} of {counts[row].sum()})")
    return f"Most often it takes {listed(described)}." if described else "It takes none for another."


def _chart(method: Method, sensor: str) -> Chart:
    counts, materials = counted(method, sensor)
    runs = len(of(method, sensor))
    label = of(method, sensor)[0].details.predictions.naming.key
    names = [str(one) for one in materials]
    spec = {**charts.matrix(counts, names, label, "named"), "usermeta": {"most": 150 + 30 * len(names)}}
    pooled = f", {runs} runs pooled" if runs > 1 else ""
    caption = f"{counts.trace()} of {counts.sum()} right{pooled}. {worst(counts, materials)}"
    return Chart(f"{shown(sensor)}: {method.name}", spec, caption)
