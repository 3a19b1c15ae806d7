"""The MiniRocket classifier: how often patterns occur in a slide, with how strong it is, read out by the nearest mean.

Patterns are those of MiniRocket, sought in the channels of a slide and in six more that describe how pressure lies
across all channels at each moment: mean, standard deviation, three quantiles and the highest. Strength is the mean, the
standard deviation and the mean step of each channel's root, for variance grows with pressure. Where contact is loosely
controlled, strength depends much on the material from few slides; where it drifts, it misleads. So its weight next to
patterns is the one that errs least on training slides that are left out one by one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Int32s, Ints
from tacpipe.models.minirocket import Rocket
from tacpipe.models.readout import Readout
from tacpipe.models.tensors import under

QUANTILES = (0.5, 0.75, 0.9, 1.0)  # taken over the channels at one moment
SHARES = (0.0, 0.3, 1.0)  # weights of strength that are tried, patterns have 1; finer steps let it in by chance


@dataclass(frozen=True)
class MinirocketClassifier:
    """Hold a fitted classifier."""

    patterns: Rocket
    readout: Readout
    share: float  # weight of strength; patterns have 1

    @classmethod
    def fit(cls, x: AnyFloats, labels: Ints, *, seed: int = 0, features: int = 10_000) -> MinirocketClassifier:
        """Return the classifier of training slides (slide, time, channel) and their classes (slide,), whole numbers.

        ``features`` is the number of patterns; ``seed`` that of the draws among them. Raises `TacpipeError` for slides
        that no pattern fits into, values not finite, or fewer than two classes.
        """
        wide = with_profile(x)
        patterns = Rocket.fit(wide, features=features, seed=seed)
        return cls(patterns, *_read(patterns.transform(wide), _strength(wide), labels))

    def relabelled(self, x: AnyFloats, labels: Ints) -> MinirocketClassifier:
        """Return a classifier with the same patterns, its readout fitted to slides ``x`` and other ``labels``."""
        wide = with_profile(x)
        return MinirocketClassifier(self.patterns, *_read(self.patterns.transform(wide), _strength(wide), labels))

    @property
    def classes(self) -> Int32s:
        """The classes in the order of scores, (class,)."""
        return self.readout.classes

    def scores(self, x: AnyFloats) -> AnyFloats:
        """Return the scores of slides (slide, time, channel), (slide, class), float32; the highest wins.

        Raises `TacpipeError` where slides are not like those that were fitted, or values are not finite.
        """
        wide = with_profile(x)
        return self.readout.scores(np.concatenate([self.patterns.transform(wide), _strength(wide)], axis=1))

    def predict(self, x: AnyFloats) -> Int32s:
        """Return the class of the highest score of each slide, (slide,)."""
        predicted: Int32s = self.classes[self.scores(x).argmax(axis=1)]
        return predicted

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return all that `from_tensors` needs."""
        parts = {"patterns": self.patterns.to_tensors(), "readout": self.readout.to_tensors()}
        tensors = {f"{name}.{key}": value for name, part in parts.items() for key, value in part.items()}
        return tensors | {"share": np.array([self.share])}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> MinirocketClassifier:
        """Return the classifier that `to_tensors` described."""
        return cls(
            Rocket.from_tensors(under("patterns.", tensors)),
            Readout.from_tensors(under("readout.", tensors)),
            float(tensors["share"][0]),
        )


def _read(patterns: AnyFloats, strength: AnyFloats, labels: Ints) -> tuple[Readout, float]:
    """Return the readout of patterns and strength, each (slide, feature), and the weight of strength."""
    features = np.concatenate([patterns, strength], axis=1)

    def shares(share: float) -> AnyFloats:
        return np.repeat([1 / patterns.shape[1], share / strength.shape[1]], [patterns.shape[1], strength.shape[1]])

    best = min(SHARES, key=lambda share: Readout.fit(features, labels, shares(share)).left_out_error)
    return Readout.nearest_mean(features, labels, shares(best)), best


def with_profile(x: AnyFloats) -> AnyFloats:
    """Return slides with the mean, spread and quantiles of their channels as six more channels, float32."""
    across = [x.mean(axis=2), x.std(axis=2), *np.quantile(x, QUANTILES, axis=2)]
    return np.concatenate([x, np.stack(across, axis=2)], axis=2, dtype=np.float32)


def _strength(x: AnyFloats) -> AnyFloats:
    """Return the mean, the standard deviation and the mean step of each channel's root, (slide, 3 x channel)."""
    root = np.sign(x) * np.sqrt(np.abs(x))  # a tared sensor may go below zero
    steps = np.abs(np.diff(root, axis=1)).mean(axis=1)
    return np.concatenate([root.mean(axis=1), root.std(axis=1), steps], axis=1)
