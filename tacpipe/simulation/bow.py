"""A bow: a segment of a torus with round ends, another body of `tacpipe.simulation.primitives`.

Rays are followed by steps of the distance to the surface, which is known exactly (J. C. Hart, *Sphere tracing*, The
Visual Computer 12, 1996): a torus has an equation of fourth degree, and its closed solution loses digits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.simulation.primitives import DOWN_Z, Rest

CLOSE_M = 1e-8  # distance at which a ray has met the surface
STEPS = 200  # a grazing ray has missed after so many steps


@dataclass(frozen=True)
class Bow:
    """A tube bent into an arc in the plane of x and y: the arc's radius, the tube's, and half the arc's angle.

    The origin is the centroid of the arc, whose middle lies at positive x.
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
