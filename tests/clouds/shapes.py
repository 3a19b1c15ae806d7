"""Clouds of points on bodies whose grasps are known by hand."""

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.clouds.cloud import Cloud

PLACE_M = np.array([0.05, -0.1, 1.2])  # Place in front of the camera


def cylinder(radius_m: float, length_m: float, seed: int = 0, points: int = 6000) -> Cloud:
    """The side of a cylinder about an axis along y."""
    random = np.random.default_rng(seed)
    angle = random.uniform(0, 2 * np.pi, points)
    along = random.uniform(-length_m / 2, length_m / 2, points)
    surface = np.column_stack([radius_m * np.cos(angle), along, radius_m * np.sin(angle)])
    return placed(surface)


def box(sides_m: tuple[float, float, float], seed: int = 0, points: int = 8000) -> Cloud:
    """The six faces of a box along x, y and z."""
    random = np.random.default_rng(seed)
    sides = np.array(sides_m)
    areas = np.prod(sides) / sides
    face = random.choice(3, points, p=areas / areas.sum())
    surface = random.uniform(-0.5, 0.5, (points, 3))
    surface[np.arange(points), face] = np.where(random.random(points) < 0.5, -0.5, 0.5)
    return placed(surface * sides)


def sphere(radius_m: float, seed: int = 0, points: int = 6000) -> Cloud:
    """A sphere, points uniform on it."""
    way = np.random.default_rng(seed).normal(size=(points, 3))
    return placed(radius_m * way / np.linalg.norm(way, axis=1, keepdims=True))


def placed(surface_m: Floats) -> Cloud:
    return Cloud((surface_m + PLACE_M).astype(np.float32))


def visible_half(cloud: Cloud) -> Cloud:
    """Return the half of a convex body's cloud that the camera at the origin sees, by the ray to its middle."""
    nearer = (cloud.points_m - PLACE_M) @ PLACE_M < 0
    return Cloud(cloud.points_m[nearer])
