"""The physics of a pick-and-move trial: two fingers with a uSkin each grasp an object, lift it and carry it about.

The hand follows a trajectory at 1 kHz; the object is held without slip. Newton gives the force that the fingers must
bring up, and a 4x4 grid of taxels on each shares it out and turns it into counts. What happens, in order:

1. the fingers close (0.6 to 1.2 s), then the grip force ramps up (0.4 s);
2. the seven phases of the published rig: accelerate, cruise, decelerate upwards, the same along -x, hold;
3. moves along random axes until the time is over.

Axes: the hand's x and y are horizontal, y from finger 1 to finger 2, z is up. A taxel's x is the hand's x, its y the
hand's z, its z the pressure. The gripper points down; the hand turns about the vertical as it moves.

Masses, grip force, jerk limit, taxel pitch and stream rates are those of `Rig`; count gains were set so that the spread
of the tared z channels comes near the 1219 counts of the published recordings (x and y: 279 and 190).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.errors import TacpipeError
from tacpipe.formats import channels
from tacpipe.simulation import faults
from tacpipe.stage import Attribute, Recording

Floats = NDArray[np.float64]

GRAVITY_M_S2 = 9.81
TRUTH_HZ = 1000
START_NS = 1_600_000_000_000_000_000  # UTC stamp of the first trial's start; the next ones follow minutes later
TRIAL_NS = 120_000_000_000
MASSES_KG = (0.20, 0.28, 0.36, 0.44, 0.52)  # five fills of a bottle
GRIP_N = (6.0, 10.0)  # normal force of each finger
JERK_S = 0.03  # over which the acceleration of a profile changes
TABLE_M = 0.001  # rise over which the table hands the object's weight over to the fingers
OPEN_M, GRASPED_M = 0.070, 0.040  # finger width
PITCH_M = 0.0047
CROSSTALK = 0.08  # of a taxel's signal that its four neighbours see
CREEP, CREEP_S = 0.03, 0.5  # share of the pressure that follows late, and how late
DRIFT_COUNT = 2.0  # random walk, counts after one second
GAIN_COUNT_N = (1500.0, 1500.0, 3000.0)  # x, y, z
BULGE = 0.15  # of a taxel's pressure that pushes it outwards, for each taxel that it is off the centre
BASE_COUNT = (16_000.0, 16_500.0, 38_000.0)
BASE_SPREAD_COUNT = 300.0
NOISE_COUNT = (1.35, 1.15, 3.4)  # x, y, z; standard deviation of second differences / sqrt(6), quiet xela-psc frames
OFF_AXIS = 0.05  # of a force that shows on the other axes


@dataclass(frozen=True)
class Rig:
    """How long a trial lasts and how its streams are logged."""

    duration_s: float = 12.0
    tactile_rate_hz: float = 50.0
    robot_rate_hz: float = 1000.0
    hold_probability: float = 0.07
    drop_probability: float = 0.002
    noise_scale: float = 1.0
    tactile_jitter_ms: float = 2.0
    robot_jitter_ms: float = 0.5
    clock_offset_ms: float = 0.0
    clock_skew_ppm: float = 50.0


@dataclass(frozen=True)
class Motion:
    """What the hand and the object do, at 1 kHz from 0; arrays are (time,) or (time, axis)."""

    t_ns: NDArray[np.int64]
    position_m: Floats  # (time, axis), world
    acceleration_m_s2: Floats  # (time, axis), world
    yaw_rad: Floats  # (time,)
    finger_m: Floats  # (time,)
    grip_n: Floats  # (time,)
    mass_kg: float

    @property
    def force_n(self) -> Floats:
        """The force on the object that the fingers bring up together (time, axis), in the frame of the hand.

        Newton: mass times acceleration and weight; before the object has left the table the table bears the weight.
        """
        borne = np.clip((self.position_m[:, 2] - self.position_m[0, 2]) / TABLE_M, 0.0, 1.0)
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        x, y, z = self.acceleration_m_s2.T
        turned = np.column_stack([cos * x + sin * y, cos * y - sin * x, (z + GRAVITY_M_S2) * borne])
        force: Floats = self.mass_kg * turned
        return force

    @property
    def normal_n(self) -> Floats:
        """The pressing force of each finger (time, finger): the grip, shifted by what moves the object along y."""
        along = self.force_n[:, 1] / 2
        return np.maximum(np.column_stack([self.grip_n + along, self.grip_n - along]), 0.0) * (self.grip_n > 0)[:, None]


def simulate_trial(seed: int, index: int, rig: Rig = Rig()) -> Recording:
    """Return trial ``index`` of the rig: the streams xela1, xela2, robot and truth, and what is known of them.

    The same seed, index and rig give the same values. Attributes that begin with ``gt_`` and the columns of ``truth``,
    at 1 kHz, are ground truth. Raises `TacpipeError` for a trial too short to lift anything.
    """
    rng = np.random.default_rng([seed, index])
    motion = move(rig.duration_s, rng)
    start_ns = START_NS + index * TRIAL_NS
    truth: dict[str, Attribute] = {"gt_mass_kg": motion.mass_kg, "gt_grip_n": float(motion.grip_n[-1])}
    streams: dict[str, pa.Table] = {}
    for finger, stream in enumerate(("xela1", "xela2")):
        clock = _clock(rig, rig.tactile_jitter_ms, rig.clock_offset_ms, rng)
        true_ns = faults.sample_times(int(motion.t_ns[-1]), rig.tactile_rate_hz, rig.drop_probability, rng)
        counts = tactile(motion, finger, true_ns, rig.noise_scale, rng)
        counts, _ = faults.hold(counts, rig.hold_probability, rng)
        t_ns = start_ns + faults.stamps(true_ns, clock, rng)
        streams[stream] = channels.stream(t_ns, counts.T, channels.uskin_fields())
        truth |= {f"gt_{stream}_clock_offset_ns": clock.offset_ns, f"gt_{stream}_clock_skew": clock.skew}
    clock = _clock(rig, rig.robot_jitter_ms, 0.0, rng)
    true_ns = faults.sample_times(int(motion.t_ns[-1]), rig.robot_rate_hz, rig.drop_probability, rng)
    fields = [channels.float_field("finger_m", "m", "finger_width"), *channels.pose_fields()]
    t_ns = start_ns + faults.stamps(true_ns, clock, rng)
    streams["robot"] = channels.stream(t_ns, _robot(motion, true_ns).T, fields)
    truth |= {"gt_robot_clock_offset_ns": clock.offset_ns, "gt_robot_clock_skew": clock.skew}
    streams["truth"] = _truth(motion, start_ns)
    attributes: dict[str, Attribute] = {
        "sensor": "xela-uskin",
        "simulated": True,
        "object": f"bottle-{round(motion.mass_kg * 1000)}g",
        "object_class": "bottle",
        "dropped": False,
        "rate_hz": rig.tactile_rate_hz,
        "trial": f"trial-{index:04d}",
    }
    return Recording(streams, attributes | truth)


def move(duration_s: float, rng: np.random.Generator) -> Motion:
    """Return a random trial's motion, grip and mass, ``duration_s`` long."""
    rows = round(duration_s * TRUTH_HZ) + 1
    approach_s, ramp_s, pause_s = rng.uniform(0.6, 1.2), 0.4, rng.uniform(0.2, 0.5)
    first = approach_s + ramp_s + pause_s
    if duration_s < first + 1.5:
        raise TacpipeError(f"A trial of {duration_s} s ends before its lift; duration_s must be 4 s or more.")
    time_s = np.arange(rows) / TRUTH_HZ
    acceleration = _smooth(_profile(rows, round(first * TRUTH_HZ), rng))  # (time, axis)
    velocity = np.cumsum(acceleration, axis=0) / TRUTH_HZ
    position = np.cumsum(velocity, axis=0) / TRUTH_HZ + [0.58, 0.0, 0.18]
    turning = np.clip((time_s - first) / 1.0, 0.0, 1.0)
    yaw = rng.uniform(0.05, 0.3) * turning * np.sin(2 * np.pi * (time_s - first) / rng.uniform(4.0, 8.0))
    closing = _ease(time_s / approach_s)
    grip = rng.uniform(*GRIP_N) * _ease((time_s - approach_s) / ramp_s)
    mass_kg = float(MASSES_KG[rng.integers(len(MASSES_KG))])
    t_ns = np.arange(rows, dtype=np.int64) * (1_000_000_000 // TRUTH_HZ)
    finger_m = OPEN_M + (GRASPED_M - OPEN_M) * closing
    return Motion(t_ns, position, acceleration, yaw, finger_m, grip, mass_kg)


def tactile(
    motion: Motion, finger: int, true_ns: NDArray[np.int64], noise_scale: float, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return the counts of finger 0 or 1 at the times ``true_ns`` (time, channel), taxel by taxel, axes x, y, z.

    Each finger bears half of the shear. A Gaussian centred where the object touches shares pressure and shear among
    the taxels; the centre moves with the shear, and pressure bulges the skin outwards. Counts are base, gain times
    force, a late share (creep), cross-talk to neighbours and other axes, drift and noise, rounded.
    """
    at_s, time_s = true_ns / 1e9, motion.t_ns / 1e9
    late = _lagged(motion.normal_n[:, finger])
    normal, slow, shear_x, shear_z = (
        np.interp(at_s, time_s, values)
        for values in (motion.normal_n[:, finger], late, motion.force_n[:, 0] / 2, motion.force_n[:, 2] / 2)
    )
    touching = np.interp(at_s, time_s, (motion.grip_n > 0).astype(np.float64))
    grid = (np.arange(4) - 1.5) * PITCH_M
    place = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)  # (taxel, 2)
    centre = rng.uniform(-0.003, 0.003, 2) + 2e-4 * np.column_stack([shear_x, shear_z])  # (time, 2), 0.2 mm/N
    distance2 = ((place[None] - centre[:, None]) ** 2).sum(axis=2)  # (time, taxel)
    share = np.exp(-distance2 / (2 * rng.uniform(0.004, 0.006) ** 2))
    share /= share.sum(axis=1, keepdims=True)
    pressed = (1 - CREEP) * normal + CREEP * slow
    force = np.stack([shear_x * touching, shear_z * touching, pressed], axis=1)[:, None] * share[:, :, None]
    force[:, :, :2] += BULGE * force[:, :, 2:] * (place[None] - centre[:, None]) / PITCH_M
    mixing = np.eye(3) + OFF_AXIS * rng.uniform(-1, 1, (channels.TAXELS, 3, 3))  # (taxel, axis, axis)
    signal = np.einsum("tna,nba->tnb", force, mixing) * GAIN_COUNT_N  # (time, taxel, axis)
    signal = np.einsum("tna,mn->tma", signal, _crosstalk())
    base = np.array(BASE_COUNT) + rng.uniform(-BASE_SPREAD_COUNT, BASE_SPREAD_COUNT, (channels.TAXELS, 3))
    steps_s = np.diff(at_s, prepend=at_s[:1])
    drift = np.cumsum(rng.normal(0, DRIFT_COUNT, signal.shape) * np.sqrt(steps_s)[:, None, None], axis=0)
    noise = rng.normal(0, 1.0, signal.shape) * NOISE_COUNT * noise_scale
    level = np.rint(base + signal + drift + noise).clip(0, 65_535)
    counts: NDArray[np.uint16] = level.reshape(len(true_ns), -1).astype(np.uint16)
    return counts


def _profile(rows: int, first: int, rng: np.random.Generator) -> Floats:
    """Return the commanded acceleration (time, axis): trapezoids of velocity, one after another from row ``first``."""
    acceleration = np.zeros((rows, 3))
    reach = np.zeros(3)  # where the hand is from its start, m
    limits = np.array([0.30, 0.15, 0.40])  # m to either side; z stays above the first lift
    row, leg = first, 0
    while row < rows:
        phase = round(rng.uniform(0.25, 0.6) * TRUTH_HZ)  # rows, T of the published profile
        axis = (2, 0)[leg] if leg < 2 else int(rng.integers(3))
        sign = (1.0, -1.0)[leg] if leg < 2 else -np.sign(reach[axis]) or float(rng.choice([-1.0, 1.0]))
        longest = limits[axis] if leg < 2 else max(limits[axis] * 0.5, 0.05)
        speed = rng.uniform(0.4, 1.0) * longest / (2 * phase / TRUTH_HZ)  # m/s, V; the leg is 2 V T long
        if leg >= 2 and axis == 2 and sign < 0:
            speed = min(speed, 0.8 * reach[2] / (2 * phase / TRUTH_HZ))
        if row + 3 * phase + round(JERK_S * TRUTH_HZ) >= rows:
            break
        acceleration[row : row + phase, axis] += sign * speed * TRUTH_HZ / phase
        acceleration[row + 2 * phase : row + 3 * phase, axis] -= sign * speed * TRUTH_HZ / phase
        reach[axis] += sign * 2 * speed * phase / TRUTH_HZ
        row += 3 * phase + (phase if leg == 1 else round(rng.uniform(0.05, 0.3) * TRUTH_HZ))
        leg += 1
    return acceleration


def _smooth(acceleration: Floats) -> Floats:
    """Return ``acceleration`` (time, axis) averaged over `JERK_S`, so that it never jumps."""
    width = round(JERK_S * TRUTH_HZ)
    total = np.cumsum(acceleration, axis=0)
    total[width:] -= total[:-width].copy()
    return total / width


def _ease(progress: Floats) -> Floats:
    """Return a smooth ramp from 0 to 1 as ``progress`` goes from 0 to 1."""
    held = np.clip(progress, 0.0, 1.0)
    eased: Floats = held**2 * (3 - 2 * held)
    return eased


def _lagged(values: Floats) -> Floats:
    """Return ``values`` (time,) after a first-order lag of `CREEP_S`."""
    steps = np.arange(round(6 * CREEP_S * TRUTH_HZ))
    kernel = np.exp(-steps / (CREEP_S * TRUTH_HZ))
    kernel /= kernel.sum()
    size = 1 << int(np.ceil(np.log2(len(values) + len(kernel))))
    lagged: Floats = np.fft.irfft(np.fft.rfft(values, size) * np.fft.rfft(kernel, size), size)[: len(values)]
    return lagged


def _crosstalk() -> Floats:
    """Return what of each taxel's signal each one sees (taxel, taxel)."""
    row, column = np.divmod(np.arange(channels.TAXELS), 4)
    apart = np.abs(row[:, None] - row) + np.abs(column[:, None] - column)
    seen: Floats = np.eye(channels.TAXELS) + CROSSTALK * (apart == 1)
    return seen


def _clock(rig: Rig, jitter_ms: float, offset_ms: float, rng: np.random.Generator) -> faults.Clock:
    offset_ns = round(rng.uniform(-1, 1) * offset_ms * 1e6)
    return faults.Clock(offset_ns, float(rng.uniform(-1, 1) * rig.clock_skew_ppm * 1e-6), jitter_ms * 1e6)


def _robot(motion: Motion, true_ns: NDArray[np.int64]) -> Floats:
    """Return finger width, position and quaternion (time, 8) at ``true_ns``: the gripper points down and yaws."""
    columns = [motion.finger_m, *motion.position_m.T, motion.yaw_rad]
    finger, x, y, z, yaw = (np.interp(true_ns, motion.t_ns, column) for column in columns)
    zero = np.zeros_like(yaw)
    return np.column_stack([finger, x, y, z, np.cos(yaw / 2), np.sin(yaw / 2), zero, zero])


def _truth(motion: Motion, start_ns: int) -> Any:
    """Return the stream ``truth`` at 1 kHz."""
    columns = {"gt_finger1_normal_n": motion.normal_n[:, 0], "gt_finger2_normal_n": motion.normal_n[:, 1]}
    columns |= {f"gt_force_{axis}_n": motion.force_n[:, i] for i, axis in enumerate("xyz")}
    fields = [channels.float_field(name, "N", "force") for name in columns]
    more = {f"gt_acceleration_{axis}_m_s2": motion.acceleration_m_s2[:, i] for i, axis in enumerate("xyz")}
    fields += [channels.float_field(name, "m/s^2", "acceleration") for name in more]
    fields.append(channels.float_field("gt_mass_kg", "kg", "mass"))
    mass = np.full(len(motion.t_ns), motion.mass_kg)
    return channels.stream(start_ns + motion.t_ns, [*columns.values(), *more.values(), mass], fields)
