"""Simulate the endless world of the emulated rig: a sequence of pick-and-move trials.

A cycle is a trial of `tacpipe.simulation.pick_and_move` followed by a return: the fingers open, and the hand moves back to
its start. Nothing jumps, and the skins do not change. Cycles are generated on demand, and a few are cached.

The joints follow the hand by damped least squares from the arm's ready position (Siciliano et al., Robotics, 2009, section
3.7), for all times of a path at once. Outside of the arm's workspace, the hand gets as close to the path as possible.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Times
from tacpipe.signals import kinematics
from tacpipe.simulation import mechanics, pick_and_move, trajectory

READY_RAD = (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4)  # start pose in the robot's examples
MIN_JOINT_RAD = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)  # Franka Emika, Panda documentation
MAX_JOINT_RAD = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)
HAND_M = 0.107 + 0.1034  # distance of the fingertips from the last joint's frame, along its axis
HAND_RAD = -np.pi / 4  # angle between the hand and the flange
WAYPOINT_ROWS = 10  # rows of 1 ms between solutions; the interpolation error of the hand is below 0.1 mm
ITERATIONS, DAMPING = 40, 1e-3


@dataclass(frozen=True)
class JointCourse:
    """Angles of the joints at waypoints: ``t_ns`` (waypoint,), ``angle_rad`` (waypoint, joint)."""

    t_ns: Times
    angle_rad: Floats

    def angles(self, t_ns: Times) -> Floats:
        """Return the angles at ``t_ns`` (time, joint) in rad."""
        return _interpolate(t_ns, self.t_ns, self.angle_rad)

    def speeds(self, t_ns: Times) -> Floats:
        """Return the speeds at ``t_ns`` (time, joint) in rad/s."""
        speed: Floats = np.gradient(self.angle_rad, self.t_ns / 1e9, axis=0)
        return _interpolate(t_ns, self.t_ns, speed)


def joint_course(t_ns: Times, position_m: Floats, yaw_rad: Floats) -> JointCourse:
    """Return the joint angles over time for a downward hand at ``position_m`` (time, axis) with ``yaw_rad`` (time,)."""
    rows = np.unique(np.append(np.arange(0, len(t_ns), WAYPOINT_ROWS), len(t_ns) - 1))
    return JointCourse(t_ns[rows], solve_angles(position_m[rows], yaw_rad[rows]))


def solve_angles(position_m: Floats, yaw_rad: Floats) -> Floats:
    """Return the joint angles (time, joint) in rad for the hand at ``position_m`` (time, axis) with ``yaw_rad`` (time,)."""
    target = _downwards(yaw_rad)
    angle = np.tile(READY_RAD, (len(position_m), 1))
    for _ in range(ITERATIONS):
        frames = kinematics.joint_frames(kinematics.PANDA, angle)
        position, rotation = hand_pose(frames)
        error = np.concatenate([position_m - position, _rotation_between(rotation, target)], axis=1)  # (time, 6)
        axes, origins = frames[:, :, :3, 2], frames[:, :, :3, 3]
        linear = np.cross(axes, position[:, None] - origins)
        jacobian = np.concatenate([linear, axes], axis=2).transpose(0, 2, 1)  # (time, 6, joint)
        square = jacobian @ jacobian.transpose(0, 2, 1) + DAMPING * np.eye(6)
        step = np.einsum("tij,ti->tj", jacobian, np.linalg.solve(square, error[:, :, None])[:, :, 0])
        angle = np.clip(angle + np.clip(step, -0.2, 0.2), MIN_JOINT_RAD, MAX_JOINT_RAD)
    return angle


def joint_torques(angle_rad: Floats, force_n: Floats) -> Floats:
    """Return the joint torques (time, joint) in N m for a force (time, axis) at the hand in the base frame."""
    frames = kinematics.joint_frames(kinematics.PANDA, angle_rad)
    linear = np.cross(frames[:, :, :3, 2], hand_pose(frames)[0][:, None] - frames[:, :, :3, 3])
    torques: Floats = -np.einsum("tja,ta->tj", linear, force_n)
    return torques


def hand_pose(frames: AnyFloats) -> tuple[Floats, Floats]:
    """Return position (time, axis) and rotation (time, 3, 3) of the hand, from the result of `kinematics.joint_frames`."""
    last = frames[:, -1]
    cos, sin = np.cos(HAND_RAD), np.sin(HAND_RAD)
    position: Floats = last[:, :3, 3] + HAND_M * last[:, :3, 2]
    rotation: Floats = last[:, :3, :3] @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return position, rotation


def _downwards(yaw_rad: Floats) -> Floats:
    """Return the rotations (time, 3, 3) of a downward hand: a half-turn around an axis at half the yaw angle."""
    rotation = np.zeros((len(yaw_rad), 3, 3))
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    rotation[:, 0, 0], rotation[:, 0, 1] = cos, sin
    rotation[:, 1, 0], rotation[:, 1, 1] = sin, -cos
    rotation[:, 2, 2] = -1.0
    return rotation


def _rotation_between(rotation: Floats, target: Floats) -> Floats:
    """Return the rotation vector (time, 3) from ``rotation`` to ``target``, for small angles."""
    vector: Floats = 0.5 * np.cross(rotation, target, axis=1).sum(axis=2)
    return vector


def _interpolate(t_ns: Times, waypoint_ns: Times, values: Floats) -> Floats:
    return np.column_stack([np.interp(t_ns, waypoint_ns, column) for column in values.T])


TRIAL_S, RETURN_S = 10.5, 1.5  # duration of a cycle
RELEASE_S = 0.3  # duration of the opening of the fingers, at the start of the return
CYCLE_NS = round((TRIAL_S + RETURN_S) * 1e9)
# offset of the arm's base from that of the published rig, so that all hand positions are within reach
BASE_M = (0.12, 0.0, 0.0)
CYCLES = 4  # number of cached cycles; streams are never further apart


@dataclass(frozen=True)
class Cycle:
    """A trial with its return, and the angles of the arm's joints."""

    scene: pick_and_move.PickScene
    joints: JointCourse

    def torques(self, t_ns: Times) -> Floats:
        """Return the joint torques (time, joint) in N m for the load in the hand."""
        load_n = -pick_and_move.interpolation(self.scene, t_ns)(self.scene.contact.force_n)
        yaw_rad = pick_and_move.interpolation(self.scene, t_ns)(self.scene.path.yaw_rad)
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        in_base_n = np.column_stack(
            [cos * load_n[:, 0] - sin * load_n[:, 1], sin * load_n[:, 0] + cos * load_n[:, 1], load_n[:, 2]]
        )
        return joint_torques(self.joints.angles(t_ns), in_base_n)


