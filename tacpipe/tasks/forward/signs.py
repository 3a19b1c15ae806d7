"""Compute features of each channel of a window that show how uncertain its forecast is."""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import AnyFloats, Bools, Float32s
from tacpipe.models.windows import POSE

SIGNS = 13  # features beside the predicted change at each step
LATEST = 3  # rows whose change is looked at beside that of the whole context


def signs(past: AnyFloats, ahead: AnyFloats, arm: AnyFloats, finger: AnyFloats, scale: AnyFloats) -> Float32s:
    """Return features (window, channel, feature), float32, of windows and their forecasts.

    ``past`` (window, context, channel) and the forecast ``ahead`` (window, horizon, channel) are levels above rest, ``arm``
    (window, context + horizon, 13) holds the hand's velocities in its last six columns, ``finger`` (window, context) the
    width of the gripper in m, and ``scale`` (channel,) each channel's spread in training.

    Of a channel, in units of its scale: how far from rest it is; its spread over the context; its change over the context
    and over the last rows, with the sign; its mean step; its part of rows that repeat; and the change that is predicted
    for each step. Of the window: the spread over all channels, how many of the last rows repeat, how fast the
    hand moves and turns, in the past and in the plan, and by how much the gripper moved.
    """
    windows, context, channels = past.shape
    level = past / scale
    last = level[:, -1]
    steps: AnyFloats = np.diff(level, axis=1)
    repeated: Bools = (steps == 0) if context > 1 else np.ones((windows, 1, channels), bool)
    by_channel = [
        np.log1p(np.abs(last) * 10),
        np.log1p(level.std(axis=1) * 100),
        np.arcsinh((last - level[:, 0]) * 100),
        np.arcsinh((last - level[:, -min(LATEST, context)]) * 100),
        np.log1p(np.abs(steps).mean(axis=1) * 100) if context > 1 else np.zeros_like(last),
        repeated.mean(axis=1),
        *np.arcsinh((ahead / scale - last[:, None]) * 100).transpose(1, 0, 2),
    ]
    speed = np.abs(arm[..., POSE:])
    moved, planned = speed[:, :context], speed[:, context:]
    repeats = np.cumprod(np.asarray(repeated.all(axis=2))[:, ::-1], axis=1).sum(axis=1)
    shared = [
        np.log1p(level.std(axis=1).mean(axis=1) * 100),
        repeats,
        *(
            np.log1p(part[..., axes].max(axis=(1, 2), initial=0) * unit)
            for part in (moved, planned)
            for axes, unit in ((slice(0, 3), 100), (slice(3, 6), 10))
        ),
        np.log1p(np.abs(finger[:, -1] - finger[:, 0]) * 1000),
    ]
    by_window = np.repeat(np.stack(shared, axis=-1)[:, None], channels, axis=1)
    return np.concatenate([np.stack(by_channel, axis=-1), by_window], axis=-1, dtype=np.float32)
