"""The fluid's pressure: predicted over true, an object a colour."""

from __future__ import annotations

import numpy as np

from tacpipe.comparison.runs import Method
from tacpipe.report import charts
from tacpipe.report.blocks import Chart, Charts, Fold, fold
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.result_names import CONSTANT, MODEL

PRESSURES = ("pdc_th", "pdc_mf")
SHOWN = 800  # grasps of a figure


def folds(method: Method) -> list[Fold]:
    """Return a chart a finger, of the first run; nothing where the method predicts no pressure."""
    rows = method.details[0].predictions
    drawn = [_chart(method, target) for target in PRESSURES if target in rows.targets and len(rows.recordings)]
    return fold("The pressure, predicted and true", Charts(drawn), about=method.name) if drawn else []


def _chart(method: Method, target: str) -> Chart:
    rows = method.details[0].predictions
    total = len(rows.recordings)
    rows = rows.rows(np.unique(np.linspace(0, total - 1, SHOWN).astype(int)))
    values = rows.true[target][:, 0], rows.predicted[MODEL][target][:, 0]
    dots = [
        {"name": f"{name}{'' if known else ' (novel)'}", "tip": str(recording), "x": float(true), "y": float(predicted)}
        for recording, name, known, true, predicted in zip(
            rows.recordings, rows.objects, rows.known, *values, strict=True
        )
    ]
    constant = rows.predicted.get(CONSTANT, {}).get(target)
    level = None if constant is None else ("constant", float(constant[0, 0]))
    name = headlines.TARGETS[target]
    spec = charts.scatter(dots, "true (counts)", "predicted (counts)", diagonal=True, level=level)
    some = f"{len(rows.recordings):,} of {total:,}" if len(rows.recordings) < total else f"{total:,}"
    return Chart(name, spec, f"{some} unseen grasps of the first run. Line: predicted as true; dashed: the constant.")