class World:
    """One physical simulation for all sensors of a rig. Times are in ns since its start.

    The hand waits with open fingers for ``idle_s`` before the first cycle.
    """

    def __init__(self, seed: int = 0, rig: pick_and_move.PickRig | None = None, *, idle_s: float = 0.0) -> None:
        self._seed, self.idle_ns = seed, round(idle_s * 1e9)
        self._rig = replace(rig or pick_and_move.PickRig(), duration_s=TRIAL_S)
        self._cycle = functools.lru_cache(CYCLES)(self._generate)
        self.skins = pick_and_move.perform(seed, 0, self._rig).skins

    def cycle(self, number: int) -> Cycle:
        """Return cycle ``number``, which depends only on the seed."""
        return self._cycle(number)

    def _generate(self, number: int) -> Cycle:
        """Return the cycle with this number: a trial and the return to its start."""
        scene = replace(pick_and_move.perform(self._seed, number, self._rig), skins=self.skins)
        full_scene = append_return(scene)
        return Cycle(
            full_scene, joint_course(full_scene.path.t_ns, full_scene.path.position_m, full_scene.path.yaw_rad)
        )

    def at(self, t_ns: Times, value: Callable[[Cycle, Times], Floats]) -> Floats:
        """Return values (time, …) at ascending ``t_ns`` (time,). ``value`` computes them from a cycle and its times."""
        since_ns = np.maximum(t_ns - self.idle_ns, 0)
        numbers = since_ns // CYCLE_NS
        parts = [
            value(self.cycle(int(number)), since_ns[numbers == number] - number * CYCLE_NS)
            for number in np.unique(numbers)
        ]
        return np.concatenate(parts)

    def contact(self, t_ns: Times, value: Callable[[pick_and_move.PickScene], Any]) -> Floats:
        """Return a value of the scene, (time,) or (time, axis) at 1 kHz, interpolated at ``t_ns`` (time,)."""
        return self.at(
            t_ns, lambda cycle, local_ns: pick_and_move.interpolation(cycle.scene, local_ns)(value(cycle.scene))
        )

    def touch(self, finger: int, t_ns: Times) -> Floats:
        """Return the force on each taxel of finger 0 or 1 (time, taxel, axis) in N."""
        return self.at(t_ns, lambda cycle, local_ns: pick_and_move.touch(cycle.scene, finger, local_ns))

    def arm(self, t_ns: Times) -> Floats:
        """Return finger width, position and quaternion (time, 8), like the simulated rig's stream ``robot``."""
        return self.at(t_ns, lambda cycle, local_ns: pick_and_move.arm(cycle.scene, local_ns))

    def joint_angles(self, t_ns: Times) -> Floats:
        """Return the angles of the arm's seven joints (time, joint) in rad."""
        return self.at(t_ns, lambda cycle, local_ns: cycle.joints.angles(local_ns))

    def joint_speeds(self, t_ns: Times) -> Floats:
        """Return the speeds of the arm's seven joints (time, joint) in rad/s."""
        return self.at(t_ns, lambda cycle, local_ns: cycle.joints.speeds(local_ns))

    def joint_torques(self, t_ns: Times) -> Floats:
        """Return the torques of the arm's seven joints (time, joint) in N m for the load in the hand."""
        return self.at(t_ns, lambda cycle, local_ns: cycle.torques(local_ns))


