"""Share classes between sensors: features of the same kind, each sensor's changed in a way of its own.

In sensor s, slides of class c have features N(m_sc, W_s). What another sensor t knows of the class predicts where m_sc is to
be expected: in each feature alone at ``a + g m_tc``, give or take a variance b. The offset a and the gain g are fitted
on the classes that both learned, the gain drawn towards that of all features, for these classes are few; b is the mean
squared error on each of these classes when it is left out of the fit. Several sensors' expectations count by 1 / b; where
none knows the class, it is expected like the sensor's own classes, with the variance between them.

What the sensor itself learned then corrects the expectation, by the rule of Bayes: n slides of mean x give
``V = (B^-1 + n W^-1)^-1`` and ``m = V (B^-1 p + n W^-1 x)``, and a new slide of the class is N(m, W + V). So one rule names
classes of many slides, of few, and of none: the wider a class is expected to lie, the less is made of a slide near its
middle. W is shrunk as by Ledoit and Wolf (A well-conditioned estimator for large-dimensional covariance matrices, 2004).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, AnyFloats, Int32s, Ints
from tacpipe.errors import TacpipeError

SHARED = 3  # fewest classes from which the difference of two sensors is fitted
PULL = 0.5  # weight of the gain of all features on that of each, as a fraction of a feature's mean sum of squares
STEADY = (
    1e-4  # fraction of a covariance's mean variance that is added to each variance: features may depend on each other
)


@dataclass(frozen=True)
class Labelled:
    """Labelled slides of a sensor: features (slide, feature) and classes (slide,)."""

    features: AnyFloats
    labels: Ints


@dataclass(frozen=True)
class Gaussians:
    """Classes as normal distributions of features; a covariance of zeros marks one of which nothing is known."""

    mean: AnyFloats  # (class, feature)
    covariance: AnyFloats  # (class, feature, feature)

    def scores(self, features: AnyFloats) -> AnyFloats:
        """Return log-likelihoods of slides (slide, feature) up to what all classes share: (slide, class), float32."""
        scores = np.full((len(features), len(self.mean)), -np.inf, np.float32)
        for index, (mean, covariance) in enumerate(zip(self.mean, self.covariance, strict=True)):
            if covariance.any():
                steady = STEADY * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
                root = np.linalg.cholesky(covariance + steady)
                away = np.linalg.solve(root, (features - mean).T)
                scores[:, index] = -np.square(away).sum(axis=0) / 2 - np.log(np.diag(root)).sum()
        return scores


@dataclass(frozen=True)
class Transfer:
    """Hold the classes of one sensor: as it learned them, and as other sensors alone predict them."""

    classes: Int32s  # (class,), sorted
    learned: Gaussians
    expected: Gaussians  # nothing of a class that no other sensor knows

    @classmethod
    def fit(cls, slides: Labelled, other_sensors: Sequence[Labelled] = ()) -> Transfer:
        """Return the classes of a sensor, fitted on its labelled ``slides`` and on those of ``other_sensors``.

        Raises `TacpipeError` if arrays do not fit one another, values are not finite, no class has two slides, the
        sensor has fewer than two classes, or fewer than `SHARED` of those of another sensor.
        """
        for part in (slides, *other_sensors):
            _check(part, slides.features.shape[-1])
        classes = np.unique(np.concatenate([part.labels for part in (slides, *other_sensors)]))
        means = _means(slides, classes)
        inner = _covariance_within(slides)
        labelled = np.isfinite(means[:, 0])
        expected, variance = _expected(means, [_means(sensor, classes) for sensor in other_sensors])
        foreign = np.isfinite(expected[:, 0])
        prior = np.where(foreign[:, None], expected, means[labelled].mean(axis=0))
        spread = np.where(foreign[:, None], variance, means[labelled].var(axis=0, ddof=1) + _smallest_variance(inner))
        mean, covariance = prior.copy(), inner + np.stack([np.diag(variances) for variances in spread])
        borrowed = Gaussians(np.where(foreign[:, None], prior, 0), np.where(foreign[:, None, None], covariance, 0))
        for index in np.flatnonzero(labelled):
            wide = np.diag(spread[index])
            trust = wide @ np.linalg.inv(wide + inner / (slides.labels == classes[index]).sum())
            mean[index] += trust @ (means[index] - prior[index])
            covariance[index] = inner + wide - trust @ wide
        return cls(classes.astype(np.int32), Gaussians(mean, (covariance + covariance.swapaxes(1, 2)) / 2), borrowed)

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return all that `from_tensors` needs."""
        return {
            "classes": self.classes,
            "known.mean": self.learned.mean,
            "known.covariance": self.learned.covariance,
            "expected.mean": self.expected.mean,
            "expected.covariance": self.expected.covariance,
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Transfer:
        """Return the knowledge that `to_tensors` described."""
        learned, expected = (
            Gaussians(tensors[f"{kind}.mean"], tensors[f"{kind}.covariance"]) for kind in ("known", "expected")
        )
        return cls(tensors["classes"], learned, expected)


def _expected(means: AnyFloats, other_means: Sequence[AnyFloats]) -> tuple[AnyFloats, AnyFloats]:
    """Return where other sensors' class means make one expect those of a sensor, and the variance of that.

    All are (class, feature), NaN in the rows of classes that a sensor did not learn, or that no other one knows.
    """
    weight, total = np.zeros(means.shape), np.zeros(means.shape)
    for foreign in other_means:
        shared = np.isfinite(means[:, 0]) & np.isfinite(foreign[:, 0])
        if shared.sum() < SHARED:
            raise TacpipeError(
                f"Two sensors learned {shared.sum()} classes in common; {SHARED} at least show how they differ. Record "
                "more with both, or learn for each sensor alone."
            )
        source, target = foreign[shared], means[shared]
        errors = [
            target[i] - _mapped(np.delete(source, i, 0), np.delete(target, i, 0), source[i])
            for i in range(int(shared.sum()))
        ]
        precise = 1 / (np.square(errors).mean(axis=0) + 1e-9)
        knows = np.isfinite(foreign[:, 0])
        weight[knows] += precise
        total[knows] += precise * _mapped(source, target, foreign[knows])
    with np.errstate(invalid="ignore", divide="ignore"):
        return total / weight, np.where(weight > 0, 1 / weight, np.nan)


def _mapped(source: AnyFloats, target: AnyFloats, features: AnyFloats) -> AnyFloats:
    """Return features of one sensor as another's, by the means (class, feature) of classes that both learned."""
    centre, target_centre = source.mean(axis=0), target.mean(axis=0)
    squares = np.square(source - centre).sum(axis=0)
    products = ((source - centre) * (target - target_centre)).sum(axis=0)
    pull = PULL * squares.mean() + 1e-12
    gain = (products + pull * products.sum() / (squares.sum() + 1e-12)) / (squares + pull)
    mapped: AnyFloats = target_centre + (features - centre) * gain
    return mapped


def _means(slides: Labelled, classes: Ints) -> AnyFloats:
    """Return the mean features of each class (class, feature), or NaN if a class has no slide."""
    means = np.full((len(classes), slides.features.shape[1]), np.nan)
    for index, label in enumerate(classes):
        if (slides.labels == label).any():
            means[index] = slides.features[slides.labels == label].mean(axis=0)
    return means


def _covariance_within(slides: Labelled) -> AnyFloats:
    """Return the covariance (feature, feature) of features within classes."""
    from sklearn.covariance import ledoit_wolf

    classes, index = np.unique(slides.labels, return_inverse=True)
    residuals = slides.features - _means(slides, classes)[index]
    spread = residuals.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    shrunk, _ = ledoit_wolf(residuals / spread, assume_centered=True)
    covariance: AnyFloats = shrunk * np.outer(spread, spread) * len(residuals) / (len(residuals) - len(classes))
    return covariance


def _smallest_variance(covariance: AnyFloats) -> float:
    """Return a variance between classes that is as good as none."""
    return float(STEADY * np.trace(covariance) / len(covariance))


def _check(slides: Labelled, number: int) -> None:
    """Refuse slides that do not distinguish classes."""
    shape, classes = slides.features.shape, len(np.unique(slides.labels))
    if len(shape) != 2 or slides.labels.shape != shape[:1] or shape[1] != number:
        raise TacpipeError(
            f"Features of {shape} and labels of {slides.labels.shape} do not fit one another; they must be "
            f"(slide, {number}) and (slide,)."
        )
    if classes < 2 or len(slides.labels) == classes:
        raise TacpipeError(
            f"{len(slides.labels)} slides of {classes} classes do not show how classes differ; give two or more classes and "
            "two slides of one of them."
        )
    if not np.isfinite(slides.features).all():
        raise TacpipeError("Some features are not finite. Look for slides with gaps, and leave these out.")


BANDS = 16
PERIODS = (
    3.0  # fewest periods of the longest wave in the way; a slower one cannot be separated from a change of pressure
)
MAX_FREQUENCY_FRACTION = (
    0.6  # fraction of the spatial frequency above which a sensor would take a wave for a longer one
)
LINES = 4  # spatial frequencies at which a band is read
LEADING = 0.3  # fraction of the channels that are read, those pressed most; the others may not touch at all
HOP = 0.25  # distance of windows, as a fraction of their length
ROUNDING = 1 / 12  # counts^2, power of whole counts' rounding: no spectrum lies below
READ = 256  # slides that are read at once


@dataclass(frozen=True)
class Sampling:
    """How a sensor's slides come about."""

    frames: int
    rate_hz: float
    speed_m_s: float

    @property
    def way_m(self) -> float:
        """How far a slide goes."""
        return self.frames * self.speed_m_s / self.rate_hz

    @property
    def highest_per_m(self) -> float:
        """The spatial frequency of which there are two samples a period."""
        return self.rate_hz / (2 * self.speed_m_s)


@dataclass(frozen=True)
class Bands:
    """The way over which spectra are taken and the bands of spatial frequency.

    A wave of the surface with k periods a metre shakes a sensor that slides at v metres a second with f = k v hertz.
    Over spatial frequency k, the spectra of one material are therefore alike whatever sensor recorded it, at whatever
    speed and rate, up to what the sensor itself does to each k: its gain, and its aperture, which passes the fraction
    exp(-2 (pi sigma k)^2) of an amplitude. Both are offsets of the logarithm. All sensors are read over the same way and
    in the same bands, so that they separate waves equally well, and only where all of them take samples densely enough.
    """

    way_m: float
    edges_per_m: AnyFloats  # (band + 1,)

    @classmethod
    def common(cls, sensors: Sequence[Sampling], number: int = BANDS) -> Bands:
        """Return ``number`` bands of equal width on a logarithmic scale, within the range that all sensors resolve.

        The lowest edge has `PERIODS` periods in the shortest slide. The highest is `MAX_FREQUENCY_FRACTION` of the lowest
        frequency limit of the sensors. Raises `TacpipeError` if this range is empty.

        >>> Bands.common([Sampling(400, 100.0, 0.025), Sampling(75, 50.0, 0.05)]).edges_per_m[[0, -1]].round(3).tolist()
        [40.0, 300.0]
        """
        way_m = min(sampling.way_m for sampling in sensors)
        lowest, highest = PERIODS / way_m, MAX_FREQUENCY_FRACTION * min(sampling.highest_per_m for sampling in sensors)
        if not lowest < highest:
            raise TacpipeError(
                f"The shortest slide goes {way_m:.3g} m and shows waves of more than {lowest:.3g} periods a metre, but a "
                f"sensor shows but those of less than {highest:.3g}. Give longer slides, or the speeds that were meant."
            )
        return cls(way_m, np.geomspace(lowest, highest, number + 1))

    def log_power(self, slides: AnyFloats, rate_hz: float, speed_m_s: float) -> AnyFloats:
        """Return the features of slides (slide, time, channel): (slide, band + 1), natural logarithms of power.

        The first are the power in each band less the mean of all bands; the last is that mean, as a density over spatial
        frequency (m), less the power of the pressure itself, so that neither gain nor force counts. Each is the median
        over the channels that are pressed most, so that a channel out of order does not count either. Raises
        `TacpipeError` for slides shorter than the way and for values that are not finite.
        """
        window = round(self.way_m / speed_m_s * rate_hz)
        if slides.ndim != 3 or window > slides.shape[1]:
            raise TacpipeError(
                f"Slides of {slides.shape} do not go {self.way_m:.3g} m; (slide, time, channel) of {window} frames or "
                f"more would."
            )
        if not np.isfinite(slides).all():
            raise TacpipeError("Some slides hold values that are not finite. Segment them again, or leave these out.")
        step_m = speed_m_s / rate_hz
        waves = self._waves(window, step_m)
        parts = [self._read(slides[first : first + READ], waves) for first in range(0, len(slides), READ)]
        features = np.concatenate(parts) if parts else np.empty((0, len(self.edges_per_m)))
        features[:, -1] += np.log(step_m)
        return features

    def _read(self, slides: AnyFloats, waves: NDArray[np.complex64]) -> AnyFloats:
        """Return the features of a few slides."""
        level = np.maximum(slides.mean(axis=1, dtype=np.float64), 0)  # (slide, channel)
        leading = np.argsort(-level, axis=1, kind="stable")[:, : max(1, round(LEADING * level.shape[1]))]
        chosen = np.take_along_axis(slides, leading[:, None], axis=2).astype(np.float32)
        level = np.take_along_axis(level, leading, axis=1)
        spectra = [self._power(part, waves) for part in _windows(chosen, len(waves))]
        power = np.log(np.mean(spectra, axis=0) + ROUNDING)  # (slide, channel, band)
        mean = power.mean(axis=2)
        shape = np.median(power - mean[:, :, None], axis=1)
        strength = np.median(mean - 2 * np.log(level + 1), axis=1)
        return np.column_stack([shape - shape.mean(axis=1, keepdims=True), strength])

    def _power(self, part: AnyFloats, waves: NDArray[np.complex64]) -> AnyFloats:
        """Return the power of a window of slides (slide, time, channel) in each band: (slide, channel, band), counts^2."""
        moved = part - part.mean(axis=1, keepdims=True)
        lines = np.square(np.abs(np.tensordot(moved, waves, axes=(1, 0))))  # (slide, channel, line)
        power: AnyFloats = lines.reshape(*lines.shape[:2], -1, LINES).mean(axis=3)
        return power

    def _waves(self, window: int, step_m: float) -> NDArray[np.complex64]:
        """Return the waves (time, line) that windows are compared with, tapered; white noise has its variance as power."""
        width = np.diff(np.log(self.edges_per_m))[:, None]
        lines = np.log(self.edges_per_m[:-1, None]) + width * (np.arange(LINES) + 0.5) / LINES
        taper = np.hanning(window + 2)[1:-1]
        angle = 2 * np.pi * step_m * np.outer(np.arange(window), np.exp(lines).ravel())
        waves = (taper / np.sqrt(np.square(taper).sum()))[:, None] * np.exp(-1j * angle)
        return np.asarray(waves, np.complex64)


def _windows(slides: AnyFloats, window: int) -> Iterator[AnyFloats]:
    """Yield overlapping windows of slides (slide, time, channel)."""
    for first in range(0, slides.shape[1] - window + 1, max(1, round(HOP * window))):
        yield slides[:, first : first + window]
