"""Which materials are taken for which."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tacpipe.arrays import Ints
from tacpipe.report import markup
from tacpipe.report.markup import listed
from tacpipe.report.material import comparison, figures, tables
from tacpipe.report.material.methods import Method, shown
from tacpipe.report.material.predictions import MODEL, NOTHING

MOST_PAIRS = 3  # pairs of materials in words
NOTE = "Blue: named right; orange: wrong, with how often. The stronger, the larger the fraction of a material's slides."


def section(methods: Sequence[Method]) -> str:
    """Return the confusions of the best method and of the joint one, a figure a sensor."""
    drawn = []
    for sensor in tables.sensors_of(methods):
        best = tables.leader(methods, sensor)
        joint = comparison.main(methods)
        chosen = [best, *([joint] if joint is not best and joint and joint.of(sensor) else [])]
        drawn += [_figure(one, sensor) for one in chosen if one]
    if not drawn:
        return ""
    return f'<h3>Which materials are confused</h3><div class="pair">{"".join(drawn)}</div>{markup.note(NOTE)}'


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


def _figure(method: Method, sensor: str) -> str:
    counts, materials = counted(method, sensor)
    runs = len(method.of(sensor))
    label = method.of(sensor)[0].predictions.naming.key
    svg = figures.confusion(counts, materials, f"Materials and what they were taken for, {shown(sensor)}", label)
    caption = (
        f"{shown(sensor)}, {method.name}: {counts.trace()} of {counts.sum()} right on unseen slides"
        f"{f', {runs} runs pooled' if runs > 1 else ''}. {worst(counts, materials)}"
    )
    return markup.figure(svg, caption)
