"""Rotations as unit quaternions in the order x, y, z, w."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def continuous(quaternions: Floats) -> Floats:
    """Return ``quaternions`` (time, 4) at unit length, each with the sign that lies nearer to the one before.

    q and -q are the same rotation; a recorded series may jump between them. The first keeps its sign. Rows of NaN stay.

    >>> continuous(np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, -2.0]])).tolist()
    [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
    """
    unit: Floats = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    signs = np.ones(len(unit))  # (time,)
    signs[1:] = np.where((unit[1:] * unit[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    unit *= np.cumprod(signs)[:, None]
    return unit + 0.0  # -0.0 becomes 0.0, so that equal rotations have equal bytes


def quaternions_of(matrices: Floats) -> Floats:
    """Return the unit quaternions (time, 4) of rotation matrices (time, 3, 3), w not negative.

    Of the four ways to take the square root that with the largest pivot is used, which never divides by a small number
    (Shepperd, "Quaternion from rotation matrix", 1978).
    """
    m = matrices
    trace = np.trace(m, axis1=1, axis2=2)  # (time,)
    diagonal = np.diagonal(m, axis1=1, axis2=2)  # (time, axis)
    pivots = np.column_stack([diagonal, trace])  # (time, 4): which of x, y, z, w is largest
    x, y, z = (2 * diagonal[:, axis] - trace + 1 for axis in range(3))
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    xw, yw, zw = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    rows = np.stack(  # (time, pivot, 4): each row is the quaternion times four of its component at the pivot
        [
            np.stack([x, xy, xz, xw], axis=1),
            np.stack([xy, y, yz, yw], axis=1),
            np.stack([xz, yz, z, zw], axis=1),
            np.stack([xw, yw, zw, 1 + trace], axis=1),
        ],
        axis=1,
    )
    chosen = rows[np.arange(len(m)), pivots.argmax(axis=1)]  # (time, 4)
    unit: Floats = chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
    return np.where(unit[:, 3:] < 0, -unit, unit)
