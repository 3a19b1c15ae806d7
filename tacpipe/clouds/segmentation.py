"""Separate the object of a grasp from its table and neighbouring objects in a camera view.

The points in front of the table's plane are clustered, and the object is the cluster nearest to the grasp. The plane is
found by random sampling (Fischler and Bolles, "Random Sample Consensus", 1981) and clusters by density (Ester et al.,
"A Density-Based Algorithm for Discovering Clusters", 1996), both with open3d; results are reproducible with a seed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import Floats, Indices, Int64s
from tacpipe.clouds.cloud import Cloud, open3d
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError

MAX_PLANES = 4  # number of planes that may be the table, largest first: a floor, walls and sides of boxes may be larger
MAX_EXTENT_M = 0.4  # maximum extent of an object along any axis; published objects have at most 0.28 m
MAX_HEIGHT_M = 0.1  # maximum height of an object above the middle of a grasp: a hand cannot lift 20 cm like that
NOISE_DEVIATIONS = 3.0  # a point is in front of the table if it is this many standard deviations of its noise above it
MAX_PLANE_POINTS = 10_000  # points that determine a plane as well as a full view does


@dataclass(frozen=True)
class SegmentationLimits:
    """Limits for the table, an object, and the grasped object."""

    plane_m: float  # maximum distance of a point from its plane; raised for noisier points
    plane_fraction: float  # minimum fraction of all points on the table
    plane_trials: int  # number of random samples per plane
    cluster_m: float  # maximum distance between neighbours in an object
    cluster_points: int  # minimum number of points within that distance, itself included, for a core point
    object_points: int  # minimum number of points of an object
    near_m: float  # maximum distance between the object and the grasp
    outlier_neighbours: int  # number of neighbours whose mean distance identifies an outlier
    outlier_deviations: float  # a point is an outlier if that distance is this many standard deviations above its mean


def object_rows(scene: Cloud, grasp: Grasp, limits: SegmentationLimits, seed: int = 0) -> Indices:
    """Return the sorted indices (point,) of the grasped object's points in a view whose camera is at the origin.

    Raises `TacpipeError` if no table is found, no object is on it, none is near the grasp, or that object is too long.
    """
    points_m = scene.points_m.astype(np.float64)
    height_m = heights_m(points_m, table_plane(points_m, grasp, limits, seed))  # (point,)
    # standard deviation of the height
    noise_m = 1.4826 * float(np.median(np.abs(height_m[np.abs(height_m) <= 3 * limits.plane_m])))
    front_rows = np.flatnonzero(height_m > max(limits.plane_m, NOISE_DEVIATIONS * noise_m))
    labels = _clusters(points_m[front_rows], limits)
    if not (labels >= 0).any():
        raise TacpipeError(
            f"No object is on the table: no cluster of the {len(front_rows)} points in front of it has "
            f"{limits.object_points} points within {1e3 * limits.cluster_m:g} mm of one another. Check the scene, or lower "
            f"--object-points."
        )
    distances_m = np.where(labels >= 0, distances_from_grasp_m(points_m[front_rows], grasp), np.inf)
    nearest = int(distances_m.argmin())
    if distances_m[nearest] > limits.near_m:
        raise TacpipeError(
            f"No object is near the grasp: of {len(np.unique(labels[labels >= 0]))} objects on the table, the nearest is "
            f"{1e3 * distances_m[nearest]:.1f} mm from the lines of the grasp; it must be "
            f"{1e3 * limits.near_m:g} mm or less, in one frame. Check the grasp, or allow more with --near-mm."
        )
    rows = front_rows[labels == labels[nearest]]
    length_m = float(np.ptp(points_m[rows], axis=0).max())
    if length_m > MAX_EXTENT_M:
        raise TacpipeError(
            f"The object near the grasp is {1e3 * length_m:.0f} mm long; a hand lifts at most {1e3 * MAX_EXTENT_M:g} mm. "
            f"It may have merged with the table or with neighbouring objects. Raise --plane-mm or lower --cluster-mm."
        )
    object_points: Indices = rows[_inliers(points_m[rows], limits)]
    return object_points


def table_plane(points_m: Floats, grasp: Grasp, limits: SegmentationLimits, seed: int = 0) -> Floats:
    """Return the table's plane (normal and offset, 4): the nearest large plane behind the middle of the grasp.

    The normal has length 1 and points to the camera's side, where the grasp is. Sides of the object are not mistaken
    for a table, because the grasp is inside the object, behind what the camera sees. Raises `TacpipeError` if no such
    plane contains ``plane_fraction`` of the points (point, xyz).
    """
    remaining = np.arange(len(points_m))
    planes: list[tuple[float, Floats]] = []
    fractions: list[float] = []
    while len(fractions) < MAX_PLANES and len(remaining) >= max(3.0, limits.plane_fraction * len(points_m)):
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
        f"No table was found: the largest planes contain {percentages} % of {len(points_m)} points, and one behind the "
        f"grasp must contain {100 * limits.plane_fraction:g} %. Give a view that shows the table, or "
        f"the object's points as the stream `cloud`."
    )


def heights_m(points_m: Floats, plane: Floats) -> Floats:
    """Return the distances (point,) of points (point, xyz) in front of a plane (4,), in metres; negative behind it."""
    distances_m: Floats = points_m @ plane[:3] + plane[3]
    return distances_m


def distances_from_grasp_m(points_m: Floats, grasp: Grasp) -> Floats:
    """Return the distances (point,) of points (point, xyz) from the nearer of a grasp's two lines, in metres.

    The first line goes from finger to finger, through the object. The second goes from the middle `MAX_HEIGHT_M`
    towards the camera, and meets the visible surface of the object, even if the fingers are far below it.
    """
    towards = -grasp.middle_m / np.linalg.norm(grasp.middle_m)  # (xyz), from the middle to the camera
    lines = ((grasp.g1_m, grasp.closing, grasp.opening_m), (grasp.middle_m, towards, MAX_HEIGHT_M))
    return np.minimum(*(_distances_from_line_m(points_m, *line) for line in lines))


def _distances_from_line_m(points_m: Floats, start_m: Floats, direction: Floats, length_m: float) -> Floats:
    """Return the distances (point,) of points (point, xyz) from a line segment, in metres."""
    along_m = np.clip((points_m - start_m) @ direction, 0, length_m)
    distances_m: Floats = np.linalg.norm(points_m - start_m - along_m[:, None] * direction, axis=1)
    return distances_m


def _cloud(library: Any, points_m: Floats) -> Any:
    return library.geometry.PointCloud(library.utility.Vector3dVector(points_m))


def _largest_plane(points_m: Floats, limits: SegmentationLimits, seed: int) -> Floats:
    """Return the plane (4,) with the most points (point, xyz), estimated from `MAX_PLANE_POINTS` of them."""
    sampled = points_m
    if len(points_m) > MAX_PLANE_POINTS:
        sampled = np.random.default_rng(seed).choice(points_m, MAX_PLANE_POINTS, replace=False)
    with open3d() as library:
        library.utility.random.seed(seed)
        # with a probability of 1 all trials are made; otherwise the result would depend on the number of threads
        plane, _ = _cloud(library, sampled).segment_plane(limits.plane_m, 3, limits.plane_trials, probability=1.0)
    normalised = np.asarray(plane, dtype=np.float64)
    normalised /= np.linalg.norm(normalised[:3])
    return normalised if normalised[3] >= 0 else -normalised


def _clusters(points_m: Floats, limits: SegmentationLimits) -> Int64s:
    """Return the cluster number of each point (point,), or -1 if its cluster has fewer than ``object_points``."""
    if not len(points_m):
        return np.zeros(0, dtype=np.int64)
    with open3d() as library:
        cluster_of_points = _cloud(library, points_m).cluster_dbscan(limits.cluster_m, limits.cluster_points)
    labels = np.asarray(cluster_of_points, np.int64)
    sizes = np.bincount(labels + 1)  # (cluster + 1,); the first is the number of unclustered points
    return np.where(sizes[labels + 1] >= limits.object_points, labels, -1)


def _inliers(points_m: Floats, limits: SegmentationLimits) -> Indices:
    """Return the sorted indices of the points (point, xyz) that are not outliers."""
    with open3d() as library:
        _, inliers = _cloud(library, points_m).remove_statistical_outlier(
            limits.outlier_neighbours, limits.outlier_deviations
        )
    return np.sort(np.asarray(inliers, dtype=np.intp))