def append_return(scene: pick_and_move.PickScene) -> pick_and_move.PickScene:
    """Return a scene with a release and the hand's way back appended, so that its last row equals its first."""
    rows = round(RETURN_S * trajectory.RATE_HZ)
    elapsed_s = np.arange(1, rows + 1) / trajectory.RATE_HZ
    grip = 1 - trajectory.minimum_jerk(np.clip(elapsed_s / RELEASE_S, 0.0, 1.0))  # (time,), fraction of the grip
    away = 1 - trajectory.minimum_jerk(np.clip((elapsed_s - RELEASE_S) / (RETURN_S - RELEASE_S), 0.0, 1.0))

    def fade(values: Floats, fraction: Floats, resting: Any = 0.0) -> Floats:
        last = values[-1] - resting
        return np.concatenate([values, resting + np.multiply.outer(fraction, last)])

    path, contact, grasp = scene.path, scene.contact, scene.grasp
    no_slip = np.zeros(rows, dtype=bool)
    step_ns = 1_000_000_000 // trajectory.RATE_HZ
    return replace(
        scene,
        path=trajectory.Trajectory(
            np.concatenate([path.t_ns, path.t_ns[-1] + step_ns * np.arange(1, rows + 1)]),
            fade(path.position_m, away, path.position_m[0]) - BASE_M,
            fade(path.yaw_rad, away, path.yaw_rad[0]),
        ),
        finger_m=fade(scene.finger_m, grip, scene.finger_m[0]),
        grasp=replace(grasp, grip_n=fade(grasp.grip_n, grip)),
        contact=mechanics.Contact(
            fade(contact.force_n, grip),
            fade(contact.normal_n, grip),
            fade(contact.displacement_m, away),
            fade(contact.velocity_m_s, np.zeros(rows)),
            np.concatenate([contact.slip, no_slip]),
            np.concatenate([contact.dropped, no_slip]),
            fade(contact.torque_nm, grip),
            fade(contact.rotation_rad, away),
        ),
    )
