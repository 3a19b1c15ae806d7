"""Measure the limits of predicting touch on some grasps: repeatability, number of grasps, information of the grasp.

The forests here are those of the architecture ``trees``, with leaves of a fixed size; they are trained and tested by
cross-validation within known objects, and their skill is 1 - RMSE / RMSE of the constant of all training grasps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import Floats, Indices, Int64s
from tacpipe.clouds import geometry
from tacpipe.errors import TacpipeError
from tacpipe.metrics import regression
from tacpipe.metrics.intervals import Estimate
from tacpipe.models.forest import Forest
from tacpipe.tasks.touch import repeatability
from tacpipe.tasks.touch.grasps import Grasps

FOLDS = 5
LEAF = 4
SIZES = (2, 4, 8, 16, 32)  # training grasps of each object
OTHER = {
    "pdc_th": ("pdc_mf", "e_mf"),
    "e_th": ("pdc_mf", "e_mf"),
    "pdc_mf": ("pdc_th", "e_th"),
    "e_mf": ("pdc_th", "e_th"),
}
Tree = dict[str, Any]
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
    near: Sequence[tuple[float, float, Mapping[str, repeatability.Repeatability]]]  # bounds in mm
    curve: Sequence[Point]
    other_finger: Skills  # skills of forests that also read the other finger's reading
    draws: int
    trees: int

    def to_json(self) -> Tree:
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
    `TacpipeError` where an object has fewer than five grasps, one for each fold, or where grasps have no object.
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
    near = repeatability.table(grasps.readings, contacts_m, grasps.objects)
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


def _by_target(skills: Skills) -> Tree:
    return {name: _numbers(estimate) for name, estimate in skills.items()}


def _numbers(estimate: Estimate) -> Tree:
    return {name: None if math.isnan(value) else value for name, value in estimate._asdict().items()}
