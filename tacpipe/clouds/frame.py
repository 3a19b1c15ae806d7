"""Axes in which a grasp looks the same however the object lies: those of the wrist, or what can be determined of them."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyFloats, Floats
from tacpipe.clouds.grasp import Grasp

STEEPEST = 0.999  # cosine between closing axis and line of sight beyond which another direction is taken


def estimated_wrist(grasp: Grasp) -> Floats:
    """Return axes for a wrist that is not stated (component, axis): approach along the line of sight, closing, and third.

    The camera, at the origin, looks down on the object as the hand comes down on it; the approach axis is the line of sight
    to the middle of the grasp less its share along the closing axis. Where nothing is left, because the fingers close
    along the line of sight or about the camera itself, the frame's axis that is most square to closing represents it.
    """
    sight = grasp.middle_m / max(float(np.linalg.norm(grasp.middle_m)), 1e-12)
    if not sight.any() or abs(sight @ grasp.closing) > STEEPEST:
        sight = np.eye(3)[np.argmin(np.abs(grasp.closing))]
    return axes(sight, grasp.closing)


def axes(approach: Floats, closing: Floats) -> Floats:
    """Return right-handed axes (component, axis): ``approach`` made square to ``closing``, that, their product.

    ``closing`` must be a unit vector, and ``approach`` not along it.
    """
    square = approach - (approach @ closing) * closing
    square = square / np.linalg.norm(square)
    return np.column_stack([square, closing, np.cross(square, closing)])


def wrist_of(grasp: Grasp) -> Floats:
    """Return the axes of a grasp (component, axis): approach, closing, third; the approach is the wrist's where it is given.

    The closing axis is that from g1 to g2, whatever a wrist's second axis is; a wrist that approaches along it gives its
    second axis for the first, so that the axes still turn with it.
    """
    if grasp.wrist is None:
        return estimated_wrist(grasp)
    approach = grasp.wrist[:, 0]
    if abs(approach @ grasp.closing) > STEEPEST:
        approach = grasp.wrist[:, 1]
    return axes(approach, grasp.closing)


def local_points(points_m: AnyFloats, grasp: Grasp) -> Floats:
    """Return points (point, axis) in the axes of the grasp, about the middle between the fingers, metres.

    g1 is at (0, -opening / 2, 0), g2 at (0, opening / 2, 0).
    """
    found: Floats = (points_m - grasp.middle_m) @ wrist_of(grasp)
    return found
