"""Compute hand-crafted features of an object before a grasp, and scale clouds and grasps for networks.

All lengths are in metres and in the axes of the grasp (`tacpipe.clouds.grasp`), with the middle between the fingers as
origin. So they are invariant to moving object, grasp and wrist together, and they keep the sizes and curvatures that
contact depends on, which scaling a cloud to a unit box discards.

Quadrics are fitted by the method of Taubin (Estimation of planar curves, surfaces, and nonplanar space curves defined
by implicit equations, 1991), which minimises the sum of squared values subject to a mean squared gradient of one.

The three normalisations are those of the letter (Zapata-Impata et al., RA-L 2020, Table III), which does not state all
constants. Here they are computed from the full cloud, not from the sampled points, so that a cloud is scaled the same
way at each visit. Extremes of a rotated cloud are those of the corners of its convex hull.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Indices
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp, local_points, wrist_axes

UNIT_M = 0.05  # unit of length of the coefficients, chosen so that they have similar magnitudes
EPSILON = 1e-9  # added to the mean squared gradient, for points without information about a coefficient


@dataclass(frozen=True)
class Quadric:
    """a x² + b y² + c z² + d xy + e xz + f yz + g x + h y + i z + k = 0, about ``centre_m`` and in units of 50 mm."""

    coefficients: Floats  # (10,)
    centre_m: Floats  # (xyz), the mean of the points

    def normal(self, at_m: Floats) -> Floats:
        """Return the unit normal (xyz) of the level surface through a point (xyz), which is the gradient's direction."""
        slopes = _slopes((at_m - self.centre_m)[None] / UNIT_M)
        gradient: Floats = np.array([part[0] @ self.coefficients for part in slopes])
        return gradient / max(float(np.linalg.norm(gradient)), 1e-12)


def fit_quadric(points_m: Floats) -> tuple[float, Quadric]:
    """Return the quadric that fits points (point, xyz) best, after their RMS distance from it in metres."""
    from scipy.linalg import eigh

    centre = points_m.mean(axis=0)
    points = (points_m - centre) / UNIT_M
    terms = _terms(points)  # (point, coefficient)
    moments = terms.T @ terms / len(points)
    gradients = np.sum([part.T @ part for part in _slopes(points)], axis=0)[:9, :9] / len(points)
    variances = moments[:9, :9] - np.outer(moments[:9, 9], moments[9, :9])  # the constant makes the mean value zero
    values, vectors = eigh(variances, gradients + EPSILON * np.eye(9), subset_by_index=(0, 0))
    coefficients = vectors[:, 0]
    rms = float(np.sqrt(max(values[0], 0.0)))
    return rms * UNIT_M, Quadric(np.append(coefficients, -moments[9, :9] @ coefficients), centre)


def _terms(points: Floats) -> Floats:
    """Return the monomials of the coefficients, (point, coefficient)."""
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
RADII_M = (0.015, 0.025, 0.04)  # radii of the patches around each contact: a fingertip's pad, and its surroundings
SLICE_M = 0.01  # half the thickness of the slice between the fingers
BINS = 10  # number of bins of that slice, from finger to finger
COLOUR_POINTS = 50  # number of points whose mean colour is a contact's colour
MIN_PATCH_POINTS = 6  # a patch with fewer points has features of 0
NEAR_M = 0.05  # radius around a contact in which a quadric is fitted
MIN_FITTED_POINTS = 30  # minimum number of points for fitting a quadric
AXES = ("approach", "closing", "third")
PAIRS = tuple(combinations_with_replacement(range(3), 2))
PAIR_NAMES = tuple(f"{AXES[first]}_{AXES[second]}" for first, second in PAIRS)


def features(cloud: Cloud, grasp: Grasp) -> dict[str, float]:
    """Return the features of a grasp on a cloud by name; colour features only if the cloud has colours.

    Lengths are in metres, colours 0 to 255. The cloud must have at least two points.
    """
    points = local_points(cloud.points_m, grasp)  # (point, axis)
    features = {"opening_m": grasp.opening_m, "points": float(len(cloud))}
    features |= _extent(points)
    features |= _principal_axes(points)
    features |= _profile(points, grasp.opening_m)
    for name, contact_m in (("g1", -grasp.opening_m / 2), ("g2", grasp.opening_m / 2)):
        distances = np.linalg.norm(points - np.array([0.0, contact_m, 0.0]), axis=1)  # (point,)
        for radius_m in RADII_M:
            features |= _patch(f"{name}_{radius_m * 1000:.0f}mm", points[distances < radius_m], contact_m, len(points))
        features |= _quadric_features(f"{name}_whole", points, contact_m) | _quadric_features(
            f"{name}_near", points[distances < NEAR_M], contact_m
        )
        if cloud.colours is not None:
            nearest = np.argsort(distances, kind="stable")[:COLOUR_POINTS]
            features |= _named_components(f"{name}_colour", cloud.colours[nearest].mean(axis=0), "rgb")
    if cloud.colours is not None:
        features |= _colours(cloud.colours.astype(np.float64))
    return features


