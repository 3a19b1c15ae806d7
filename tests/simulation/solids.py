"""Independent equations of the simulated bodies, as an oracle for rays, normals and curvatures."""

from collections.abc import Callable

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.simulation.bodies import Bow, Box, Ellipsoid, Frustum, Shape

BOX = Box(np.array([0.02, 0.03, 0.045]))
ELLIPSOID = Ellipsoid(np.array([0.02, 0.03, 0.05]))
BALL = Ellipsoid(np.full(3, 0.03))
CYLINDER = Frustum(0.03, 0.03, 0.04)
CONE = Frustum(0.04, 0.02, 0.05)
BOW = Bow(0.04, 0.012, 2.0)
SHAPES: dict[str, Shape] = {
    "box": BOX,
    "ellipsoid": ELLIPSOID,
    "sphere": BALL,
    "cylinder": CYLINDER,
    "cone": CONE,
    "bow": BOW,
}


def level(name: str, at_m: Floats) -> Floats:
    """Return how far points are outside (point,), in metres or a monotonic measure: 0 on the surface, negative inside."""
    x, y, z = at_m.T
    if name == "box":
        return np.asarray(np.max(np.abs(at_m) - [0.02, 0.03, 0.045], axis=1))
    if name in ("ellipsoid", "sphere"):
        a, b, c = (0.02, 0.03, 0.05) if name == "ellipsoid" else (0.03, 0.03, 0.03)
        return np.asarray(0.03 * (x**2 / a**2 + y**2 / b**2 + z**2 / c**2 - 1))
    if name in ("cylinder", "cone"):
        radius, half = (0.03 + 0 * z, 0.04) if name == "cylinder" else (0.03 - 0.2 * z, 0.05)
        return np.asarray(np.maximum(np.hypot(x, y) - radius, np.abs(z) - half))
    angles = np.linspace(-2.0, 2.0, 4001)  # The bow is a union of balls along its arc.
    arc = 0.04 * np.column_stack([np.cos(angles) - np.sin(2.0) / 2.0, np.sin(angles), 0 * angles])
    return np.array([np.sqrt(((arc - point) ** 2).sum(axis=1).min()) for point in at_m]) - 0.012


def rays(name: str, count: int, seed: int) -> tuple[Floats, Floats]:
    """Return rays from afar to places in and around a body: origins and directions (ray, xyz), of any length."""
    rng = np.random.default_rng(seed)
    shape = SHAPES[name]
    origin = rng.normal(size=(count, 3))
    origin *= 0.3 / np.linalg.norm(origin, axis=1, keepdims=True)
    target = rng.uniform(-1, 1, (count, 3)) * shape.bound_m
    return origin, (target - origin) * rng.uniform(0.5, 2, (count, 1))


def surface(name: str, count: int, seed: int = 0) -> Floats:
    """Return points of a body's surface that rays have found (point, xyz)."""
    origin, direction = rays(name, 8 * count, seed)
    way = SHAPES[name].hit(origin, direction)
    met = np.flatnonzero(np.isfinite(way))[:count]
    return np.asarray(origin[met] + way[met, None] * direction[met])


def second_differences(height: Callable[[float], float], step: float) -> float:
    """Return the second derivative of a function at 0."""
    return (height(step) - 2 * height(0.0) + height(-step)) / step**2
