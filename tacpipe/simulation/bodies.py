"""Define bodies with analytic surfaces: intersections with rays, outward normals, and curvature.

Each body is centred at its own origin, with z as its axis. Curvature is a symmetric matrix B (3, 3): the normal
curvature along a unit tangent v is v' B v, positive where the body is convex (M. do Carmo, *Differential Geometry of
Curves and Surfaces*, section 3.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tacpipe.arrays import Bools, Floats

DOWN_Z = np.array([0.0, 0.0, -1.0])
MAX_ASPECT = 2.5  # maximum ratio of height to width of an upright body


@dataclass(frozen=True)
class Rest:
    """A stable pose on a table: the direction of the body that points up (xyz), and the height of its origin in metres."""

    up: Floats
    height_m: float


class Shape(Protocol):
    """A body centred at its own origin. Points and directions have shape (point, xyz), in metres."""

    @property
    def bound_m(self) -> float:
        """Radius in metres of the bounding sphere around the origin."""

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return the distance of the first intersection of each ray (ray,) in lengths of its direction, or inf.

        Rays must start outside of the body.
        """

    def normal(self, at_m: Floats) -> Floats:
        """Return the outward unit normals at points of the surface (point, xyz)."""

    def bending(self, at_m: Floats) -> Floats:
        """Return the curvature matrix at points of the surface (point, xyz, xyz), in 1/m."""

    def margin_m(self, at_m: Floats) -> Floats:
        """Return the distance of each point of the surface from the nearest edge (point,) in metres; inf without edges."""

    def rests(self) -> list[Rest]:
        """Return the stable poses on a table."""


def principal_curvatures(bending: Floats, normal: Floats) -> Floats:
    """Return the principal curvatures (point, 2) in 1/m, ascending; they are positive on a sphere.

    ``bending`` are curvature matrices (point, xyz, xyz) in 1/m (`Shape.bending`), and ``normal`` unit normals (point, xyz).
    """
    helper = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    tangents = np.stack([first, np.cross(normal, first)], axis=2)  # (point, xyz, tangent)
    return np.linalg.eigvalsh(np.swapaxes(tangents, 1, 2) @ bending @ tangents)


