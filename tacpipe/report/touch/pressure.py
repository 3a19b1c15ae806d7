"""The fluid's pressure: predicted over true, an object a colour."""

from __future__ import annotations

import numpy as np

from tacpipe.report import markup
from tacpipe.report.touch import figures, wording
from tacpipe.report.touch.figures import Scattered
from tacpipe.report.touch.methods import Method
from tacpipe.tasks.touch.result_names import CONSTANT, MODEL

PRESSURES = ("pdc_th", "pdc_mf")
SHOWN = 800  # grasps of a figure


def section(method: Method) -> str:
    """Return a figure a finger, of the first run; empty where the method predicts no pressure."""
    drawn = [_figure(method, target) for target in PRESSURES if target in method.runs[0].predictions.targets]
    return f'<div class="pair">{"".join(drawn)}</div>' if drawn else ""


def _figure(method: Method, target: str) -> str:
    rows = method.runs[0].predictions
    total = len(rows.recordings)
    if not total:
        return ""
    rows = rows.rows(np.unique(np.linspace(0, total - 1, SHOWN).astype(int)))
    parts = sorted({(not known, str(name)) for known, name in zip(rows.known, rows.objects, strict=True)})
    objects = []
    for novel, name in parts:
        held = rows.rows((rows.objects == name) & (rows.known != novel))
        objects.append(Scattered(name, novel, held.true[target][:, 0], held.predicted[MODEL][target][:, 0]))
    constant = rows.predicted.get(CONSTANT, {}).get(target)
    level = float("nan") if constant is None else float(constant[0, 0])
    name = wording.TARGETS[target]
    svg = figures.scatter(objects, level, "(counts)", f"Predicted over true {name}")
    some = f"{len(rows.recordings):,} of {total:,}" if len(rows.recordings) < total else f"{total:,}"
    return markup.figure(svg, f"{name}, {method.name}: {some} unseen grasps of its first run. Line: predicted as true.")
