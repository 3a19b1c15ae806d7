"""How uncertain a predicted reading is, of a model of any architecture: quantiles about what it predicts.

Grasps are few, so that no spread can be learned for each: a value's error is measured in units of its own standard
deviation over training grasps, and of these units the quantiles are those of all values of a target together, each
calibration grasp weighing the same: split conformal prediction with normalised errors (Papadopoulos, Gammerman and Vovk,
2008), over groups (`tacpipe.metrics.conformal`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from safetensors.numpy import save

from tacpipe.arrays import AnyArray, Bools, Floats
from tacpipe.channels import biotac_sp
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.metrics import conformal
from tacpipe.models.tensors import under
from tacpipe.tasks import calibrated
from tacpipe.tasks.touch.grasps import Grasps

FILE = "quantiles.safetensors"
LEVELS = "levels"
MODEL, CONSTANT, OBJECT_MEAN = "model", "constant", "object_mean"
Readings = Mapping[str, Floats]  # by target (grasp, value), device counts
Offsets = Mapping[str, Floats]  # by target (level, value), device counts


@dataclass(frozen=True)
class Uncertainty:
    """By how much quantiles lie beyond a prediction: of the model, of the constant and of the object's mean."""

    levels: Floats  # (level,), fractions in ascending order
    offsets: Mapping[str, Offsets]  # by predictor

    @property
    def percents(self) -> tuple[int, ...]:
        """The levels of the quantiles in percent, ascending."""
        return calibrated.percents(self.levels)

    def quantiles(self, predicted: Readings, predictor: str = MODEL) -> dict[str, Floats]:
        """Return quantiles by target (grasp, value, level), device counts, of what a predictor predicts."""
        offsets = self.offsets[predictor]
        return {target: values[..., None] + offsets[target].T for target, values in predicted.items()}

    @classmethod
    def fit(
        cls, levels: Floats, training: Grasps, calibration: Grasps, predicted: Readings, *, promised: bool = False
    ) -> Self:
        """Return quantiles of the errors of what a model ``predicted`` for the grasps of ``calibration``.

        Those of the constant and of the object's mean, the baselines, are empirical ones of ``training``. Raises
        `TacpipeError` with too few calibration grasps to promise the levels.
        """
        own, constant, objects = {}, {}, {}
        for target, values in predicted.items():
            known = training.readings[target]
            unit = np.maximum(known.std(axis=0), 1.0)  # a count
            errors = (calibration.readings[target] - values) / unit
            own[target] = _quantiles(errors, levels, promised)[:, None] * unit
            constant[target] = np.quantile(known - known.mean(axis=0), levels, axis=0)
            objects[target] = np.quantile(_about_objects(known, training.objects), levels, axis=0)
        return cls(levels, {MODEL: own, CONSTANT: constant, OBJECT_MEAN: objects})

    def to_bytes(self) -> bytes:
        """Return a file that `load` reads."""
        tensors: dict[str, AnyArray] = {LEVELS: self.levels}
        for predictor, offsets in self.offsets.items():
            tensors |= {f"{predictor}.{target}": np.ascontiguousarray(one) for target, one in offsets.items()}
        return save(tensors)

    @classmethod
    def load(cls, content: bytes, targets: Sequence[str]) -> Self:
        """Return what `to_bytes` wrote. Raises `TacpipeError` for another file, `ValueError` where shapes do not fit."""
        found = model_files.arrays(content, FILE)
        offsets = {name: dict(under(f"{name}.", found)) for name in (MODEL, CONSTANT, OBJECT_MEAN)}
        for each in offsets.values():
            shapes = {target: each[target].shape for target in targets}
            if shapes != {target: (len(found[LEVELS]), biotac_sp.width(target)) for target in targets}:
                raise ValueError(f"the quantiles are of {shapes}")
        return cls(found[LEVELS], offsets)


def _quantiles(errors: Floats, levels: Floats, promised: bool) -> Floats:
    """Return the quantile (level,) of errors (grasp, value), each grasp weighing the same."""
    groups = np.repeat(np.arange(len(errors)), errors.shape[1])
    flat, middle = errors.ravel(), len(levels) // 2
    found = np.zeros(len(levels))
    for at, level in enumerate(levels):
        if not promised or at == middle:
            found[at] = conformal.quantile(flat, groups, float(level))
    if promised:
        away = np.abs(flat - found[middle])
        for low in range(middle):
            level = float(levels[-1 - low] - levels[low])
            far = conformal.quantile(away, groups, level, promised=True)
            if not np.isfinite(far):
                raise TacpipeError(
                    f"{len(errors)} calibration grasps can promise a band that holds "
                    f"{100 * conformal.most_promised(len(errors)):.0f} % at most, not {100 * level:.0f} %. Split with more "
                    f"of them (`tacpipe split --val`), give quantiles nearer to 50, or leave out --promise."
                )
            found[low], found[-1 - low] = found[middle] - far, found[middle] + far
    return found


def _about_objects(values: Floats, objects: Sequence[str]) -> Floats:
    """Return readings (grasp, value) less the mean of the grasps of the same object."""
    found = np.empty_like(values)
    names = np.array(objects)
    for name in set(objects):
        same: Bools = names == name
        found[same] = values[same] - values[same].mean(axis=0)
    return found
