"""Losses over the epochs of training, among them Figure 8 of the paper."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

from tacpipe.channels import biotac_sp
from tacpipe.comparison.runs import Method
from tacpipe.report import blocks, learning
from tacpipe.report.blocks import Chart
from tacpipe.tasks.touch import headline as headlines
from tacpipe.tasks.touch.report import forms, wording
from tacpipe.tasks.touch.report.methods import PAPERS, Result, main

ALL = "all"  # stands where one network predicts all targets
UNWATCHED = (
    " Where no grasps were kept for validation, it is the loss on those of training, evaluated after each epoch."
)


def charts_of(methods: Sequence[Method]) -> list[Chart]:
    """Return validation losses of one method an architecture, a chart a target; none without epochs."""
    drawn, shown = [], main(methods)
    for target in (*biotac_sp.TARGETS, ALL):
        curves = learning.of_methods(shown, functools.partial(losses, target=target, name="val_loss"))
        if curves:
            name = headlines.TARGETS.get(target, "one network for all targets")
            spec = learning.by_epoch(curves, "validation loss", log=True)
            caption = "Each method's own loss. Thick: mean over runs; thin: single runs."
            drawn.append(Chart(f"Validation loss by epoch, {name}", spec, f"{caption}{_unwatched(shown)}"))
    return drawn


def figure_8(methods: Sequence[Method]) -> list[Chart]:
    """Return Figure 8 in the paper's form: both losses of its network, of most epochs; none where it was not run."""
    found = [
        (method, target)
        for method in methods
        for target in (forms.TARGET, ALL)
        if method.settings["architecture"] == PAPERS and _curves(method, target, "train_loss")
    ]
    if not found:
        return []
    method, target = max(found, key=lambda one: (len(_curves(one[0], one[1], "train_loss")[0]), len(one[0].runs)))
    named = {"training": "train_loss", "validation": "val_loss"}
    curves = {name: described for name, loss in named.items() if (described := _curves(method, target, loss))}
    quantity = "loss (RMSE, fraction of the range)" if method.settings.get("loss", "rmse") == "rmse" else "loss"
    text = f"training and validation loss by epoch, {method.name}, {headlines.TARGETS.get(target, 'all targets')}"
    printed = " The paper's figure has 1,000 epochs." if method.published else ""
    caption = f"{wording.basis([method])}{printed}{_unwatched([method])}{' Simulated.' if method.simulated else ''}"
    return [
        Chart(blocks.form("Figure 8", text, method.published), learning.by_epoch(curves, quantity, log=True), caption)
    ]


def losses(result: Result, target: str, name: str) -> list[float]:
    """Return a loss of the network of one target by epoch, or the mean of several networks; empty where none states it.

    The mean ends where the first network does. NaN stands where an epoch does not state the loss.
    """
    networks: dict[object, list[float]] = {}
    for line in result.history:
        if line.get("target", ALL) == target:
            described = line.get(name)
            networks.setdefault(line.get("network"), []).append(float("nan") if described is None else float(described))
    length = min(map(len, networks.values()), default=0)
    mean = [sum(values) / len(values) for values in zip(*(one[:length] for one in networks.values()), strict=True)]
    return mean if any(not math.isnan(value) for value in mean) else []


def _curves(method: Method, target: str, name: str) -> list[list[float]]:
    return [curve for one in method.details if (curve := losses(one, target, name))]


def _unwatched(methods: Sequence[Method]) -> str:
    """Return what must be stated where some runs had no validation grasps."""
    runs = [run for one in methods for run in one.details if run.history]
    return UNWATCHED if any(run.config.get("counts", {}).get("val") == 0 for run in runs) else ""
