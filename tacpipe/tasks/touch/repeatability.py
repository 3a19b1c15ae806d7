"""Compare the readings of pairs of grasps of one object by the distance of the grasps.

Two grasps of one object at the same place differ in their readings by what no camera and no planner states: how hard the
hand closed, how the skin lay, noise. Half of the mean squared difference of near pairs is at least the variance that
nothing read of the grasp can explain, because such pairs differ in pose too. So the skill that it leaves is a lower bound on
what can be reached, not an upper bound. Pairs at larger distances show how fast likeness is lost.

Objects differ in how much their readings vary, and not all of them have near pairs. So differences are compared with
the variance of the pair's own object, and the ratio is what is carried over to all objects.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tacpipe.arrays import Floats, Indices
from tacpipe.metrics.intervals import Estimate

EDGES_MM = (0.0, 6.0, 10.0, 20.0, 40.0, math.inf)  # edges of the classes of distance
RESAMPLES = 500
NOTHING = Estimate(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Pairs:
    """Pairs of grasps of the same object."""

    first: Indices  # (pair,), numbers of grasps
    second: Indices  # (pair,)
    distance_mm: Floats  # (pair,): root of the mean of both contacts' squared displacement, in the camera's frame

    @classmethod
    def of(cls, contacts_m: Floats, objects: Sequence[str]) -> Pairs:
        """Return every pair; ``contacts_m`` are (grasp, finger, axis). Grasps without an object are in none."""
        first, second = np.triu_indices(len(objects), 1)
        names = np.asarray(objects)
        same = (names[first] == names[second]) & (names[first] != "")
        first, second = first[same], second[same]
        moved = contacts_m[first] - contacts_m[second]  # (pair, finger, axis)
        return cls(first, second, 1e3 * np.sqrt(np.square(moved).sum(axis=2).mean(axis=1)))


@dataclass(frozen=True)
class Repeatability:
    """Repeatability of one target, from pairs of one class of distance."""

    pairs: int
    likeness: (
        Estimate  # 1 - half the mean squared difference / variance within objects: 1 equal, 0 as unlike as any pair
    )
    pair_skill: Estimate  # skill over the constant of a predictor that errs by no more than such pairs differ


def repeatability(
    values: Floats, objects: Sequence[str], pairs: Pairs, low_mm: float, high_mm: float, seed: int = 0
) -> Repeatability:
    """Return what pairs at ``low_mm`` or more and less than ``high_mm`` show of values (grasp, value), device counts.

    Intervals are the middle 95 % over resampled grasps: a pair counts as often as both of its grasps are drawn. They are
    NaN without a pair.
    """
    near = (pairs.distance_mm >= low_mm) & (pairs.distance_mm < high_mm)
    first, second = pairs.first[near], pairs.second[near]
    if not len(first):
        return Repeatability(0, NOTHING, NOTHING)
    squared = np.square(values[first] - values[second]).sum(axis=1)  # (pair,)
    kind = np.unique(np.asarray(objects), return_inverse=True)[1]

    def estimates(weight: Floats) -> tuple[float, float]:
        variance_within, total = variances(values, kind, weight)
        counts = weight[first] * weight[second]
        expected = float((counts * variance_within[kind[first]]).sum())
        if expected <= 0 or total <= 0:
            return math.nan, math.nan
        ratio = float((counts * squared).sum()) / 2 / expected
        return 1 - ratio, 1 - math.sqrt(ratio * float(np.average(variance_within[kind], weights=weight)) / total)

    rng, count = np.random.default_rng(seed), len(values)
    drawn = [np.bincount(rng.integers(0, count, count), minlength=count).astype(np.float64) for _ in range(RESAMPLES)]
    resampled = np.array([estimates(weight) for weight in drawn])  # (resample, likeness or pair skill)
    resampled = resampled[np.isfinite(resampled).all(axis=1)]
    means = estimates(np.ones(count))
    if not len(resampled):
        return Repeatability(len(first), *(Estimate(mean, math.nan, math.nan) for mean in means))
    low, high = np.quantile(resampled, (0.025, 0.975), axis=0)
    return Repeatability(len(first), *(Estimate(*map(float, ends)) for ends in zip(means, low, high, strict=True)))


def variances(values: Floats, kind: Indices, weight: Floats) -> tuple[Floats, float]:
    """Return the variance of values (grasp, value) about the mean of each object (object,), and about that of all.

    ``kind`` (grasp,) is the number of the object; ``weight`` (grasp,) how often each grasp counts. Variances of the values
    are added; that within an object is unbiased, and 0 where the object counts once or never.
    """
    objects = int(kind.max()) + 1
    counts = np.bincount(kind, weight, objects)
    sums = np.zeros((objects, values.shape[1]))
    np.add.at(sums, kind, weight[:, None] * values)
    means = sums / np.maximum(counts, 1)[:, None]
    squared_deviations = weight * np.square(values - means[kind]).sum(axis=1)
    variance_within = np.where(
        counts > 1, np.bincount(kind, squared_deviations, objects) / np.maximum(counts - 1, 1), 0.0
    )
    centre = np.average(values, axis=0, weights=weight)
    return variance_within, float(np.average(np.square(values - centre).sum(axis=1), weights=weight))


def table(
    readings: Mapping[str, Floats], contacts_m: Floats, objects: Sequence[str]
) -> list[tuple[float, float, dict[str, Repeatability]]]:
    """Return `repeatability` by class of distance, each with its bounds in mm, and by target."""
    pairs = Pairs.of(contacts_m, objects)
    return [
        (low, high, {name: repeatability(values, objects, pairs, low, high) for name, values in readings.items()})
        for low, high in pairwise(EDGES_MM)
    ]
