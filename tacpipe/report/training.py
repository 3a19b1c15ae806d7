"""Draw the loss of a training by epoch."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tacpipe.comparison.runs import ComparedRun
from tacpipe.report import charts
from tacpipe.report.blocks import Chart, Fold, fold
from tacpipe.report.charts import Curve
from tacpipe.report.context import Context, median_run
from tacpipe.training.following import HISTORY, Line, read_history

LOSSES = {"training": "train_loss", "validation": "val_loss"}


def training_folds(context: Context) -> list[Fold]:
    """Return a chart of the losses of the best method that was trained in epochs; empty if there is no such method."""
    for comparison in context.comparisons[:1]:
        for row in comparison.models:
            history = history_of(median_run(row.method, comparison))
            if history:
                return fold("Training", _loss_chart(row.name, history))
    return []


def history_of(run: ComparedRun) -> list[Line]:
    """Return the lines of a run's history file; empty if it was not trained in epochs."""
    return read_history(run.dataset.files.get(HISTORY, b""))


def losses_by_epoch(history: Sequence[Line], name: str) -> list[float]:
    """Return a loss by epoch, averaged over the networks that were trained; NaN for epochs without it.

    It ends with the shortest training. Empty if no epoch has the loss.
    """
    networks: dict[tuple[object, object], list[float]] = {}
    for line in history:
        loss = line.get(name)
        network = networks.setdefault((line.get("target"), line.get("network")), [])
        network.append(math.nan if loss is None else float(loss))  # type: ignore[arg-type]
    means = [sum(losses) / len(losses) for losses in zip(*networks.values(), strict=False)]
    return means if any(not math.isnan(mean) for mean in means) else []


def _loss_chart(method: str, history: Sequence[Line]) -> Chart:
    """Return a chart of training and validation loss by epoch; a single epoch is drawn as points."""
    losses = {label: values for label, name in LOSSES.items() if (values := losses_by_epoch(history, name))}
    curves = [Curve(label, range(1, len(values) + 1), values) for label, values in losses.items()]
    is_positive = all(math.isnan(value) or value > 0 for values in losses.values() for value in values)
    epochs = max(map(len, losses.values()), default=0)
    unit = "loss (own unit, logarithmic)" if is_positive else "loss (own unit)"
    spec = charts.lines(curves, "epoch", unit, log=is_positive, points=epochs < 2)
    return Chart(
        f"Loss by epoch: {method}", spec, "The run of median score; the mean over its networks if it has several."
    )
