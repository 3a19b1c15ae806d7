"""What is drawn over epochs and over the number of training slides: Figures 9 and 10 of the paper, and few slides."""

from __future__ import annotations

import functools
from collections.abc import Sequence

from tacpipe.comparison.runs import Method
from tacpipe.report import blocks, charts, learning
from tacpipe.report.blocks import Chart, Charts, Fold
from tacpipe.report.charts import Line
from tacpipe.report.learning import stated
from tacpipe.tasks.material.report import comparison
from tacpipe.tasks.material.report.accuracy import accuracy
from tacpipe.tasks.material.report.methods import Result, line, of, plain, sensors_of, shown

Points = dict[int, tuple[float, float, float]]  # accuracy and its bounds, by number of training slides


def training(methods: Sequence[Method]) -> list[Fold]:
    """Return validation accuracy and latent difference by epoch."""
    drawn = [*convergence(methods), *alignment(methods)]
    return blocks.fold("Training", Charts(drawn)) if drawn else []


def convergence(methods: Sequence[Method]) -> list[Chart]:
    """Return validation accuracy by epoch, Figure 9 of the paper, one chart a sensor; none without epochs."""
    networks = [one for one in methods if plain(one.settings)]
    chosen = [one for family in ("RAEC joint", "RAEC independent") for one in networks if one.family == family]
    order = [one.name for one in chosen]
    drawn = []
    for sensor in sensors_of(chosen):
        held = learning.of_methods(chosen, functools.partial(_validation, sensor=sensor))
        if held:
            spec = learning.by_epoch(held, "validation accuracy (%)", order)
            title = blocks.form(
                "Figure 9", f"validation accuracy on {shown(sensor)}", all(one.published for one in chosen)
            )
            drawn.append(Chart(title, spec, "Thick: mean over runs; thin: single runs."))
    return drawn


def alignment(methods: Sequence[Method]) -> list[Chart]:
    """Return Figure 10 in the paper's form: how far the sensors' latents of a pair are apart; none where none is given."""
    chosen = [one for one in methods if (plain(one.settings) or comparison.control(one)) and one.settings["joint"]]
    held = learning.of_methods(chosen, aligned)
    if not held:
        return []
    spec = learning.by_epoch(held, "mean squared latent difference", log=True)
    title = blocks.form("Figure 10", "latent difference of training pairs", all(one.published for one in chosen))
    caption = ""
    if any(comparison.control(one) for one in chosen):
        caption = "Pairs of permuted materials fall as real ones do where labels alone drive the alignment."
    return [Chart(title, spec, caption)]


def aligned(run: Result) -> list[float]:
    """Return the mean squared latent difference of training pairs by epoch; NaN where an epoch does not state it."""
    return stated([one.get("alignment") for one in run.history])


def few_slides(methods: Sequence[Method]) -> list[Fold]:
    """Return accuracy over the number of training slides, a chart a sensor; none where all have as many."""
    chosen = [one for one in methods if plain(one.settings, "few", "subsample_sensor")]
    drawn = []
    for sensor in sensors_of(chosen):
        points: dict[str, Points] = {}
        for method in chosen:
            fewer = {method.settings["subsample_sensor"], method.settings["few_of"]} - {""}
            if fewer <= {sensor}:
                _add(points, line(method), method, sensor)
            if fewer == {sensor}:  # such a line ends where all sensors have all slides
                loose = ("few", "few_of", "subsample_sensor", "subsample_percent")
                for one in chosen:
                    if plain(one.settings) and one.key_without(*loose) == method.key_without(*loose):
                        _add(points, line(method), one, sensor)
        held = {name: one for name, one in sorted(points.items()) if len(one) > 1}
        if held:
            several = []
            for name, found in held.items():
                slides = sorted(found)
                mean, low, high = (
                    [100 * value for value in part] for part in zip(*(found[at] for at in slides), strict=True)
                )
                several.append(Line(name, slides, mean, low, high))
            chance = 100 / max(len(chosen[0].details[0].config.get("classes", ())), 1)
            spec = charts.lines(several, "training slides", "accuracy (%)", level=("chance", chance))
            caption = "Unseen slides, with 95 % intervals; dashed across: chance."
            if any("other sensor whole" in name for name in held):
                caption += " Other sensor whole: this one alone has fewer."
            if any("fixed batches" in name for name in held):
                caption += " Fixed batches: the same in every epoch, of which a sensor learns from a share."
            drawn.append(Chart(f"Accuracy on {shown(sensor)} by number of training slides", spec, caption))
    return blocks.fold("Few slides", Charts(drawn)) if drawn else []


def _add(points: dict[str, Points], name: str, method: Method, sensor: str) -> None:
    """Add what a method states to a line."""
    found = accuracy(of(method, sensor), sensor)
    if found is None:
        return
    described = [run.details.learned[sensor] for run in of(method, sensor) if sensor in run.details.learned]
    if described:
        points.setdefault(name, {})[max(described)] = (found.fraction, found.low, found.high)


def _validation(run: Result, sensor: str) -> list[float]:
    """Return the validation accuracy on a sensor's slides by epoch, in percent; empty where none is given."""
    found = [one.get("val", {}).get(sensor, {}).get("accuracy") for one in run.history]
    return [100 * value for value in stated(found)]
