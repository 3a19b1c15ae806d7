"""What changes over the epochs of training, as lines of a chart: a thin one a run, a thick one their mean."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.report import charts
from tacpipe.report.charts import Line

if TYPE_CHECKING:
    from tacpipe.comparison.runs import Method
    from tacpipe.report.charts import Spec


def by_epoch(
    runs: Mapping[str, Sequence[Sequence[float]]], quantity: str, order: Sequence[str] = (), *, log: bool = False
) -> Spec:
    """Return a thin line a run, one value an epoch, and the mean over the runs of each name.

    The mean ends where the first of its runs does. NaN breaks a line.
    """
    several = []
    for name, curves in runs.items():
        if len(curves) > 1:
            several += [Line(name, range(1, len(curve) + 1), curve, thin=True) for curve in curves]
        length = min(map(len, curves))
        mean = np.mean([curve[:length] for curve in curves], axis=0)
        several.append(Line(name, range(1, length + 1), mean))
    single = all(len(curve) < 2 for curves in runs.values() for curve in curves)  # of which no line can be seen
    return charts.lines(several, "epoch", quantity, order=order, log=log, points=single)


def stated(values: Sequence[float | None]) -> list[float]:
    """Return one value an epoch, NaN where an epoch states none; empty where no epoch states any.

    >>> stated([None, 1]), stated([None, None])
    ([nan, 1.0], [])
    """
    return [] if all(one is None for one in values) else [math.nan if one is None else float(one) for one in values]


def of_methods(methods: Sequence[Method], read: Callable[[Any], list[float]]) -> dict[str, list[list[float]]]:
    """Return the curves that ``read`` gives of the results of each method, by its name; methods without any left out."""
    found = {method.name: [curve for one in method.details if (curve := read(one))] for method in methods}
    return {name: curves for name, curves in found.items() if curves}
