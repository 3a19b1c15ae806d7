"""Measure limits on predicting touch: repeatability, number of grasps, and information in the grasp.

The forests are those of the architecture ``trees`` with a fixed leaf size. They are cross-validated within known
objects, and their skill is 1 - RMSE / RMSE of the constant of all training grasps.

Two grasps of one object at the same position have different readings because of effects that neither camera nor planner
measures: closing force, position of the skin, noise. Such pairs also differ slightly in pose, so half of their mean
squared difference is an upper bound on the unexplainable variance. The remaining skill is therefore a lower bound on
the achievable skill, not an upper bound. Pairs at larger distances show how fast similarity decreases.

Objects differ in the variance of their readings, and some have no near pairs. So each pair's difference is divided by
the variance within its object, and this ratio is applied to all objects.
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

EDGES_MM = (0.0, 6.0, 10.0, 20.0, 40.0, math.inf)  # edges of the distance bins
RESAMPLES = 500
NOTHING = Estimate(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Pairs:
    """Pairs of grasps of the same object."""

    first: Indices  # (pair,), indices of grasps
    second: Indices  # (pair,)
    distance_mm: Floats  # (pair,): root mean square displacement of both contacts, in the camera's frame

    @classmethod
    def from_contacts(cls, contacts_m: Floats, objects: Sequence[str]) -> Pairs:
        """Return all pairs of grasps of the same object; ``contacts_m`` is (grasp, finger, axis).

        Grasps without an object are skipped.
        """
        first, second = np.triu_indices(len(objects), 1)
        names = np.asarray(objects)
        is_same_object = (names[first] == names[second]) & (names[first] != "")
        first, second = first[is_same_object], second[is_same_object]
        displacement = contacts_m[first] - contacts_m[second]  # (pair, finger, axis)
        return cls(first, second, 1e3 * np.sqrt(np.square(displacement).sum(axis=2).mean(axis=1)))


@dataclass(frozen=True)
class Repeatability:
    """Repeatability of one target, from the pairs of one distance bin."""

    pairs: int
    likeness: Estimate  # 1 - half the mean squared difference / variance within objects; 1 if equal, 0 for random pairs
    pair_skill: Estimate  # skill, relative to a constant, of predictions as wrong as the differences within pairs


def repeatability(
    values: Floats, objects: Sequence[str], pairs: Pairs, low_mm: float, high_mm: float, seed: int = 0
) -> Repeatability:
    """Return the repeatability of values (grasp, value), in device counts, over the pairs in a distance bin.

    The bin contains distances of at least ``low_mm`` and less than ``high_mm``. Intervals are the middle 95 % over
    resampled grasps, in which a pair has the product of the counts of its two grasps as weight. The results are NaN if
    there are no pairs.
    """
    in_bin = (pairs.distance_mm >= low_mm) & (pairs.distance_mm < high_mm)
    first, second = pairs.first[in_bin], pairs.second[in_bin]
    if not len(first):
        return Repeatability(0, NOTHING, NOTHING)
    squared = np.square(values[first] - values[second]).sum(axis=1)  # (pair,)
    object_index = np.unique(np.asarray(objects), return_inverse=True)[1]

    def estimates(weight: Floats) -> tuple[float, float]:
        variance_within, total = variances(values, object_index, weight)
        counts = weight[first] * weight[second]
        expected = float((counts * variance_within[object_index[first]]).sum())
        if expected <= 0 or total <= 0:
            return math.nan, math.nan
        ratio = float((counts * squared).sum()) / 2 / expected
        return 1 - ratio, 1 - math.sqrt(
            ratio * float(np.average(variance_within[object_index], weights=weight)) / total
        )

    rng, count = np.random.default_rng(seed), len(values)
    weights = [np.bincount(rng.integers(0, count, count), minlength=count).astype(np.float64) for _ in range(RESAMPLES)]
    resampled = np.array([estimates(weight) for weight in weights])  # (resample, likeness or pair skill)
    resampled = resampled[np.isfinite(resampled).all(axis=1)]
    means = estimates(np.ones(count))
    if not len(resampled):
        return Repeatability(len(first), *(Estimate(mean, math.nan, math.nan) for mean in means))
    low, high = np.quantile(resampled, (0.025, 0.975), axis=0)
    return Repeatability(len(first), *(Estimate(*map(float, ends)) for ends in zip(means, low, high, strict=True)))


def variances(values: Floats, object_index: Indices, weight: Floats) -> tuple[Floats, float]:
    """Return the variances of values (grasp, value) about each object's mean (object,) and about the overall mean.

    ``object_index`` (grasp,) contains object indices, and ``weight`` (grasp,) the count of each grasp. Variances are
    summed over values. The variance within an object is unbiased, and 0 if the object's total count is below 2.
    """
    objects = int(object_index.max()) + 1
    counts = np.bincount(object_index, weight, objects)
    sums = np.zeros((objects, values.shape[1]))
    np.add.at(sums, object_index, weight[:, None] * values)
    means = sums / np.maximum(counts, 1)[:, None]
    squared_deviations = weight * np.square(values - means[object_index]).sum(axis=1)
    variance_within = np.where(
        counts > 1, np.bincount(object_index, squared_deviations, objects) / np.maximum(counts - 1, 1), 0.0
    )
    centre = np.average(values, axis=0, weights=weight)
    return variance_within, float(np.average(np.square(values - centre).sum(axis=1), weights=weight))


def table(
    readings: Mapping[str, Floats], contacts_m: Floats, objects: Sequence[str]
) -> list[tuple[float, float, dict[str, Repeatability]]]:
    """Return, for each distance bin, its lower and upper bound in mm and the `repeatability` by target."""
    pairs = Pairs.from_contacts(contacts_m, objects)
    return [
        (low, high, {name: repeatability(values, objects, pairs, low, high) for name, values in readings.items()})
        for low, high in pairwise(EDGES_MM)
    ]


FOLDS = 5
LEAF = 4
SIZES = (2, 4, 8, 16, 32)  # training grasps per object
OTHER = {
    "pdc_th": ("pdc_mf", "e_mf"),
    "e_th": ("pdc_mf", "e_mf"),
    "pdc_mf": ("pdc_th", "e_th"),
    "e_mf": ("pdc_th", "e_th"),
}
Skills = dict[str, Estimate]  # target -> skill


@dataclass(frozen=True)
class Point:
    """A point of a learning curve."""

    grasps: int  # maximum number of training grasps per object
    trained: float  # number of training grasps, mean over folds
    skill: Skills


@dataclass(frozen=True)
class Limits:
    """Limits measured on a set of grasps."""

    counts: Mapping[str, int]  # number of grasps by object
    near: Sequence[tuple[float, float, Mapping[str, Repeatability]]]  # distance bins, with bounds in mm
    curve: Sequence[Point]
    other_finger: Skills  # skills of forests that also get the other finger's reading
    draws: int
    trees: int

    def to_json(self) -> Json:
        """Return all limits for JSON; NaN and the upper bound of the last distance bin become null."""
        repeatability = [
            {
                "low_mm": low,
                "high_mm": None if math.isinf(high) else high,
                "pairs": max((estimates.pairs for estimates in by_target.values()), default=0),
                "likeness": {name: _estimate_json(estimates.likeness) for name, estimates in by_target.items()},
                "pair_skill": {name: _estimate_json(estimates.pair_skill) for name, estimates in by_target.items()},
            }
            for low, high, by_target in self.near
        ]
        return {
            "grasps": dict(self.counts),
            "draws": self.draws,
            "folds": FOLDS,
            "trees": self.trees,
            "repeatability": repeatability,
            "learning_curve": [
                {"grasps": point.grasps, "trained": point.trained, "skill": _skills_json(point.skill)}
                for point in self.curve
            ],
            "other_finger": _skills_json(self.other_finger),
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
    """Return the limits of predicting touch on grasps with readings.

    ``draws`` is the number of random choices of folds and training grasps. ``advance`` is called `steps` times. Raises
    `TacpipeError` if grasps have no object, or an object has fewer than five grasps, one per fold.
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
    rows, _ = geometry.feature_table(grasps.clouds, grasps.grasps, coloured=coloured)
    contacts_m = np.array([[grasp.g1_m, grasp.g2_m] for grasp in grasps.grasps])  # (grasp, finger, axis)
    trial = _Trial(grasps, rows, draws, trees, seed, advance or (lambda *_, **__: None))
    largest_size = max(counts.values()) * (FOLDS - 1) // FOLDS
    curve = [trial.point(size) for size in sorted({min(size, largest_size) for size in sizes})]
    bins = table(grasps.readings, contacts_m, grasps.objects)
    return Limits(counts, bins, curve, trial.skills_with_other_finger(), draws, trees)


