"""Simulate the world of the emulated rig without an end: pick-and-move trials, one after another.

A cycle is a trial of `tacpipe.simulation.pick_and_move` and the way back: the fingers open, the hand returns to where it
began. So nothing jumps, and the skins stay the same throughout. Cycles are made when they are asked for, and a few are kept.

The joints follow the hand by damped least squares from the arm's ready position (Siciliano et al., Robotics, 2009, section
3.7), all moments of a path side by side. Where the path leaves what the arm reaches, the hand comes as near as it can.
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

READY_RAD = (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4)  # start pose of the robot's own examples
MIN_JOINT_RAD = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)  # Franka Emika, Panda documentation
MAX_JOINT_RAD = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)
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


def joint_course(t_ns: Times, position_m: Floats, yaw_rad: Floats) -> JointCourse:
    """Return the course of the joints that has the hand at ``position_m`` (time, axis), pointing down, turned by the yaw."""
    rows = np.unique(np.append(np.arange(0, len(t_ns), WAYPOINT_ROWS), len(t_ns) - 1))
    return JointCourse(t_ns[rows], solved(position_m[rows], yaw_rad[rows]))


def solved(position_m: Floats, yaw_rad: Floats) -> Floats:
    """Return the angles (time, joint) that bring the hand to ``position_m`` (time, axis) with ``yaw_rad`` (time,)."""
    target = _downwards(yaw_rad)
    angle = np.tile(READY_RAD, (len(position_m), 1))
    for _ in range(ROUNDS):
        frames = kinematics.joint_frames(kinematics.PANDA, angle)
        place, turn = hand_pose(frames)
        off = np.concatenate([position_m - place, _rotation_between(turn, target)], axis=1)  # (time, 6)
        axes, places = frames[:, :, :3, 2], frames[:, :, :3, 3]
        linear = np.cross(axes, place[:, None] - places)
        jacobian = np.concatenate([linear, axes], axis=2).transpose(0, 2, 1)  # (time, 6, joint)
        square = jacobian @ jacobian.transpose(0, 2, 1) + DAMPING * np.eye(6)
        step = np.einsum("tij,ti->tj", jacobian, np.linalg.solve(square, off[:, :, None])[:, :, 0])
        angle = np.clip(angle + np.clip(step, -0.2, 0.2), MIN_JOINT_RAD, MAX_JOINT_RAD)
    return angle


def joint_torques(angle_rad: Floats, force_n: Floats) -> Floats:
    """Return what the joints bear (time, joint), N m, for a force (time, axis) at the hand in the base's frame."""
    frames = kinematics.joint_frames(kinematics.PANDA, angle_rad)
    linear = np.cross(frames[:, :, :3, 2], hand_pose(frames)[0][:, None] - frames[:, :, :3, 3])
    borne: Floats = -np.einsum("tja,ta->tj", linear, force_n)
    return borne


def hand_pose(frames: AnyFloats) -> tuple[Floats, Floats]:
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


TRIAL_S, RETURN_S = 10.5, 1.5  # duration of a cycle
RELEASE_S = 0.3  # time in which the fingers open, at the start of the way back
CYCLE_NS = round((TRIAL_S + RETURN_S) * 1e9)
BASE_M = (
    0.12,
    0.0,
    0.0,
)  # the arm stands this much nearer than the published rig's, so that it reaches all positions of hands
CYCLES = 4  # number of cycles that are kept: streams run ahead of each other by less


@dataclass(frozen=True)
class Cycle:
    """A trial with its way back, and the angles of the arm's joints meanwhile."""

    scene: pick_and_move.PickScene
    joints: JointCourse

    def torques(self, t_ns: Times) -> Floats:
        """Return what the load in the hand asks of the joints (time, joint), N m."""
        load_n = -pick_and_move.interpolation(self.scene, t_ns)(self.scene.contact.force_n)
        yaw_rad = pick_and_move.interpolation(self.scene, t_ns)(self.scene.path.yaw_rad)
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        in_base_n = np.column_stack(
            [cos * load_n[:, 0] - sin * load_n[:, 1], sin * load_n[:, 0] + cos * load_n[:, 1], load_n[:, 2]]
        )
        return joint_torques(self.joints.angles(t_ns), in_base_n)


