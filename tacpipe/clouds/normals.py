"""Where the surface behind a cloud faces at each point."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.library import open3d

RADIUS_M = 0.015  # of 10 to 30 mm, that under which the published grasps close most squarely on the surface
CAMERA_M = (0.0, 0.0, 0.0)  # a cloud in the camera's frame is seen from its origin


def normals(cloud: Cloud, radius_m: float = RADIUS_M, camera_m: Sequence[float] = CAMERA_M) -> Floats:
    """Return the unit normals (point, xyz) of the surface that a cloud was seen on, each turned towards the camera.

    A normal is the direction in which the neighbours within ``radius_m`` spread least; where there are fewer than two, it
    states nothing. Raises `TacpipeError` if open3d is not installed.
    """
    camera = np.asarray(camera_m, np.float64)
    with open3d() as library:
        held = library.geometry.PointCloud(library.utility.Vector3dVector(cloud.points_m.astype(np.float64)))
        around = library.geometry.KDTreeSearchParamRadius(radius_m)
        held.estimate_normals(around, fast_normal_computation=False)
        found: Floats = np.array(held.normals)
    towards = camera - cloud.points_m  # (point, xyz)
    return np.where((found * towards).sum(axis=1, keepdims=True) < 0, -found, found)
