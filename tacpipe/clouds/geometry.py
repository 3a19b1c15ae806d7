"""Compute hand-made features of an object about to be grasped, and scale clouds and grasps for networks.

All lengths are in metres and in the axes of the grasp (`tacpipe.clouds.grasp`), with the middle between the fingers as
origin: they do not change when object, grasp and wrist are moved together, and they keep the sizes and curvatures on
which contact depends, which scaling a cloud to a unit box throws away.

Quadrics are fitted by the method of Taubin (Estimation of planar curves, surfaces, and nonplanar space curves defined by
implicit equations, 1991): of all quadrics the one with the least sum of squared values, the mean squared gradient being one.

The three normalisations are those of the letter (Zapata-Impata et al., RA-L 2020, Table III), whose constants it does not
give in full. Here they come from the whole cloud, not from the points drawn of it, so that a cloud is scaled the same way
at each visit. Extremes of a turned cloud are those of its convex hull's corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Indices
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp, local_points, wrist_of

UNIT_M = 0.05  # unit of length of the coefficients, which gives them similar magnitudes
EPSILON = 1e-9  # added to the mean squared gradient, for points without information about a coefficient


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
    values, vectors = eigh(free, steep + EPSILON * np.eye(9), subset_by_index=(0, 0))
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
    zeros, ones = np.zeros(len(points)), np.ones(len(points))
    return [
        np.column_stack([2 * x, zeros, zeros, y, z, zeros, ones, zeros, zeros, zeros]),
        np.column_stack([zeros, 2 * y, zeros, x, zeros, z, zeros, ones, zeros, zeros]),
        np.column_stack([zeros, zeros, 2 * z, zeros, x, y, zeros, zeros, ones, zeros]),
    ]


QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
RADII_M = (0.015, 0.025, 0.04)  # radii of the patches about each contact: a fingertip's pad, and its surroundings
SLICE_M = 0.01  # half the thickness of the slice that the fingers close in
BINS = 10  # bins of that slice, from finger to finger
COLOUR_POINTS = 50  # points whose mean colour is that of a contact
MIN_PATCH_POINTS = 6  # points of a patch below which its shape is not stated
NEAR_M = 0.05  # about a contact, within which a quadric is fitted
MIN_FITTED_POINTS = 30  # points below which none is
AXES = ("approach", "closing", "third")
PAIRS = tuple(combinations_with_replacement(range(3), 2))
PAIR_NAMES = tuple(f"{AXES[first]}_{AXES[second]}" for first, second in PAIRS)


def features(cloud: Cloud, grasp: Grasp) -> dict[str, float]:
    """Return the features of a grasp on a cloud by name; those of colours only where the cloud has them.

    Lengths are metres, colours 0 to 255. The cloud must have two points or more.
    """
    points = local_points(cloud.points_m, grasp)  # (point, axis)
    values_by_name = {"opening_m": grasp.opening_m, "points": float(len(cloud))}
    values_by_name |= _extent(points)
    values_by_name |= _principal_axes(points)
    values_by_name |= _profile(points, grasp.opening_m)
    for name, place_m in (("g1", -grasp.opening_m / 2), ("g2", grasp.opening_m / 2)):
        away = np.linalg.norm(points - np.array([0.0, place_m, 0.0]), axis=1)  # (point,)
        for radius_m in RADII_M:
            values_by_name |= _patch(f"{name}_{radius_m * 1000:.0f}mm", points[away < radius_m], place_m, len(points))
        values_by_name |= _fitted(f"{name}_whole", points, place_m) | _fitted(
            f"{name}_near", points[away < NEAR_M], place_m
        )
        if cloud.colours is not None:
            nearest = np.argsort(away, kind="stable")[:COLOUR_POINTS]
            values_by_name |= _with_parts(f"{name}_colour", cloud.colours[nearest].mean(axis=0), "rgb")
    if cloud.colours is not None:
        values_by_name |= _colours(cloud.colours.astype(np.float64))
    return values_by_name


def place(grasp: Grasp) -> dict[str, float]:
    """Return where the grasp is and how it is turned in the frame of its cloud: these change when all is moved."""
    wrist = wrist_of(grasp)
    values_by_name = _with_parts("g1_m", grasp.g1_m, "xyz") | _with_parts("g2_m", grasp.g2_m, "xyz")
    return values_by_name | _with_parts("approach", wrist[:, 0], "xyz") | _with_parts("closing", wrist[:, 1], "xyz")


def table(
    clouds: Sequence[Cloud], grasps: Sequence[Grasp], *, coloured: bool, placed: bool = False
) -> tuple[Floats, tuple[str, ...]]:
    """Return the features of many grasps (grasp, feature) and their names.

    There must be one grasp or more. Without ``coloured`` those of colour are left out, else every cloud must have
    colours; with ``placed`` those of `place` are added.
    """
    rows = []
    for cloud, grasp in zip(clouds, grasps, strict=True):
        values_by_name = features(cloud if coloured else Cloud(cloud.points_m), grasp)
        rows.append(values_by_name | place(grasp) if placed else values_by_name)
    names = tuple(rows[0])
    return np.array([[row[name] for name in names] for row in rows]), names


def _with_parts(name: str, values: Sequence[float] | Floats, parts: Sequence[str]) -> dict[str, float]:
    return {f"{name}_{part}": float(value) for part, value in zip(parts, values, strict=True)}


def _extent(points: Floats) -> dict[str, float]:
    """Return where the object lies about the grasp: mean, bounds and quantiles along each axis."""
    low, high = points.min(axis=0), points.max(axis=0)
    values_by_name = _with_parts("mean_m", points.mean(axis=0), AXES)
    for name, values in (("low_m", low), ("high_m", high), ("extent_m", high - low)):
        values_by_name |= _with_parts(name, values, AXES)
    for share, values in zip(QUANTILES, np.quantile(points, QUANTILES, axis=0), strict=True):
        values_by_name |= _with_parts(f"quantile{share * 100:.0f}_m", values, AXES)
    return values_by_name


def _principal_axes(points: Floats) -> dict[str, float]:
    """Return the object's principal sizes, how its axes lie to the grasp, and where along the longest the grasp is.

    An axis has two ends and no sign, so that products of its components are given.
    """
    centre = points.mean(axis=0)
    variances, directions = np.linalg.eigh(np.cov(points.T))
    longest = directions[:, -1]
    along = (points - centre) @ longest
    length = max(float(np.ptp(along)), 1e-9)
    at = float(-centre @ longest)
    values_by_name = _with_parts("spread_m", np.sqrt(np.maximum(variances[::-1], 0)), ("first", "second", "third"))
    for name, axis in (("first_axis", longest), ("second_axis", directions[:, 1])):
        values_by_name |= _with_parts(name, [axis[first] * axis[second] for first, second in PAIRS], PAIR_NAMES)
    values_by_name |= {"length_m": length, "along_m": abs(at), "along": abs(at) / length}
    widths = [float(np.ptp(points @ directions[:, index])) for index in (1, 0)]
    return values_by_name | _with_parts("width_m", widths, ("second", "third"))


def _profile(points: Floats, opening_m: float) -> dict[str, float]:
    """Return the height of the slice between the fingers, from the first to the second, or 0 if nothing is seen."""
    inside = points[np.abs(points[:, 2]) < SLICE_M]
    bins = np.floor((inside[:, 1] / opening_m + 0.5) * BINS).astype(int)
    heights = [float(np.median(at)) if len(at := inside[bins == index, 0]) else 0.0 for index in range(BINS)]
    return _with_parts("profile_m", heights, [str(index) for index in range(BINS)])


def _patch(name: str, points: Floats, place_m: float, total: int) -> dict[str, float]:
    """Return the shape of the surface about a contact: how much of it is seen, its spreads, flatness and normal."""
    parts = (
        "share",
        "spread3_m",
        "spread2_m",
        "spread1_m",
        "flatness",
        *(f"normal_{axis}" for axis in AXES),
        "offset_m",
    )
    if len(points) < MIN_PATCH_POINTS:
        return _with_parts(name, np.zeros(len(parts)), parts)
    variances, directions = np.linalg.eigh(np.cov(points.T))
    variances = np.maximum(variances, 0)
    normal = _outwards(directions[:, 0], place_m)
    offset = (points.mean(axis=0) - (0.0, place_m, 0.0)) @ normal
    flatness = variances[0] / max(variances.sum(), 1e-18)
    return _with_parts(name, [len(points) / total, *np.sqrt(variances), flatness, *normal, offset], parts)


def _fitted(name: str, points: Floats, place_m: float) -> dict[str, float]:
    """Return how well a quadric fits the points, and which way it faces at a contact, whether that is seen or not."""
    parts = ("misfit_m", *(f"faces_{axis}" for axis in AXES))
    if len(points) < MIN_FITTED_POINTS:
        return _with_parts(name, np.zeros(len(parts)), parts)
    misfit_m, surface = fitted(points)
    normal = _outwards(surface.normal(np.array([0.0, place_m, 0.0])), place_m)
    return _with_parts(name, [misfit_m, *normal], parts)


def _outwards(normal: Floats, place_m: float) -> Floats:
    """Return a normal at a contact with the sign that points away from the object: up, and to the finger's side."""
    return normal if np.sign(place_m) * normal[1] - normal[0] > 0 else -normal


