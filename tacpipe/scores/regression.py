"""Compute errors of predicted values, the skill over a baseline, and its interval.

Values are (grasp, value): one for a pressure, 24 for electrodes. An error is global: over all grasps and values at
once. Published figures are often means over batches instead, which are never larger and depend on the batches
(`batch_mean_rmse`).
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats
from tacpipe.errors import TacpipeError
from tacpipe.scores import intervals
from tacpipe.scores.intervals import Estimate

BATCH = 10  # grasps per batch whose RMSE the letter (RA-L 2020) averages


def squared_sums(true: AnyFloats, predicted: AnyFloats) -> AnyFloats:
    """Return the squared error of each grasp, summed over values: (grasp, value) to (grasp,).

    Raises `TacpipeError` if the shapes differ.
    """
    error = _error(true, predicted)
    total: AnyFloats = np.einsum("gv,gv->g", error, error)
    return total


def rmse(true: AnyFloats, predicted: AnyFloats) -> float:
    """Return the root mean squared error over all grasps and values; NaN if there are none."""
    return _root_mean_square(_error(true, predicted))


def batch_mean_rmse(true: AnyFloats, predicted: AnyFloats, batch: int = BATCH) -> float:
    """Return the mean RMSE of successive batches of grasps, the last of which may be smaller; NaN if there are no grasps.

    It is at most `rmse` if batches have equal sizes (Jensen), which is why both are reported. Raises `TacpipeError` if
    ``batch`` is below 1.
    """
    if batch < 1:
        raise TacpipeError(f"The batch size is {batch}; it must be 1 or more.")
    error = _error(true, predicted)
    if not error.size:
        return float("nan")
    return float(np.mean([_root_mean_square(error[first : first + batch]) for first in range(0, len(error), batch)]))


def mae(true: AnyFloats, predicted: AnyFloats) -> float:
    """Return the mean absolute error over all grasps and values; NaN if there are none."""
    error = _error(true, predicted)
    return float(np.abs(error).mean()) if error.size else float("nan")


def r2(true: AnyFloats, predicted: AnyFloats) -> float:
    """Return the explained fraction of the variance of ``true`` (row, value), summed over values; NaN if nothing varies.

    1 is perfect, and 0 is as good as predicting the mean of each value. That mean is unknown in advance, so a constant
    that was fitted to other rows has a score below 0.
    """
    error, spread = _sums_by_value(true, predicted)
    return _explained_fraction(error.sum(), spread.sum())


def r2_by_value(true: AnyFloats, predicted: AnyFloats) -> AnyFloats:
    """Return `r2` of each value separately, (grasp, value) to (value,)."""
    return np.array([_explained_fraction(*pair) for pair in zip(*_sums_by_value(true, predicted), strict=True)])


def rmse_by_value(true: AnyFloats, predicted: AnyFloats) -> AnyFloats:
    """Return `rmse` of each value separately, (grasp, value) to (value,)."""
    error = _error(true, predicted)
    return np.array([_root_mean_square(column) for column in error.T])


def skill_interval(model: AnyFloats, baseline: AnyFloats, clusters: AnyArray) -> Estimate:
    """Return 1 - RMSE / RMSE of a baseline with its 95 % interval, from `squared_sums` of both, each (grasp,).

    ``clusters`` (grasp,) groups dependent grasps: those of an object if predictions are for new objects, or a grasp in
    several runs if objects are known. Raises `TacpipeError` if lengths differ.
    """
    if not len(model) == len(baseline) == len(clusters):
        raise TacpipeError(
            f"There are errors of {len(model)} and {len(baseline)} grasps and clusters of {len(clusters)}; give all three "
            f"for the same grasps."
        )
    return intervals.skill_interval(model[:, None], baseline[:, None], clusters, power=0.5).first


def _error(true: AnyFloats, predicted: AnyFloats) -> AnyFloats:
    """Return predicted minus true values (grasp, value) as float64. Raises `TacpipeError` for other shapes."""
    if np.ndim(true) != 2 or np.shape(true) != np.shape(predicted):
        raise TacpipeError(
            f"True values of the shape {np.shape(true)} and predicted ones of {np.shape(predicted)} cannot be compared; "
            f"both must be (grasp, value)."
        )
    return np.asarray(predicted, np.float64) - np.asarray(true, np.float64)


def _root_mean_square(error: AnyFloats) -> float:
    return float(np.sqrt(np.mean(np.square(error)))) if error.size else float("nan")


def _sums_by_value(true: AnyFloats, predicted: AnyFloats) -> tuple[AnyFloats, AnyFloats]:
    """Return the sums of squared errors and of squared deviations from the mean of each value, both (value,)."""
    error = _error(true, predicted)
    if not len(error):
        return np.zeros(error.shape[1]), np.zeros(error.shape[1])
    values = np.asarray(true, np.float64)
    return np.square(error).sum(axis=0), np.square(values - values.mean(axis=0)).sum(axis=0)


def _explained_fraction(error: float, spread: float) -> float:
    return float(1 - error / spread) if spread > 0 else float("nan")


def squared_error_sums(predicted: AnyFloats, truth: AnyFloats) -> AnyFloats:
    """Return the squared error summed over windows: (window, step, channel) to (step, channel), as float64."""
    error = predicted.astype(np.float64) - truth
    total: AnyFloats = np.einsum("wsc,wsc->sc", error, error)
    return total


def absolute_error_sums(predicted: AnyFloats, truth: AnyFloats) -> AnyFloats:
    """Return the absolute error summed over windows: (window, step, channel) to (step, channel), as float64."""
    total: AnyFloats = np.abs(predicted.astype(np.float64) - truth).sum(axis=0)
    return total
