"""Draw confusions, and report calibrated probabilities, the answer ``unknown`` and materials held out of the labels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from tacpipe.arrays import Ints
from tacpipe.printable import format_count
from tacpipe.report import charts
from tacpipe.report.blocks import NONE, Cell, Chart, Charts, Fold, estimate, fixed, fold, notes, number, table
from tacpipe.report.charts import Curve
from tacpipe.report.context import Context, median_run
from tacpipe.scores.intervals import wilson
from tacpipe.tasks.material.headline import HeldOutAccuracy, ProbabilityMeasures, sensor_title
from tacpipe.tasks.material.params import KEY
from tacpipe.tasks.material.predictions import MODEL
from tacpipe.tasks.material.report.methods import Method, question_on, runs_on, sensors_of


def confusion_folds(context: Context) -> list[Fold]:
    """Return a confusion matrix of the best method per sensor."""
    figures = []
    for sensor in sensors_of(context.methods):
        parts = [comparison for comparison in context.comparisons if comparison.question.part == sensor_title(sensor)]
        figures += [_confusion_chart(part.best.method, sensor) for part in parts if part.best]
    return fold("Which materials are confused", Charts(figures)) if figures else []


def count_confusions(method: Method, sensor: str) -> tuple[Ints, list[int] | list[str]]:
    """Return the confusion counts (material, predicted), pooled over runs, and the names of the materials."""
    slides = pd.concat([run.details.predictions for run in runs_on(method, sensor)])
    slides = slides[(slides["sensor"] == sensor) & slides[MODEL].notna()]
    materials = sorted({*slides["material"], *slides[MODEL]})
    counts = pd.crosstab(slides["material"], slides[MODEL]).reindex(index=materials, columns=materials, fill_value=0)
    return counts.to_numpy(dtype=np.int64), materials


def _confusion_chart(method: Method, sensor: str) -> Chart:
    """Return the confusion matrix of a method on a sensor's slides."""
    counts, materials = count_confusions(method, sensor)
    rows = f"answers on unseen slides of {format_count(len(runs_on(method, sensor)), 'runs')}"
    label = method.details[0].config.get("label", KEY)
    return charts.confusions(f"{sensor_title(sensor)}: {method.name}", counts, list(map(str, materials)), label, rows)


ZERO_SHOT_NOTE = (
    "The labels and pairs of these materials were excluded from training for this sensor. The classifier of the "
    "other sensor predicts them from the latents, among all materials or only among the held-out ones. Only an "
    "accuracy above chance is evidence of information that the sensors have in common. Slides of one material "
    "are not independent, so the interval is over held-out materials, not over slides or runs. "
)


def zero_shot_folds(methods: Sequence[Method]) -> list[Fold]:
    """Return a table of accuracies on materials that a sensor's labels did not include; empty if none were held out."""
    rows: list[list[str | Cell]] = []
    for method in methods:
        measured = [run.metrics["zero_shot"] for run in method.details if "zero_shot" in run.metrics]
        among = [accuracies["among_held_out"] for accuracies in measured if "among_held_out" in accuracies]
        for name, results in (("out of all", measured), ("out of those held out", among)):
            for sensor in dict.fromkeys(sensor for result in results for sensor in result["accuracy"]):
                held_out = str(method.settings["hold_out"])
                rows.append(
                    [
                        f"{method.name}, {name}",
                        sensor_title(sensor),
                        *_zero_shot_cells(results, sensor, count_held_out(held_out, sensor)),
                        str(len(results)),
                    ]
                )
    heads = ["", "slides of", "accuracy (%)", "chance (%)", "runs"]
    return (
        fold("Materials that one sensor was not trained on", table("", heads, rows), notes(ZERO_SHOT_NOTE))
        if rows
        else []
    )


def count_held_out(setting: str, sensor: str) -> int:
    """Return the number of materials that a setting such as ``roboskin=17,18`` holds out of a sensor's labels.

    >>> count_held_out("biotac=1; roboskin=17,18", "roboskin")
    2
    """
    parts = (part.strip().partition("=") for part in setting.split(";"))
    return max(sum(len(materials.split(",")) for name, _, materials in parts if name == sensor), 1)


