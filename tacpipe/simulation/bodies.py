"""Bodies with surfaces known by formula: where a ray meets one, its outward normal, and how it bends there.

Each body lies about its own origin, z being its axis. Bending is given by a symmetric matrix B (3, 3): the normal
curvature along a unit tangent v is v' B v, positive where the body is convex (M. do Carmo, *Differential Geometry of
Curves and Surfaces*, section 3.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tacpipe.arrays import Bools, Floats

DOWN_Z = np.array([0.0, 0.0, -1.0])
STABLE = 2.5  # largest height over width of what is stood on its end


@dataclass(frozen=True)
class Rest:
    """A way a body lies on a table: which of its directions points up (xyz), and how high its origin then is, metres."""

    up: Floats
    height_m: float


class Shape(Protocol):
    """A body about its own origin; points and directions are (point, xyz), in metres."""

    @property
    def bound_m(self) -> float:
        """Radius of a sphere about the origin that holds the body, metres."""

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return how far along each ray, in lengths of its direction, the body is first met (ray,); inf where never.

        Rays start outside of the body.
        """

    def normal(self, at_m: Floats) -> Floats:
        """Return the outward unit normal at points of the surface (point, xyz)."""

    def bending(self, at_m: Floats) -> Floats:
        """Return the matrix B of each point of the surface (point, xyz, xyz), 1/m."""

    def margin_m(self, at_m: Floats) -> Floats:
        """Return how far each point of the surface is from the nearest edge (point,), metres; inf without edges."""

    def rests(self) -> list[Rest]:
        """Return the ways in which the body lies on a table."""


def principal_curvatures(bending: Floats, normal: Floats) -> Floats:
    """Return the principal curvatures (point, 2), 1/m, the smaller one first, of B (point, xyz, xyz) and the normals."""
    helper = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    tangents = np.stack([first, np.cross(normal, first)], axis=2)  # (point, xyz, tangent)
    curvatures: Floats = np.linalg.eigvalsh(np.swapaxes(tangents, 1, 2) @ bending @ tangents)
    return curvatures