def steps(sizes: Iterable[int], draws: int) -> int:
    """Return the maximum number of calls of ``advance`` by `limits`."""
    return (len(set(sizes)) + 1) * draws * FOLDS


@dataclass(frozen=True)
class _Trial:
    """Cross-validation of forests on a set of grasps."""

    grasps: Grasps
    rows: Floats  # (grasp, feature)
    draws: int
    trees: int
    seed: int
    advance: Callable[..., None]

    def point(self, size: int) -> Point:
        """Return the learning-curve point for ``size`` training grasps per object."""
        skill, trained = self._skills(size, dict.fromkeys(self.grasps.readings, self.rows), f"{size} grasps per object")
        return Point(size, trained, skill)

    def skills_with_other_finger(self) -> Skills:
        """Return the skill of forests that also read the other finger, trained on all training grasps."""
        readings = self.grasps.readings
        rows = {
            name: np.concatenate(
                [self.rows, *(readings[target] for target in OTHER[name] if target in readings)], axis=1
            )
            for name in readings
        }
        return self._skills(len(self.grasps), rows, "other finger")[0]

    def _skills(self, size: int, rows: Mapping[str, Floats], note: str) -> tuple[Skills, float]:
        """Return the skill of forests of ``rows`` by target, over draws and folds, and the mean number of training grasps.

        ``size`` is the maximum number of training grasps per object, and ``note`` a text for the progress bar.
        """
        readings = self.grasps.readings
        squared = {name: np.zeros((2, len(self.grasps))) for name in readings}  # (model or constant, grasp)
        trained = []
        for draw in range(self.draws):
            rng = np.random.default_rng([self.seed, draw])
            folds = stratified_folds(self.grasps.objects, rng)
            for fold in range(FOLDS):
                trained_on, tested = np.flatnonzero(folds != fold), np.flatnonzero(folds == fold)
                sample = sample_grasps(trained_on, self.grasps.objects, size, rng)
                trained.append(len(sample))
                for name, values in readings.items():
                    leaf = max(1, min(LEAF, len(sample) // 4))
                    forest = Forest.fit(
                        rows[name][sample], values[sample], trees=self.trees, leaf=leaf, seed=self.seed + draw
                    )
                    constant = np.tile(values[trained_on].mean(axis=0), (len(tested), 1))
                    for index, predicted in enumerate((forest.predict(rows[name][tested]), constant)):
                        squared[name][index, tested] += regression.squared_sums(values[tested], predicted)
                self.advance(note=note)
        clusters = np.arange(len(self.grasps))
        skills = {
            name: regression.skill_interval(model, constant, clusters) for name, (model, constant) in squared.items()
        }
        return skills, float(np.mean(trained))


def stratified_folds(objects: Sequence[str], rng: np.random.Generator) -> Int64s:
    """Return the fold (grasp,), 0 to 4, of each grasp, with each object's grasps distributed evenly over folds."""
    names = np.asarray(objects)
    folds = np.zeros(len(names), np.int64)
    for name in sorted(set(objects)):
        members = rng.permutation(np.flatnonzero(names == name))
        folds[members] = np.arange(len(members)) % FOLDS
    return folds


def sample_grasps(candidates: Indices, objects: Sequence[str], size: int, rng: np.random.Generator) -> Indices:
    """Return ``size`` random grasps of each object among ``candidates`` (grasp,), or all if it has fewer."""
    names = np.asarray(objects)[candidates]
    return np.concatenate([rng.permutation(candidates[names == name])[:size] for name in sorted(set(names))])


def _skills_json(skills: Skills) -> dict[str, dict[str, float | None]]:
    return {name: _estimate_json(estimate) for name, estimate in skills.items()}


def _estimate_json(estimate: Estimate) -> dict[str, float | None]:
    return {name: None if math.isnan(value) else value for name, value in estimate._asdict().items()}