def _colours(colours: Floats) -> dict[str, float]:
    """Return mean, spread and quantiles of the colours, and of their shares, which shade leaves as they are."""
    proportions = colours / (colours.sum(axis=1, keepdims=True) + 1)
    values_by_name = _with_parts("colour_mean", colours.mean(axis=0), "rgb") | _with_parts(
        "colour_spread", colours.std(axis=0), "rgb"
    )
    for share, values in zip((10, 50, 90), np.quantile(colours, (0.1, 0.5, 0.9), axis=0), strict=True):
        values_by_name |= _with_parts(f"colour_quantile{share}", values, "rgb")
    return (
        values_by_name
        | _with_parts("share_mean", proportions.mean(axis=0), "rgb")
        | _with_parts("share_spread", proportions.std(axis=0), "rgb")
    )


NORMALISATIONS = ("none", "sphere", "minmax", "wrist")
MIN_EXTENT_M = 1e-6  # a cloud's extent along an axis counts as at least this, so that a flat one can be divided by it


@dataclass(frozen=True)
class Extent:
    """How far a cloud reaches."""

    corners_m: AnyFloats  # (corner, xyz), of the convex hull
    centroid_m: AnyFloats  # (xyz), mean of all points
    colours: AnyFloats | None  # (lowest and highest, rgb), 0 to 1, or None if the cloud has no colours

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
    scaled: AnyFloats = 2 * (points - low) / np.maximum(high - low, MIN_EXTENT_M) - 1
    return scaled


def sphere(points: AnyFloats, extent: Extent, rotation: AnyFloats) -> AnyFloats:
    """Return points (point, xyz), turned already, about the cloud's centroid and with its largest radius as unit."""
    radius = np.linalg.norm(extent.corners_m - extent.centroid_m, axis=1).max()  # a farthest point is a corner
    scaled: AnyFloats = (points - rotation @ extent.centroid_m) / max(radius, MIN_EXTENT_M)
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
