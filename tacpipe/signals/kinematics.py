"""Convert rotations and compute the velocity of a serial arm's hand from its joints. Quaternions are x, y, z, w.

A chain is defined by its modified Denavit-Hartenberg parameters (Craig, Introduction to Robotics, 1986, section 3.4).
The column of the geometric Jacobian for a revolute joint is ``axis × (hand - joint)`` for linear and ``axis`` for
angular velocity (Siciliano et al., Robotics, 2009, section 3.1). This velocity is more accurate than differences of
logged poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Indices, Times

UPRIGHT = 1e-12  # distance of a sine from 1 below which the angle counts as a right angle


def make_continuous(quaternions: Floats) -> Floats:
    """Return ``quaternions`` (time, 4) normalised, with the sign of the smaller distance to the previous one.

    q and -q are the same rotation, and a recorded series may jump between them. The sign of the first is unchanged, and
    NaN is allowed.

    >>> make_continuous(np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, -2.0]])).tolist()
    [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
    """
    unit: Floats = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    unit *= continuous_signs(unit)[:, None]
    return unit + 0.0  # -0.0 becomes 0.0, so that equal rotations have equal bytes


def continuous_signs(quaternions: Floats) -> Floats:
    """Return the sign (time,) of each of ``quaternions`` (time, 4) for the smaller distance to the previous one."""
    signs = np.ones(len(quaternions))  # (time,)
    signs[1:] = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return np.asarray(np.cumprod(signs), dtype=np.float64)


class SignContinuation:
    """Continues the signs of quaternions from part to part of a series, as `make_continuous` does in the whole series."""

    def __init__(self) -> None:
        self._rows = np.zeros(0, np.int64)  # rows of the last part
        self._unit = np.zeros((0, 4))
        self._signs = np.zeros(0)

    def apply(self, rows: Indices, quaternions: Floats) -> Floats:
        """Return ``quaternions`` (time, 4) at the ascending ``rows`` with continuous signs. Parts may overlap."""
        later = rows > self._rows[-1] if len(self._rows) else np.ones(len(rows), dtype=bool)
        unit = quaternions[later] / np.linalg.norm(quaternions[later], axis=1, keepdims=True)
        signs = continuous_signs(np.concatenate([self._unit[-1:], unit]))
        if len(self._rows):
            signs = signs[1:] * self._signs[-1]
        self._rows, self._unit, self._signs = (
            np.concatenate(parts)[-len(rows) :]
            for parts in ((self._rows, rows[later]), (self._unit, unit), (self._signs, signs))
        )
        return quaternions * self._signs[self._rows.searchsorted(rows), None]


def matrices_to_quaternions(matrices: Floats) -> Floats:
    """Return unit quaternions (time, 4) with non-negative w of rotation matrices (time, 3, 3).

    The largest pivot is used, so that no division is by a small number (Shepperd, "Quaternion from rotation matrix",
    1978).
    """
    m = matrices
    trace = np.trace(m, axis1=1, axis2=2)  # (time,)
    diagonal = np.diagonal(m, axis1=1, axis2=2)  # (time, axis)
    pivots = np.column_stack([diagonal, trace])  # (time, 4): the largest belongs to the largest of x, y, z, w
    x, y, z = (2 * diagonal[:, axis] - trace + 1 for axis in range(3))
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    xw, yw, zw = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    rows = np.stack(  # (time, pivot, 4): the quaternion times four times its component at the pivot
        [
            np.stack([x, xy, xz, xw], axis=1),
            np.stack([xy, y, yz, yw], axis=1),
            np.stack([xz, yz, z, zw], axis=1),
            np.stack([xw, yw, zw, 1 + trace], axis=1),
        ],
        axis=1,
    )
    chosen = rows[np.arange(len(m)), pivots.argmax(axis=1)]  # (time, 4)
    unit: Floats = chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
    return np.where(unit[:, 3:] < 0, -unit, unit)


def quaternions_to_matrices(quaternions: Floats) -> Floats:
    """Return the rotation matrices (time, 3, 3) of unit quaternions (time, 4)."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def vectors_to_quaternions(vectors_rad: Floats) -> Floats:
    """Convert rotation vectors (time, 3) in rad to unit quaternions (time, 4)."""
    half = np.linalg.norm(vectors_rad, axis=1, keepdims=True) / 2
    shrink = np.sinc(half / np.pi) / 2  # sin(half) / angle, 1/2 at angle 0
    return np.hstack([vectors_rad * shrink, np.cos(half)])


def quaternions_to_vectors(quaternions: Floats) -> Floats:
    """Return the rotation vectors (time, 3), with angles of at most pi, of unit quaternions (time, 4)."""
    signed = np.where(quaternions[:, 3:] < 0, -quaternions, quaternions)
    sine = np.linalg.norm(signed[:, :3], axis=1, keepdims=True)
    half = np.arctan2(sine, signed[:, 3:])
    vectors: Floats = signed[:, :3] * 2 / np.sinc(half / np.pi)
    return vectors


def angles_to_quaternions(angles_rad: Floats) -> Floats:
    """Return the unit quaternions (time, 4) of intrinsic z-y-x Euler angles (time, 3) in rad, KUKA's A, B and C."""
    (cz, cy, cx), (sz, sy, sx) = np.cos(angles_rad.T / 2), np.sin(angles_rad.T / 2)
    return np.column_stack(
        [
            sx * cy * cz - cx * sy * sz,
            cx * sy * cz + sx * cy * sz,
            cx * cy * sz - sx * sy * cz,
            cx * cy * cz + sx * sy * sz,
        ]
    )


def quaternions_to_angles(quaternions: Floats) -> Floats:
    """Return the intrinsic z-y-x Euler angles (time, 3) in rad of unit quaternions (time, 4).

    In gimbal lock, the last angle is 0.
    """
    x, y, z, w = quaternions.T
    sine = np.clip(2 * (w * y - z * x), -1, 1)
    upright = np.abs(sine) > 1 - UPRIGHT
    about_z = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    about_x = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    about_z = np.where(upright, -2 * np.sign(sine) * np.arctan2(x, w), about_z)
    return np.column_stack([about_z, np.arcsin(sine), np.where(upright, 0.0, about_x)])


BLOCK_ROWS = 1 << 14  # rows of frames in memory
TOOL_SPREAD_M = 0.005  # maximum standard deviation of the position of a hand in the frame of its arm's last link
TURN_SPREAD = 0.01  # maximum standard deviation of the entries of its rotation matrix


@dataclass(frozen=True)
class KinematicChain:
    """Modified Denavit-Hartenberg parameters of revolute joints, each (joint,)."""

    length_m: tuple[float, ...]
    offset_m: tuple[float, ...]
    twist_rad: tuple[float, ...]


_QUARTER = np.pi / 2
PANDA = KinematicChain(  # Franka Emika, Panda documentation, "Denavit-Hartenberg parameters"
    (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088),
    (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0),
    (0.0, -_QUARTER, _QUARTER, _QUARTER, -_QUARTER, _QUARTER, _QUARTER),
)
IIWA14 = (
    KinematicChain(  # KUKA LBR iiwa 14 R820, data sheet: 0.36, 0.42, 0.40 m between base, shoulder, elbow and wrist
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.36, 0.0, 0.42, 0.0, 0.4, 0.0, 0.126),  # the last offset is to the flange, without the tool plate
        (0.0, -_QUARTER, _QUARTER, _QUARTER, -_QUARTER, -_QUARTER, _QUARTER),
    )
)


