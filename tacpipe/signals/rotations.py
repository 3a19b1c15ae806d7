"""Rotations as unit quaternions in the order x, y, z, w."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import Floats

UPRIGHT = 1e-12  # largest distance of the sine of a right angle from 1


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


def matrices_of(quaternions: Floats) -> Floats:
    """Return the rotation matrices (time, 3, 3) of unit quaternions (time, 4)."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def quaternions_of_vectors(vectors_rad: Floats) -> Floats:
    """Return the unit quaternions (time, 4) of rotation vectors (time, 3): the axis, as long as the angle in rad."""
    half = np.linalg.norm(vectors_rad, axis=1, keepdims=True) / 2
    shrink = np.sinc(half / np.pi) / 2  # sin(half) / angle, 1/2 where nothing is turned
    return np.hstack([vectors_rad * shrink, np.cos(half)])


def vectors_of(quaternions: Floats) -> Floats:
    """Return the rotation vectors (time, 3) of unit quaternions (time, 4), of half a turn at most."""
    signed = np.where(quaternions[:, 3:] < 0, -quaternions, quaternions)
    sine = np.linalg.norm(signed[:, :3], axis=1, keepdims=True)
    half = np.arctan2(sine, signed[:, 3:])
    vectors: Floats = signed[:, :3] * 2 / np.sinc(half / np.pi)
    return vectors


def quaternions_of_angles(angles_rad: Floats) -> Floats:
    """Return the unit quaternions (time, 4) of turns (time, 3) about z, then the new y, then the new x; rad.

    These are the angles A, B and C of KUKA.
    """
    (cz, cy, cx), (sz, sy, sx) = np.cos(angles_rad.T / 2), np.sin(angles_rad.T / 2)
    return np.column_stack(
        [
            sx * cy * cz - cx * sy * sz,
            cx * sy * cz + sx * cy * sz,
            cx * cy * sz - sx * sy * cz,
            cx * cy * cz + sx * sy * sz,
        ]
    )


def angles_of(quaternions: Floats) -> Floats:
    """Return the turns (time, 3) about z, the new y and the new x of unit quaternions (time, 4); rad.

    Where the new x points along z, the first and the last turn are about one axis; the last is 0 then.
    """
    x, y, z, w = quaternions.T
    sine = np.clip(2 * (w * y - z * x), -1, 1)
    upright = np.abs(sine) > 1 - UPRIGHT
    about_z = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    about_x = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    about_z = np.where(upright, -2 * np.sign(sine) * np.arctan2(x, w), about_z)
    return np.column_stack([about_z, np.arcsin(sine), np.where(upright, 0.0, about_x)])
