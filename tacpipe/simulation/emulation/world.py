"""Simulate the world of the emulated rig without an end: pick-and-move trials, one after another.

A cycle is a trial of `tacpipe.simulation.pick_and_move` and the way back: the fingers open, the hand returns to where it
began. So nothing jumps, and the skins stay the same throughout. Cycles are made when they are asked for, and a few are kept.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tacpipe.arrays import Floats, Times
from tacpipe.simulation import mechanics, pick_and_move, trajectory
from tacpipe.simulation.emulation import joints

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
    joints: joints.JointCourse

    def torques(self, t_ns: Times) -> Floats:
        """Return what the load in the hand asks of the joints (time, joint), N m."""
        load_n = -pick_and_move.interpolation(self.scene, t_ns)(self.scene.contact.force_n)
        yaw_rad = pick_and_move.interpolation(self.scene, t_ns)(self.scene.path.yaw_rad)
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        in_base_n = np.column_stack(
            [cos * load_n[:, 0] - sin * load_n[:, 1], sin * load_n[:, 0] + cos * load_n[:, 1], load_n[:, 2]]
        )
        return joints.torques(self.joints.angles(t_ns), in_base_n)


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
            full_scene, joints.course(full_scene.path.t_ns, full_scene.path.position_m, full_scene.path.yaw_rad)
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
