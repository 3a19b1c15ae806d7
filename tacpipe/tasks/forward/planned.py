"""Planned motion as a forecaster reads it: the rows to come, from a plan, or from what is assumed without one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tacpipe.arrays import AnyFloats, Float32s, Floats, Times
from tacpipe.models.windows import POSE
from tacpipe.signals import kinematics
from tacpipe.signals.resampling import linear, slerp
from tacpipe.signals.rotations import quaternions_of_vectors


class Plan(NamedTuple):
    """Planned poses of the hand: times, and positions in m with quaternions x, y, z, w."""

    t_ns: Times  # (point,), ascending
    poses: Floats  # (point, 7); a quaternion that is not finite: the hand does not turn


def rows(plan: Plan, t_ns: int, ahead_ns: Times, now: AnyFloats) -> Float32s:
    """Return the arm's rows (step, 13) at the times ``ahead_ns`` (step,), which follow ``t_ns``.

    ``now`` (13,) is the arm at ``t_ns``. A plan that begins later is reached from there in a straight line; after its end
    the hand stays. Velocities are differences of the planned rows, as those of a recording are, and the sign of the
    quaternions continues that of ``now``.
    """
    points_ns, poses = plan
    if not np.isfinite(poses[:, 3:]).all():
        poses = np.hstack([poses[:, :3], np.tile(now[3:POSE].astype(np.float64), (len(poses), 1))])
    if points_ns[0] > t_ns or points_ns[-1] <= t_ns:
        before = now[None, :POSE].astype(np.float64)
        points_ns, poses = (
            (np.append(np.int64(t_ns), points_ns), np.concatenate([before, poses]))
            if points_ns[0] > t_ns
            else (np.array([t_ns]), before)
        )
    grid_ns = np.append(np.int64(t_ns), ahead_ns)
    quaternions = slerp(points_ns, poses[:, 3:], grid_ns)
    if quaternions[0] @ now[3:POSE] < 0:
        quaternions = -quaternions
    placed = np.hstack([linear(points_ns, poses[:, :3], grid_ns), quaternions])
    moved = kinematics.differences(grid_ns, placed[:, :3], placed[:, 3:])
    return np.hstack([placed, moved])[1:].astype(np.float32)


def without(t_ns: int, ahead_ns: Times, now: AnyFloats) -> Float32s:
    """Return the arm's rows (step, 13) at ``ahead_ns`` (step,) of a hand that moves and turns on as at ``t_ns``.

    ``now`` (13,) is the arm at ``t_ns``.
    """
    after_s = ((ahead_ns - t_ns) / 1e9)[:, None]  # (step, 1)
    arm: Floats = now.astype(np.float64)
    position = arm[:3] + after_s * arm[POSE : POSE + 3]
    turned = _product(quaternions_of_vectors(after_s * arm[POSE + 3 :]), arm[3:POSE])
    moved = np.broadcast_to(arm[POSE:], (len(ahead_ns), 6))
    return np.hstack([position, turned, moved]).astype(np.float32)


def _product(first: Floats, second: Floats) -> Floats:
    """Return the quaternions (step, 4) that turn by ``second`` (4,), then by ``first`` (step, 4)."""
    a, b = first[:, :3], second[:3]
    vector = first[:, 3:] * b + second[3] * a + np.cross(a, b)
    scalar = first[:, 3:] * second[3] - (a @ b)[:, None]
    return np.hstack([vector, scalar])