def joint_frames(chain: KinematicChain, joint_rad: AnyFloats) -> AnyFloats:
    """Return the poses of the joints' frames in the base frame (time, joint, 4, 4) at angles ``joint_rad`` (time, joint)."""
    frames = np.empty((*joint_rad.shape, 4, 4))
    frame = np.broadcast_to(np.eye(4), (len(joint_rad), 4, 4))
    for joint, (length, offset, twist) in enumerate(zip(chain.length_m, chain.offset_m, chain.twist_rad, strict=True)):
        cos, sin = np.cos(joint_rad[:, joint]), np.sin(joint_rad[:, joint])
        tilt_cos, tilt_sin = np.cos(twist), np.sin(twist)
        step = np.zeros((len(joint_rad), 4, 4))
        step[:, 0, 0], step[:, 0, 1], step[:, 0, 3] = cos, -sin, length
        step[:, 1, 0], step[:, 1, 1], step[:, 1, 2], step[:, 1, 3] = (
            sin * tilt_cos,
            cos * tilt_cos,
            -tilt_sin,
            -offset * tilt_sin,
        )
        step[:, 2, 0], step[:, 2, 1], step[:, 2, 2], step[:, 2, 3] = (
            sin * tilt_sin,
            cos * tilt_sin,
            tilt_cos,
            offset * tilt_cos,
        )
        step[:, 3, 3] = 1.0
        frame = frame @ step
        frames[:, joint] = frame
    return frames


def carries_hand(chain: KinematicChain, joint_rad: AnyFloats, hand_m: AnyFloats) -> bool:
    """Return whether the positions ``hand_m`` (time, 3) are fixed in the frame of the chain's last link.

    If not, the hand belongs to another arm. Non-finite rows are ignored.
    """
    tool_m = np.concatenate(
        [np.zeros((0, 3)), *(tool_positions(chain, joint_rad[block], hand_m[block]) for block in _blocks(len(hand_m)))]
    )
    return is_fixed(tool_m)


def tool_positions(chain: KinematicChain, joint_rad: AnyFloats, hand_m: AnyFloats) -> AnyFloats:
    """Return the finite positions of ``hand_m`` (time, 3) in the frame of the chain's last link."""
    finite = np.isfinite(joint_rad).all(axis=1) & np.isfinite(hand_m).all(axis=1)
    last = last_frames(chain, joint_rad[finite])
    tool_m: AnyFloats = np.einsum("tji,tj->ti", last[:, :3, :3], hand_m[finite] - last[:, :3, 3])
    return tool_m


