"""Run a forecaster row by row, without looking ahead, with the results of `tracks` and `predictors` on whole recordings.

Rows are encoded and predicted one at a time, because matrix products of one row and of many rows round differently, and
a forecast must not depend on how many rows arrived together.
"""

from __future__ import annotations

import numpy as np
import torch

from tacpipe.arrays import AnyFloats, Bools, Float32s, Floats, Times
from tacpipe.codecs.codec import INCREMENTS
from tacpipe.live.plans import PosePlan
from tacpipe.models.windows import ARM, POSE, ForecastWindows
from tacpipe.signals import kinematics
from tacpipe.signals.kinematics import vectors_to_quaternions
from tacpipe.signals.resampling import linear, slerp
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.forecaster import Forecaster

# maximum distance from the initial position of a hand that is fixed to the last link
JOINED = 2 * 3 * kinematics.TOOL_SPREAD_M


class Arm:
    """The arm's rows: position, orientation with continuous sign, and velocities from joints or differences."""

    def __init__(self, orientation: AnyFloats) -> None:
        """Start before the first row; ``orientation`` (4,) is the quaternion that defines the sign in recordings."""
        self._reference = orientation
        self._sign = 1.0
        self._opposite = None if orientation is None else False
        self._decided = False
        self._unit: Floats | None = None  # (1, 4), previous quaternion as received
        self._before: tuple[int, Floats] | None = None  # time and pose (7,) of the previous row
        self._tool_m: Floats | None = None  # (3,), initial position of the hand on the last link
        self._carried = True

    def row(
        self,
        t_ns: int,
        position_m: Floats,
        quaternion: Floats,
        angles: Floats | None = None,
        speeds: Floats | None = None,
    ) -> Float32s:
        """Return the arm (13,) in a row: position (3,), quaternion (4,), velocity (3,) and angular velocity (3,).

        ``angles`` and ``speeds`` are of the joints (7,), None if they are not recorded. Velocities come from the joints
        of a known arm while the hand keeps its initial position on the last link. Otherwise they are differences from
        the previous row.
        """
        placed = np.concatenate([position_m, self._continuous(quaternion)])
        moved = None if angles is None or speeds is None else self._joint_velocity(angles, speeds, position_m)
        if moved is None:
            moved = self._finite_difference_velocity(t_ns, placed)
        self._before = (t_ns, placed)
        row = np.concatenate([placed, moved]).astype(np.float32)[None]
        if not self._decided and np.isfinite(row).all():
            self._opposite, self._decided = tracks.is_opposite(row, self._reference), True
        aligned: Float32s = (tracks.negate_quaternions(row) if self._opposite else row)[0]
        return aligned

    def _continuous(self, quaternion: Floats) -> Floats:
        """Return the quaternion (4,) with the sign that `rotations.continuous` would choose in the full series."""
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = quaternion[None] / np.linalg.norm(quaternion[None], axis=1, keepdims=True)
        if self._unit is not None and (unit * self._unit).sum(axis=1)[0] < 0:
            self._sign = -self._sign
        self._unit = unit
        continuous: Floats = unit[0] * self._sign + 0.0
        return continuous

    def _finite_difference_velocity(self, t_ns: int, placed: Floats) -> Floats:
        """Return velocity and angular velocity (6,) from the difference to the previous row; 0 in the first row."""
        if self._before is None:
            return np.zeros(6)
        before_ns, before = self._before
        rows = np.stack([before, placed])
        velocity: Floats = kinematics.difference_velocity(np.array([before_ns, t_ns]), rows[:, :3], rows[:, 3:])[1]
        return velocity

    def _joint_velocity(self, angles: Floats, speeds: Floats, hand_m: Floats) -> Floats | None:
        """Return velocity and angular velocity (6,) from the joints; None once the hand has moved on the last link."""
        if not self._carried:
            return None
        frames = kinematics.joint_frames(kinematics.PANDA, angles[None])
        if np.isfinite(angles).all() and np.isfinite(hand_m).all():
            last = frames[0, -1]
            tool_m = last[:3, :3].T @ (hand_m - last[:3, 3])
            self._tool_m = tool_m if self._tool_m is None else self._tool_m
            self._carried = bool((np.abs(tool_m - self._tool_m) < JOINED).all())
            if not self._carried:
                return None
        velocity: Floats = kinematics.velocity_from_frames(frames, speeds[None], hand_m[None])[0]
        return velocity


