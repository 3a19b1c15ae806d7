"""The load along the skin (shear), and how a forecast of it rises and gives way: what the alarm for slips looks at.

An object that is about to slip pulls harder and harder along the skin, until friction gives way and the pull drops. So the
score of a forecast is how far the shear load of a sensor is predicted to rise from now to a step, plus how far it is
predicted to fall afterwards, at the step where the sum is largest; as a fraction of the load that presses on that sensor
now, because friction holds in proportion to it. A forecast of no change has the score 0.

The shear load of a sensor is the length of the mean of its taxels along the axes x and y, the pressing load the size of
their mean along z. A sensor that is hardly touched presses with next to nothing: the divisor is at least a floor, which
`floors` makes of the spread of the same channels in training. Numerator, divisor and floor are of one unit, so that the
score has none, and sensors of unlike units can be compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats, Floats

Layout = Sequence[Mapping[str, str]]

ALONG = ("x", "y")  # axes along the skin
PRESSING = "z"  # the axis into it


def skins(layout: Layout) -> tuple[str, ...]:
    """Return the streams with channels along the skin, in the order of the channels.

    >>> skins([{"stream": "left", "axis": "x"}, {"stream": "pad", "axis": "z"}, {"stream": "left", "axis": "z"}])
    ('left',)
    """
    return tuple(dict.fromkeys(channel.get("stream", "") for channel in layout if channel.get("axis") in ALONG))


def shear(levels: AnyFloats, layout: Layout) -> Floats:
    """Return the shear load (…, skin) of ``levels`` (…, channel) above rest, of channels that lie so.

    >>> layout = [{"stream": "left", "axis": axis} for axis in "xxyz"]
    >>> shear(np.array([[2.0, 4.0, -4.0, 100.0]]), layout).tolist()
    [[5.0]]
    """
    parts = [[_mean(levels, layout, skin, axis) for axis in ALONG] for skin in skins(layout)]
    return np.stack([np.hypot(*axes) for axes in parts], axis=-1) if parts else np.zeros((*levels.shape[:-1], 0))


def pressing(levels: AnyFloats, layout: Layout) -> Floats:
    """Return the load that presses on each skin (…, skin), 0 where a sensor does not measure it."""
    loads = [np.abs(_mean(levels, layout, skin, PRESSING)) for skin in skins(layout)]
    return np.stack(loads, axis=-1) if loads else np.zeros((*levels.shape[:-1], 0))


def floors(spread: AnyFloats, layout: Layout) -> Floats:
    """Return the least divisor of each skin (skin,), of the standard deviation of each channel in training (channel,).

    It is the mean deviation of the channels that press; of a sensor without any, of those along the skin.

    >>> layout = [{"stream": "left", "axis": axis} for axis in "xyzz"]
    >>> floors(np.array([1.0, 3.0, 10.0, 30.0]), layout).tolist(), floors(np.array([1.0, 3.0]), layout[:2]).tolist()
    ([20.0], [2.0])
    """
    divisors = []
    for skin in skins(layout):
        sizes = [
            (channel.get("axis"), float(size))
            for channel, size in zip(layout, spread, strict=True)
            if _on(channel, skin)
        ]
        presses = [size for axis, size in sizes if axis == PRESSING]
        divisors.append(np.mean(presses or [size for axis, size in sizes if axis in ALONG]))
    return np.array(divisors, dtype=np.float64)


def rise_and_fall(ahead: AnyFloats, now: AnyFloats, layout: Layout, divisors: AnyFloats) -> Floats:
    """Return the score (window,) of forecasts ``ahead`` (window, step, channel) at levels ``now`` (window, channel).

    The largest of all skins counts; ``divisors`` (skin,) is what `floors` gives. NaN where a forecast is not finite, and for
    channels none of which lies along a skin.
    """
    if not skins(layout):
        return np.full(len(now), np.nan)
    predicted, present = shear(ahead, layout), shear(now, layout)[:, None]  # (window, step, skin)
    lowest = np.minimum.accumulate(predicted[:, ::-1], axis=1)[:, ::-1]  # least of each step and those after it
    moved = ((predicted - present) + (predicted - lowest)).max(axis=1)
    score: Floats = (moved / np.maximum(pressing(now, layout), divisors)).max(axis=1)
    return np.maximum(score, 0.0)


def _mean(levels: Any, layout: Layout, skin: str, axis: str) -> Floats:
    """Return the mean (…,) of the channels of a skin along an axis, 0 where it has none."""
    chosen = [index for index, channel in enumerate(layout) if _on(channel, skin) and channel.get("axis") == axis]
    if not chosen:
        return np.zeros(levels.shape[:-1])
    mean: Floats = np.asarray(levels[..., chosen], dtype=np.float64).mean(axis=-1)
    return mean


def _on(channel: Mapping[str, str], skin: str) -> bool:
    return channel.get("stream", "") == skin
