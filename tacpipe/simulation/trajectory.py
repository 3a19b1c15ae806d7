"""The path of the hand: how the arm lifts an object and moves it about.

Two protocols of collection are known (Mandil et al., TAROS 2021, and the authors' recordings):

- *controlled*: Cartesian velocity commands of trapezoidal profile, first up, then along -x, then a hold. The published
  generator cuts this into seven phases of equal length T, with acceleration V / T and 2 V T a leg, from x = 0.58 m and
  z = 0.18 m; V and T are random here, and random legs follow until the time is over;
- *kinaesthetic*: a person moves the arm by hand. Human reaching is close to minimum jerk (Flash and Hogan 1985,
  J. Neurosci. 5(7)); segments overlap, and a tremor lies on top.

World axes: x and y are horizontal, z is up. The gripper points down and turns about the vertical by the yaw angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Floats, Int64s, Times
from tacpipe.errors import TacpipeError

RATE_HZ = 1000  # rate of a Franka Emika Panda's states
PROTOCOLS = ("controlled", "kinaesthetic")
START_M = (0.58, 0.0, 0.18)  # x and z: the published profile generator
JERK_S = 0.03  # over which the acceleration of a controlled profile changes
PHASE_S = (0.16, 0.6)  # T of the lift and the leg after it
JOLT_S = (0.06, 0.6)  # T of further legs: the short ones make the object slip a little and hold again
SPEED_M_S = 1.0  # largest V; a Panda's hand is rated for 1.7 m/s
LEG_M = (0.30, 0.15, 0.40)  # longest leg along x, y, z; the published ones are 0.30 m long
AFTER_LIFT_S = 1.5  # time of a trial after the lift, at least
BOX_M = (
    (-0.25, 0.25),
    (-0.15, 0.15),
    (0.10, 0.40),
)  # region in which a person carries the object, relative to the start
PEAK_M_S2 = (1.0, 8.0)  # peak acceleration of a minimum-jerk segment; the larger one is the limit of a leg's too
REACH = (0.05, 1.0)  # fraction of the way to its random target per segment: short ones are shakes
MIN_SEGMENT_S = 0.12  # segment
JERK_PEAK = 10 / np.sqrt(3)  # peak acceleration of a minimum-jerk segment of one metre in one second
OVERLAP = (0.75, 1.15)  # start of the next segment, in lengths of this one
TREMOR_HZ = 4.0
TREMOR_M = (0.0002, 0.0008)  # amplitude along each axis: up to 0.5 m/s²


@dataclass(frozen=True)
class Trajectory:
    """The motion of the hand at `RATE_HZ` from 0. Arrays are (time,) or (time, axis), in world coordinates."""

    t_ns: Times
    position_m: Floats  # (time, axis)
    yaw_rad: Floats  # (time,)

    @property
    def acceleration_m_s2(self) -> Floats:
        """The second difference of the position (time, axis); nothing moves before the first row."""
        return np.diff(self.position_m, n=2, axis=0, prepend=self.position_m[[0, 0]]) * RATE_HZ**2

    @property
    def rise_m(self) -> Floats:
        """How far the hand is above where it started (time,)."""
        rise: Floats = self.position_m[:, 2] - self.position_m[0, 2]
        return rise

    @property
    def hand_acceleration_m_s2(self) -> Floats:
        """The acceleration in the frame of the hand, turned by the yaw (time, axis)."""
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        x, y, z = self.acceleration_m_s2.T
        return np.column_stack([cos * x + sin * y, cos * y - sin * x, z])


def trajectory(protocol: str, duration_s: float, first_s: float, rng: np.random.Generator) -> Trajectory:
    """Return a random trajectory of a protocol whose lift begins at ``first_s``.

    Raises `TacpipeError` for a protocol that is not known, and for a trial too short to lift anything.
    """
    if protocol not in PROTOCOLS:
        raise TacpipeError(f"There is no protocol {protocol!r}; it must be {', '.join(PROTOCOLS)} or mixed.")
    if duration_s < first_s + AFTER_LIFT_S:
        raise TacpipeError(f"A trial of {duration_s} s ends before its lift; duration_s must be 4 s or more.")
    rows, first = round(duration_s * RATE_HZ) + 1, round(first_s * RATE_HZ)
    path = controlled(rows, first, rng) if protocol == "controlled" else kinaesthetic(rows, first, rng)
    since_s = _times_s(rows) - first_s
    yaw = rng.uniform(0.05, 0.3) * np.clip(since_s, 0.0, 1.0) * np.sin(2 * np.pi * since_s / rng.uniform(4.0, 8.0))
    return Trajectory(_stamps(rows), path + START_M, yaw)


def rest(duration_s: float) -> Trajectory:
    """Return a hand that hovers, lifted, from the first row to the last."""
    rows = round(duration_s * RATE_HZ) + 1
    return Trajectory(_stamps(rows), np.tile(np.add(START_M, (0.0, 0.0, BOX_M[2][0])), (rows, 1)), np.zeros(rows))


def controlled(rows: int, first: int, rng: np.random.Generator) -> Floats:
    """Return the path of the controlled protocol from row ``first``, in metres from the start (time, axis)."""
    acceleration = smooth(_trapezoids(rows, first, rng))
    path: Floats = np.cumsum(np.cumsum(acceleration, axis=0), axis=0) / RATE_HZ**2
    return path


def kinaesthetic(rows: int, first: int, rng: np.random.Generator) -> Floats:
    """Return the path of the kinaesthetic protocol from row ``first``, in metres from the start (time, axis)."""
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
    """Return the fraction of the way that a minimum-jerk movement has covered when ``progress`` of its time is over."""
    fraction: Floats = progress**3 * (10 - 15 * progress + 6 * progress**2)
    return fraction


def smooth(acceleration: Floats) -> Floats:
    """Return ``acceleration`` (time, axis) averaged over the `JERK_S` before, so that it never jumps."""
    width = round(JERK_S * RATE_HZ)
    total = np.cumsum(acceleration, axis=0)
    total[width:] -= total[:-width].copy()
    return total / width


def _trapezoids(rows: int, first: int, rng: np.random.Generator) -> Floats:
    """Return the commanded acceleration (time, axis): trapezoids of velocity, one after another from row ``first``."""
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
