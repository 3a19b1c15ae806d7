"""The object of a grasp, derived from its table and the things next to it in a view of the camera.

What lies in front of the table's plane falls into clusters, and the object is the one that is nearest to the grasp. The
plane is found by random samples (Fischler and Bolles, "Random Sample Consensus", 1981), clusters by density (Ester et al.,
"A Density-Based Algorithm for Discovering Clusters", 1996), both through open3d; a seed gives the same again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import Floats, Indices, Int64s
from tacpipe.clouds.cloud import Cloud, open3d
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError

PLANES = 4  # the largest ones, among which the table is looked for: a floor, walls and sides of boxes may be larger
MAX_EXTENT_M = 0.4  # largest extent of an object along any axis; published objects have at most 0.28 m
MAX_HEIGHT_M = 0.1  # largest height of an object above the middle of a grasp: a hand cannot lift 20 cm like that
NOISES = 3.0  # standard deviations of the table's points about its plane, beyond which a point lies in front of it
SAMPLED = 10_000  # points that state a plane as well as all of a view do


@dataclass(frozen=True)
class SegmentationLimits:
    """Limits of the table, of one object, and of the grasped object."""

    plane_m: float  # largest distance of a point from its plane, larger where points spread more
    plane_fraction: float  # least fraction of all points on the table
    plane_trials: int  # random samples for each plane
    cluster_m: float  # largest distance between neighbours in one object
    cluster_points: int  # least number of points that near, itself included, for a point inside an object
    object_points: int  # least number of points of an object
    near_m: float  # largest distance of the object from the grasp
    outlier_neighbours: int  # number of neighbours whose mean distance identifies a stray point
    outlier_deviations: float  # standard deviations of that distance above its mean, beyond which a point is stray


def object_rows(scene: Cloud, grasp: Grasp, limits: SegmentationLimits, seed: int = 0) -> Indices:
    """Return which points of a view (point,) are the grasped object, in their order; the camera is at the origin.

    Raises `TacpipeError` if no table is found, nothing stands on it, nothing that stands there is near
    the grasp, or that is too long for an object.
    """
    points_m = scene.points_m.astype(np.float64)
    above_m = heights_m(points_m, table_plane(points_m, grasp, limits, seed))  # (point,)
    spread_m = 1.4826 * float(np.median(np.abs(above_m[np.abs(above_m) <= 3 * limits.plane_m])))  # standard deviation
    front = np.flatnonzero(above_m > max(limits.plane_m, NOISES * spread_m))
    labels = _clusters(points_m[front], limits)
    if not (labels >= 0).any():
        raise TacpipeError(
            f"No object is on the table: of {len(front)} points in front of it no {limits.object_points} are near one "
            f"another, within {1e3 * limits.cluster_m:g} mm. Check the scene, or lower --object-points."
        )
    distances_m = np.where(labels >= 0, from_grasp_m(points_m[front], grasp), np.inf)
    nearest = int(distances_m.argmin())
    if distances_m[nearest] > limits.near_m:
        raise TacpipeError(
            f"No object is near the grasp: of {len(np.unique(labels[labels >= 0]))} objects on the table, the nearest is "
            f"{1e3 * distances_m[nearest]:.1f} mm from the lines of the grasp; it must be "
            f"{1e3 * limits.near_m:g} mm or less, in one frame. Check the grasp, or allow more with --near-mm."
        )
    rows = front[labels == labels[nearest]]
    length_m = float(np.ptp(points_m[rows], axis=0).max())
    if length_m > MAX_EXTENT_M:
        raise TacpipeError(
            f"The object near the grasp is {1e3 * length_m:.0f} mm long; a hand lifts at most {1e3 * MAX_EXTENT_M:g} mm. "
            f"It may have merged with the table or with neighbouring objects. Raise --plane-mm or lower --cluster-mm."
        )
    object_points: Indices = rows[_inliers(points_m[rows], limits)]
    return object_points


def table_plane(points_m: Floats, grasp: Grasp, limits: SegmentationLimits, seed: int = 0) -> Floats:
    """Return the table's plane (normal and offset, 4): of the large ones behind the middle of the grasp the nearest.

    The normal has length 1 and points to the camera's side, where the grasp lies. Sides of the object are not a table: the
    grasp lies within it, behind what the camera sees. Raises `TacpipeError` if there is no such plane that holds
    ``plane_fraction`` of the points (point, xyz).
    """
    remaining = np.arange(len(points_m))
    planes: list[tuple[float, Floats]] = []
    fractions: list[float] = []
    while len(fractions) < PLANES and len(remaining) >= max(3.0, limits.plane_fraction * len(points_m)):
        plane = _largest_plane(points_m[remaining], limits, seed)
        in_plane = np.abs(heights_m(points_m[remaining], plane)) <= limits.plane_m
        fractions.append(np.count_nonzero(in_plane) / len(points_m))
        height_m = float(heights_m(grasp.middle_m[None], plane)[0])
        if fractions[-1] >= limits.plane_fraction and height_m > limits.plane_m:
            planes.append((height_m, plane))
        remaining = remaining[~in_plane]
    if planes:
        return min(planes, key=lambda item: item[0])[1]
    percentages = ", ".join(f"{100 * fraction:.0f}" for fraction in fractions) or "0"
    raise TacpipeError(
        f"No table is found: the largest planes hold {percentages} % of {len(points_m)} points, and one with the grasp in "
        f"front of it must hold {100 * limits.plane_fraction:g} %. Give the view with its table, or the object's points as "
        f"the stream `cloud`."
    )


def heights_m(points_m: Floats, plane: Floats) -> Floats:
    """Return how far points (point, xyz) lie in front of a plane (4,), metres (point,); behind it negative."""
    distances_m: Floats = points_m @ plane[:3] + plane[3]
    return distances_m


def from_grasp_m(points_m: Floats, grasp: Grasp) -> Floats:
    """Return how far points (point, xyz) lie from a grasp, metres (point,): from its two lines, whichever is nearer.

    One goes from finger to finger, through the object. The other goes from the middle `MAX_HEIGHT_M` towards the camera, and
    meets what the camera sees of the object, though the fingers may lie far beneath it.
    """
    towards = -grasp.middle_m / np.linalg.norm(grasp.middle_m)  # (xyz), from the middle to the camera
    lines = ((grasp.g1_m, grasp.closing, grasp.opening_m), (grasp.middle_m, towards, MAX_HEIGHT_M))
    return np.minimum(*(_from_line_m(points_m, *line) for line in lines))


def _from_line_m(points_m: Floats, start_m: Floats, direction: Floats, length_m: float) -> Floats:
    """Return how far points (point, xyz) lie from a straight line with two ends, metres (point,)."""
    along_m = np.clip((points_m - start_m) @ direction, 0, length_m)
    distances_m: Floats = np.linalg.norm(points_m - start_m - along_m[:, None] * direction, axis=1)
    return distances_m


def _cloud(library: Any, points_m: Floats) -> Any:
    return library.geometry.PointCloud(library.utility.Vector3dVector(points_m))


def _largest_plane(points_m: Floats, limits: SegmentationLimits, seed: int) -> Floats:
    """Return the plane (4,) that the most points (point, xyz) lie in, derived from `SAMPLED` of them."""
    sampled = points_m
    if len(points_m) > SAMPLED:
        sampled = np.random.default_rng(seed).choice(points_m, SAMPLED, replace=False)
    with open3d() as library:
        library.utility.random.seed(seed)
        plane, _ = _cloud(library, sampled).segment_plane(
            limits.plane_m, 3, limits.plane_trials, probability=1.0
        )  # all trials are made: with fewer the result would depend on the number of threads
    normalised = np.asarray(plane, dtype=np.float64)
    normalised /= np.linalg.norm(normalised[:3])
    return normalised if normalised[3] >= 0 else -normalised


def _clusters(points_m: Floats, limits: SegmentationLimits) -> Int64s:
    """Return the number of the cluster of each point (point,), -1 for those of none with ``object_points``."""
    if not len(points_m):
        return np.zeros(0, dtype=np.int64)
    with open3d() as library:
        cluster_of_points = _cloud(library, points_m).cluster_dbscan(limits.cluster_m, limits.cluster_points)
    labels = np.asarray(cluster_of_points, np.int64)
    sizes = np.bincount(labels + 1)  # (cluster,), the first being that of no cluster
    return np.where(sizes[labels + 1] >= limits.object_points, labels, -1)


def _inliers(points_m: Floats, limits: SegmentationLimits) -> Indices:
    """Return which points (point, xyz) are not a stray ones."""
    with open3d() as library:
        _, inliers = _cloud(library, points_m).remove_statistical_outlier(
            limits.outlier_neighbours, limits.outlier_deviations
        )
    return np.sort(np.asarray(inliers, dtype=np.intp))
