"""Predictions for objects that were not trained on, moved towards the constant as far as training objects show to be right.

What a model knows of some objects need not hold for others. So each training object is left out in turn: of what a model
of the others predicts beyond their constant, the fraction is kept that errs least on it, over all of them. 1 keeps a
prediction as it is, 0 replaces it by the constant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Floats
from tacpipe.errors import UsageError

FEWEST = 3  # objects; with two, a model of one is asked about the other


@dataclass(frozen=True)
class Shrinkage:
    """How predictions for novel objects are shrunk, by target."""

    factor: Mapping[str, float]  # multiplies the difference between prediction and constant, 0 to 1
    constant: Mapping[str, Floats]  # (value,), device counts

    def apply(self, predicted: Mapping[str, Floats], novel: Bools) -> dict[str, Floats]:
        """Return predictions (grasp, value) by target, those of the ``novel`` grasps (grasp,) shrunk."""
        shrunk = {}
        for name, values in predicted.items():
            constant = self.constant[name]
            shrunk[name] = np.where(novel[:, None], constant + self.factor[name] * (values - constant), values)
        return shrunk

    def tensors(self) -> dict[str, AnyArray]:
        """Return what `from_tensors` reads."""
        factors = {f"kept.{name}": np.array([value]) for name, value in self.factor.items()}
        return {**factors, **{f"constant.{name}": values for name, values in self.constant.items()}}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray], targets: Sequence[str]) -> Shrinkage:
        """Return what `tensors` wrote. Raises `ValueError` for a fraction outside 0 to 1."""
        factor = {name: float(tensors[f"kept.{name}"][0]) for name in targets}
        if not all(0 <= value <= 1 for value in factor.values()):
            raise ValueError(f"predictions of novel objects keep {factor}, not 0 to 1")
        return cls(factor, {name: tensors[f"constant.{name}"].astype(np.float64) for name in targets})


def fit(
    readings: Mapping[str, Floats],
    objects: Sequence[str],
    predict: Callable[[Bools], Mapping[str, Floats]],
) -> Shrinkage:
    """Return the shrinkage that errs least on training objects left out one by one.

    ``readings`` are (grasp, value) by target, device counts; ``predict`` returns what a model that was trained on the
    grasps of a mask (grasp,) predicts for all others, by target (other grasp, value). Raises `UsageError` with fewer than
    three objects.
    """
    names = np.asarray(objects)
    object_names = sorted(set(objects) - {""})
    if len(object_names) < FEWEST:
        raise UsageError(
            f"shrink_novel is set and training grasps are of {len(object_names)} objects; it needs {FEWEST} or more, which "
            f"are left out one by one. Label objects, or leave out --shrink-novel."
        )
    products = {name: [0.0, 0.0] for name in readings}  # prediction times truth, prediction squared
    for name in object_names:
        in_training = names != name
        predicted = predict(in_training)
        for target, values in readings.items():
            constant = values[in_training].mean(axis=0)
            beyond = predicted[target] - constant
            products[target][0] += float((beyond * (values[~in_training] - constant)).sum())
            products[target][1] += float(np.square(beyond).sum())
    factor = {
        name: float(np.clip(product / square, 0, 1)) if square > 0 else 0.0
        for name, (product, square) in products.items()
    }
    return Shrinkage(factor, {name: values.mean(axis=0) for name, values in readings.items()})
