"""Counts of right names, with intervals: the numbers of a result."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from tacpipe.arrays import Bools
from tacpipe.metrics.intervals import mcnemar, wilson
from tacpipe.tasks.material.classifier import MEAN_LEVEL

MODEL, SWAPPED, LAST_EPOCH = "model", "swapped", "last_epoch"
Tree = dict[str, Any]


def accuracy(correct: Mapping[str, Bools]) -> Tree:
    """Return accuracy, right ones, number and 95 % Wilson interval by sensor; a sensor without slides is left out.

    Accuracy is the ratio of right names: equation (4) of the paper, taken literally, would be a mean squared difference
    of labels.

    >>> import numpy as np
    >>> accuracy({"biotac": np.array([True, False])})["accuracy"]
    {'biotac': 0.5}
    """
    tree: Tree = {"accuracy": {}, "correct": {}, "n": {}, "low": {}, "high": {}}
    for sensor, right in correct.items():
        if not len(right):
            continue
        count = int(right.sum())
        low, high = wilson(count, len(right))
        tree["accuracy"][sensor] = count / len(right)
        tree["correct"][sensor], tree["n"][sensor] = count, len(right)
        tree["low"][sensor], tree["high"][sensor] = low, high
    return tree


def chance(counts: Mapping[str, int], classes: int) -> Tree:
    """Return what guessing one of ``classes`` gets, by sensor."""
    shares = {sensor: 1 / classes for sensor, count in counts.items() if count}
    return {"accuracy": shares, "n": {sensor: counts[sensor] for sensor in shares}}


def summary(right: Mapping[str, Mapping[str, Bools]], classes: int) -> Tree:
    """Return the metrics of predictors: ``right`` holds by predictor and sensor which slides were named rightly (slide,).

    ``skill`` is the fraction of the mean level's wrong names that the model gets right; ``mcnemar`` the exact probability
    of so unequal disagreements if both were as good.
    """
    tree: Tree = {name: accuracy(by_sensor) for name, by_sensor in right.items()}
    counts = {sensor: len(is_right) for sensor, is_right in right[MODEL].items()}
    tree["chance"] = chance(counts, classes)
    tree["counts"] = {"slides": counts}
    if MEAN_LEVEL in right:
        tree["skill"], tree["mcnemar"] = {}, {"model_vs_mean_level": {}}
        for sensor, model in right[MODEL].items():
            level = right[MEAN_LEVEL][sensor]
            if len(model) and not level.all():
                tree["skill"][sensor] = float(1 - (~model).mean() / (~level).mean())
            if len(model):
                tree["mcnemar"]["model_vs_mean_level"][sensor] = mcnemar(model, level)
    return tree


def confusion_csv(sensors: Sequence[str], materials: Sequence[Any], predicted: Sequence[Any]) -> bytes:
    """Return how often each sensor's slides of a material were given each name, as CSV."""
    counts: dict[tuple[str, Any, Any], int] = {}
    for key in zip(sensors, materials, predicted, strict=True):
        counts[key] = counts.get(key, 0) + 1
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["sensor", "material", "predicted", "count"])
    writer.writerows([*key, count] for key, count in sorted(counts.items()))
    return text.getvalue().encode()
