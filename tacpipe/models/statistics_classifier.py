"""The statistics classifier: how each channel is spread over a slide, read out by the nearest mean, for few slides.

A few slides of each class determine few numbers. So a slide is described by statistics of each channel, and of six more
channels that describe how contact lies across all of them at each moment, as `minirocket_classifier` makes them. All
are of the root, because variance grows with pressure.

Much of what they hold is the level: how hard and where the finger was pressed. `VIEWS` are therefore of three kinds:
all statistics, the level alone, and all statistics of slides whose level is removed. What the second gets right, contact
conditions or drift may give away; what the third gets right is neither.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Self, get_args

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Float32s, Floats, Int32s, Ints
from tacpipe.errors import TacpipeError
from tacpipe.models.readout import Readout
from tacpipe.models.tensors import under

View = Literal["all", "level", "level_removed"]
VIEWS: tuple[View, ...] = get_args(View)
ACROSS = (0.5, 0.75, 0.9, 1.0)  # quantiles of the channels at one moment
OVER = (0.1, 0.25, 0.5, 0.75, 0.9)  # quantiles of a channel over the slide
FEWEST = 3  # frames; fewer have no thirds and no turns
CHUNK = 64  # slides at once, which bounds memory


@dataclass(frozen=True)
class StatisticsClassifier:
    """Hold a fitted classifier."""

    readout: Readout
    view: View = "all"

    @classmethod
    def fit(cls, x: AnyFloats, labels: Ints, *, view: View = "all") -> Self:
        """Return the classifier of training slides (slide, time, channel) and their classes (slide,), whole numbers.

        Raises `TacpipeError` for slides of fewer than three frames, values not finite, or fewer than two classes.
        """
        return cls(Readout.nearest_mean(read(x, view), labels), view)

    @property
    def classes(self) -> Int32s:
        """The classes in the order of scores, (class,)."""
        return self.readout.classes

    def scores(self, x: AnyFloats) -> AnyFloats:
        """Return the scores of slides (slide, time, channel), (slide, class), float32; the highest wins.

        Raises `TacpipeError` where slides have other channels than those that were fitted, or values are not finite.
        """
        return self.readout.scores(read(x, self.view))

    def predict(self, x: AnyFloats) -> Int32s:
        """Return the class of the highest score of each slide, (slide,)."""
        predicted: Int32s = self.classes[self.scores(x).argmax(axis=1)]
        return predicted

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return all that `from_tensors` needs."""
        tensors = {f"readout.{key}": value for key, value in self.readout.to_tensors().items()}
        return tensors | {"view": np.array([VIEWS.index(self.view)], np.int32)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Self:
        """Return the classifier that `to_tensors` described."""
        return cls(Readout.from_tensors(under("readout.", tensors)), VIEWS[int(tensors["view"][0])])


def read(x: AnyFloats, view: View = "all") -> Float32s:
    """Return what a view holds of slides (slide, time, channel): (slide, feature), float32.

    ``all`` is what `statistics` returns; ``level`` of that the mean of each channel's root; ``level_removed`` what
    `statistics` returns of slides of which each channel's mean is subtracted. Raises as `statistics`.
    """
    if view == "level_removed":
        _check(x)
        x = x - x.mean(axis=1, keepdims=True, dtype=np.float64)
    features = statistics(x)
    return features[:, : x.shape[2] + len(ACROSS) + 2] if view == "level" else features


def statistics(x: AnyFloats) -> Float32s:
    """Return the statistics of slides (slide, time, channel): (slide, 15 x (channel + 6)), float32.

    In this order, each of all channels and of the six across them (mean, standard deviation, quantiles of `ACROSS`), of
    the root of each value, its sign kept: the mean over time; the standard deviation; the mean absolute step; the quantiles
    of `OVER`; the lowest and the highest value; the roughness, which is the mean absolute change of the step as a ratio to
    the mean absolute step, 0 without steps; the fraction of frames in which the value is 0; the mean of each third of the
    slide.
    Raises `TacpipeError` for slides of fewer than three frames, without channels, or with values that are not finite.
    """
    _check(x)
    parts = [_statistics(x[first : first + CHUNK]) for first in range(0, len(x), CHUNK)]
    return np.concatenate(parts) if parts else np.empty((0, 15 * (x.shape[2] + len(ACROSS) + 2)), np.float32)


def _check(x: AnyFloats) -> None:
    if x.ndim != 3 or x.shape[1] < FEWEST or not x.shape[2]:
        raise TacpipeError(
            f"Slides of {x.shape} have no statistics; they must be (slide, time, channel) with {FEWEST} frames or more and "
            "a channel. Segment longer slides."
        )
    if not np.isfinite(x).all():
        raise TacpipeError("Some slides hold values that are not finite. Segment them again, or leave these out.")


def _statistics(x: AnyFloats) -> Float32s:
    root = _wide(np.sign(x) * np.sqrt(np.abs(x)).astype(np.float64))  # a tared sensor may go below zero
    steps = np.diff(root, axis=1)
    step = np.abs(steps).mean(axis=1)
    turn = np.abs(np.diff(steps, axis=1)).mean(axis=1)
    parts = [
        root.mean(axis=1),
        root.std(axis=1),
        step,
        *np.quantile(root, OVER, axis=1),
        root.min(axis=1),
        root.max(axis=1),
        np.divide(turn, step, out=np.zeros_like(step), where=step > 0),
        (root == 0).mean(axis=1),
        *(third.mean(axis=1) for third in np.array_split(root, 3, axis=1)),
    ]
    return np.concatenate(parts, axis=1, dtype=np.float32)


def _wide(root: Floats) -> Floats:
    """Return roots (slide, time, channel) with the mean, spread and quantiles of all channels as six more channels."""
    across = [root.mean(axis=2), root.std(axis=2), *np.quantile(root, ACROSS, axis=2)]
    wide: Floats = np.concatenate([root, np.stack(across, axis=2)], axis=2)
    return wide