def pose_features(grasp: Grasp) -> dict[str, float]:
    """Return the position and orientation of the grasp in the frame of its cloud, which depend on where the object is."""
    wrist = wrist_axes(grasp)
    features = _named_components("g1_m", grasp.g1_m, "xyz") | _named_components("g2_m", grasp.g2_m, "xyz")
    return (
        features | _named_components("approach", wrist[:, 0], "xyz") | _named_components("closing", wrist[:, 1], "xyz")
    )


def feature_table(
    clouds: Sequence[Cloud], grasps: Sequence[Grasp], *, coloured: bool, placed: bool = False
) -> tuple[Floats, tuple[str, ...]]:
    """Return the features of one or more grasps (grasp, feature) and their names.

    Without ``coloured``, colour features are omitted; with it, every cloud must have colours. ``placed`` adds
    `pose_features`.
    """
    rows = []
    for cloud, grasp in zip(clouds, grasps, strict=True):
        grasp_features = features(cloud if coloured else Cloud(cloud.points_m), grasp)
        rows.append(grasp_features | pose_features(grasp) if placed else grasp_features)
    names = tuple(rows[0])
    return np.array([[row[name] for name in names] for row in rows]), names


def _named_components(name: str, values: Sequence[float] | Floats, parts: Sequence[str]) -> dict[str, float]:
    return {f"{name}_{part}": float(value) for part, value in zip(parts, values, strict=True)}


def _extent(points: Floats) -> dict[str, float]:
    """Return the object's extent relative to the grasp: mean, bounds and quantiles along each axis."""
    low, high = points.min(axis=0), points.max(axis=0)
    features = _named_components("mean_m", points.mean(axis=0), AXES)
    for name, values in (("low_m", low), ("high_m", high), ("extent_m", high - low)):
        features |= _named_components(name, values, AXES)
    for share, values in zip(QUANTILES, np.quantile(points, QUANTILES, axis=0), strict=True):
        features |= _named_components(f"quantile{share * 100:.0f}_m", values, AXES)
    return features


def _principal_axes(points: Floats) -> dict[str, float]:
    """Return the object's principal sizes and axes relative to the grasp, and the grasp's position along the longest axis.

    Axes have no sign, so products of their components are returned.
    """
    centre = points.mean(axis=0)
    variances, directions = np.linalg.eigh(np.cov(points.T))
    longest = directions[:, -1]
    along = (points - centre) @ longest
    length = max(float(np.ptp(along)), 1e-9)
    position = float(-centre @ longest)
    features = _named_components("spread_m", np.sqrt(np.maximum(variances[::-1], 0)), ("first", "second", "third"))
    for name, axis in (("first_axis", longest), ("second_axis", directions[:, 1])):
        features |= _named_components(name, [axis[first] * axis[second] for first, second in PAIRS], PAIR_NAMES)
    features |= {"length_m": length, "along_m": abs(position), "along": abs(position) / length}
    widths = [float(np.ptp(points @ directions[:, index])) for index in (1, 0)]
    return features | _named_components("width_m", widths, ("second", "third"))


def _profile(points: Floats, opening_m: float) -> dict[str, float]:
    """Return the height profile of the slice between the fingers, from the first to the second; 0 in bins without points."""
    inside = points[np.abs(points[:, 2]) < SLICE_M]
    bins = np.floor((inside[:, 1] / opening_m + 0.5) * BINS).astype(int)
    profile = [float(np.median(heights)) if len(heights := inside[bins == index, 0]) else 0.0 for index in range(BINS)]
    return _named_components("profile_m", profile, [str(index) for index in range(BINS)])


def _patch(name: str, points: Floats, contact_m: float, total: int) -> dict[str, float]:
    """Return the shape of the surface around a contact: the fraction that is visible, its spreads, flatness and normal."""
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
        return _named_components(name, np.zeros(len(parts)), parts)
    variances, directions = np.linalg.eigh(np.cov(points.T))
    variances = np.maximum(variances, 0)
    normal = _outward_normal(directions[:, 0], contact_m)
    offset = (points.mean(axis=0) - (0.0, contact_m, 0.0)) @ normal
    flatness = variances[0] / max(variances.sum(), 1e-18)
    return _named_components(name, [len(points) / total, *np.sqrt(variances), flatness, *normal, offset], parts)


def _quadric_features(name: str, points: Floats, contact_m: float) -> dict[str, float]:
    """Return the misfit of a quadric to the points, and its normal at a contact, which may be on a hidden side."""
    parts = ("misfit_m", *(f"faces_{axis}" for axis in AXES))
    if len(points) < MIN_FITTED_POINTS:
        return _named_components(name, np.zeros(len(parts)), parts)
    misfit_m, surface = fit_quadric(points)
    normal = _outward_normal(surface.normal(np.array([0.0, contact_m, 0.0])), contact_m)
    return _named_components(name, [misfit_m, *normal], parts)