class World:
    """One physical simulation, which all sensors of a rig look at; times are nanoseconds from its start."""

    def __init__(self, seed: int = 0, rig: pick_and_move.PickRig | None = None) -> None:
        self._seed = seed
        self._rig = replace(rig or pick_and_move.PickRig(), duration_s=TRIAL_S)
        self._cycle = functools.lru_cache(CYCLES)(self._generate)
        self.skins = pick_and_move.perform(seed, 0, self._rig).skins

    def cycle(self, number: int) -> Cycle:
        """Return cycle ``number``; the same seed gives the same one, whenever it is asked for."""
        return self._cycle(number)

    def _generate(self, number: int) -> Cycle:
        scene = replace(pick_and_move.perform(self._seed, number, self._rig), skins=self.skins)
        full_scene = with_return(scene)
        return Cycle(
            full_scene, joint_course(full_scene.path.t_ns, full_scene.path.position_m, full_scene.path.yaw_rad)
        )

    def at(self, t_ns: Times, look: Callable[[Cycle, Times], Floats]) -> Floats:
        """Return what ``look`` finds of each cycle at times within it, for ``t_ns`` (time,) in order: (time, …)."""
        numbers = t_ns // CYCLE_NS
        parts = [
            look(self.cycle(int(number)), t_ns[numbers == number] - number * CYCLE_NS) for number in np.unique(numbers)
        ]
        return np.concatenate(parts)

    def contact(self, t_ns: Times, value: Callable[[pick_and_move.PickScene], Any]) -> Floats:
        """Return at ``t_ns`` (time,) a value of the scene that is given at 1 kHz: (time,) or (time, axis)."""
        return self.at(
            t_ns, lambda cycle, local_ns: pick_and_move.interpolation(cycle.scene, local_ns)(value(cycle.scene))
        )

    def touch(self, finger: int, t_ns: Times) -> Floats:
        """Return the force on each taxel of finger 0 or 1 (time, taxel, axis), N."""
        return self.at(t_ns, lambda cycle, local_ns: pick_and_move.touch(cycle.scene, finger, local_ns))

    def arm(self, t_ns: Times) -> Floats:
        """Return finger width, position and quaternion (time, 8), as the simulated rig's stream ``robot``."""
        return self.at(t_ns, lambda cycle, local_ns: pick_and_move.arm(cycle.scene, local_ns))

    def joint_angles(self, t_ns: Times) -> Floats:
        """Return the angles of the arm's seven joints (time, joint), rad."""
        return self.at(t_ns, lambda cycle, local_ns: cycle.joints.angles(local_ns))

    def joint_speeds(self, t_ns: Times) -> Floats:
        """Return the speeds of the arm's seven joints (time, joint), rad/s."""
        return self.at(t_ns, lambda cycle, local_ns: cycle.joints.speeds(local_ns))

    def joint_torques(self, t_ns: Times) -> Floats:
        """Return what the load in the hand asks of the arm's seven joints (time, joint), N m."""
        return self.at(t_ns, lambda cycle, local_ns: cycle.torques(local_ns))


def with_return(scene: pick_and_move.PickScene) -> pick_and_move.PickScene:
    """Return a scene that is longer by the way back: its last row is as its first."""
    rows = round(RETURN_S * trajectory.RATE_HZ)
    since_s = np.arange(1, rows + 1) / trajectory.RATE_HZ
    grip = 1 - trajectory.minimum_jerk(np.clip(since_s / RELEASE_S, 0.0, 1.0))  # (time,), of the grip
    away = 1 - trajectory.minimum_jerk(np.clip((since_s - RELEASE_S) / (RETURN_S - RELEASE_S), 0.0, 1.0))

    def fading(values: Floats, fraction: Floats, resting: Any = 0.0) -> Floats:
        last = values[-1] - resting
        faded: Floats = np.concatenate([values, resting + np.multiply.outer(fraction, last)])
        return faded

    path, contact, grasp = scene.path, scene.contact, scene.grasp
    no_slip = np.zeros(rows, dtype=bool)
    step_ns = 1_000_000_000 // trajectory.RATE_HZ
    return replace(
        scene,
        path=trajectory.Trajectory(
            np.concatenate([path.t_ns, path.t_ns[-1] + step_ns * np.arange(1, rows + 1)]),
            fading(path.position_m, away, path.position_m[0]) - BASE_M,
            fading(path.yaw_rad, away, path.yaw_rad[0]),
        ),
        finger_m=fading(scene.finger_m, grip, scene.finger_m[0]),
        grasp=replace(grasp, grip_n=fading(grasp.grip_n, grip)),
        contact=mechanics.Contact(
            fading(contact.force_n, grip),
            fading(contact.normal_n, grip),
            fading(contact.displacement_m, away),
            fading(contact.velocity_m_s, np.zeros(rows)),
            np.concatenate([contact.slip, no_slip]),
            np.concatenate([contact.dropped, no_slip]),
            fading(contact.torque_nm, grip),
            fading(contact.rotation_rad, away),
        ),
    )
