"""Two methods on the same slides: by how much one names more of them right, and how sure that is."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.metrics import forecast
from tacpipe.metrics.proportions import mcnemar, paired_t
from tacpipe.report.material import accuracy
from tacpipe.report.material.methods import Method, Run
from tacpipe.report.material.predictions import MODEL

_draws = functools.lru_cache(maxsize=8)(forecast.draws)


@dataclass(frozen=True)
class Difference:
    """What the first method has over the second, in fractions of the slides that both were evaluated on."""

    slides: int
    mean: float
    low: float  # 95 % interval, from drawing slides anew
    high: float
    first_only: int  # slides that the first alone names right
    second_only: int
    mcnemar: float  # p
    unit: str  # what is paired next to: ``folds``, or ``seeds`` where there is one fold
    units: int
    paired: float  # p of the paired t test over units, NaN below two and where all differ by as much

    @property
    def word(self) -> str:
        """Whether the first is ``better`` or ``worse``, or that is ``unclear``."""
        return "better" if self.low > 0 else "worse" if self.high < 0 else "unclear"


@dataclass(frozen=True)
class Pair:
    """Two methods that a table compares."""

    name: str
    first: Method
    second: Method


def difference(
    first: Sequence[Run], second: Sequence[Run], sensor: str, predictors: tuple[str, str] = (MODEL, MODEL)
) -> Difference | None:
    """Return what ``first`` has over ``second`` on slides of a sensor; None where they share none.

    A slide that several runs of a method were evaluated on counts as the fraction of runs that name it right; McNemar's test
    takes it for right where at least half of them do.
    """
    one, other = (accuracy.verdicts(runs, sensor, name) for runs, name in zip((first, second), predictors, strict=True))
    common = [name for name in one.recordings if name in set(other.recordings)]
    if not common:
        return None
    places = [dict(zip(found.recordings, found.fraction, strict=True)) for found in (one, other)]
    fractions = np.array([[place[name] for name in common] for place in places])  # (method, slide)
    gain = fractions[0] - fractions[1]
    low, high = forecast.bounds((_draws(len(common)) @ gain / len(common))[:, None])
    right = fractions >= 0.5
    unit, pairs = _paired(first, second, sensor, predictors)
    return Difference(
        len(common),
        float(gain.mean()),
        float(low[0]),
        float(high[0]),
        int((right[0] & ~right[1]).sum()),
        int((right[1] & ~right[0]).sum()),
        mcnemar(right[0], right[1]),
        unit,
        len(pairs),
        _p_of_pairs(pairs),
    )


def pairs(methods: Sequence[Method]) -> list[Pair]:
    """Return which methods a table compares: what is asked to help, against the same without it."""
    plain = [one for one in methods if one.plain]
    found = []
    for joint in (one for one in plain if one.kind == "RAEC joint"):
        alone = nearest(joint, [one for one in plain if one.kind == "RAEC independent"])
        permuted = nearest(joint, [one for one in methods if control(one)])
        found += [Pair(f"{joint.name} − {one.name}", joint, one) for one in (alone, permuted) if one]
        found += [Pair(f"{one.name} − {joint.name}", one, joint) for one in plain if one.kind == "MiniRocket"]
    return found


def control(method: Method) -> bool:
    """Return whether a method is the negative control: trained jointly like others, its pairs of permuted materials."""
    return method.kind == "RAEC joint" and method.settings["pairing"] == "permuted" and method.differs_only("pairing")


def main(methods: Sequence[Method], kind: str = "RAEC joint") -> Method | None:
    """Return the plain method of a kind that represents it where one is given: that with most runs."""
    return max((one for one in methods if one.plain and one.kind == kind), key=lambda one: len(one.runs), default=None)


def nearest(method: Method, others: Sequence[Method]) -> Method | None:
    """Return that of ``others`` that shares most settings with a method; of several the one with most runs."""

    def shared(other: Method) -> int:
        return sum(other.settings.get(name) == value for name, value in method.settings.items())

    return max(others, key=lambda other: (shared(other), len(other.runs), other.name), default=None)


def _paired(
    first: Sequence[Run], second: Sequence[Run], sensor: str, predictors: tuple[str, str]
) -> tuple[str, list[tuple[float, float]]]:
    """Return accuracies by fold, or by seed where there is one fold, of the folds that both methods have."""

    def fold(run: Run) -> Hashable:
        return run.config.get("fold")

    def tested(run: Run) -> Hashable:
        return frozenset(run.predictions.of(sensor).recordings.tolist())

    def seed(run: Run) -> Hashable:
        return run.params.get("seed")

    rules: list[tuple[str, Callable[[Run], Hashable]]]
    rules = [("folds", fold), ("folds", tested), ("seeds", seed)]
    for unit, rule in rules:
        one, other = (
            _by_unit(runs, sensor, name, rule) for runs, name in zip((first, second), predictors, strict=True)
        )
        common = [key for key in one if key in other]
        if len(common) > 1:
            return unit, [(one[key], other[key]) for key in common]
    return "folds", []


def _p_of_pairs(pairs: Sequence[tuple[float, float]]) -> float:
    gains = [one - other for one, other in pairs]
    if len(gains) < 2 or max(gains) - min(gains) < 1e-12:
        return float("nan")
    return paired_t(*zip(*pairs, strict=True))[2]


def _by_unit(
    runs: Sequence[Run], sensor: str, predictor: str, rule: Callable[[Run], Hashable]
) -> dict[Hashable, float]:
    units: dict[Hashable, list[Run]] = {}
    for run in runs:
        if (key := rule(run)) is not None:
            units.setdefault(key, []).append(run)
    described = {key: accuracy.accuracy(same, sensor, predictor) for key, same in units.items()}
    return {key: found.mean for key, found in described.items() if found}
