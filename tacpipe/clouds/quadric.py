"""A quadric through points: one formula for spheres, ellipsoids, cylinders and cones, also where the camera saw nothing.

Fitted by the method of Taubin (Estimation of planar curves, surfaces, and nonplanar space curves defined by implicit
equations, 1991): of all quadrics the one with the least sum of squared values, the mean squared gradient being one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Floats

UNIT_M = 0.05  # length in which coefficients are given, so that they are of one order
SMALLEST = 1e-9  # added to the mean squared gradient, for points that state nothing of a coefficient


@dataclass(frozen=True)
class Quadric:
    """a x² + b y² + c z² + d xy + e xz + f yz + g x + h y + i z + k = 0, about ``centre_m`` and in units of 50 mm."""

    coefficients: Floats  # (10,)
    centre_m: Floats  # (xyz), the mean of the points

    def normal(self, at_m: Floats) -> Floats:
        """Return the unit normal (xyz) of the level surface through a point (xyz): the gradient's direction."""
        slopes = _slopes((at_m - self.centre_m)[None] / UNIT_M)
        gradient: Floats = np.array([part[0] @ self.coefficients for part in slopes])
        return gradient / max(float(np.linalg.norm(gradient)), 1e-12)


def fitted(points_m: Floats) -> tuple[float, Quadric]:
    """Return how far points (point, xyz) lie from their quadric, root mean square in metres to first order, and it."""
    from scipy.linalg import eigh

    centre = points_m.mean(axis=0)
    points = (points_m - centre) / UNIT_M
    terms = _terms(points)  # (point, coefficient)
    moments = terms.T @ terms / len(points)
    steep = np.sum([part.T @ part for part in _slopes(points)], axis=0)[:9, :9] / len(points)
    free = moments[:9, :9] - np.outer(moments[:9, 9], moments[9, :9])  # the constant makes the mean value zero
    values, vectors = eigh(free, steep + SMALLEST * np.eye(9), subset_by_index=(0, 0))
    first = vectors[:, 0]
    misfit = float(np.sqrt(max(values[0], 0.0)))
    return misfit * UNIT_M, Quadric(np.append(first, -moments[9, :9] @ first), centre)


def _terms(points: Floats) -> Floats:
    """Return what the coefficients are multiplied by, (point, coefficient)."""
    x, y, z = points.T
    return np.column_stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z, np.ones(len(points))])


def _slopes(points: Floats) -> list[Floats]:
    """Return the derivatives of the terms along x, y and z, each (point, coefficient)."""
    x, y, z = points.T
    none, one = np.zeros(len(points)), np.ones(len(points))
    return [
        np.column_stack([2 * x, none, none, y, z, none, one, none, none, none]),
        np.column_stack([none, 2 * y, none, x, none, z, none, one, none, none]),
        np.column_stack([none, none, 2 * z, none, x, y, none, none, one, none]),
    ]