@dataclass(frozen=True)
class Box:
    """A box with half edge lengths ``half_m`` (3,) in metres."""

    half_m: Floats

    @property
    def bound_m(self) -> float:
        """Half the diagonal in metres."""
        return float(np.linalg.norm(self.half_m))

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return the entry distance of rays (ray,): the last entry into the three slabs, if it precedes the first exit."""
        with np.errstate(divide="ignore", invalid="ignore"):
            walls = np.stack([(side * self.half_m - origin_m) / direction for side in (-1, 1)])
        entered = np.nanmax(walls.min(axis=0), axis=1)
        exit_distance = np.nanmin(walls.max(axis=0), axis=1)
        return np.where((entered <= exit_distance) & (entered > 0), entered, np.inf)

    def normal(self, at_m: Floats) -> Floats:
        """Return the normal of the face at each point (point, xyz)."""
        axis = np.argmax(np.abs(at_m) - self.half_m, axis=1)
        return np.asarray(np.eye(3)[axis] * np.sign(np.take_along_axis(at_m, axis[:, None], 1)), np.float64)

    def bending(self, at_m: Floats) -> Floats:
        """Return zeros (point, xyz, xyz), because faces are flat."""
        return np.zeros((len(at_m), 3, 3))

    def margin_m(self, at_m: Floats) -> Floats:
        """Return the distance to the nearest edge of the face (point,) in metres."""
        return np.asarray(np.sort(self.half_m - np.abs(at_m), axis=1)[:, 1])

    def rests(self) -> list[Rest]:
        """Return a pose for each axis whose height does not exceed `MAX_ASPECT` times the shorter edge below."""
        poses = []
        for axis, half in enumerate(self.half_m):
            if half <= MAX_ASPECT * np.delete(self.half_m, axis).min():
                poses.append(Rest(np.eye(3)[axis], float(half)))
        return poses


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid with semi-axes ``semi_m`` (3,) in metres; a sphere if they are equal."""

    semi_m: Floats

    @property
    def bound_m(self) -> float:
        """The longest semi-axis in metres."""
        return float(self.semi_m.max())

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return the entry distance of rays (ray,): the smaller root of a quadratic equation."""
        start, scaled = origin_m / self.semi_m, direction / self.semi_m
        return _first_root((scaled**2).sum(axis=-1), (start * scaled).sum(axis=-1), (start**2).sum(axis=-1) - 1)

    def normal(self, at_m: Floats) -> Floats:
        """Return the direction of the gradient of sum (x / a)^2 (point, xyz)."""
        gradient = at_m / self.semi_m**2
        return np.asarray(gradient / np.linalg.norm(gradient, axis=1, keepdims=True))

    def bending(self, at_m: Floats) -> Floats:
        """Return the Hessian of sum (x / a)^2, projected onto the tangent plane, over its gradient (point, xyz, xyz)."""
        steepness = np.linalg.norm(at_m / self.semi_m**2, axis=1)
        projection = _tangent_projection(self.normal(at_m))
        return np.asarray(projection @ np.diag(1 / self.semi_m**2) @ projection / steepness[:, None, None])

    def margin_m(self, at_m: Floats) -> Floats:
        """Return inf (point,), because there are no edges."""
        return np.full(len(at_m), np.inf)

    def rests(self) -> list[Rest]:
        """Return the only stable pose, with the shortest axis up."""
        axis = int(np.argmin(self.semi_m))
        return [Rest(np.eye(3)[axis], float(self.semi_m[axis]))]


@dataclass(frozen=True)
class Frustum:
    """A truncated cone, or a cylinder: radii at the bottom and at the top, and half the height, in metres."""

    bottom_m: float
    top_m: float
    half_m: float

    @property
    def slope(self) -> float:
        """The increase of the radius per height."""
        return (self.top_m - self.bottom_m) / (2 * self.half_m)

    @property
    def middle_m(self) -> float:
        """The radius at half the height in metres."""
        return (self.top_m + self.bottom_m) / 2

    @property
    def bound_m(self) -> float:
        """The distance to the wider rim in metres."""
        return float(np.hypot(max(self.bottom_m, self.top_m), self.half_m))

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return the entry distance of rays (ray,): the nearest intersection with the side and the two ends, else inf."""
        start_m, along = np.broadcast_arrays(origin_m, direction)
        radius, growth = self.middle_m + self.slope * start_m[:, 2], self.slope * along[:, 2]
        square = (along[:, :2] ** 2).sum(axis=1) - growth**2
        linear = (start_m[:, :2] * along[:, :2]).sum(axis=1) - radius * growth
        constant = (start_m[:, :2] ** 2).sum(axis=1) - radius**2
        side = _first_root(square, linear, constant)
        with np.errstate(invalid="ignore"):
            side[~(np.abs(start_m[:, 2] + side * along[:, 2]) <= self.half_m)] = np.inf
        distance = side
        for height, radius_m in ((-self.half_m, self.bottom_m), (self.half_m, self.top_m)):
            with np.errstate(divide="ignore", invalid="ignore"):
                end = (height - start_m[:, 2]) / along[:, 2]
                from_axis = np.hypot(*(start_m[:, :2] + end[:, None] * along[:, :2]).T)
            distance = np.where((from_axis <= radius_m) & (end > 0) & (end < distance), end, distance)
        return distance

    def normal(self, at_m: Floats) -> Floats:
        """Return the normal of the side or end at each point (point, xyz)."""
        from_axis = np.hypot(at_m[:, 0], at_m[:, 1])
        with np.errstate(invalid="ignore", divide="ignore"):
            outward = at_m[:, :2] / from_axis[:, None]
        side = np.column_stack([outward, np.full(len(at_m), -self.slope)]) / np.hypot(1, self.slope)
        return np.where(self._is_on_side(at_m)[:, None], side, -DOWN_Z * np.sign(at_m[:, 2:]))

    def bending(self, at_m: Floats) -> Floats:
        """Return cos(half angle) / radius around the axis on the side (point, xyz, xyz), and zeros on the ends."""
        on = np.flatnonzero(self._is_on_side(at_m))
        bending = np.zeros((len(at_m), 3, 3))
        from_axis = np.hypot(at_m[on, 0], at_m[on, 1])
        about = np.column_stack([-at_m[on, 1], at_m[on, 0], np.zeros(len(on))]) / from_axis[:, None]
        curvature = 1 / (from_axis * np.hypot(1, self.slope))
        bending[on] = curvature[:, None, None] * about[:, :, None] * about[:, None, :]
        return bending

    def margin_m(self, at_m: Floats) -> Floats:
        """Return the distance to the nearest rim (point,) in metres."""
        end = np.where(at_m[:, 2] > 0, self.top_m, self.bottom_m)
        from_axis = np.hypot(at_m[:, 0], at_m[:, 1])
        along = (self.half_m - np.abs(at_m[:, 2])) * np.hypot(1, self.slope)
        return np.where(self._is_on_side(at_m), along, end - from_axis)

    def rests(self) -> list[Rest]:
        """Return standing on the wider end, unless the body is too tall, and lying on the side."""
        wider = max(self.bottom_m, self.top_m)
        up = -DOWN_Z if self.bottom_m >= self.top_m else DOWN_Z
        standing = [Rest(up, self.half_m)] if self.half_m <= MAX_ASPECT * wider else []
        outward = np.array([1.0, 0.0, -self.slope]) / np.hypot(1, self.slope)
        return [*standing, Rest(-outward, float(self.middle_m / np.hypot(1, self.slope)))]

    def _is_on_side(self, at_m: Floats) -> Bools:
        from_axis = np.hypot(at_m[:, 0], at_m[:, 1])
        from_side = np.abs(from_axis - self.middle_m - self.slope * at_m[:, 2])
        return np.asarray(from_side <= np.abs(self.half_m - np.abs(at_m[:, 2])))


def _tangent_projection(normal: Floats) -> Floats:
    """Return the projections onto the planes orthogonal to unit normals (point, xyz, xyz)."""
    return np.asarray(np.eye(3) - normal[:, :, None] * normal[:, None, :])


