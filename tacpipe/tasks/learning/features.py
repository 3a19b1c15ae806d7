"""Compute scale-free features of windows of touch: level, shear over load, motion, its spread, and spectra.

Each feature depends on the rows of its window only, and all arithmetic is per window, so that a window gives the same bits
by itself as among others. Features of several fingers are reduced to their maximum and minimum.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Indices

CYCLES = (1, 2, 3, 5, 8, 12)  # cycles per window of the spectrum
EPSILON = 1e-9  # minimum divisor
PRESSED = 0.2  # fraction of the largest normal load of a finger above which a taxel counts as pressed
Layout = Sequence[Mapping[str, str]]  # taxel and axis of each channel, if its metadata contains them

NAMES = (
    *(
        "level",
        "level change",
        "level over mean",
        "speed",
        "recent speed",
        "mean speed",
        "top speed",
        "speed over mean",
    ),
    *("motion", "late motion", "spread of motion", "spread of late motion", "top of late motion"),
    *("shear", "shear change", "load", "load change", "shear over load", "change of shear over load", "slope"),
    *("taxel ratio", "spread of ratios", "change of the spread of ratios", "top ratio"),
    *(f"spectrum {cycles}" for cycles in CYCLES),
)


@dataclass(frozen=True)
class ChannelAxes:
    """Indices (taxel,) of the channels of a finger along each axis; empty for an axis that is not measured."""

    shear: tuple[Indices, Indices]
    normal: Indices

    @classmethod
    def from_layout(cls, layout: Layout) -> ChannelAxes:
        """Return the places of a finger's channels; an axis is used where all its taxels have it."""
        axes = {
            axis: [index for index, channel in enumerate(layout) if channel.get("axis") == axis]
            for axis in ("x", "y", "z")
        }
        has_shear = bool(axes["x"]) and len(axes["x"]) == len(axes["y"])
        along = [np.array(axes[axis] if has_shear else [], np.intp) for axis in ("x", "y")]
        has_normal = bool(axes["z"]) and len(axes["z"]) in (len(axes["x"]), 1)
        return cls((along[0], along[1]), np.array(axes["z"] if has_normal else [], np.intp))


