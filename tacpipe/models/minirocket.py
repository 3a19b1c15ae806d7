"""Transform slides with MiniRocket, and classify them by its features.

Dempster, Schmidt and Webb, MiniRocket: A Very Fast (Almost) Deterministic Transform for Time Series Classification,
2021 (arXiv 2012.08791), section 3, in its multivariate form. A pattern is one of 84 kernels of sums weights, three of
them 2 and six -1, with a dilation, applied to the sum of a few randomly drawn channels. A feature is the fraction of
positions at which the kernel's output exceeds a bias, and biases are quantiles of the outputs on training slides. Every
other kernel is applied without padding; the rest see zeros beyond the ends of a slide.

Only the biases are learned, so a few slides suffice; a linear readout interprets the features.

Arrays are ordered channel, time, slide, so a shift in time is a slice and the arithmetic needs neither copies nor
strides. Three things make it fast: the sums weights are summed once for all kernels, by doubling (2, 4 and 8 shifts,
then the ninth); a block of slides fits into the CPU's cache; and positions are counted as bytes.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Bools, Int32s, Ints
from tacpipe.errors import TacpipeError
from tacpipe.models.readout import Readout
from tacpipe.models.tensors import tensors_under

LENGTH = 9  # weights per kernel
# (kernel, 3): positions of the weights equal to 2
HEAVY_POSITIONS = np.array(list(itertools.combinations(range(LENGTH), 3)))
KERNELS = len(HEAVY_POSITIONS)  # 84
MAX_DILATIONS = 32  # maximum number of dilations per kernel
MAX_CHANNELS = 9  # maximum number of channels that a kernel sums
GOLDEN = (5**0.5 + 1) / 2  # its multiples, modulo 1, cover the unit interval evenly
BLOCK_BYTES = 2**18  # size of one channel of a block of slides: several such arrays fit into a cache of 1 MB
MAX_BYTE_COUNT = 255  # maximum number of positions counted in a byte


@dataclass(frozen=True)
class Rocket:
    """The patterns and their biases. Features are ordered by dilation, then kernel, then bias."""

    frames: int
    dilations: Int32s  # (dilation,), frames
    counts: Int32s  # (dilation,): biases per kernel
    channels: Bools  # (dilation, kernel, channel): whether the kernel sums the channel
    biases: AnyFloats  # (feature,), in the slides' unit

    @classmethod
    def fit(cls, x: AnyFloats, *, features: int = 10_000, seed: int = 0) -> Rocket:
        """Fit a transform on training slides ``x`` (slide, time, channel).

        ``features`` is rounded down to a multiple of 84. ``seed`` determines the channels of each kernel and the slides
        of the biases. Raises `TacpipeError` if there are fewer than `LENGTH` frames or 84 features, or a value is not
        finite.
        """
        _validate_slides(x)
        if features < KERNELS:
            raise TacpipeError(f"{features} features are too few for {KERNELS} kernels; use {KERNELS} or more.")
        slides, frames, channels = x.shape
        rng = np.random.default_rng(seed)
        dilations, counts_per_kernel = _dilations(frames, features // KERNELS)
        limit = min(channels, MAX_CHANNELS)
        channel_counts = (2 ** rng.uniform(0, np.log2(limit + 1), (len(dilations), KERNELS))).astype(int)
        ranks = rng.random((len(dilations), KERNELS, channels)).argsort(axis=-1).argsort(axis=-1)
        chosen = ranks < channel_counts[..., None]
        examples = rng.integers(slides, size=(len(dilations), KERNELS))
        quantiles = np.arange(1, KERNELS * counts_per_kernel.sum() + 1) * GOLDEN % 1
        padded, outputs = _pad(x, dilations[-1]), []
        for index, dilation in enumerate(dilations):
            for kernel in range(KERNELS):
                example = padded[:, :, examples[index, kernel], None]
                outputs.append(_kernel_output(example, frames, index, kernel, dilation, chosen)[:, 0])
        quantiles_by_output = np.split(quantiles, np.repeat(counts_per_kernel, KERNELS).cumsum()[:-1])
        biases = [np.quantile(output, levels) for output, levels in zip(outputs, quantiles_by_output, strict=True)]
        return cls(frames, dilations, counts_per_kernel, chosen, np.concatenate(biases).astype(np.float32))

    def transform(self, x: AnyFloats) -> AnyFloats:
        """Return the features of slides (slide, time, channel): fractions from 0 to 1, (slide, feature), float32.

        Raises `TacpipeError` if the shape of the slides differs from the training slides, or a value is not finite.
        """
        _validate_slides(x)
        if x.shape[1:] != (self.frames, self.channels.shape[-1]):
            raise TacpipeError(
                f"Slides of {x.shape} do not fit the transform; (slide, {self.frames}, {self.channels.shape[-1]}) "
                "was fitted."
            )
        features = np.empty((len(x), len(self.biases)), np.float32)
        size = max(16, BLOCK_BYTES // (4 * self.frames))
        for first in range(0, len(x), size):
            features[first : first + size] = self._block(x[first : first + size]).T
        return features

    def _block(self, x: AnyFloats) -> AnyFloats:
        """Return the features of a block of slides, (feature, slide)."""
        features, row = np.empty((len(self.biases), len(x)), np.float32), 0
        padded = _pad(x, self.dilations[-1])
        for index, (dilation, features_per_kernel) in enumerate(zip(self.dilations, self.counts, strict=True)):
            for kernel in range(KERNELS):
                output = _kernel_output(padded, self.frames, index, kernel, dilation, self.channels)
                flags = np.empty(output.shape, np.bool_)
                for _ in range(features_per_kernel):
                    np.greater(output, self.biases[row], out=flags)
                    features[row] = _count_true(flags)
                    row += 1
                features[row - features_per_kernel : row] /= len(output)
        return features

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return the arrays that `from_tensors` reads."""
        return {
            "frames": np.array([self.frames], np.int32),
            "dilations": self.dilations,
            "each": self.counts,
            "channels": self.channels,
            "biases": self.biases,
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Rocket:
        """Return the transform that `to_tensors` stored. Raises `ValueError` if its arrays do not match."""
        names = ("dilations", "each", "channels", "biases")
        rocket = cls(int(tensors["frames"][0]), *(tensors[name] for name in names))
        count = len(rocket.dilations)
        fits = (
            rocket.counts.shape == (count,)
            and rocket.channels.shape[:2] == (count, KERNELS)
            and rocket.channels.dtype == np.bool_
        )
        fits = (
            fits and bool((rocket.counts >= 0).all()) and rocket.biases.shape == (KERNELS * int(rocket.counts.sum()),)
        )
        if not count or not fits or not ((rocket.dilations >= 1) & (rocket.dilations <= rocket.frames)).all():
            raise ValueError(f"{len(rocket.biases)} biases do not fit {count} dilations of {KERNELS} kernels")
        return rocket


def _dilations(frames: int, features_per_kernel: int) -> tuple[Int32s, Int32s]:
    """Return the dilations, and for each its number of features per kernel, both (dilation,).

    The numbers add up to ``features_per_kernel``. Dilations are spaced evenly over powers of two, up to that at which a
    kernel spans the slide. Dilations that round to the same integer are merged, and the remainder of rounding is
    distributed from the first on.
    """
    limit = min(features_per_kernel, MAX_DILATIONS)
    powers = np.linspace(0, np.log2((frames - 1) / (LENGTH - 1)), limit)
    dilations, shared = np.unique((2**powers).astype(np.int32), return_counts=True)
    counts = (shared * (features_per_kernel / limit)).astype(np.int32)
    counts[np.arange(features_per_kernel - counts.sum()) % len(counts)] += 1
    return dilations, counts


def _pad(x: AnyFloats, dilation: int) -> AnyFloats:
    """Pad slides with zeros at both ends for kernels up to ``dilation``: (channel, time, slide), float32."""
    pad = (LENGTH // 2) * int(dilation)
    padded = np.zeros((x.shape[2], x.shape[1] + 2 * pad, x.shape[0]), np.float32)
    padded[:, pad : pad + x.shape[1]] = x.transpose(2, 1, 0)
    return padded


def _kernel_output(
    padded: AnyFloats, frames: int, index: int, kernel: int, dilation: int, channels: Bools
) -> AnyFloats:
    """Return the output of a kernel on padded slides (channel, time, slide) at each position, (time, slide).

    ``index`` is that of the dilation. The weights are 2 at `HEAVY_POSITIONS` and -1 elsewhere, computed as three times
    the sum of the heavy positions minus the sum of all nine.
    """
    reach = (LENGTH - 1) * int(dilation)
    padding = padded.shape[1] - frames
    length = frames + reach if (index + kernel) % 2 == 0 else frames  # every other kernel is padded
    first = (padding - (length - frames)) // 2
    length -= reach
    summed_channels = np.flatnonzero(channels[index, kernel])
    total = padded[summed_channels[0], first : first + length + reach]
    if len(summed_channels) > 1:
        total = total + padded[summed_channels[1], first : first + length + reach]
        for channel in summed_channels[2:]:
            total += padded[channel, first : first + length + reach]
    sums = total[:-dilation] + total[dilation:]
    sums = sums[: -2 * dilation] + sums[2 * dilation :]
    sums = sums[: -4 * dilation] + sums[4 * dilation :]  # sums of eight
    sums = sums[:length]
    sums += total[reach:]
    heavy = [total[weight * dilation : weight * dilation + length] for weight in HEAVY_POSITIONS[kernel]]
    output = heavy[0] + heavy[1]
    output += heavy[2]
    output *= 3
    output -= sums
    return output


def _count_true(flags: Bools) -> AnyArray:
    """Count the True flags (time, slide) of each slide, (slide,)."""
    byte = flags.view(np.uint8)
    parts = [
        np.add.reduce(byte[start : start + MAX_BYTE_COUNT], axis=0, dtype=np.uint8)
        for start in range(0, len(byte), MAX_BYTE_COUNT)
    ]
    total: AnyFloats = np.sum(parts, axis=0, dtype=np.float32)
    return total


def _validate_slides(x: AnyFloats) -> None:
    """Raise `TacpipeError` unless slides are (slide, time, channel), long enough for a kernel, and finite."""
    if x.ndim != 3 or not x.size or x.shape[1] < LENGTH:
        raise TacpipeError(
            f"Slides of {x.shape} cannot be transformed; they must be (slide, time, channel), with {LENGTH} frames or "
            "more."
        )
    if not np.isfinite(x).all():
        raise TacpipeError("Some slides contain values that are not finite. Segment them again, or exclude these.")


QUANTILES = (0.5, 0.75, 0.9, 1.0)  # quantiles over the channels at each moment
# candidate weights of strength, relative to 1 for patterns; a finer grid would select it by chance
STRENGTH_WEIGHTS = (0.0, 0.3, 1.0)


@dataclass(frozen=True)
class MinirocketClassifier:
    """Classify slides by MiniRocket features and contact strength, with a nearest-mean readout.

    Patterns are computed on the channels of a slide and on six more that summarise all channels at each moment: mean,
    standard deviation, three quantiles and maximum. Strength is the mean, the standard deviation and the mean step of
    each channel's square root, because variance grows with pressure. If contact is poorly controlled, strength reveals
    the material even with few slides; if it drifts, strength misleads. So its weight is the one with the smallest
    leave-one-out error on training slides.
    """

    ANY_LENGTH: ClassVar[bool] = False  # True: also reads slides with fewer frames than in training
    patterns: Rocket
    readout: Readout
    share: float  # weight of strength, relative to 1 for patterns

    @classmethod
    def fit(cls, x: AnyFloats, labels: Ints, *, seed: int = 0, features: int = 10_000) -> MinirocketClassifier:
        """Fit a classifier on training slides (slide, time, channel) and their classes (slide,), integers.

        ``features`` is the number of patterns, drawn with ``seed``. Raises `TacpipeError` if slides are too short for
        the patterns, a value is not finite, or there are fewer than two classes.
        """
        wide = with_profile(x)
        patterns = Rocket.fit(wide, features=features, seed=seed)
        return cls(patterns, *_fit_readout(patterns.transform(wide), _strength(wide), labels))

    @property
    def classes(self) -> Int32s:
        """The classes (class,), in the order of the scores."""
        return self.readout.classes

    def scores(self, x: AnyFloats) -> AnyFloats:
        """Return the scores (slide, class), float32, of slides (slide, time, channel).

        The class with the highest score wins.

        Raises `TacpipeError` if the shape of the slides differs from the training slides, or a value is not finite.
        """
        wide = with_profile(x)
        return self.readout.scores(np.concatenate([self.patterns.transform(wide), _strength(wide)], axis=1))

    def predict(self, x: AnyFloats) -> Int32s:
        """Return the class with the highest score of each slide, (slide,)."""
        predicted: Int32s = self.classes[self.scores(x).argmax(axis=1)]
        return predicted

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return the arrays that `from_tensors` reads."""
        parts = {"patterns": self.patterns.to_tensors(), "readout": self.readout.to_tensors()}
        tensors = {f"{name}.{key}": value for name, part in parts.items() for key, value in part.items()}
        return tensors | {"share": np.array([self.share])}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> MinirocketClassifier:
        """Return the classifier that `to_tensors` stored."""
        return cls(
            Rocket.from_tensors(tensors_under("patterns.", tensors)),
            Readout.from_tensors(tensors_under("readout.", tensors)),
            float(tensors["share"][0]),
        )


def _fit_readout(patterns: AnyFloats, strength: AnyFloats, labels: Ints) -> tuple[Readout, float]:
    """Fit a readout of patterns and strength, each (slide, feature), and return it with the weight of strength.

    The weight has the smallest leave-one-out error of a ridge readout; the returned readout is a nearest-mean readout.
    """
    features = np.concatenate([patterns, strength], axis=1)

    def feature_shares(share: float) -> AnyFloats:
        return np.repeat([1 / patterns.shape[1], share / strength.shape[1]], [patterns.shape[1], strength.shape[1]])

    best = min(
        STRENGTH_WEIGHTS, key=lambda share: Readout.fit(features, labels, feature_shares(share)).leave_one_out_error
    )
    return Readout.nearest_mean(features, labels, feature_shares(best)), best


def with_profile(x: AnyFloats) -> AnyFloats:
    """Append the mean, spread and quantiles of the channels at each moment as six more channels, float32."""
    across = [x.mean(axis=2), x.std(axis=2), *np.quantile(x, QUANTILES, axis=2)]
    return np.concatenate([x, np.stack(across, axis=2)], axis=2, dtype=np.float32)


def _strength(x: AnyFloats) -> AnyFloats:
    """Return the mean, standard deviation and mean step of each channel's square root, (slide, 3 x channel)."""
    root = np.sign(x) * np.sqrt(np.abs(x))  # a tared sensor may be below zero
    steps = np.abs(np.diff(root, axis=1)).mean(axis=1)
    return np.concatenate([root.mean(axis=1), root.std(axis=1), steps], axis=1)
