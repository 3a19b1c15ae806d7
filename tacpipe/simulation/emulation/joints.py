"""The angles at which a Panda's joints stand while its hand goes along a path: inverse kinematics of whole paths at once.

Damped least squares (Siciliano et al., Robotics, 2009, section 3.7) from the arm's ready position, all moments of the path
side by side. Where the path leaves what the arm reaches, the hand comes as near as it can.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Times
from tacpipe.signals import kinematics

READY_RAD = (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4)  # start pose of the robot's own examples
LOWEST_RAD = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)  # Franka Emika, Panda documentation
HIGHEST_RAD = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)
HAND_M = 0.107 + 0.1034  # distance of the fingertips from the last joint's frame, along its axis
HAND_RAD = -np.pi / 4  # angle between the hand and the flange
WAYPOINT_ROWS = 10  # rows of 1 ms between solved angles; interpolation moves the hand by less than 0.1 mm
ROUNDS, DAMPING = 40, 1e-3


@dataclass(frozen=True)
class JointCourse:
    """Angles of the joints at waypoints: ``t_ns`` (waypoint,), ``angle_rad`` (waypoint, joint)."""

    t_ns: Times
    angle_rad: Floats

    def angles(self, t_ns: Times) -> Floats:
        """Return the angles at ``t_ns`` (time, joint), rad."""
        return _interpolated(t_ns, self.t_ns, self.angle_rad)

    def speeds(self, t_ns: Times) -> Floats:
        """Return the speeds at ``t_ns`` (time, joint), rad/s."""
        speed: Floats = np.gradient(self.angle_rad, self.t_ns / 1e9, axis=0)
        return _interpolated(t_ns, self.t_ns, speed)


def course(t_ns: Times, position_m: Floats, yaw_rad: Floats) -> JointCourse:
    """Return the course of the joints that has the hand at ``position_m`` (time, axis), pointing down, turned by the yaw."""
    rows = np.unique(np.append(np.arange(0, len(t_ns), WAYPOINT_ROWS), len(t_ns) - 1))
    return JointCourse(t_ns[rows], solved(position_m[rows], yaw_rad[rows]))


def solved(position_m: Floats, yaw_rad: Floats) -> Floats:
    """Return the angles (time, joint) that bring the hand to ``position_m`` (time, axis) with ``yaw_rad`` (time,)."""
    target = _downwards(yaw_rad)
    angle = np.tile(READY_RAD, (len(position_m), 1))
    for _ in range(ROUNDS):
        frames = kinematics.joint_frames(kinematics.PANDA, angle)
        place, turn = hand(frames)
        off = np.concatenate([position_m - place, _rotation_between(turn, target)], axis=1)  # (time, 6)
        axes, places = frames[:, :, :3, 2], frames[:, :, :3, 3]
        linear = np.cross(axes, place[:, None] - places)
        jacobian = np.concatenate([linear, axes], axis=2).transpose(0, 2, 1)  # (time, 6, joint)
        square = jacobian @ jacobian.transpose(0, 2, 1) + DAMPING * np.eye(6)
        step = np.einsum("tij,ti->tj", jacobian, np.linalg.solve(square, off[:, :, None])[:, :, 0])
        angle = np.clip(angle + np.clip(step, -0.2, 0.2), LOWEST_RAD, HIGHEST_RAD)
    return angle


def torques(angle_rad: Floats, force_n: Floats) -> Floats:
    """Return what the joints bear (time, joint), N m, for a force (time, axis) at the hand in the base's frame."""
    frames = kinematics.joint_frames(kinematics.PANDA, angle_rad)
    linear = np.cross(frames[:, :, :3, 2], hand(frames)[0][:, None] - frames[:, :, :3, 3])
    borne: Floats = -np.einsum("tja,ta->tj", linear, force_n)
    return borne


def hand(frames: AnyFloats) -> tuple[Floats, Floats]:
    """Return place (time, axis) and rotation (time, 3, 3) of the hand, of what `kinematics.joint_frames` gives."""
    last = frames[:, -1]
    cos, sin = np.cos(HAND_RAD), np.sin(HAND_RAD)
    place: Floats = last[:, :3, 3] + HAND_M * last[:, :3, 2]
    turn: Floats = last[:, :3, :3] @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return place, turn


def _downwards(yaw_rad: Floats) -> Floats:
    """Return the rotations (time, 3, 3) of a hand that points down: half a turn about an axis of half the yaw."""
    turn = np.zeros((len(yaw_rad), 3, 3))
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    turn[:, 0, 0], turn[:, 0, 1] = cos, sin
    turn[:, 1, 0], turn[:, 1, 1] = sin, -cos
    turn[:, 2, 2] = -1.0
    return turn


def _rotation_between(turn: Floats, target: Floats) -> Floats:
    """Return for small angles the vector (time, 3) that turns ``turn`` into ``target``."""
    vector: Floats = 0.5 * np.cross(turn, target, axis=1).sum(axis=2)
    return vector


def _interpolated(t_ns: Times, known_ns: Times, values: Floats) -> Floats:
    return np.column_stack([np.interp(t_ns, known_ns, column) for column in values.T])
