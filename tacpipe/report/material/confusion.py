"""Which materials are taken for which."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tacpipe.arrays import Ints
from tacpipe.report import charts
from tacpipe.report.blocks import Chart, Charts, Fold, Note, fold, listed
from tacpipe.report.material import comparison, tables
from tacpipe.report.material.methods import Method, shown
from tacpipe.report.material.predictions import MODEL, NOTHING

MOST_PAIRS = 3  # pairs of materials in words
NOTE = "Unseen slides. Blue: named right; orange: wrong. The stronger, the larger the fraction of a material's slides."


def folds(methods: Sequence[Method]) -> list[Fold]:
    """Return the confusions of the best method and of the joint one, a chart a sensor."""
    drawn = []
    for sensor in tables.sensors_of(methods):
        best = tables.leader(methods, sensor)
        joint = comparison.main(methods)
        chosen = [best, *([joint] if joint is not best and joint and joint.of(sensor) else [])]
        drawn += [_chart(one, sensor) for one in chosen if one]
    return fold("Which materials are confused", Charts(drawn), Note(NOTE)) if drawn else []


def counted(method: Method, sensor: str) -> tuple[Ints, list[int] | list[str]]:
    """Return how often each material was taken for each, pooled over runs, (material, named), and the materials."""
    truth, predicted = [], []
    for run in method.of(sensor):
        rows = run.predictions.of(sensor)
        described = rows.predicted[MODEL] != NOTHING
        truth.append(rows.named(rows.materials[described]))
        predicted.append(rows.named(rows.predicted[MODEL][described]))
    materials, codes = np.unique(np.concatenate([*truth, *predicted]), return_inverse=True)
    pairs = codes.reshape(2, -1)
    counts = np.zeros((len(materials), len(materials)), dtype=np.int64)
    np.add.at(counts, (pairs[0], pairs[1]), 1)
    return counts, materials.tolist()


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
    runs = len(method.of(sensor))
    label = method.of(sensor)[0].predictions.naming.key
    names = [str(one) for one in materials]
    spec = {**charts.matrix(counts, names, label, "named"), "usermeta": {"most": 150 + 30 * len(names)}}
    pooled = f", {runs} runs pooled" if runs > 1 else ""
    caption = f"{counts.trace()} of {counts.sum()} right{pooled}. {worst(counts, materials)}"
    return Chart(f"{shown(sensor)}: {method.name}", spec, caption)
