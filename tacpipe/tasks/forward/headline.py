"""The headline of forecasts: the error of the shown steps, relative to persistence's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tacpipe.arrays import AnyFloats
from tacpipe.metrics import pairing
from tacpipe.metrics.headline import Headline
from tacpipe.metrics.pairing import Measure, Sums
from tacpipe.tasks.forward.units import COUNTS

TASK, MODEL, BASELINE = "forward", "model", "persistence"
STEPS = (1, 3, 5, 10)  # those shown, as far as a model predicts them
RECORDINGS, OBJECTS = "recordings", "objects"  # what chance draws: another recording, or another object
PARTS = {True: "known objects", False: "unseen objects", None: ""}


def legitimate(predictor: str) -> bool:
    """Return whether a predictor is a baseline: neither the model's own, nor one that goes through its codec.

    >>> [legitimate(name) for name in ("ridge", "persistence", "model_anchored", "codec", "codec_persistence")]
    [True, True, False, False, False]
    """
    return not predictor.startswith((MODEL, "codec"))


def shown(steps: Sequence[int]) -> tuple[int, ...]:
    """Return those of a model's steps that a headline is about.

    >>> shown(range(1, 11)), shown((1, 2, 3)), shown((2, 4))
    ((1, 3, 5, 10), (1, 3), (4,))
    """
    return tuple(step for step in STEPS if step in steps) or (max(steps),)


def sums(squared: AnyFloats, absolute: AnyFloats, persistence: AnyFloats, values: float) -> AnyFloats:
    """Return what adds up over recordings, from the error sums of a recording at the shown steps, each (step,).

    ``values`` is how many values each was summed over: windows times channels.
    """
    return np.concatenate([squared, persistence, absolute, [values]])


def headline(
    method: str,
    steps: Sequence[int],
    model: Sums,
    baselines: Mapping[str, Sums],
    part: bool | None,
    runs: int = 1,
    unit: str = COUNTS,
    objects: Mapping[str, str] | None = None,
) -> Headline | None:
    """Return how a method compares with its baselines on known objects, unseen ones or all; `sums` by seed and recording.

    ``unit`` is that of the mean absolute errors. The interval is over ``objects``, by recording, where these are given.
    """
    compared = {name: one for name, one in baselines.items() if legitimate(name)}
    cluster = OBJECTS if objects else RECORDINGS
    return pairing.headline(
        TASK, method, measure(steps, unit, cluster), model, compared, part=PARTS[part], clusters=objects, runs=runs
    )


def measure(steps: Sequence[int], unit: str = COUNTS, cluster: str = RECORDINGS) -> Measure:
    """Return how `sums` at some steps become errors; ``unit`` is that of the mean absolute ones."""
    count, ahead = len(steps), [f"t+{step}" for step in steps]

    def error(found: AnyFloats) -> AnyFloats:
        squared, persistence = found[:, :count], found[:, count : 2 * count]
        errs = persistence > 0  # where persistence never errs, nothing is relative to it
        ratio = np.where(errs, squared / np.where(errs, persistence, 1), 0.0)
        return np.where(errs.any(axis=1), ratio.sum(axis=1) / np.maximum(errs.sum(axis=1), 1), np.nan)

    def gain(one: AnyFloats, other: AnyFloats) -> AnyFloats:
        return np.where(other > 0, 1 - one / np.where(other > 0, other, 1), np.nan)

    def values(found: AnyFloats) -> tuple[float, ...]:
        mae = found[2 * count : 3 * count] / found[-1] if found[-1] else np.full(count, np.nan)
        return (*map(float, mae), 1 - float(error(found[None])[0]))

    # a column of its own for what ranks: errors by step alone do not rank predictors
    over = " and ".join(filter(None, (", ".join(ahead[:-1]), ahead[-1])))
    return Measure(
        (*(f"MAE {step}" for step in ahead), "vs persistence"),
        unit,
        f"the squared error as a fraction of persistence's, averaged over {over} (1 less that: vs persistence)",
        "skill",
        cluster,
        error,
        gain,
        values,
        lambda found: 1 - found,
        "skill over persistence",
        rises=True,
        weight=lambda found: found[:, count : 2 * count].sum(axis=1),
    )
