"""Simulate stick and slip between two fingers and the object in their grasp.

Each finger presses along y with N, so that Coulomb friction transmits up to 2 mu N in the xz plane. The required force
is D = m (a + g e_z), where a is the acceleration of the hand in its own frame. The model has two states and is
integrated with an implicit velocity step:

- *stick*: a critically damped spring at an anchor (k = 2e4 N/m, c = 2 sqrt(k m)) carries the load. Slip starts if the spring
  force exceeds 2 mu_s N. The damper force is not counted; it adds a few percent for some ms after a jolt;
- *slip*: friction of 2 mu_k N opposes the relative velocity. If it would reverse the velocity, the object sticks again, with
  the anchor set so that the spring carries the load at that time.

The LuGre model is not used, because its break-away force depends on the loading rate, and it creeps at rest. The spring
represents the stiffness of a resting contact. Its deflection (0.3 mm at 6 N) is not counted as displacement; only slip is.

Along y the object is clamped: its acceleration follows from the difference of the normal forces, whose sum stays 2 N. While
the object is on the table, the table carries its weight, and transfers it within `TABLE_M` of rise. After a displacement of
`DROP_M` the object is dropped: contact forces are zero, it falls, and rests where it lands.

A grasp next to the centre of mass also twists the object around y. Each soft finger resists up to (2/3) mu N R, as for
uniform pressure on a disc of radius R. The friction limits of twist and shear are independent.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Bools, Floats

GRAVITY_M_S2 = 9.81
UPWARDS_M_S2 = np.array([0.0, 0.0, GRAVITY_M_S2])  # acceleration of a resting object due to its support
STIFFNESS_N_M = 2e4
KINETIC = 0.8  # mu_k / mu_s
DROP_M = 0.025
TABLE_M = 0.001  # rise over which the object's weight is transferred from the table to the fingers
PATCH_M = 0.008  # R, radius of the contact patch
BLOCK_ROWS = 1 << 14  # rows converted to Python numbers at once, which need ten times the memory of an array
GYRATION_M = 0.06  # radius of gyration, as for a small bottle


@dataclass(frozen=True)
class HeldObject:
    """The object in the grasp, and the parameters of the grasp."""

    mass_kg: float
    friction: float  # mu_s
    grip_n: Floats  # (time,), normal force of each finger in N without acceleration along y
    lever_m: float = 0.0  # offset of the centre of mass from the grasp along x

    @property
    def limit_n(self) -> Floats:
        """The largest static friction force of both fingers in the xz plane, 2 mu_s N (time,)."""
        return 2 * self.friction * self.grip_n

    def demand_n(self, acceleration_m_s2: Floats, borne: Floats | float = 1.0) -> Floats:
        """Return the force (time, axis) in the hand frame that moves the object with the hand.

        ``acceleration_m_s2`` (time, axis) is that of the hand in its frame; ``borne`` (time,) is the fraction of the weight
        that the fingers carry.
        """
        pull: Floats = self.mass_kg * (acceleration_m_s2 + UPWARDS_M_S2)
        pull[:, 2] *= borne
        return pull


@dataclass(frozen=True)
class Contact:
    """Contact forces, and the motion of the object relative to the fingers, in the hand frame."""

    force_n: Floats  # (time, axis), force of both fingers on the object
    normal_n: Floats  # (time, finger)
    displacement_m: Floats  # (time, 2), relative displacement of the object along x and z
    velocity_m_s: Floats  # (time, 2), relative velocity along x and z
    slip: Bools  # (time,), True while the object slips and is not dropped
    dropped: Bools  # (time,)
    torque_nm: Floats  # (time,), torque of both fingers around y
    rotation_rad: Floats  # (time,), relative rotation of the object around y

    @property
    def onset(self) -> int | None:
        """The first row with slip, or None."""
        return int(self.slip.argmax()) if self.slip.any() else None


def carry(
    grasp: HeldObject, acceleration_m_s2: Floats, rise_m: Floats | None = None, *, rate_hz: float = 1000.0
) -> Contact:
    """Simulate the contact while the hand accelerates with ``acceleration_m_s2`` (time, axis) in its own frame.

    ``rise_m`` (time,) is the hand's height above its height at which the object is on the table. If it is None, there is no
    table, and the object initially sticks under its load.
    """
    moves = _slide(grasp, acceleration_m_s2, rise_m, 1 / rate_hz)  # (time, 7)
    is_held = moves[:, 6] < 2
    along = acceleration_m_s2[:, 1] * grasp.mass_kg * (grasp.grip_n > 0) * is_held
    force = np.column_stack([moves[:, 0], along, moves[:, 1]])
    pressed = (grasp.grip_n > 0) * is_held
    normal = np.column_stack([grasp.grip_n + along / 2, grasp.grip_n - along / 2]) * pressed[:, None]
    torque, rotation = _twist(grasp, force, is_held, 1 / rate_hz)
    return Contact(
        force, np.maximum(normal, 0.0), moves[:, 2:4], moves[:, 4:6], moves[:, 6] == 1, ~is_held, torque, rotation
    )


def _slide(grasp: HeldObject, acceleration_m_s2: Floats, rise_m: Floats | None, step_s: float) -> Floats:
    """Return force x and z, displacement x and z, velocity x and z, and state (time, 7).

    The state is 0 for stick or before contact, 1 for slip and 2 after a drop. The loop over rows is needed because the
    state of a row depends on the previous row.
    """
    rows = len(acceleration_m_s2)
    moves = np.zeros((rows, 7))
    if not (grasp.grip_n > 0).any():
        return moves
    first = int((grasp.grip_n > 0).argmax())
    mass, rate = grasp.mass_kg, step_s / grasp.mass_kg
    damping = 2 * math.sqrt(STIFFNESS_N_M * mass)
    implicit_factor = 1 / (1 + rate * damping + rate * step_s * STIFFNESS_N_M)
    limits, heights_m = grasp.limit_n, np.ones(rows) if rise_m is None else rise_m
    sx = sz = vx = vz = 0.0  # displacement (x, z) by slip, and relative velocity (x, z)
    load_fraction = min(max(float(heights_m[first]) / TABLE_M, 0.0), 1.0)
    ex = -(mass * float(acceleration_m_s2[first, 0])) / STIFFNESS_N_M  # deflection (x, z) of the spring
    ez = -(mass * (float(acceleration_m_s2[first, 2]) + GRAVITY_M_S2)) * load_fraction / STIFFNESS_N_M
    slipping = False
    pending: list[tuple[float, ...]] = []  # rows that have not been written to `moves`
    last = first  # number of rows in `moves`
    for height_m, pull_x, pull_z, limit in _python_rows(mass, acceleration_m_s2, limits, heights_m, first):
        load_fraction = min(max((height_m + sz) / TABLE_M, 0.0), 1.0)
        dx, dz = pull_x, pull_z * load_fraction
        if not slipping:
            vx = (vx - rate * (STIFFNESS_N_M * ex + dx)) * implicit_factor
            vz = (vz - rate * (STIFFNESS_N_M * ez + dz)) * implicit_factor
            ex, ez = ex + step_s * vx, ez + step_s * vz
            fx, fz = -STIFFNESS_N_M * ex - damping * vx, -STIFFNESS_N_M * ez - damping * vz
            slipping = (ex * ex + ez * ez) * STIFFNESS_N_M**2 > limit * limit
        if slipping:
            free_x, free_z = vx - rate * dx, vz - rate * dz
            speed, friction_step = (free_x**2 + free_z**2) ** 0.5, rate * KINETIC * limit
            if speed <= friction_step:
                slipping, vx, vz, fx, fz = False, 0.0, 0.0, dx, dz
                ex, ez = -dx / STIFFNESS_N_M, -dz / STIFFNESS_N_M
            else:
                vx, vz = free_x * (1 - friction_step / speed), free_z * (1 - friction_step / speed)
                fx, fz = -KINETIC * limit * free_x / speed, -KINETIC * limit * free_z / speed
                sx, sz = sx + step_s * vx, sz + step_s * vz
                if sx * sx + sz * sz > DROP_M**2:
                    break
        pending.append((fx, fz, sx, sz, vx if slipping else 0.0, vz if slipping else 0.0, float(slipping)))
        if len(pending) == BLOCK_ROWS:
            moves[last : last + len(pending)] = pending
            last += len(pending)
            pending.clear()
    moves[last : last + len(pending)] = pending
    last += len(pending)
    if last < rows:
        moves[last:, 2:6] = _fall(acceleration_m_s2[last:], heights_m[last:], (sx, sz), (vx, vz), step_s)
        moves[last:, 6] = 2
    return moves


def _python_rows(
    mass_kg: float, acceleration_m_s2: Floats, limits_n: Floats, rises_m: Floats, first: int
) -> Iterator[tuple[float, float, float, float]]:
    """Yield (rise, force along x, force along z, friction limit) of each row from ``first`` on as Python numbers."""
    for begin in range(first, len(rises_m), BLOCK_ROWS):
        block = slice(begin, begin + BLOCK_ROWS)
        pull_x = (mass_kg * acceleration_m_s2[block, 0]).tolist()
        pull_z = (mass_kg * (acceleration_m_s2[block, 2] + GRAVITY_M_S2)).tolist()
        yield from zip(rises_m[block].tolist(), pull_x, pull_z, limits_n[block].tolist(), strict=True)


def _fall(
    acceleration_m_s2: Floats,
    height: Floats,
    displacement_m: tuple[float, float],
    velocity_m_s: tuple[float, float],
    step_s: float,
) -> Floats:
    """Return displacement x and z and velocity x and z of a dropped object (time, 4), which rests after landing."""
    velocity = np.array(velocity_m_s) - np.cumsum(acceleration_m_s2[:, ::2] + [0.0, GRAVITY_M_S2], axis=0) * step_s
    displacement = np.array(displacement_m) + np.cumsum(velocity, axis=0) * step_s
    landed = height + displacement[:, 1] <= 0
    if landed.any():
        row = int(landed.argmax())
        displacement[row:, 1] = -height[row:]
        displacement[row:, 0] = displacement[row, 0]
        velocity[row:] = 0.0
        velocity[row + 1 :, 1] = -np.diff(height[row:]) / step_s
    return np.column_stack([displacement, velocity])


def _twist(grasp: HeldObject, force_n: Floats, is_held: Bools, step_s: float) -> tuple[Floats, Floats]:
    """Return torque around y and relative rotation of the object (time,).

    At angle 0, the centre of mass is ``lever_m`` next to the grasp. Friction prevents a rotation up to the limit of the soft
    fingers, and damps it beyond. After a drop, the angle is constant.
    """
    rows = len(force_n)
    torques, angles = np.zeros(rows), np.zeros(rows)
    if not grasp.lever_m:
        return torques, angles
    rate = step_s / (grasp.mass_kg * (GYRATION_M**2 + grasp.lever_m**2))
    limits = (2 * (2 / 3) * grasp.friction * grasp.grip_n * PATCH_M).tolist()
    force_x, force_z = force_n[:, 0].tolist(), force_n[:, 2].tolist()
    angle = speed = 0.0
    for row in range(int(is_held.sum())):
        demand = grasp.lever_m * (force_z[row] * math.cos(angle) - force_x[row] * math.sin(angle))
        limit, torque = limits[row], demand
        if speed or abs(demand) > limit:
            free, braked = speed + rate * demand, rate * KINETIC * limit
            if abs(free) > braked:
                speed = free - math.copysign(braked, free)
                torque = math.copysign(KINETIC * limit, free)
            else:
                speed = 0.0
            angle += step_s * speed
        torques[row], angles[row] = torque, angle
    angles[int(is_held.sum()) :] = angle
    return torques, angles