@dataclass(frozen=True)
class Box:
    """A box, stated by half its edges (3,), metres."""

    half_m: Floats

    @property
    def bound_m(self) -> float:
        """Half the diagonal, metres."""
        return float(np.linalg.norm(self.half_m))

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return where rays enter (ray,): the last of the three slabs that they enter, if they leave none before."""
        with np.errstate(divide="ignore", invalid="ignore"):
            walls = np.stack([(side * self.half_m - origin_m) / direction for side in (-1, 1)])
        entered = np.nanmax(walls.min(axis=0), axis=1)
        exit = np.nanmin(walls.max(axis=0), axis=1)
        return np.where((entered <= exit) & (entered > 0), entered, np.inf)

    def normal(self, at_m: Floats) -> Floats:
        """Return the normal of the face that each point lies on (point, xyz)."""
        axis = np.argmax(np.abs(at_m) - self.half_m, axis=1)
        return np.asarray(np.eye(3)[axis] * np.sign(np.take_along_axis(at_m, axis[:, None], 1)), np.float64)

    def bending(self, at_m: Floats) -> Floats:
        """Return zeros (point, xyz, xyz): faces are flat."""
        return np.zeros((len(at_m), 3, 3))

    def margin_m(self, at_m: Floats) -> Floats:
        """Return the way to the nearest edge of the face (point,), metres."""
        return np.asarray(np.sort(self.half_m - np.abs(at_m), axis=1)[:, 1])

    def rests(self) -> list[Rest]:
        """Return each axis up that is not too tall for the shorter edge under it."""
        poses = []
        for axis, half in enumerate(self.half_m):
            if half <= STABLE * np.delete(self.half_m, axis).min():
                poses.append(Rest(np.eye(3)[axis], float(half)))
        return poses


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid, stated by its semi-axes (3,), metres; a sphere if they are equal."""

    semi_m: Floats

    @property
    def bound_m(self) -> float:
        """The longest semi-axis, metres."""
        return float(self.semi_m.max())

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return where rays enter (ray,): the smaller root of a quadratic equation."""
        start, way = origin_m / self.semi_m, direction / self.semi_m
        return _first_root((way**2).sum(axis=-1), (start * way).sum(axis=-1), (start**2).sum(axis=-1) - 1)

    def normal(self, at_m: Floats) -> Floats:
        """Return the direction of the gradient of sum (x / a)^2 (point, xyz)."""
        gradient = at_m / self.semi_m**2
        return np.asarray(gradient / np.linalg.norm(gradient, axis=1, keepdims=True))

    def bending(self, at_m: Floats) -> Floats:
        """Return the Hessian of sum (x / a)^2 across the normal, over its gradient (point, xyz, xyz)."""
        steepness = np.linalg.norm(at_m / self.semi_m**2, axis=1)
        across = _across(self.normal(at_m))
        return np.asarray(across @ np.diag(1 / self.semi_m**2) @ across / steepness[:, None, None])

    def margin_m(self, at_m: Floats) -> Floats:
        """Return inf (point,): there are no edges."""
        return np.full(len(at_m), np.inf)

    def rests(self) -> list[Rest]:
        """Return the one stable way: the shortest axis up."""
        axis = int(np.argmin(self.semi_m))
        return [Rest(np.eye(3)[axis], float(self.semi_m[axis]))]


@dataclass(frozen=True)
class Frustum:
    """A cone cut off at both ends, or a cylinder: radii at the bottom and at the top and half the height, metres."""

    bottom_m: float
    top_m: float
    half_m: float

    @property
    def slope(self) -> float:
        """The growth of the radius per height."""
        return (self.top_m - self.bottom_m) / (2 * self.half_m)

    @property
    def middle_m(self) -> float:
        """The radius at half the height, metres."""
        return (self.top_m + self.bottom_m) / 2

    @property
    def bound_m(self) -> float:
        """The way to the wider rim, metres."""
        return float(np.hypot(max(self.bottom_m, self.top_m), self.half_m))

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return where rays enter (ray,): the nearest of what they meet of the side and of the two ends."""
        origin_m, direction = np.broadcast_arrays(origin_m, direction)
        radius, growth = self.middle_m + self.slope * origin_m[:, 2], self.slope * direction[:, 2]
        square = (direction[:, :2] ** 2).sum(axis=1) - growth**2
        linear = (origin_m[:, :2] * direction[:, :2]).sum(axis=1) - radius * growth
        constant = (origin_m[:, :2] ** 2).sum(axis=1) - radius**2
        side = _first_root(square, linear, constant)
        with np.errstate(invalid="ignore"):
            side[~(np.abs(origin_m[:, 2] + side * direction[:, 2]) <= self.half_m)] = np.inf
        distance = side
        for height, radius_m in ((-self.half_m, self.bottom_m), (self.half_m, self.top_m)):
            with np.errstate(divide="ignore", invalid="ignore"):
                way = (height - origin_m[:, 2]) / direction[:, 2]
                off = np.hypot(*(origin_m[:, :2] + way[:, None] * direction[:, :2]).T)
            distance = np.where((off <= radius_m) & (way > 0) & (way < distance), way, distance)
        return distance

    def normal(self, at_m: Floats) -> Floats:
        """Return the normal of the side or of the end that each point lies on (point, xyz)."""
        off = np.hypot(at_m[:, 0], at_m[:, 1])
        with np.errstate(invalid="ignore", divide="ignore"):
            outward = at_m[:, :2] / off[:, None]
        side = np.column_stack([outward, np.full(len(at_m), -self.slope)]) / np.hypot(1, self.slope)
        return np.where(self._on_side(at_m)[:, None], side, -DOWN_Z * np.sign(at_m[:, 2:]))

    def bending(self, at_m: Floats) -> Floats:
        """Return cos(half angle) / radius about the axis on the side (point, xyz, xyz), zeros on the ends."""
        on = np.flatnonzero(self._on_side(at_m))
        bending = np.zeros((len(at_m), 3, 3))
        off = np.hypot(at_m[on, 0], at_m[on, 1])
        about = np.column_stack([-at_m[on, 1], at_m[on, 0], np.zeros(len(on))]) / off[:, None]
        curvature = 1 / (off * np.hypot(1, self.slope))
        bending[on] = curvature[:, None, None] * about[:, :, None] * about[:, None, :]
        return bending

    def margin_m(self, at_m: Floats) -> Floats:
        """Return the way to the nearest rim (point,), metres."""
        end = np.where(at_m[:, 2] > 0, self.top_m, self.bottom_m)
        off = np.hypot(at_m[:, 0], at_m[:, 1])
        along = (self.half_m - np.abs(at_m[:, 2])) * np.hypot(1, self.slope)
        return np.where(self._on_side(at_m), along, end - off)

    def rests(self) -> list[Rest]:
        """Return standing on the wider end, if it is not too tall for that, and lying on the side."""
        wider = max(self.bottom_m, self.top_m)
        up = -DOWN_Z if self.bottom_m >= self.top_m else DOWN_Z
        standing = [Rest(up, self.half_m)] if self.half_m <= STABLE * wider else []
        outward = np.array([1.0, 0.0, -self.slope]) / np.hypot(1, self.slope)
        return [*standing, Rest(-outward, float(self.middle_m / np.hypot(1, self.slope)))]

    def _on_side(self, at_m: Floats) -> Bools:
        off = np.hypot(at_m[:, 0], at_m[:, 1])
        from_side = np.abs(off - self.middle_m - self.slope * at_m[:, 2])
        return np.asarray(from_side <= np.abs(self.half_m - np.abs(at_m[:, 2])))


def _across(normal: Floats) -> Floats:
    """Return the projections across unit normals (point, xyz, xyz)."""
    return np.asarray(np.eye(3) - normal[:, :, None] * normal[:, None, :])