def is_fixed(tool_m: AnyFloats) -> bool:
    """Return whether positions (time, 3) in the frame of a link do not move in it."""
    return bool(len(tool_m)) and bool((tool_m.std(axis=0) < TOOL_SPREAD_M).all())


def rotates_with_hand(chain: KinematicChain, joint_rad: AnyFloats, quaternions: Floats) -> bool:
    """Return whether the orientations ``quaternions`` (time, 4) are fixed in the frame of the chain's last link.

    Non-finite rows are ignored.
    """
    finite = np.isfinite(joint_rad).all(axis=1) & np.isfinite(quaternions).all(axis=1)
    last = last_frames(chain, joint_rad[finite])[:, :3, :3]
    # (time, 3, 3), in the frame of the last link
    tool = last.transpose(0, 2, 1) @ quaternions_to_matrices(quaternions[finite])
    return bool(len(tool)) and bool((tool.std(axis=0) < TURN_SPREAD).all())


def last_frames(chain: KinematicChain, joint_rad: AnyFloats) -> AnyFloats:
    """Return the pose of the last joint's frame in the base frame (time, 4, 4)."""
    frames = [joint_frames(chain, joint_rad[block])[:, -1].copy() for block in _blocks(len(joint_rad))]
    return np.concatenate([np.zeros((0, 4, 4)), *frames])


def hand_velocity(chain: KinematicChain, joint_rad: AnyFloats, joint_rad_s: AnyFloats, hand_m: AnyFloats) -> AnyFloats:
    """Return linear (m/s) and angular (rad/s) velocity of the hand in the base frame (time, 6).

    ``joint_rad`` and ``joint_rad_s`` are (time, joint), ``hand_m`` (time, 3).
    """
    velocity = np.empty((len(joint_rad), 6))
    for block in _blocks(len(joint_rad)):
        velocity[block] = velocity_from_frames(joint_frames(chain, joint_rad[block]), joint_rad_s[block], hand_m[block])
    return velocity


def velocity_from_frames(frames: AnyFloats, joint_rad_s: AnyFloats, hand_m: AnyFloats) -> AnyFloats:
    """Return the result of `hand_velocity` (time, 6) from the result of `joint_frames`."""
    axes, origins = frames[:, :, :3, 2], frames[:, :, :3, 3]  # (time, joint, 3)
    levers = np.cross(axes, hand_m[:, None] - origins)
    parts = [np.einsum("tja,tj->ta", vectors, joint_rad_s) for vectors in (levers, axes)]
    return np.concatenate(parts, axis=1)


def _blocks(rows: int) -> Iterator[slice]:
    """Yield slices of `BLOCK_ROWS` rows. The frames of a row need 900 bytes, so those of an hour do not fit in memory."""
    return (slice(first, first + BLOCK_ROWS) for first in range(0, rows, BLOCK_ROWS))


def difference_velocity(t_ns: Times, position_m: AnyFloats, quaternions: AnyFloats) -> AnyFloats:
    """Return linear (m/s) and angular (rad/s) velocity (time, 6) as backward differences; 0 in the first row.

    ``quaternions`` (time, 4) are normalised and of continuous sign. Rotations between rows are small, so the rotation
    vector is twice the vector part of their quotient.
    """
    velocity = np.zeros((len(t_ns), 6))
    step_s = np.diff(t_ns) / 1e9
    step_s = np.where(step_s > 0, step_s, np.inf)[:, None]
    velocity[1:, :3] = np.diff(position_m, axis=0) / step_s
    before, after = quaternions[:-1], quaternions[1:]
    # (time - 1, 3), the vector part of after times the inverse of before
    turned = before[:, 3:] * after[:, :3] - after[:, 3:] * before[:, :3] - np.cross(after[:, :3], before[:, :3])
    velocity[1:, 3:] = 2 * turned / step_s
    return velocity


def path_speed(t_ns: Times, position_m: AnyFloats, span_s: float = 0.02) -> Floats:
    """Return the speed (time,) in m/s of ``position_m`` (time, axis), averaged over ``span_s`` around each row.

    Differences of neighbouring rows are mostly noise.

    >>> path_speed(np.arange(5) * 10_000_000, np.arange(5)[:, None] * 0.01).round(6).tolist()
    [1.0, 1.0, 1.0, 1.0, 1.0]
    """
    half_ns = round(span_s * 5e8)
    rows = np.arange(len(t_ns))
    first = np.minimum(np.searchsorted(t_ns, t_ns - half_ns), np.maximum(rows - 1, 0))
    last = np.maximum(np.searchsorted(t_ns, t_ns + half_ns, side="right") - 1, np.minimum(rows + 1, len(rows) - 1))
    distance_m = np.empty(len(t_ns))
    for block in _blocks(len(t_ns)):
        distance_m[block] = np.linalg.norm(position_m[last[block]] - position_m[first[block]], axis=1)
    duration_s = (t_ns[last] - t_ns[first]) / 1e9
    return np.divide(distance_m, duration_s, out=np.zeros(len(t_ns)), where=duration_s > 0)
