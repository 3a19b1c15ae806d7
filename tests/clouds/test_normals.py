"""Compare normals with those of known bodies."""

from __future__ import annotations

import numpy as np

from tacpipe.clouds.cloud import Cloud, normals
from tests.clouds import shapes


def test_normals_of_a_sphere_point_along_its_radius_and_towards_the_camera() -> None:
    cloud = shapes.sphere(0.05)
    unit_normals = normals(cloud, 0.008)
    radial = (cloud.points_m - shapes.PLACE_M) / 0.05
    towards = -(cloud.points_m * unit_normals).sum(axis=1)
    np.testing.assert_allclose(np.linalg.norm(unit_normals, axis=1), 1, atol=1e-9)
    assert np.median(np.abs((unit_normals * radial).sum(axis=1))) > 0.999
    assert (towards >= 0).all()


def test_a_camera_elsewhere_turns_the_normals_towards_itself() -> None:
    grid = np.stack(np.meshgrid(np.arange(12), np.arange(12)), axis=-1).reshape(-1, 2) * 0.003
    plane = Cloud(np.column_stack([grid, np.full(len(grid), 1.0)]).astype(np.float32))
    np.testing.assert_allclose(normals(plane), np.tile([0, 0, -1.0], (len(grid), 1)), atol=1e-6)
    np.testing.assert_allclose(normals(plane, camera_m=(0, 0, 2)), np.tile([0, 0, 1.0], (len(grid), 1)), atol=1e-6)
