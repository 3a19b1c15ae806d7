"""How numbers and names of this task are written, and what must be stated next to an error."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from tacpipe.comparison.runs import Method
from tacpipe.report import blocks, provenance
from tacpipe.tasks.touch.report import printed
from tacpipe.tasks.touch.report.methods import PAPERS, Result
from tacpipe.tasks.touch.result_names import CONSTANT, NEAREST_IN_TIME, OBJECT_MEAN

FINGERS = {"e_th": "thumb", "e_mf": "middle finger"}
BASELINES = {  # rows that every table has
    CONSTANT: "constant: the mean of training",
    OBJECT_MEAN: "mean of the object",
    NEAREST_IN_TIME: "mean of the nearest in time",
}
RECORDED = (
    "{same} of {all} evaluated grasps follow one of the same object in time, so errors on known objects rest on when they "
    "were recorded as well: the mean of the grasps nearest in time, whatever their object, states how much."
)
IN_A_ROW = 0.75  # of successive grasps: from here on, objects were not taken by turns


def caution(methods: Sequence[Method]) -> str:
    """Return what these grasps cannot show, next to every table of errors; empty where nothing is known against them."""
    if methods and all(one.simulated for one in methods):
        return provenance.SIMULATED
    found = [run.predictions.in_a_row for one in methods if not one.simulated for run in one.details]
    same, every = (sum(column) for column in zip(*found, strict=True)) if found else (0, 0)
    return RECORDED.format(same=f"{same:,}", all=f"{every:,}") if every and same / every >= IN_A_ROW else ""


def baseline(predictor: str) -> str:
    """Return what a table calls a predictor that is not a model's own.

    >>> baseline("object_mean"), baseline("nearest_neighbours")
    ('mean of the object', 'nearest neighbours')
    """
    return BASELINES.get(predictor, predictor.replace("_", " "))


def signed_short(value: float) -> str:
    """Return R² where there is little room.

    >>> [signed_short(value) for value in (0.456, -0.02, -3.04, -1234.5)]
    ['0.46', '−0.02', '−3.0', '< −9']
    """
    if value >= -1 or math.isnan(value):
        return blocks.fixed(value, 2)
    return f"−{-value:.1f}" if value > -9 else "< −9"


def split(described: str) -> str:
    """Return how grasps were parted, where somebody stated so."""
    return described.replace("-", " ").replace("_", " ") or "one split"


def place(described: str, simulated: bool) -> str:
    """Return how grasps were parted and whether they were simulated.

    >>> place("by-day", True), place("simulated", True), place("", False)
    ('by day, simulated', 'simulated', 'one split')
    """
    name = split(described)
    return f"{name}, simulated" if simulated and "simulated" not in name else name


def schedule(run: Result) -> str:
    """Return how a run was trained, and whether that is the paper's way."""
    if not run.history:
        return "fitted without epochs"
    params = run.params
    epochs, batch, rate = (params.get(name) for name in ("epochs", "batch", "learning_rate"))
    described = f"{epochs} epochs in batches of {batch}, learning rate {rate}"
    if run.architecture != PAPERS or not run.published:
        return described
    if (batch, rate) == (printed.BATCH, printed.LEARNING_RATE) and int(epochs or 0) >= printed.EPOCHS:
        return f"paper schedule ({described})"
    return f"quick ({described}; the paper: {printed.EPOCHS}, {printed.BATCH}, {printed.LEARNING_RATE})"


def basis(methods: Sequence[Method]) -> str:
    """Return with which preset the runs of a table were trained, how many there are, and on how many grasps."""
    runs = [run for one in methods for run in one.details]
    described = [
        f"{count} run{'s' if count > 1 else ''}: {one}"
        for one, count in Counter(schedule(run) for run in runs).most_common()
    ]
    trained = sorted({run.trained for run in runs if run.trained is not None})
    counts = f" Trained on {span(trained)} grasps." if trained else ""
    return f"{'; '.join(described)}.{counts}"


def span(counts: Sequence[int]) -> str:
    """Return the least and the largest of sorted counts.

    >>> span([412, 9000]), span([7])
    ('412 to 9,000', '7')
    """
    return " to ".join(f"{count:,}" for count in dict.fromkeys((counts[0], counts[-1])))