def _first_root(square: Floats, linear: Floats, constant: Floats) -> Floats:
    """Return the smaller positive root of square t^2 + 2 linear t + constant = 0 (ray,), or inf if there is none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(linear**2 - square * constant)
        stable_root = -linear - np.where(linear < 0, -root, root)  # avoids cancellation
        roots = np.stack([stable_root / square, constant / stable_root])
    roots[~(roots > 0)] = np.inf
    return np.asarray(roots.min(axis=0))


CLOSE_M = 1e-8  # distance at which a ray counts as having hit the surface
MAX_STEPS = 200  # after this many steps, a grazing ray counts as a miss


@dataclass(frozen=True)
class Bow:
    """A tube bent to an arc in the xy plane, defined by the radii of arc and tube, and half the angle of the arc.

    The origin is the centroid of the arc, and the middle of the arc is at positive x. Rays advance by their exact
    distance to the surface (J. C. Hart, *Sphere tracing*, The Visual Computer 12, 1996), because the closed solution of
    the torus's quartic equation is numerically inaccurate.
    """

    arc_m: float
    tube_m: float
    half_rad: float

    @property
    def shift_m(self) -> Floats:
        """The arc's centroid relative to the arc's centre (xyz), in metres."""
        return np.array([self.arc_m * np.sin(self.half_rad) / self.half_rad, 0.0, 0.0])

    @property
    def bound_m(self) -> float:
        """The largest distance from the centroid in metres: to the arc's middle or ends, plus the tube."""
        angles = np.array([0.0, min(self.half_rad, np.pi)])
        ends = self.arc_m * np.column_stack([np.cos(angles), np.sin(angles)]) - self.shift_m[:2]
        return float(np.hypot(*ends.T).max()) + self.tube_m

    def distance_m(self, at_m: Floats) -> Floats:
        """Return the distance of each point from the surface (point,) in metres, negative inside."""
        return np.asarray(np.linalg.norm(self._from_arc(at_m), axis=1) - self.tube_m)

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return the distance of the first intersection of rays (ray,), within `CLOSE_M`; inf if there is none."""
        start_m, along = np.broadcast_arrays(origin_m, direction)
        length = np.linalg.norm(along, axis=1)
        unit = along / length[:, None]
        nearest = -(start_m * unit).sum(axis=1)
        chord2 = self.bound_m**2 - (start_m**2).sum(axis=1) + nearest**2
        distance = np.full(len(unit), np.inf)
        exits = nearest + np.sqrt(np.maximum(chord2, 0))
        rays = np.flatnonzero((chord2 > 0) & (exits > 0))
        chord = np.sqrt(chord2[rays])
        travelled, limit = np.maximum(nearest[rays] - chord, 0), exits[rays]
        for _ in range(MAX_STEPS):
            gap = self.distance_m(start_m[rays] + travelled[:, None] * unit[rays])
            reached = gap < CLOSE_M
            distance[rays[reached]] = travelled[reached]
            travelled = travelled + gap
            active = ~reached & (travelled < limit)
            rays, travelled, limit = rays[active], travelled[active], limit[active]
            if not len(rays):
                break
        return np.asarray(distance / length)

    def normal(self, at_m: Floats) -> Floats:
        """Return the direction from the arc to each point (point, xyz)."""
        outward = self._from_arc(at_m)
        return np.asarray(outward / np.linalg.norm(outward, axis=1, keepdims=True))

    def bending(self, at_m: Floats) -> Floats:
        """Return the curvature (point, xyz, xyz): 1 / tube radius around the tube, cos / distance from the axis along it."""
        normal = self.normal(at_m)
        curvature = (np.eye(3) - normal[:, :, None] * normal[:, None, :]) / self.tube_m
        relative_m = at_m + self.shift_m
        from_axis = np.hypot(relative_m[:, 0], relative_m[:, 1])
        on = np.flatnonzero(np.abs(np.arctan2(relative_m[:, 1], relative_m[:, 0])) <= self.half_rad)
        along = np.column_stack([-relative_m[on, 1], relative_m[on, 0], np.zeros(len(on))]) / from_axis[on, None]
        lengthwise = (from_axis[on] - self.arc_m) / self.tube_m / from_axis[on]
        curvature[on] += (lengthwise - 1 / self.tube_m)[:, None, None] * along[:, :, None] * along[:, None, :]
        return np.asarray(curvature)

    def margin_m(self, at_m: Floats) -> Floats:
        """Return inf (point,), because there are no edges."""
        return np.full(len(at_m), np.inf)

    def rests(self) -> list[Rest]:
        """Return the only stable pose: lying flat."""
        return [Rest(-DOWN_Z, self.tube_m)]

    def _from_arc(self, at_m: Floats) -> Floats:
        """Return the vectors from the nearest points of the arc (point, xyz)."""
        relative_m = at_m + self.shift_m
        angle = np.clip(np.arctan2(relative_m[:, 1], relative_m[:, 0]), -self.half_rad, self.half_rad)
        arc = self.arc_m * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
        return np.asarray(relative_m - arc)
