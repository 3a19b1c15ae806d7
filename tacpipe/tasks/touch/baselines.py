"""Predictions without a network: the baselines of every table, and predictions of novel objects moved towards the constant.

What a model knows of some objects need not hold for others. So each training object is left out in turn: of what a model
of the others predicts beyond their constant, the fraction is kept that errs least on it, over all of them. 1 keeps a
prediction as it is, 0 replaces it by the constant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Bools, Floats, Times
from tacpipe.channels import biotac_sp
from tacpipe.errors import UsageError
from tacpipe.tasks.touch.grasps import Grasps
from tacpipe.tasks.touch.headline import CONSTANT, NEAREST_IN_TIME, OBJECT_MEAN

NEAREST = 3  # training grasps whose mean is predicted


@dataclass(frozen=True)
class Baselines:
    """The readings of the training grasps, from which baselines predict."""

    readings: Mapping[str, Floats]  # target -> (grasp, value), device counts
    objects: tuple[str, ...]
    t_ns: Times  # (grasp,)

    @classmethod
    def from_grasps(cls, grasps: Grasps) -> Baselines:
        """Return the baselines that training grasps give."""
        return cls(grasps.readings, grasps.objects, grasps.t_ns)

    def check(self) -> None:
        """Raise `ValueError` where arrays are not as long as there are training grasps, or of another width."""
        for name, values in self.readings.items():
            if values.shape != (len(self.objects), biotac_sp.width(name)) or self.t_ns.shape != values.shape[:1]:
                raise ValueError(f"baselines of {name} are {values.shape} for {len(self.objects)} grasps")

    def predict(self, grasps: Grasps) -> dict[str, dict[str, Floats]]:
        """Return each baseline's values by target (grasp, value), device counts.

        ``constant`` predicts the mean of all training grasps; ``object_mean`` that of the grasps of the same object, and the
        constant where none is or no object is named; ``nearest_in_time`` the mean of the three training grasps nearest in
        time, which follows a drifting sensor and knows nothing of the grasp.
        """
        names = np.array(self.objects)
        same = [(names == name) & (names != "") for name in grasps.objects]  # (grasp)(training grasp,)
        reference_masks = [mask if mask.any() else np.ones_like(mask) for mask in same]
        nearest = [np.argsort(np.abs(self.t_ns - t_ns), kind="stable")[:NEAREST] for t_ns in grasps.t_ns]
        return {
            CONSTANT: {name: np.tile(values.mean(axis=0), (len(grasps), 1)) for name, values in self.readings.items()},
            OBJECT_MEAN: {
                name: np.array([values[mask].mean(axis=0) for mask in reference_masks]).reshape(len(grasps), -1)
                for name, values in self.readings.items()
            },
            NEAREST_IN_TIME: {
                name: np.array([values[at].mean(axis=0) for at in nearest]).reshape(len(grasps), -1)
                for name, values in self.readings.items()
            },
        }

    def same_reading(self, grasps: Grasps) -> Bools:
        """Return whether each grasp (grasp,) has a reading of training, to the count: one that was logged twice."""
        before, now = (
            np.concatenate([values[name] for name in self.readings], axis=1)
            for values in (self.readings, grasps.readings)
        )
        training_rows = {row.tobytes() for row in np.asarray(before, np.float64)}
        return np.array([row.tobytes() in training_rows for row in np.asarray(now, np.float64)], bool)

    def tensors(self) -> dict[str, NDArray[np.generic]]:
        """Return what `from_tensors` reads, but for the objects' names."""
        return {**{f"felt.{name}": values for name, values in self.readings.items()}, "t_ns": self.t_ns}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, NDArray[np.generic]], objects: tuple[str, ...]) -> Baselines:
        """Return the baselines that `tensors` wrote."""
        readings = {
            name: tensors[f"felt.{name}"].astype(np.float64) for name in biotac_sp.TARGETS if f"felt.{name}" in tensors
        }
        return cls(readings, objects, tensors["t_ns"].astype(np.int64))


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


def fit_shrinkage(
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
