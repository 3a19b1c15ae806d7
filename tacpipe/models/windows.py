"""Define forecasting windows of touch and arm, time first, in the units of the recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

MOTION, UP = 15, 3  # numbers of columns of the motion and of the up direction that a plain network reads
POSE = 7  # columns of ``arm`` with position and quaternion; velocity follows
ARM = 13


class ForecastWindows(NamedTuple):
    """Windows of equal length: rows of the past, up to the present, then rows of the plan."""

    touch: Tensor  # (context, window, feature): latents in their codec's unit, or counts above rest
    arm: Tensor  # (context + horizon, window, 13): position m, quaternion xyzw, velocity m/s, angular velocity rad/s
    finger: Tensor  # (context, window): width between the fingers, m; 0 if it was not recorded

    @property
    def context(self) -> int:
        """The number of past rows."""
        return len(self.touch)

    @property
    def horizon(self) -> int:
        """The number of planned rows."""
        return len(self.arm) - len(self.touch)


@dataclass(frozen=True)
class ForecastShape:
    """Sizes of a forecaster's inputs and outputs, and the layout of its channels."""

    features: int  # channels of touch, or latents
    context: int  # rows of the past
    horizon: int  # rows of the plan, and predicted steps
    layout: Sequence[Mapping[str, str]] = ()  # stream, taxel and axis of each channel; empty for latents
    increments: bool = False  # features are differences from the previous row

    @property
    def past(self) -> int:
        """The number of inputs per past row of a plain network: change, level, repetition, gripper and motion."""
        return 2 * self.features + 2 + self.plan

    @property
    def plan(self) -> int:
        """The number of inputs per planned row of a plain network: motion and up."""
        return MOTION + UP


def repeats(touch: Tensor) -> Tensor:
    """Return 1 where a row of ``touch`` (context, window, feature) equals the previous row, else 0: (context, window).

    The first row counts as new, because the row before it is outside the window.
    """
    same = (touch[1:] == touch[:-1]).all(dim=-1)
    return torch.cat([same.new_zeros(1, touch.shape[1]), same]).to(touch.dtype)


def rotations(quaternions: Tensor) -> Tensor:
    """Return the rotation matrices (…, 3, 3) of unit quaternions x, y, z, w (…, 4)."""
    x, y, z, w = quaternions.unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], -1),
        torch.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], -1),
        torch.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def motion(windows: ForecastWindows) -> tuple[Tensor, Tensor]:
    """Return motion in the present frame of the hand (context + horizon, window, 12), and up in this frame (window, 3).

    Columns: position relative to the present, m; rotation relative to the present, as the vector part of the rotation
    matrix's skew-symmetric half; velocity, m/s; angular velocity, rad/s. Neither position nor heading of the arm is an
    input: the load on a fingertip depends on weight and acceleration in the frame of the hand.
    """
    position, quaternions = windows.arm[..., :3], windows.arm[..., 3:POSE]
    now = windows.context - 1
    hand_rotations = rotations(quaternions)  # (row, window, 3, 3)
    to_hand = hand_rotations[now].transpose(-1, -2)  # (window, 3, 3), from the base frame to the hand frame
    displacement = _apply(to_hand, position - position[now])
    relative = to_hand @ hand_rotations
    vector = 0.5 * torch.stack(
        [
            relative[..., 2, 1] - relative[..., 1, 2],
            relative[..., 0, 2] - relative[..., 2, 0],
            relative[..., 1, 0] - relative[..., 0, 1],
        ],
        -1,
    )
    linear, angular = _apply(to_hand, windows.arm[..., POSE : POSE + 3]), _apply(to_hand, windows.arm[..., POSE + 3 :])
    return torch.cat([displacement, vector, linear, angular], -1), to_hand[..., 2]


def without_plan(windows: ForecastWindows) -> ForecastWindows:
    """Replace every row of the plan by the last row of the past, so that the model gets no plan."""
    now = windows.arm[windows.context - 1 : windows.context]
    return windows._replace(arm=torch.cat([windows.arm[: windows.context], now.expand(windows.horizon, -1, -1)]))


def swap_plans(windows: ForecastWindows, sources: Tensor) -> ForecastWindows:
    """Return windows whose plans are those of the windows ``sources`` (window,), moved to start at the present pose.

    The plans are plausible but wrong. Positions, orientations and velocities are transformed by one rigid motion.
    """
    now = windows.context - 1
    start, source_start = windows.arm[now], windows.arm[now, sources]  # (window, 13)
    plan = windows.arm[windows.context :, sources]
    bridge = _product(start[..., 3:POSE], _conjugate(source_start[..., 3:POSE]))  # (window, 4)
    turn = rotations(bridge)
    moved = torch.cat(
        [
            start[..., :3] + _apply(turn, plan[..., :3] - source_start[..., :3]),
            _product(bridge.expand(len(plan), -1, -1), plan[..., 3:POSE]),
            _apply(turn, plan[..., POSE : POSE + 3]),
            _apply(turn, plan[..., POSE + 3 :]),
        ],
        -1,
    )
    return windows._replace(arm=torch.cat([windows.arm[: windows.context], moved]))


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Return ``matrices`` (window, 3, 3) times ``vectors`` (row, window, 3)."""
    return (matrices @ vectors.unsqueeze(-1)).squeeze(-1)


def _conjugate(quaternions: Tensor) -> Tensor:
    return quaternions * quaternions.new_tensor([-1.0, -1.0, -1.0, 1.0])


def _product(first: Tensor, second: Tensor) -> Tensor:
    """Return the quaternion (…, 4) of the rotation by ``second``, followed by ``first``."""
    a, b = first[..., :3], second[..., :3]
    vector = first[..., 3:] * b + second[..., 3:] * a + torch.linalg.cross(a, b)
    scalar = first[..., 3:] * second[..., 3:] - (a * b).sum(-1, keepdim=True)
    return torch.cat([vector, scalar], -1)
