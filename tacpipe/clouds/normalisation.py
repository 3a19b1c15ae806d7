"""How clouds and grasps are scaled before a network reads them, and turned to make more of few.

The three normalisations are those of the letter (Zapata-Impata et al., RA-L 2020, Table III), whose constants it does not
give in full. Here they come from the whole cloud, not from the points drawn of it, so that a cloud is scaled the same way
at each visit; grasp points are scaled with it. Extremes of a turned cloud are those of its convex hull's corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats, Indices
from tacpipe.clouds.cloud import Cloud

NORMALISATIONS = ("none", "sphere", "minmax", "wrist")
SMALLEST_M = 1e-6  # a cloud's extent along an axis counts as at least this, so that a flat one can be divided by it


@dataclass(frozen=True)
class Extent:
    """How far a cloud reaches."""

    corners_m: AnyFloats  # (corner, xyz), of the convex hull
    centroid_m: AnyFloats  # (xyz), mean of all points
    colours: AnyFloats | None  # (lowest and highest, rgb), 0 to 1; None where the cloud has no colours

    @classmethod
    def of(cls, cloud: Cloud) -> Extent:
        """Return the extent of a cloud."""
        points = cloud.points_m.astype(np.float64)
        colours = None
        if cloud.colours is not None:
            colours = np.stack([cloud.colours.min(axis=0), cloud.colours.max(axis=0)]) / 255.0
        return cls(points[_corners(points)], points.mean(axis=0), colours)


def _corners(points_m: AnyFloats) -> Indices:
    """Return which points are the corners of the convex hull; all of them where they lie in one plane."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        vertices: Indices = ConvexHull(points_m).vertices
    except QhullError:
        return np.arange(len(points_m))
    return vertices


def minmax(points: AnyFloats, extent: Extent, rotation: AnyFloats) -> AnyFloats:
    """Return points (point, xyz), turned already, so that the cloud fills -1 to 1 along each axis.

    Sizes and proportions are lost: that is what the letter does, and why a turn before it distorts.
    """
    corners = extent.corners_m @ rotation.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    scaled: AnyFloats = 2 * (points - low) / np.maximum(high - low, SMALLEST_M) - 1
    return scaled


def sphere(points: AnyFloats, extent: Extent, rotation: AnyFloats) -> AnyFloats:
    """Return points (point, xyz), turned already, about the cloud's centroid and with its largest radius as unit."""
    radius = np.linalg.norm(extent.corners_m - extent.centroid_m, axis=1).max()  # a farthest point is a corner
    scaled: AnyFloats = (points - rotation @ extent.centroid_m) / max(radius, SMALLEST_M)
    return scaled


def to_wrist(points: AnyFloats, wrist: AnyFloats) -> AnyFloats:
    """Return points (point, xyz) in the axes of the wrist (component, axis), whose place is not taken off: R^T p."""
    return points @ wrist


def normalised(
    method: str, points: AnyFloats, extent: Extent, rotation: AnyFloats, wrist: AnyFloats | None
) -> AnyFloats:
    """Return points (point, xyz), turned by ``rotation`` (3, 3) already, normalised by one of `NORMALISATIONS`.

    ``wrist`` (component, axis) is turned already too; only ``wrist`` needs it.
    """
    if method == "minmax":
        return minmax(points, extent, rotation)
    if method == "sphere":
        return sphere(points, extent, rotation)
    if method == "wrist":
        assert wrist is not None
        return to_wrist(points, wrist)
    return points


def colours_normalised(method: str, colours: AnyFloats, extent: Extent) -> AnyFloats:
    """Return colours (point, rgb) of 0 to 1: to -1 to 1 by the cloud's extremes (minmax) or by black and white (wrist)."""
    if method == "minmax":
        assert extent.colours is not None
        low, high = extent.colours
        scaled: AnyFloats = 2 * (colours - low) / np.maximum(high - low, 1 / 255) - 1
        return scaled
    if method == "wrist":
        return 2 * colours - 1
    return colours


def random_rotation(rng: np.random.Generator, largest_deg: float) -> AnyFloats:
    """Return a rotation (3, 3) about x, y and z in turn, by angles drawn evenly from ±``largest_deg``."""
    from scipy.spatial.transform import Rotation

    if not largest_deg:
        return np.eye(3)
    rotation: AnyFloats = Rotation.from_euler(
        "xyz", rng.uniform(-largest_deg, largest_deg, 3), degrees=True
    ).as_matrix()
    return rotation