class Rolling:
    """The latest rows that a forecaster reads, and its prediction from them."""

    def __init__(self, forecaster: Forecaster, *, continues: bool = False) -> None:
        """Start without rows.

        If it ``continues`` a session, the first rows depend on earlier rows that are unknown, through velocities and
        latents, and are not used.
        """
        codec, context = forecaster.codec, forecaster.context
        self._forecaster = forecaster
        self._latent = np.zeros((context, len(codec.latents)), np.float32)
        self._arm, self._finger = np.zeros((context, ARM), np.float32), np.zeros(context, np.float32)
        # number of rows that the newest row's latents depend on
        frames = int(getattr(codec, "frames", 1)) + (codec.representation == INCREMENTS)
        self._levels = np.zeros((frames, len(codec.channels)))
        self._begins: Bools = np.zeros(frames, bool)
        self._past = np.zeros((forecaster.context if forecaster.quantiles else 0, len(codec.channels)))
        self._rows = self._run = 0
        self._unknown = max(1, frames - 1) if continues else 0

    @property
    def now(self) -> Floats:
        """The levels above rest (channel,) of the newest row."""
        levels: Floats = self._levels[-1]
        return levels

    @property
    def arm(self) -> Float32s:
        """The arm (13,) in the newest row."""
        row: Float32s = self._arm[-1]
        return row

    @property
    def is_ready(self) -> bool:
        """Whether enough consecutive usable rows are available."""
        return self._run >= self._forecaster.context

    def add(self, level: Floats, arm: Float32s, finger: float, *, follows: bool, encodes: bool, usable: bool) -> bool:
        """Add a row: levels above rest (channel,), the arm (13,), and the gripper's opening in m.

        ``follows``: whether the row follows the previous one without a gap for the window; ``encodes``: the same for
        the codec. ``usable``: whether no stream had a gap. Returns whether all values of the row are finite.
        """
        self._levels[:-1], self._begins[:-1] = self._levels[1:], self._begins[1:]
        self._levels[-1], self._begins[-1] = level, not encodes
        self._past[:-1] = self._past[1:]
        self._past[-1:] = level
        count = min(self._rows + 1, len(self._levels))
        self._rows += 1
        codec = self._forecaster.codec
        begins = self._begins[-count:].copy()
        begins[0] = True
        latent = codec.encode(self._levels[-count:], codec.channels, begins)[-1]
        for kept_rows, newest in ((self._latent, latent), (self._arm, arm), (self._finger, finger)):
            kept_rows[:-1] = kept_rows[1:]
            kept_rows[-1] = newest
        finite = bool(np.isfinite(level).all() and np.isfinite(latent).all() and np.isfinite(arm).all())
        finite = finite and bool(np.isfinite(finger))
        is_decided = self._rows > self._unknown
        if not (usable and finite and is_decided):
            self._run = 0
        else:
            self._run = self._run + 1 if follows else 1
        return finite

    def predict(self, plan: AnyFloats) -> Float32s:
        """Return predicted levels above rest (horizon, channel) for the arm's planned rows (horizon, 13)."""
        features = self._forecaster.single.features(self._windows(plan))
        levels = self._forecaster.decode_counts(features, self._levels[None, -1], self._latent[None, -1])
        predicted: Float32s = levels[0].astype(np.float32)
        return predicted

    def quantiles(self, plan: AnyFloats, ahead: Float32s) -> Float32s:
        """Return all quantiles (horizon, channel, level) around ``ahead``, which `predict` returned for the same ``plan``.

        The model must have quantiles.
        """
        quantiles: Float32s = self._forecaster.forecast_quantiles(self._windows(plan), self._past[None], ahead[None])[0]
        return quantiles

    def _windows(self, plan: AnyFloats) -> ForecastWindows:
        """Return the current rows and the arm's planned ones as one window."""
        parts = (self._latent, np.concatenate([self._arm, plan.astype(np.float32)]), self._finger)
        return ForecastWindows(*(torch.from_numpy(part[:, None].copy()) for part in parts))


def rows(plan: PosePlan, t_ns: int, ahead_ns: Times, now: AnyFloats) -> Float32s:
    """Return the arm's rows (step, 13) at the times ``ahead_ns`` (step,) after ``t_ns``, following a plan.

    ``now`` (13,) is the arm at ``t_ns``. A plan that begins later is approached in a straight line; after its end the
    hand stays. Velocities are differences of the planned rows, as in a recording, and the signs of the quaternions
    continue that of ``now``.
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
    moved = kinematics.difference_velocity(grid_ns, placed[:, :3], placed[:, 3:])
    return np.hstack([placed, moved])[1:].astype(np.float32)


def extrapolate_arm(t_ns: int, ahead_ns: Times, now: AnyFloats) -> Float32s:
    """Return the arm's rows (step, 13) at ``ahead_ns`` (step,) for a hand that keeps moving and turning as at ``t_ns``.

    ``now`` (13,) is the arm at ``t_ns``.
    """
    after_s = ((ahead_ns - t_ns) / 1e9)[:, None]  # (step, 1)
    arm: Floats = now.astype(np.float64)
    position = arm[:3] + after_s * arm[POSE : POSE + 3]
    turned = _product(vectors_to_quaternions(after_s * arm[POSE + 3 :]), arm[3:POSE])
    moved = np.broadcast_to(arm[POSE:], (len(ahead_ns), 6))
    return np.hstack([position, turned, moved]).astype(np.float32)


def _product(first: Floats, second: Floats) -> Floats:
    """Return the quaternions (step, 4) that turn by ``second`` (4,), then by ``first`` (step, 4)."""
    a, b = first[:, :3], second[:3]
    vector = first[:, 3:] * b + second[3] * a + np.cross(a, b)
    scalar = first[:, 3:] * second[3] - (a @ b)[:, None]
    return np.hstack([vector, scalar])
