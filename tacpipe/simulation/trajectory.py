"""Generate random paths of the hand that lift and move an object.

There are two published protocols (Mandil et al., TAROS 2021, and the authors' recordings):

- *controlled*: Cartesian velocity commands with a trapezoidal profile, first up, then along -x, then a hold. The published
  generator has seven phases of equal duration T, with acceleration V / T and legs of length 2 V T, from x = 0.58 m and
  z = 0.18 m. Here V and T are random, and random legs follow until the end;
- *kinaesthetic*: a person moves the arm by hand. Human reaching is close to minimum jerk (Flash and Hogan 1985,
  J. Neurosci. 5(7)). Segments overlap, and a tremor is added.

World axes: x and y are horizontal, z is up. The gripper points down and rotates around the vertical by the yaw angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Floats, Int64s, Times
from tacpipe.errors import TacpipeError

RATE_HZ = 1000  # rate of a Franka Emika Panda's states
PROTOCOLS = ("controlled", "kinaesthetic")
START_M = (0.58, 0.0, 0.18)  # x and z from the published profile generator
JERK_S = 0.03  # time in which the acceleration of a controlled profile changes
PHASE_S = (0.16, 0.6)  # range of T for the lift and the next leg
JOLT_S = (0.06, 0.6)  # range of T for further legs; short ones make the object slip briefly
SPEED_M_S = 1.0  # maximum V; the limit of a Panda's hand is 1.7 m/s
LEG_M = (0.30, 0.15, 0.40)  # longest leg along x, y, z; the published legs have 0.30 m
AFTER_LIFT_S = 1.5  # shortest time of a trial after the lift
# region in which a person carries the object, relative to the start
BOX_M = ((-0.25, 0.25), (-0.15, 0.15), (0.10, 0.40))
PEAK_M_S2 = (1.0, 8.0)  # range of the peak acceleration of a minimum-jerk segment; the maximum also applies to legs
REACH = (0.05, 1.0)  # range of the fraction of the distance to the target that a segment covers; short ones are shakes
MIN_SEGMENT_S = 0.12
JERK_PEAK = 10 / np.sqrt(3)  # peak acceleration in m/s² of a minimum-jerk segment of 1 m in 1 s
OVERLAP = (0.75, 1.15)  # range of the start of the next segment, as a fraction of the duration of the current one
TREMOR_HZ = 4.0
TREMOR_M = (0.0002, 0.0008)  # range of the amplitude along each axis: up to 0.5 m/s²


@dataclass(frozen=True)
class Trajectory:
    """The motion of the hand at `RATE_HZ`, starting at 0, in world coordinates."""

    t_ns: Times
    position_m: Floats  # (time, axis)
    yaw_rad: Floats  # (time,)

    @property
    def acceleration_m_s2(self) -> Floats:
        """The second derivative of the position (time, axis). The hand is at rest before the first row."""
        return np.diff(self.position_m, n=2, axis=0, prepend=self.position_m[[0, 0]]) * RATE_HZ**2

    @property
    def rise_m(self) -> Floats:
        """The height of the hand above its start (time,)."""
        rise: Floats = self.position_m[:, 2] - self.position_m[0, 2]
        return rise

    @property
    def hand_acceleration_m_s2(self) -> Floats:
        """The acceleration in the hand frame, which is rotated by the yaw (time, axis)."""
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        x, y, z = self.acceleration_m_s2.T
        return np.column_stack([cos * x + sin * y, cos * y - sin * x, z])


def draw_trajectory(protocol: str, duration_s: float, first_s: float, rng: np.random.Generator) -> Trajectory:
    """Return a random trajectory of a protocol whose lift starts at ``first_s``.

    Raises `TacpipeError` for an unknown protocol, or if the trial is too short for the lift.
    """
    if protocol not in PROTOCOLS:
        raise TacpipeError(f"There is no protocol {protocol!r}; it must be {', '.join(PROTOCOLS)} or mixed.")
    if duration_s < first_s + AFTER_LIFT_S:
        raise TacpipeError(f"A trial of {duration_s} s ends before its lift; duration_s must be 4 s or more.")
    rows, first = round(duration_s * RATE_HZ) + 1, round(first_s * RATE_HZ)
    path = (
        draw_controlled_path(rows, first, rng) if protocol == "controlled" else draw_kinaesthetic_path(rows, first, rng)
    )
    since_s = _times_s(rows) - first_s
    yaw = rng.uniform(0.05, 0.3) * np.clip(since_s, 0.0, 1.0) * np.sin(2 * np.pi * since_s / rng.uniform(4.0, 8.0))
    return Trajectory(_stamps(rows), path + START_M, yaw)


def path_from_start(moved_m: Floats) -> Trajectory:
    """Return the trajectory of a hand that is displaced from its start by ``moved_m`` (time, axis), without yaw."""
    return Trajectory(_stamps(len(moved_m)), moved_m + START_M, np.zeros(len(moved_m)))


def rest(duration_s: float) -> Trajectory:
    """Return the trajectory of a lifted hand at rest."""
    rows = round(duration_s * RATE_HZ) + 1
    return Trajectory(_stamps(rows), np.tile(np.add(START_M, (0.0, 0.0, BOX_M[2][0])), (rows, 1)), np.zeros(rows))


def draw_controlled_path(rows: int, first: int, rng: np.random.Generator) -> Floats:
    """Return a path of the controlled protocol that starts in row ``first`` (time, axis), in metres from the start."""
    acceleration = smooth(_trapezoids(rows, first, rng))
    return np.cumsum(np.cumsum(acceleration, axis=0), axis=0) / RATE_HZ**2


def draw_kinaesthetic_path(rows: int, first: int, rng: np.random.Generator) -> Floats:
    """Return a path of the kinaesthetic protocol that starts in row ``first`` (time, axis), in metres from the start."""
    path = np.zeros((rows, 3))
    low, high = np.array(BOX_M).T
    at, row = np.zeros(3), first
    while row < rows:
        target = rng.uniform(low, high)
        if row == first:
            target[:2] *= 0.2  # the first segment is the lift
        else:
            target = at + (target - at) * rng.uniform(*REACH)
        distance = float(np.linalg.norm(target - at))
        peak = np.exp(rng.uniform(*np.log(PEAK_M_S2)))
        length = max(round(np.sqrt(JERK_PEAK * distance / peak) * RATE_HZ), round(MIN_SEGMENT_S * RATE_HZ))
        progress = np.clip((np.arange(rows) - row) / length, 0.0, 1.0)
        path += (target - at) * minimum_jerk(progress)[:, None]
        at, row = target, row + round(rng.uniform(*OVERLAP) * length)
    since_s = np.maximum(_times_s(rows) - first / RATE_HZ, 0.0)
    phases = 2 * np.pi * (TREMOR_HZ * since_s[:, None] + rng.random(3))
    path += rng.uniform(*TREMOR_M, 3) * minimum_jerk(np.clip(since_s, 0.0, 1.0))[:, None] * np.sin(phases)
    return path


def minimum_jerk(progress: Floats) -> Floats:
    """Return the fraction of the distance of a minimum-jerk movement after a fraction ``progress`` of its duration."""
    return progress**3 * (10 - 15 * progress + 6 * progress**2)


def smooth(acceleration: Floats) -> Floats:
    """Return ``acceleration`` (time, axis) averaged over the previous `JERK_S`, so that it has no steps."""
    width = round(JERK_S * RATE_HZ)
    total = np.cumsum(acceleration, axis=0)
    total[width:] -= total[:-width].copy()
    return total / width


def _trapezoids(rows: int, first: int, rng: np.random.Generator) -> Floats:
    """Return the commanded acceleration (time, axis): consecutive trapezoids of velocity from row ``first`` on."""
    acceleration = np.zeros((rows, 3))
    reach = np.zeros(3)  # position of the hand relative to its start, m
    row, leg = first, 0
    while row < rows:
        phase_s = rng.uniform(*PHASE_S) if leg < 2 else np.exp(rng.uniform(*np.log(JOLT_S)))
        phase = round(phase_s * RATE_HZ)  # rows, T of the published profile
        axis = (2, 0)[leg] if leg < 2 else int(rng.integers(3))
        sign = (1.0, -1.0)[leg] if leg < 2 else -np.sign(reach[axis]) or float(rng.choice([-1.0, 1.0]))
        longest = LEG_M[axis] if leg < 2 else max(LEG_M[axis] * 0.5, 0.05)
        top = min(longest / (2 * phase / RATE_HZ), SPEED_M_S, PEAK_M_S2[1] * phase / RATE_HZ)
        speed = rng.uniform(0.4, 1.0) * top  # V; a leg is 2 V T long
        if leg >= 2 and axis == 2 and sign < 0:
            speed = min(speed, 0.8 * reach[2] / (2 * phase / RATE_HZ))
        if row + 3 * phase + round(JERK_S * RATE_HZ) >= rows:
            break
        acceleration[row : row + phase, axis] += sign * speed * RATE_HZ / phase
        acceleration[row + 2 * phase : row + 3 * phase, axis] -= sign * speed * RATE_HZ / phase
        reach[axis] += sign * 2 * speed * phase / RATE_HZ
        row += 3 * phase + (phase if leg == 1 else round(rng.uniform(0.05, 0.3) * RATE_HZ))
        leg += 1
    return acceleration


def _times_s(rows: int) -> Floats:
    return np.arange(rows) / RATE_HZ


def _stamps(rows: int) -> Int64s:
    return np.arange(rows, dtype=np.int64) * (1_000_000_000 // RATE_HZ)
