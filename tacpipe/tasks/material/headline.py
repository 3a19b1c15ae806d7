"""The headline of materials: the accuracy on a sensor's slides."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.metrics import pairing
from tacpipe.metrics.headline import Headline
from tacpipe.metrics.pairing import Measure, Sums

TASK = "material"
CHANCE = "chance"
# predictors that are baselines; others are controls or the model's own
BASELINES = {"mean_level": "mean level alone", "level_only": "same readout of the level alone"}


def headline(
    method: str,
    sensor: str,
    right: Mapping[str, Mapping[tuple[Any, str], tuple[int, int]]],
    classes: int,
    *,
    model: str = "model",
    runs: int = 1,
) -> Headline | None:
    """Return how a method compares with its baselines on the slides of a sensor.

    ``right`` holds, by predictor, then by seed and slide, how often the slide was classified right and how often at all.
    Guessing among ``classes`` counts as a baseline too.
    """
    model_sums = _sums(right.get(model, {}))
    baselines = {name: _sums(right[predictor]) for predictor, name in BASELINES.items() if right.get(predictor)}
    if classes:
        baselines[CHANCE] = {
            key: np.array([slide_sums[1] / classes, slide_sums[1]]) for key, slide_sums in model_sums.items()
        }
    return pairing.headline(TASK, method, MEASURE, model_sums, baselines, part=sensor, runs=runs)


def _sums(right: Mapping[tuple[Any, str], tuple[int, int]]) -> Sums:
    return {key: np.array(counts, dtype=np.float64) for key, counts in right.items()}


def _wrong(sums: AnyFloats) -> AnyFloats:
    return np.where(sums[:, 1] > 0, 1 - sums[:, 0] / np.maximum(sums[:, 1], 1), np.nan)


MEASURE = Measure(
    ("accuracy (%)",),
    "percent of slides",
    "accuracy",
    "points",
    "slides",
    _wrong,
    lambda wrong, baseline: 100 * (baseline - wrong),
    lambda sums: (100 * (1 - float(_wrong(sums[None])[0])),),
    lambda wrong: 100 * (1 - wrong),
    "accuracy (%)",
    rises=True,
    weight=lambda draws: draws[:, 1],
)