def _first_root(square: Floats, linear: Floats, constant: Floats) -> Floats:
    """Return the smaller positive root of square t^2 + 2 linear t + constant = 0 (ray,), inf where there is none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(linear**2 - square * constant)
        q = -linear - np.where(linear < 0, -root, root)  # the sum that loses no digits
        roots = np.stack([q / square, constant / q])
    roots[~(roots > 0)] = np.inf
    return np.asarray(roots.min(axis=0))


CLOSE_M = 1e-8  # distance at which a ray has met the surface
STEPS = 200  # a grazing ray has missed after so many steps


@dataclass(frozen=True)
class Bow:
    """A tube bent into an arc in the plane of x and y: the arc's radius, the tube's, and half the arc's angle.

    The origin is the centroid of the arc, whose middle lies at positive x. Rays are followed by steps of the distance to the
    surface, which is known exactly (J. C. Hart, *Sphere tracing*, The Visual Computer 12, 1996): a torus has an equation of
    fourth degree, and its closed solution loses digits.
    """

    arc_m: float
    tube_m: float
    half_rad: float

    @property
    def shift_m(self) -> Floats:
        """The arc's centroid as seen from the arc's centre (xyz), metres."""
        return np.array([self.arc_m * np.sin(self.half_rad) / self.half_rad, 0.0, 0.0])

    @property
    def bound_m(self) -> float:
        """The way to what is farthest from the centroid, metres: the arc's middle or its ends, and the tube."""
        angles = np.array([0.0, min(self.half_rad, np.pi)])
        ends = self.arc_m * np.column_stack([np.cos(angles), np.sin(angles)]) - self.shift_m[:2]
        return float(np.hypot(*ends.T).max()) + self.tube_m

    def distance_m(self, at_m: Floats) -> Floats:
        """Return the distance of each point from the surface (point,), metres, negative within."""
        return np.asarray(np.linalg.norm(self._from_arc(at_m), axis=1) - self.tube_m)

    def hit(self, origin_m: Floats, direction: Floats) -> Floats:
        """Return where rays first meet the surface (ray,), to `CLOSE_M`; inf where they do not."""
        origin_m, direction = np.broadcast_arrays(origin_m, direction)
        length = np.linalg.norm(direction, axis=1)
        unit = direction / length[:, None]
        nearest = -(origin_m * unit).sum(axis=1)
        chord2 = self.bound_m**2 - (origin_m**2).sum(axis=1) + nearest**2
        distance = np.full(len(unit), np.inf)
        leaves = nearest + np.sqrt(np.maximum(chord2, 0))
        going = np.flatnonzero((chord2 > 0) & (leaves > 0))
        chord = np.sqrt(chord2[going])
        way, until = np.maximum(nearest[going] - chord, 0), leaves[going]
        for _ in range(STEPS):
            gap = self.distance_m(origin_m[going] + way[:, None] * unit[going])
            met = gap < CLOSE_M
            distance[going[met]] = way[met]
            way = way + gap
            active = ~met & (way < until)
            going, way, until = going[active], way[active], until[active]
            if not len(going):
                break
        return np.asarray(distance / length)

    def normal(self, at_m: Floats) -> Floats:
        """Return the direction from the arc to each point (point, xyz)."""
        outward = self._from_arc(at_m)
        return np.asarray(outward / np.linalg.norm(outward, axis=1, keepdims=True))

    def bending(self, at_m: Floats) -> Floats:
        """Return one over the tube's radius around the tube, cos / distance from the axis along it (point, xyz, xyz)."""
        normal = self.normal(at_m)
        curvature = (np.eye(3) - normal[:, :, None] * normal[:, None, :]) / self.tube_m
        relative_m = at_m + self.shift_m
        off = np.hypot(relative_m[:, 0], relative_m[:, 1])
        on = np.flatnonzero(np.abs(np.arctan2(relative_m[:, 1], relative_m[:, 0])) <= self.half_rad)
        along = np.column_stack([-relative_m[on, 1], relative_m[on, 0], np.zeros(len(on))]) / off[on, None]
        lengthwise = (off[on] - self.arc_m) / self.tube_m / off[on]
        curvature[on] += (lengthwise - 1 / self.tube_m)[:, None, None] * along[:, :, None] * along[:, None, :]
        return np.asarray(curvature)

    def margin_m(self, at_m: Floats) -> Floats:
        """Return inf (point,): there are no edges."""
        return np.full(len(at_m), np.inf)

    def rests(self) -> list[Rest]:
        """Return lying flat."""
        return [Rest(-DOWN_Z, self.tube_m)]

    def _from_arc(self, at_m: Floats) -> Floats:
        """Return the vectors from the nearest point of the arc (point, xyz)."""
        relative_m = at_m + self.shift_m
        angle = np.clip(np.arctan2(relative_m[:, 1], relative_m[:, 0]), -self.half_rad, self.half_rad)
        arc = self.arc_m * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
        return np.asarray(relative_m - arc)
