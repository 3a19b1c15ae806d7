"""Weights of several forecasts of change, fitted on recordings that none of them was fitted on.

No change, which is persistence, is among what is blended: its weight is what the others leave of 1. So on the recordings
that weights are fitted on no blend is worse than persistence, and forecasts that mean nothing there get no weight.
"""

from __future__ import annotations

import itertools

import numpy as np

from tacpipe.arrays import AnyFloats, Floats

PARTS = 20  # of the whole; weights are multiples of a twentieth


def weights(changes: AnyFloats, truth: AnyFloats, *, parts: int = PARTS) -> Floats:
    """Return the weight of each forecast (forecast,), 0 or more and together at most 1, of the least mean absolute error.

    ``changes`` (forecast, value) are forecasts of the change ``truth`` (value,). Of equal errors the one with the least
    weights is returned, so without values all are 0.

    >>> weights(np.array([[2.0, -2.0], [9.0, 9.0]]), np.array([1.0, -1.0]))
    array([0.5, 0. ])
    """
    best, lowest = np.zeros(len(changes)), float(np.abs(truth).sum())
    wholes = [one for one in itertools.product(range(parts + 1), repeat=len(changes)) if sum(one) <= parts]
    for one in sorted(wholes, key=sum):
        weight = np.array(one) / parts
        error = float(np.abs(truth - weight.astype(changes.dtype) @ changes).sum())
        if error < lowest * (1 - 1e-9):
            best, lowest = weight, error
    return best