def stream_features(windows: AnyFloats, layout: ChannelAxes) -> Floats:
    """Return the features (window, feature) of windows (window, time, channel) of one finger, above rest and scaled.

    A feature that the finger does not measure is NaN, such as shear over load without axes.
    """
    count, rows, _ = windows.shape
    last = windows[:, -1]
    levels = np.sqrt(np.square(windows).mean(axis=2))  # (window, time)
    late, fifth = max(0, rows - 1 - rows // 2), max(1, (rows - 1) // 5)
    features = np.full((count, len(NAMES)), np.nan)
    mean_level = levels.mean(axis=1)
    features[:, 0] = levels[:, -1]
    features[:, 1] = levels[:, -1] - levels[:, 0]
    features[:, 2] = levels[:, -1] / np.maximum(mean_level, EPSILON)
    if rows > 1:
        speeds = np.sqrt(np.square(np.diff(windows, axis=1)).mean(axis=2))  # (window, time - 1)
        recent, mean = speeds[:, -fifth:].mean(axis=1), speeds.mean(axis=1)
        features[:, 3:8] = np.stack(
            [speeds[:, -1], recent, mean, speeds.max(axis=1), recent / np.maximum(mean, EPSILON)], axis=1
        )
        for column, start in ((8, 0), (9, late)):
            moved = last - windows[:, start]
            features[:, column] = np.sqrt(np.square(moved).mean(axis=1))
            features[:, column + 2] = _spread(moved, layout)
            if column == 9:
                features[:, 12] = np.abs(moved).max(axis=1) / np.maximum(features[:, 9], EPSILON)
        features[:, len(NAMES) - len(CYCLES) :] = _spectra(levels)
    if len(layout.shear[0]):
        _add_shear(features, windows, layout, late)
    return features


def _add_shear(features: Floats, windows: AnyFloats, layout: ChannelAxes, late: int) -> None:
    """Write the features of shear, and of shear over normal load, into ``features`` (window, feature)."""
    along = [_channels(windows, places) for places in layout.shear]  # 2 x (window, time, taxel)
    shear = np.hypot(*(values.mean(axis=2) for values in along))  # (window, time)
    features[:, 13], features[:, 14] = shear[:, -1], shear[:, -1] - shear[:, late]
    if not len(layout.normal):
        return
    pressed = np.abs(_channels(windows, layout.normal))
    load = pressed.mean(axis=2)
    ratio = shear / np.maximum(load, EPSILON)
    features[:, 15], features[:, 16] = load[:, -1], load[:, -1] / np.maximum(load[:, late], EPSILON)
    features[:, 17], features[:, 18] = ratio[:, -1], ratio[:, -1] - ratio[:, late]
    features[:, 19] = ratio[:, -1] - ratio[:, max(0, ratio.shape[1] - 4)]
    if len(layout.normal) == len(layout.shear[0]):
        spreads = []
        for row in (late, -1):
            normal = pressed[:, row]
            ratios = np.hypot(along[0][:, row], along[1][:, row]) / np.maximum(normal, EPSILON)
            counted = normal >= PRESSED * normal.max(axis=1, keepdims=True)
            total = np.maximum(counted.sum(axis=1), 1)
            mean = np.where(counted, ratios, 0.0).sum(axis=1) / total
            variance = np.where(counted, np.square(ratios - mean[:, None]), 0.0).sum(axis=1) / total
            spreads.append(np.sqrt(variance) / np.maximum(mean, EPSILON))
        features[:, 20], features[:, 21], features[:, 22] = mean, spreads[1], spreads[1] - spreads[0]
        features[:, 23] = np.where(counted, ratios, 0.0).max(axis=1)


def _channels(values: AnyFloats, places: Indices) -> AnyFloats:
    """Return some channels of values (…, channel) in the order of memory, in which each window's sums have the same bits."""
    return np.ascontiguousarray(values[..., places])


def _spread(moved: AnyFloats, layout: ChannelAxes) -> Floats:
    """Return how unlike the displacements (window, channel) of taxels are: 0 if all move alike, 1 without a common part."""
    parts = [_channels(moved, places) for places in layout.shear] if len(layout.shear[0]) else [moved]
    total = sum(np.square(part).mean(axis=1) for part in parts)
    common = sum(np.square(part.mean(axis=1)) for part in parts)
    spread: Floats = 1 - common / np.maximum(total, EPSILON)
    return spread


def _spectra(levels: Floats) -> Floats:
    """Return the amplitudes (window, cycle) of levels (window, time) around their mean at `CYCLES` per window."""
    rows = levels.shape[1]
    around = levels - levels.mean(axis=1, keepdims=True)
    amplitudes = np.full((len(levels), len(CYCLES)), np.nan)
    for index, cycles in enumerate(CYCLES):
        if 2 * cycles < rows:
            angle = 2 * np.pi * cycles * np.arange(rows) / rows
            # sums of products instead of a transform, whose bits may depend on the number of windows
            parts = [(around * wave).sum(axis=1) for wave in (np.cos(angle), np.sin(angle))]
            amplitudes[:, index] = np.hypot(*parts) / rows
    return amplitudes


def feature_names(fingers: int) -> list[str]:
    """Return the names of the features of a model that reads so many fingers."""
    return list(NAMES) if fingers == 1 else [f"{end} {name}" for end in ("largest", "smallest") for name in NAMES]


def combine_streams(by_stream: Sequence[Floats]) -> Floats:
    """Return the maximum and minimum over fingers of their features (window, feature), for one finger the features."""
    if len(by_stream) == 1:
        return by_stream[0]
    stacked = np.stack(by_stream)
    return np.concatenate([np.fmax.reduce(stacked), np.fmin.reduce(stacked)], axis=1)


SMALLEST_DEVIATION = 1e-12  # minimum divisor of features
LARGEST = 10.0  # maximum standardised feature
FeatureKind = Literal["last", "statistics", "time"]
Kind = Literal["quantity", "class"]  # what is learned: values, or scores of classes
PARTS = ("last", "mean", "deviation", "change", "least", "largest")  # features of each channel in a window


def window_features(kind: FeatureKind, windows: Sequence[AnyFloats], layouts: Sequence[Layout]) -> Floats:
    """Return the features (window, feature) of the windows (window, time, channel) of each stream.

    ``last``: the values of the last row. ``statistics``: `PARTS` of each channel, then `stream_features` of each stream; of
    windows of one row these are the values alone.
    """
    if kind == "last" or all(part.shape[1] == 1 for part in windows):
        return np.concatenate([part[:, -1] for part in windows], axis=1)
    parts: list[AnyFloats] = []
    for part, layout in zip(windows, layouts, strict=True):
        last = part[:, -1]
        parts += [last, part.mean(axis=1), part.std(axis=1), last - part[:, 0], part.min(axis=1), part.max(axis=1)]
        parts.append(stream_features(part, ChannelAxes.from_layout(layout)))
    return np.concatenate(parts, axis=1)


def standardise(rows: Floats, means: Floats | float, deviations: Floats | float) -> Floats:
    """Return features (row, …) in standard deviations from their means, limited, 0 where they are missing."""
    standard = np.ascontiguousarray((rows - means) / deviations)
    return np.nan_to_num(np.clip(standard, -LARGEST, LARGEST))
