"""MiniRocket, the fractions of a slide where ten thousand patterns occur, and a classifier that reads them.

Dempster, Schmidt and Webb, MiniRocket: A Very Fast (Almost) Deterministic Transform for Time Series Classification, 2021
(arXiv 2012.08791), section 3, in its form for several channels. A pattern is one of 84 kernels of nine weights, three of
them 2 and six -1, stretched by a dilation and laid over the sum of a few channels drawn at random. A feature is the
fraction of positions at which the kernel's answer exceeds a bias, and biases are quantiles of the answers to training
slides. Every other kernel looks only where it fits into the slide; the rest see zeros beyond its ends.

Nothing is learned but the biases, so few slides suffice; what the features mean is left to a linear readout.

Slides are laid out channel, time, slide: a shifted slide is then a slice, and no step of the arithmetic below copies or
strides. Three things make it fast: the nine weights are summed once for all, by doubling (2, 4 and 8 shifts, then the
ninth); a block of slides stays in the processor's cache; and positions are counted as bytes.
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

LENGTH = 9  # weights of a kernel
HEAVY = np.array(list(itertools.combinations(range(LENGTH), 3)))  # (kernel, 3): where its weights are 2
KERNELS = len(HEAVY)  # 84
DILATIONS = 32  # most dilations of a kernel
MAX_CHANNELS = 9  # most channels that one kernel sums
GOLDEN = (5**0.5 + 1) / 2  # its multiples, modulo 1, fill the unit interval evenly
BLOCK_BYTES = 2**18  # size of one channel of a block of slides: several such arrays fit into a cache of 1 MB
COUNTED = 255  # positions that a byte can count


@dataclass(frozen=True)
class Rocket:
    """The patterns and their biases. Features come dilation by dilation, then kernel by kernel, then bias by bias."""

    frames: int
    dilations: Int32s  # (dilation,), frames
    counts: Int32s  # (dilation,): biases of each kernel
    channels: Bools  # (dilation, kernel, channel): which it sums
    biases: AnyFloats  # (feature,), in the slides' unit

    @classmethod
    def fit(cls, x: AnyFloats, *, features: int = 10_000, seed: int = 0) -> Rocket:
        """Return a transform for slides like the training slides ``x``, (slide, time, channel).

        ``features`` is rounded down to a multiple of 84, and channels and slides that biases are taken of follow from
        ``seed``. Raises `TacpipeError` for fewer than nine frames, fewer than 84 features, or values not finite.
        """
        _check(x)
        if features < KERNELS:
            raise TacpipeError(f"{features} features are too few for {KERNELS} kernels; use {KERNELS} or more.")
        slides, frames, channels = x.shape
        rng = np.random.default_rng(seed)
        dilations, counts_per_kernel = _dilations(frames, features // KERNELS)
        limit = min(channels, MAX_CHANNELS)
        channel_counts = (2 ** rng.uniform(0, np.log2(limit + 1), (len(dilations), KERNELS))).astype(int)
        drawn = rng.random((len(dilations), KERNELS, channels)).argsort(axis=-1).argsort(axis=-1)
        chosen = drawn < channel_counts[..., None]
        examples = rng.integers(slides, size=(len(dilations), KERNELS))
        quantiles = np.arange(1, KERNELS * counts_per_kernel.sum() + 1) * GOLDEN % 1
        padded, answers = _padded(x, dilations[-1]), []
        for at, dilation in enumerate(dilations):
            for kernel in range(KERNELS):
                example = padded[:, :, examples[at, kernel], None]
                answers.append(_answer(example, frames, at, kernel, dilation, chosen)[:, 0])
        quantiles_by_answer = np.split(quantiles, np.repeat(counts_per_kernel, KERNELS).cumsum()[:-1])
        biases = [np.quantile(answer, levels) for answer, levels in zip(answers, quantiles_by_answer, strict=True)]
        return cls(frames, dilations, counts_per_kernel, chosen, np.concatenate(biases).astype(np.float32))

    def transform(self, x: AnyFloats) -> AnyFloats:
        """Return the features of slides (slide, time, channel): shares from 0 to 1, (slide, feature), float32.

        Raises `TacpipeError` if slides are not like those that were fitted, or values are not finite.
        """
        _check(x)
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
        """Return the features of a few slides, (feature, slide)."""
        features, at = np.empty((len(self.biases), len(x)), np.float32), 0
        padded = _padded(x, self.dilations[-1])
        for index, (dilation, features_per_kernel) in enumerate(zip(self.dilations, self.counts, strict=True)):
            for kernel in range(KERNELS):
                answer = _answer(padded, self.frames, index, kernel, dilation, self.channels)
                flags = np.empty(answer.shape, np.bool_)
                for _ in range(features_per_kernel):
                    np.greater(answer, self.biases[at], out=flags)
                    features[at] = _counts(flags)
                    at += 1
                features[at - features_per_kernel : at] /= len(answer)
        return features

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return all that `from_tensors` needs."""
        return {
            "frames": np.array([self.frames], np.int32),
            "dilations": self.dilations,
            "each": self.counts,
            "channels": self.channels,
            "biases": self.biases,
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Rocket:
        """Return the transform that `to_tensors` described. Raises `ValueError` if its parts do not fit one another."""
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
    """Return the dilations and how many of a kernel's ``features_per_kernel`` features every one gets, both (dilation,).

    They are spread evenly over powers of two, up to that at which a kernel spans the slide; those that fall on the same
    whole number share it, and what rounding leaves over goes round from the first on.
    """
    limit = min(features_per_kernel, DILATIONS)
    powers = np.linspace(0, np.log2((frames - 1) / (LENGTH - 1)), limit)
    dilations, shared = np.unique((2**powers).astype(np.int32), return_counts=True)
    counts = (shared * (features_per_kernel / limit)).astype(np.int32)
    counts[np.arange(features_per_kernel - counts.sum()) % len(counts)] += 1
    return dilations, counts


def _padded(x: AnyFloats, dilation: int) -> AnyFloats:
    """Return slides with zeros before and after them for kernels up to ``dilation``, (channel, time, slide), float32."""
    pad = (LENGTH // 2) * int(dilation)
    padded = np.zeros((x.shape[2], x.shape[1] + 2 * pad, x.shape[0]), np.float32)
    padded[:, pad : pad + x.shape[1]] = x.transpose(2, 1, 0)
    return padded


def _answer(padded: AnyFloats, frames: int, index: int, kernel: int, dilation: int, channels: Bools) -> AnyFloats:
    """Return what a kernel answers at each position, (time, slide)."""
    reach = (LENGTH - 1) * int(dilation)
    spare = padded.shape[1] - frames
    rows = frames + reach if (index + kernel) % 2 == 0 else frames  # every other kernel reads zeros beyond the ends
    first = (spare - (rows - frames)) // 2
    rows -= reach
    chosen = np.flatnonzero(channels[index, kernel])
    total = padded[chosen[0], first : first + rows + reach]
    if len(chosen) > 1:
        total = total + padded[chosen[1], first : first + rows + reach]
        for channel in chosen[2:]:
            total += padded[channel, first : first + rows + reach]
    nine = total[:-dilation] + total[dilation:]
    nine = nine[: -2 * dilation] + nine[2 * dilation :]
    nine = nine[: -4 * dilation] + nine[4 * dilation :]  # eight of them
    nine = nine[:rows]
    nine += total[reach:]
    heavy = [total[weight * dilation : weight * dilation + rows] for weight in HEAVY[kernel]]
    answer = heavy[0] + heavy[1]
    answer += heavy[2]
    answer *= 3
    answer -= nine
    return answer


def _counts(flags: Bools) -> AnyArray:
    """Return how many of the flags (time, slide) are set, (slide,)."""
    byte = flags.view(np.uint8)
    parts = [np.add.reduce(byte[at : at + COUNTED], axis=0, dtype=np.uint8) for at in range(0, len(byte), COUNTED)]
    total: AnyFloats = np.sum(parts, axis=0, dtype=np.float32)
    return total


def _check(x: AnyFloats) -> None:
    if x.ndim != 3 or not x.size or x.shape[1] < LENGTH:
        raise TacpipeError(
            f"Slides of {x.shape} cannot be transformed; they must be (slide, time, channel), with {LENGTH} frames or "
            "more."
        )
    if not np.isfinite(x).all():
        raise TacpipeError("Some slides hold values that are not finite. Segment them again, or leave these out.")


QUANTILES = (0.5, 0.75, 0.9, 1.0)  # taken over the channels at one moment
SHARES = (0.0, 0.3, 1.0)  # weights of strength that are tried, patterns have 1; finer steps let it in by chance


@dataclass(frozen=True)
class MinirocketClassifier:
    """Hold a fitted classifier.

    The MiniRocket classifier: how often patterns occur in a slide, with how strong it is, read out by the nearest mean.

    Patterns are those of MiniRocket, sought in the channels of a slide and in six more that describe how pressure lies
    across all channels at each moment: mean, standard deviation, three quantiles and the highest. Strength is the mean,
    the standard deviation and the mean step of each channel's root, for variance grows with pressure. Where contact is
    loosely controlled, strength depends much on the material from few slides; where it drifts, it misleads. So its
    weight next to patterns is the one that errs least on training slides that are left out one by one.
    """

    ANY_LENGTH: ClassVar[bool] = False  # True: slides of fewer frames than in training are read, too
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

        Raises `TacpipeError` if slides are not like those that were fitted, or values are not finite.
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
            Rocket.from_tensors(tensors_under("patterns.", tensors)),
            Readout.from_tensors(tensors_under("readout.", tensors)),
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