def _zero_shot_cells(results: Sequence[HeldOutAccuracy], sensor: str, materials: int) -> list[str | Cell]:
    """Return the accuracy on held-out materials of one sensor with its interval over ``materials``, and chance."""
    correct, evaluated = (sum(result[part].get(sensor, 0) for result in results) for part in ("correct", "n"))
    if not evaluated:
        return [NONE, NONE]
    fraction = correct / evaluated
    chance = float(np.mean([result["chance"][sensor] for result in results]))
    return [
        estimate((fraction, *wilson(round(fraction * materials), materials)), 1, f"{correct}/{evaluated}", 100),
        fixed(100 * chance, 1),
    ]


RELIABLE = (
    "Accuracy against stated probability; on the thin line, probabilities equal frequencies. Band: 95 % interval "
    "(Wilson) over slides. False unknown: slides of known materials classified as unknown, over slides. False known: "
    "slides of left-out materials assigned to a class, over materials. Right: accuracy among the assigned slides of known "
    "materials. All are of the run of median score, with 95 % intervals; the lines below are before calibration."
)
PROBABILITY_HEADS = ("", "calibration error", "log loss", "false unknown (%)", "false known (%)", "AUROC", "right (%)")


def probability_folds(context: Context) -> list[Fold]:
    """Return the reliability of calibrated probabilities and the rates of the answer unknown; empty if there are none."""
    drawn: list[Chart] = []
    rows: list[list[str | Cell]] = []
    for comparison in context.comparisons:
        for method in (method for method in context.methods if method.of(comparison.question)):
            run = median_run(method, comparison)
            sensor = next(sensor for sensor in run.details.sensors if question_on(run, sensor) == comparison.question)
            probabilities = run.details.metrics.get("calibration", {}).get(sensor)
            if probabilities:
                name = f"{comparison.question.where}: {method.name}"
                drawn.append(_reliability_chart(name, probabilities))
                answers = run.details.metrics.get("unknown", {}).get(sensor, {})
                rows.append([name, *_probability_cells(probabilities, answers)])
    if not rows:
        return []
    return fold("Uncertainty", Charts(drawn), table("", PROBABILITY_HEADS, rows), notes(RELIABLE))


def _reliability_chart(title: str, probabilities: ProbabilityMeasures) -> Chart:
    """Return a chart of accuracy by stated probability, before and after calibration."""
    curves = []
    for name, measures in (("calibrated", probabilities["after"]), ("as trained", probabilities["before"])):
        bins = measures["reliability"]
        ends = np.array([wilson(round(part["accuracy"] * part["n"]), part["n"]) for part in bins]).reshape(-1, 2)
        stated, right = ([part[key] for part in bins] for key in ("confidence", "accuracy"))
        bounds = (ends[:, 0], ends[:, 1]) if name == "calibrated" else (None, None)
        curves += [Curve(name, stated, right, *bounds)] if bins else []
    x, y = "stated probability (fraction)", "right (fraction of slides)"
    return Chart(title, charts.lines(curves, x, y, diagonal=(0, 1), height=220))


def _probability_cells(probabilities: ProbabilityMeasures, answers: Mapping[str, Any]) -> list[str | Cell]:
    """Return the cells of a run below `PROBABILITY_HEADS`: errors of its probabilities, and rates of its answers."""
    before, after = probabilities["before"], probabilities["after"]
    errors = [(before["calibration_error"], after["calibration_error"]), (before["log_loss"], after["log_loss"])]
    rates = [
        estimate(
            (answers.get(f"{name}{end}") for end in ("", "_low", "_high")),
            1,
            f"of {answers.get(f'{name}_n', 0):,}",
            100,
        )
        for name in ("false_unknown", "false_known")
    ]
    area = answers["auroc"][answers["rule"]] if "auroc" in answers else math.nan
    return [
        *(Cell(number(new, 3).text, f"before: {number(old, 3).text}", new) for old, new in errors),
        *rates,
        number(area, 3),
        number(100 * answers.get("accuracy_of_answers", math.nan), 3),
    ]
