"""Grasps of a body that lies on a table: where two fingers that close on a line meet it, and how the wrist is turned.

As in the letter's protocol, the line goes through a point shifted along the first principal axis of what the camera
sees, half as deep as the body is there. Of the level lines through it one is taken along which both fingers stay
within a cone of friction about the normals.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import Bools, Floats
from tacpipe.clouds.grasp import Grasp
from tacpipe.simulation.depth_camera import Placed

OPENING_M = (0.02, 0.12)  # distance between the fingers
CONE_RAD = np.deg2rad(15.0)  # largest angle between closing and a normal
MARGIN_M = 0.004  # least way from a contact to an edge
DIRECTIONS = 36  # number of lines that are tried
LEAN_RAD = np.deg2rad(4.0)  # standard deviation of their angle to the table
PITCH_RAD = np.deg2rad(20.0)  # largest angle of the approach to the vertical, about the closing axis
FAR_M = 0.2  # distance from which the fingers approach


def grasped(
    placed: Placed, seen_m: Floats, up: Floats, shift: float, rng: np.random.Generator, *, central: bool = False
) -> Grasp | None:
    """Return a grasp of a body that is seen at points (point, xyz), metres; None if no line suits.

    ``shift`` is the largest fraction of half the cloud's length by which the point is shifted; ``central`` takes the
    body's origin instead. Finger 1, the one at ``g1``, comes from the camera's left, as on the published rig.
    """
    through = placed.origin_m if central else _inside(placed, _shifted(seen_m, shift, rng))
    if through is None:
        return None
    ways = _level(up, rng)
    start, stop = (through - FAR_M * side * ways for side in (1, -1))
    first = start + placed.hit(start, ways)[:, None] * ways
    second = stop - placed.hit(stop, -ways)[:, None] * ways
    suitable = np.flatnonzero(_suitable(placed, first, second))
    if not len(suitable):
        return None
    chosen = int(rng.choice(suitable))
    closing, pitch = ways[chosen], rng.uniform(-PITCH_RAD, PITCH_RAD)
    down = -up + (up @ closing) * closing
    down /= np.linalg.norm(down)
    approach = np.cos(pitch) * down + np.sin(pitch) * np.cross(closing, down)
    return Grasp(first[chosen], second[chosen], np.column_stack([approach, closing, np.cross(approach, closing)]))


def _shifted(seen_m: Floats, shift: float, rng: np.random.Generator) -> Floats:
    """Return the seen point nearest to one on the first principal axis (xyz), metres."""
    centre = seen_m.mean(axis=0)
    axis = np.linalg.eigh(np.cov(seen_m.T))[1][:, -1]
    half = np.ptp(seen_m @ axis) / 2
    target = centre + shift * half * rng.uniform(-1, 1) * axis
    return np.asarray(seen_m[np.argmin(((seen_m - target) ** 2).sum(axis=1))])


def _inside(placed: Placed, seen_m: Floats) -> Floats | None:
    """Return the point halfway through the body along the camera's ray to ``seen_m`` (xyz), metres, None if it misses."""
    ray = seen_m / np.linalg.norm(seen_m)
    near = float(placed.hit(np.zeros((1, 3)), ray[None])[0])
    back = near + 2 * placed.shape.bound_m + FAR_M
    far = back - float(placed.hit((back * ray)[None], -ray[None])[0])
    if not np.isfinite(near):
        return None
    hollow = far - near > 2 * placed.shape.bound_m
    return None if hollow else np.asarray((near + far) / 2 * ray)


def _level(up: Floats, rng: np.random.Generator) -> Floats:
    """Return unit vectors nearly level with the table (direction, xyz), all towards positive x."""
    side = np.cross(up, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.pi * (np.arange(DIRECTIONS) + rng.random()) / DIRECTIONS - np.pi / 2
    lean = rng.normal(0, LEAN_RAD, DIRECTIONS)
    level = np.outer(np.cos(angle), side) + np.outer(np.sin(angle), np.cross(up, side))
    ways = np.cos(lean)[:, None] * level + np.outer(np.sin(lean), up)
    return np.asarray(ways * np.where(ways[:, :1] < 0, -1.0, 1.0))


def _suitable(placed: Placed, first_m: Floats, second_m: Floats) -> Bools:
    """Return which pairs of contacts (pair, xyz) fingers of the hand can hold (pair,)."""
    with np.errstate(invalid="ignore"):
        gap = second_m - first_m
        opening = np.linalg.norm(gap, axis=1)
        closing = gap / opening[:, None]
    suitable = np.isfinite(opening) & (opening >= OPENING_M[0]) & (opening <= OPENING_M[1])
    for at_m, sign in ((first_m, -1), (second_m, 1)):
        rows = np.flatnonzero(suitable)
        along = sign * (placed.normal(at_m[rows]) * closing[rows]).sum(axis=1)
        suitable[rows] &= (along >= np.cos(CONE_RAD)) & (placed.shape.margin_m(placed.inward(at_m[rows])) >= MARGIN_M)
    return np.asarray(suitable)
