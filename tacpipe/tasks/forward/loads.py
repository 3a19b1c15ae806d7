"""Loads: the mean count of each axis of each sensor, which change when a hand grips, slips or lets go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats


def axes(layout: Sequence[Mapping[str, str]]) -> tuple[tuple[str, str], ...]:
    """Return stream and axis of each load of channels that lie so."""
    return tuple(dict.fromkeys(map(_axis, layout)))


def loads(counts: Any, layout: Sequence[Mapping[str, str]]) -> AnyFloats:
    """Return the loads (time, load), in the order of `axes`, of ``counts`` (time, channel) of channels that lie so.

    >>> layout = [{"stream": "left", "axis": axis} for axis in "xxz"]
    >>> loads(np.array([[1.0, 3.0, 7.0]]), layout).tolist()
    [[2.0, 7.0]]
    """
    places = [_axis(channel) for channel in layout]
    return np.stack(
        [
            counts[:, [index for index, place in enumerate(places) if place == load_axis]].mean(axis=1)
            for load_axis in axes(layout)
        ],
        axis=1,
    )


def _axis(channel: Mapping[str, str]) -> tuple[str, str]:
    return channel.get("stream", ""), channel.get("axis", "")
