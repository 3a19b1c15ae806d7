"""Measure the limits of predicting touch on some grasps: repeatability, number of grasps, information of the grasp.

The forests here are those of the architecture ``trees``, with leaves of a fixed size; they are trained and tested by
cross-validation within known objects, and their skill is 1 - RMSE / RMSE of the constant of all training grasps.

Two grasps of one object at the same place differ in their readings by what no camera and no planner states: how hard the
hand closed, how the skin lay, noise. Half of the mean squared difference of near pairs is at least the variance that
nothing read of the grasp can explain, because such pairs differ in pose too. So the skill that it leaves is a lower bound on
what can be reached, not an upper bound. Pairs at larger distances show how fast likeness is lost.

Objects differ in how much their readings vary, and not all of them have near pairs. So differences are compared with
the variance of the pair's own object, and the ratio is what is carried over to all objects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tacpipe.arrays import Floats, Indices, Int64s
from tacpipe.clouds import geometry
from tacpipe.errors import TacpipeError
from tacpipe.io import Json
from tacpipe.metrics import regression
from tacpipe.metrics.intervals import Estimate
from tacpipe.models.forest import Forest
from tacpipe.tasks.touch.grasps import Grasps

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
    def from_contacts(cls, contacts_m: Floats, objects: Sequence[str]) -> Pairs:
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
    pairs = Pairs.from_contacts(contacts_m, objects)
    return [
        (low, high, {name: repeatability(values, objects, pairs, low, high) for name, values in readings.items()})
        for low, high in pairwise(EDGES_MM)
    ]


FOLDS = 5
LEAF = 4
SIZES = (2, 4, 8, 16, 32)  # training grasps of each object
OTHER = {
    "pdc_th": ("pdc_mf", "e_mf"),
    "e_th": ("pdc_mf", "e_mf"),
    "pdc_mf": ("pdc_th", "e_th"),
    "e_mf": ("pdc_th", "e_th"),
}
Skills = dict[str, Estimate]  # target to skill


@dataclass(frozen=True)
class Point:
    """A point of a learning curve."""

    grasps: int  # most grasps of one object that were trained on
    trained: float  # grasps trained on, mean over folds
    skill: Skills


@dataclass(frozen=True)
class Limits:
    """Limits that were measured on grasps."""

    counts: Mapping[str, int]  # grasps by object
    near: Sequence[tuple[float, float, Mapping[str, Repeatability]]]  # bounds in mm
    curve: Sequence[Point]
    other_finger: Skills  # skills of forests that also read the other finger's reading
    draws: int
    trees: int

    def to_json(self) -> Json:
        """Return all of it for JSON; NaN is null, and so is the upper bound of the last class of distance."""
        return {
            "grasps": dict(self.counts),
            "draws": self.draws,
            "folds": FOLDS,
            "trees": self.trees,
            "repeatability": [
                {
                    "low_mm": low,
                    "high_mm": None if math.isinf(high) else high,
                    "pairs": max((estimates.pairs for estimates in by_target.values()), default=0),
                    "likeness": {name: _numbers(estimates.likeness) for name, estimates in by_target.items()},
                    "pair_skill": {name: _numbers(estimates.pair_skill) for name, estimates in by_target.items()},
                }
                for low, high, by_target in self.near
            ],
            "learning_curve": [
                {"grasps": point.grasps, "trained": point.trained, "skill": _by_target(point.skill)}
                for point in self.curve
            ],
            "other_finger": _by_target(self.other_finger),
        }


def limits(
    grasps: Grasps,
    *,
    sizes: Sequence[int] = SIZES,
    draws: int = 2,
    trees: int = 100,
    seed: int = 0,
    advance: Callable[..., None] | None = None,
) -> Limits:
    """Return what limits the prediction of touch on grasps with readings.

    ``draws`` is how often folds and training grasps are drawn anew; ``advance`` is called `steps` times. Raises
    `TacpipeError` if an object has fewer than five grasps, one for each fold, or where grasps have no object.
    """
    counts = {name: grasps.objects.count(name) for name in sorted(set(grasps.objects))}
    rarest = min(counts, key=lambda name: counts[name], default="")
    if not counts or "" in counts or counts[rarest] < FOLDS:
        shortage = f"{counts[rarest]} of {rarest or 'no named object'}" if counts else "none"
        raise TacpipeError(
            f"There are too few grasps: {shortage}. Limits need {FOLDS} or more of each object, one for each fold; label "
            f"objects with `tacpipe label RECORDINGS NAME --label object=…`, or leave some out with --exclude."
        )
    coloured = all(cloud.colours is not None for cloud in grasps.clouds)
    rows, _ = geometry.table(grasps.clouds, grasps.grasps, coloured=coloured)
    contacts_m = np.array([[grasp.g1_m, grasp.g2_m] for grasp in grasps.grasps])  # (grasp, finger, axis)
    trial = _Trial(grasps, rows, draws, trees, seed, advance or (lambda *_, **__: None))
    largest_size = max(counts.values()) * (FOLDS - 1) // FOLDS
    curve = [trial.point(size) for size in sorted({min(size, largest_size) for size in sizes})]
    near = table(grasps.readings, contacts_m, grasps.objects)
    return Limits(counts, near, curve, trial.other_finger(), draws, trees)


def steps(sizes: Iterable[int], draws: int) -> int:
    """Return how often `limits` calls ``advance`` at most."""
    return (len(set(sizes)) + 1) * draws * FOLDS


@dataclass(frozen=True)
class _Trial:
    """Cross-validation of forests on some grasps."""

    grasps: Grasps
    rows: Floats  # (grasp, feature)
    draws: int
    trees: int
    seed: int
    advance: Callable[..., None]

    def point(self, size: int) -> Point:
        """Return the skill where ``size`` grasps of each object are trained on."""
        skill, trained = self._skills(size, dict.fromkeys(self.grasps.readings, self.rows), f"{size} grasps an object")
        return Point(size, trained, skill)

    def other_finger(self) -> Skills:
        """Return the skill of forests that also read what the other finger measured, on all training grasps."""
        readings = self.grasps.readings
        rows = {
            name: np.concatenate(
                [self.rows, *(readings[target] for target in OTHER[name] if target in readings)], axis=1
            )
            for name in readings
        }
        return self._skills(len(self.grasps), rows, "other finger")[0]

    def _skills(self, size: int, rows: Mapping[str, Floats], note: str) -> tuple[Skills, float]:
        readings = self.grasps.readings
        squared = {name: np.zeros((2, len(self.grasps))) for name in readings}  # (model or constant, grasp)
        trained = []
        for draw in range(self.draws):
            rng = np.random.default_rng([self.seed, draw])
            folds = stratified(self.grasps.objects, rng)
            for fold in range(FOLDS):
                trained_on, tested = np.flatnonzero(folds != fold), np.flatnonzero(folds == fold)
                chosen = drawn(trained_on, self.grasps.objects, size, rng)
                trained.append(len(chosen))
                for name, values in readings.items():
                    leaf = max(1, min(LEAF, len(chosen) // 4))
                    forest = Forest.fitted(
                        rows[name][chosen], values[chosen], trees=self.trees, leaf=leaf, seed=self.seed + draw
                    )
                    constant = np.tile(values[trained_on].mean(axis=0), (len(tested), 1))
                    for at, predicted in enumerate((forest.predict(rows[name][tested]), constant)):
                        squared[name][at, tested] += regression.squared_sums(values[tested], predicted)
                self.advance(note=note)
        clusters = np.arange(len(self.grasps))
        skills = {
            name: regression.skill_interval(model, constant, clusters) for name, (model, constant) in squared.items()
        }
        return skills, float(np.mean(trained))


def stratified(objects: Sequence[str], rng: np.random.Generator) -> Int64s:
    """Return the fold of each grasp (grasp,), 0 to 4, the grasps of each object spread evenly over all."""
    names = np.asarray(objects)
    folds = np.zeros(len(names), np.int64)
    for name in sorted(set(objects)):
        members = rng.permutation(np.flatnonzero(names == name))
        folds[members] = np.arange(len(members)) % FOLDS
    return folds


def drawn(candidates: Indices, objects: Sequence[str], size: int, rng: np.random.Generator) -> Indices:
    """Return those of the grasps ``candidates`` (grasp,) that train: ``size`` of each object, or all that it has."""
    names = np.asarray(objects)[candidates]
    return np.concatenate([rng.permutation(candidates[names == name])[:size] for name in sorted(set(names))])


def _by_target(skills: Skills) -> dict[str, dict[str, float | None]]:
    return {name: _numbers(estimate) for name, estimate in skills.items()}


def _numbers(estimate: Estimate) -> dict[str, float | None]:
    return {name: None if math.isnan(value) else value for name, value in estimate._asdict().items()}
