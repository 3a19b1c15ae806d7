"""How wrong a forecast is: sums of errors over the windows of each recording."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyFloats, Ints


def squared_sums(predicted: AnyFloats, truth: AnyFloats) -> AnyFloats:
    """Return the sum over windows of the squared error, (window, step, channel) to (step, channel), as float64."""
    error = predicted.astype(np.float64) - truth
    total: AnyFloats = np.einsum("wsc,wsc->sc", error, error)
    return total


def absolute_sums(predicted: AnyFloats, truth: AnyFloats) -> AnyFloats:
    """Return the sum over windows of the absolute error, (window, step, channel) to (step, channel), as float64."""
    total: AnyFloats = np.abs(predicted.astype(np.float64) - truth).sum(axis=0)
    return total


def mean_error(sums: AnyFloats, windows: Ints) -> AnyFloats:
    """Return the error of each step, averaged over all windows and channels, shape (step,).

    ``sums`` is (recording, step, channel) as summed above, ``windows`` is (recording,). NaN without windows.
    """
    count = windows.sum() * sums.shape[2]
    total: AnyFloats = sums.sum(axis=(0, 2))
    return total / count if count else np.full(sums.shape[1], np.nan)