def _outward_normal(normal: Floats, contact_m: float) -> Floats:
    """Return the normal (xyz,) at a contact with the sign for which it points away from the object.

    In the grasp's axes, x points down and y is the closing axis, on which the finger touches at ``contact_m``. So an
    outward normal has a negative x, or a y with the sign of ``contact_m``, whichever is larger.
    """
    return normal if np.sign(contact_m) * normal[1] - normal[0] > 0 else -normal


def _colours(colours: Floats) -> dict[str, float]:
    """Return mean, spread and quantiles of the colours, and mean and spread of their proportions, which ignore shading."""
    proportions = colours / (colours.sum(axis=1, keepdims=True) + 1)
    features = _named_components("colour_mean", colours.mean(axis=0), "rgb") | _named_components(
        "colour_spread", colours.std(axis=0), "rgb"
    )
    for share, values in zip((10, 50, 90), np.quantile(colours, (0.1, 0.5, 0.9), axis=0), strict=True):
        features |= _named_components(f"colour_quantile{share}", values, "rgb")
    return (
        features
        | _named_components("share_mean", proportions.mean(axis=0), "rgb")
        | _named_components("share_spread", proportions.std(axis=0), "rgb")
    )


NORMALISATIONS = ("none", "sphere", "minmax", "wrist")
MIN_EXTENT_M = 1e-6  # minimum extent of a cloud along an axis, so that a flat cloud can be scaled


@dataclass(frozen=True)
class Extent:
    """The extent of a cloud."""

    corners_m: AnyFloats  # (corner, xyz), corners of the convex hull
    centroid_m: AnyFloats  # (xyz), mean of all points
    colours: AnyFloats | None  # (lowest and highest, rgb), 0 to 1, or None if the cloud has no colours

    @classmethod
    def from_cloud(cls, cloud: Cloud) -> Extent:
        """Return the extent of a cloud, which is independent of its rotation."""
        points = cloud.points_m.astype(np.float64)
        colours = None
        if cloud.colours is not None:
            colours = np.stack([cloud.colours.min(axis=0), cloud.colours.max(axis=0)]) / 255.0
        return cls(points[_corners(points)], points.mean(axis=0), colours)


def _corners(points_m: AnyFloats) -> Indices:
    """Return the indices of the corners of the convex hull of points (point, xyz); all indices if they are in one plane."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        vertices: Indices = ConvexHull(points_m).vertices
    except QhullError:
        return np.arange(len(points_m))
    return vertices


def minmax(points: AnyFloats, extent: Extent, rotation: AnyFloats) -> AnyFloats:
    """Return points (point, xyz), already rotated by ``rotation`` (3, 3), such that the cloud fills -1 to 1 on each axis.

    This discards sizes and proportions, as the letter does, and distorts a cloud that was rotated before.
    """
    corners = extent.corners_m @ rotation.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    scaled: AnyFloats = 2 * (points - low) / np.maximum(high - low, MIN_EXTENT_M) - 1
    return scaled


def sphere(points: AnyFloats, extent: Extent, rotation: AnyFloats) -> AnyFloats:
    """Centre rotated points (point, xyz) on the cloud's centroid and divide them by its largest radius."""
    radius = np.linalg.norm(extent.corners_m - extent.centroid_m, axis=1).max()  # the farthest point is a corner
    scaled: AnyFloats = (points - rotation @ extent.centroid_m) / max(radius, MIN_EXTENT_M)
    return scaled


def to_wrist(points: AnyFloats, wrist: AnyFloats) -> AnyFloats:
    """Rotate points (point, xyz) into the axes of the wrist (component, axis), R^T p, without subtracting its position."""
    return points @ wrist


def normalise(
    method: str, points: AnyFloats, extent: Extent, rotation: AnyFloats, wrist: AnyFloats | None
) -> AnyFloats:
    """Return points (point, xyz), already rotated by ``rotation`` (3, 3), normalised by one of `NORMALISATIONS`.

    ``wrist`` (component, axis), also rotated, is needed for the method ``wrist`` only.
    """
    if method == "minmax":
        return minmax(points, extent, rotation)
    if method == "sphere":
        return sphere(points, extent, rotation)
    if method == "wrist":
        assert wrist is not None
        return to_wrist(points, wrist)
    return points


def normalise_colours(method: str, colours: AnyFloats, extent: Extent) -> AnyFloats:
    """Return colours (point, rgb) scaled to -1..1: by their extremes (minmax), by black and white (wrist), or not."""
    if method == "minmax":
        assert extent.colours is not None
        low, high = extent.colours
        scaled: AnyFloats = 2 * (colours - low) / np.maximum(high - low, 1 / 255) - 1
        return scaled
    if method == "wrist":
        return 2 * colours - 1
    return colours


def random_rotation(rng: np.random.Generator, largest_deg: float) -> AnyFloats:
    """Return a rotation (3, 3) about x, y and z in turn, by angles drawn uniformly from ±``largest_deg``."""
    from scipy.spatial.transform import Rotation

    if not largest_deg:
        return np.eye(3)
    rotation: AnyFloats = Rotation.from_euler(
        "xyz", rng.uniform(-largest_deg, largest_deg, 3), degrees=True
    ).as_matrix()
    return rotation
