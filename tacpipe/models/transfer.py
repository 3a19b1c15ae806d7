"""Share classes between sensors by mapping the features of each sensor to those of another.

In sensor s, slides of class c have features N(m_sc, W_s). The class mean m_tc of another sensor t predicts m_sc in each
feature separately as ``a + g m_tc``, with variance b. The offset a and the gain g are fitted on the classes that both
sensors have; g is pulled towards the gain of all features, because these classes are few; b is the mean squared
leave-one-class-out error. The predictions of several sensors are weighted by 1 / b. If no sensor has the class, the
prior is the mean of the sensor's own classes, with the variance between them.

The sensor's own slides then update this prior by Bayes' rule: n slides of mean x give ``V = (B^-1 + n W^-1)^-1`` and
``m = V (B^-1 p + n W^-1 x)``, and a new slide of the class is N(m, W + V). So one rule covers classes with many slides,
few and none: the more uncertain a class is, the less a slide near its mean counts. W is shrunk as by Ledoit and Wolf (A
well-conditioned estimator for large-dimensional covariance matrices, 2004).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, AnyFloats, Int32s, Ints
from tacpipe.errors import TacpipeError

MIN_SHARED = 3  # minimum number of classes for fitting the map between two sensors
PULL = 0.5  # weight of the gain of all features in the gain of each, as a fraction of a feature's mean sum of squares
# fraction of a covariance's mean variance that is added to each variance, because features may be collinear
REGULARISATION = 1e-4


@dataclass(frozen=True)
class Labelled:
    """Labelled slides of a sensor: features (slide, feature) and classes (slide,)."""

    features: AnyFloats
    labels: Ints


@dataclass(frozen=True)
class Gaussians:
    """Classes as normal distributions of features; a covariance of zeros marks a class without information."""

    mean: AnyFloats  # (class, feature)
    covariance: AnyFloats  # (class, feature, feature)

    def scores(self, features: AnyFloats) -> AnyFloats:
        """Return the log-likelihoods (slide, class), float32, of slides (slide, feature), up to a constant."""
        scores = np.full((len(features), len(self.mean)), -np.inf, np.float32)
        for index, (mean, covariance) in enumerate(zip(self.mean, self.covariance, strict=True)):
            if covariance.any():
                regularisation = REGULARISATION * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
                root = np.linalg.cholesky(covariance + regularisation)
                away = np.linalg.solve(root, (features - mean).T)
                scores[:, index] = -np.square(away).sum(axis=0) / 2 - np.log(np.diag(root)).sum()
        return scores


@dataclass(frozen=True)
class Transfer:
    """The classes of one sensor: as learned from its slides, and as predicted from other sensors only."""

    classes: Int32s  # (class,), sorted
    learned: Gaussians
    expected: Gaussians  # zeros for a class that no other sensor has

    @classmethod
    def fit(cls, slides: Labelled, other_sensors: Sequence[Labelled] = ()) -> Transfer:
        """Fit the classes of a sensor on its labelled ``slides`` and on those of ``other_sensors``.

        Raises `TacpipeError` if arrays do not fit one another, values are not finite, no class has two slides, the
        sensor has fewer than two classes, or fewer than `MIN_SHARED` of those of another sensor.
        """
        for part in (slides, *other_sensors):
            _validate_slides(part, slides.features.shape[-1])
        classes = np.unique(np.concatenate([part.labels for part in (slides, *other_sensors)]))
        means = _means(slides, classes)
        covariance_within = _covariance_within(slides)
        labelled = np.isfinite(means[:, 0])
        expected, variance = _predict_means(means, [_means(sensor, classes) for sensor in other_sensors])
        has_other = np.isfinite(expected[:, 0])
        prior = np.where(has_other[:, None], expected, means[labelled].mean(axis=0))
        spread = np.where(
            has_other[:, None], variance, means[labelled].var(axis=0, ddof=1) + _smallest_variance(covariance_within)
        )
        mean, covariance = prior.copy(), covariance_within + np.stack([np.diag(variances) for variances in spread])
        from_others = Gaussians(
            np.where(has_other[:, None], prior, 0), np.where(has_other[:, None, None], covariance, 0)
        )
        for index in np.flatnonzero(labelled):
            prior_covariance = np.diag(spread[index])
            trust = prior_covariance @ np.linalg.inv(
                prior_covariance + covariance_within / (slides.labels == classes[index]).sum()
            )
            mean[index] += trust @ (means[index] - prior[index])
            covariance[index] = covariance_within + prior_covariance - trust @ prior_covariance
        return cls(classes.astype(np.int32), Gaussians(mean, (covariance + covariance.swapaxes(1, 2)) / 2), from_others)

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return the arrays that `from_tensors` reads."""
        return {
            "classes": self.classes,
            "known.mean": self.learned.mean,
            "known.covariance": self.learned.covariance,
            "expected.mean": self.expected.mean,
            "expected.covariance": self.expected.covariance,
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Transfer:
        """Return the classes that `to_tensors` stored."""
        learned, expected = (
            Gaussians(tensors[f"{kind}.mean"], tensors[f"{kind}.covariance"]) for kind in ("known", "expected")
        )
        return cls(tensors["classes"], learned, expected)


def _predict_means(means: AnyFloats, other_means: Sequence[AnyFloats]) -> tuple[AnyFloats, AnyFloats]:
    """Predict the class means of a sensor from other sensors' class means, and return them with their variance.

    All are (class, feature), with NaN in the rows of classes that the sensor, or all other sensors, did not learn.
    Raises `TacpipeError` if another sensor shares fewer than `MIN_SHARED` classes.
    """
    weight, total = np.zeros(means.shape), np.zeros(means.shape)
    for source_means in other_means:
        shared = np.isfinite(means[:, 0]) & np.isfinite(source_means[:, 0])
        if shared.sum() < MIN_SHARED:
            raise TacpipeError(
                f"Two sensors learned {shared.sum()} classes in common; a map between them needs {MIN_SHARED}. Record "
                "more with both, or train each sensor separately."
            )
        source, target = source_means[shared], means[shared]
        errors = [
            target[i] - _map_features(np.delete(source, i, 0), np.delete(target, i, 0), source[i])
            for i in range(int(shared.sum()))
        ]
        precision = 1 / (np.square(errors).mean(axis=0) + 1e-9)
        has_class = np.isfinite(source_means[:, 0])
        weight[has_class] += precision
        total[has_class] += precision * _map_features(source, target, source_means[has_class])
    with np.errstate(invalid="ignore", divide="ignore"):
        return total / weight, np.where(weight > 0, 1 / weight, np.nan)


def _map_features(source: AnyFloats, target: AnyFloats, features: AnyFloats) -> AnyFloats:
    """Map ``features`` (…, feature) of one sensor to another.

    The map is fitted on the means (class, feature) of the classes that both learned.
    """
    centre, target_centre = source.mean(axis=0), target.mean(axis=0)
    squares = np.square(source - centre).sum(axis=0)
    products = ((source - centre) * (target - target_centre)).sum(axis=0)
    pull = PULL * squares.mean() + 1e-12
    gain = (products + pull * products.sum() / (squares.sum() + 1e-12)) / (squares + pull)
    mapped: AnyFloats = target_centre + (features - centre) * gain
    return mapped


def _means(slides: Labelled, classes: Ints) -> AnyFloats:
    """Return the mean features of each class (class, feature); NaN if a class has no slides."""
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
    """Return a negligible variance between classes."""
    return float(REGULARISATION * np.trace(covariance) / len(covariance))


def _validate_slides(slides: Labelled, number: int) -> None:
    """Raise `TacpipeError` if the slides do not distinguish classes."""
    shape, classes = slides.features.shape, len(np.unique(slides.labels))
    if len(shape) != 2 or slides.labels.shape != shape[:1] or shape[1] != number:
        raise TacpipeError(
            f"Features of {shape} and labels of {slides.labels.shape} do not match; they must be "
            f"(slide, {number}) and (slide,)."
        )
    if classes < 2 or len(slides.labels) == classes:
        raise TacpipeError(
            f"{len(slides.labels)} slides of {classes} classes do not show how classes differ; give two or more classes and "
            "two slides of one of them."
        )
    if not np.isfinite(slides.features).all():
        raise TacpipeError("Some features are not finite. Look for slides with gaps, and exclude these.")


BANDS = 16
# minimum number of periods of the longest wave; a slower wave cannot be separated from a change of pressure
MIN_PERIODS = 3.0
MAX_FREQUENCY_FRACTION = 0.6  # maximum frequency as a fraction of the Nyquist frequency, to avoid aliasing
LINES_PER_BAND = 4  # number of spatial frequencies per band
# fraction of the channels that are used: those with the highest level, because others may not be in contact
LEADING_FRACTION = 0.3
HOP = 0.25  # distance between windows, as a fraction of their length
ROUNDING_POWER = 1 / 12  # counts^2, noise power of rounding to integers: no spectrum is below it
CHUNK = 256  # slides per chunk


@dataclass(frozen=True)
class Sampling:
    """How a sensor samples a slide."""

    frames: int
    rate_hz: float
    speed_m_s: float

    @property
    def distance_m(self) -> float:
        """The length of a slide."""
        return self.frames * self.speed_m_s / self.rate_hz

    @property
    def max_per_m(self) -> float:
        """The Nyquist limit of spatial frequency: two samples per period."""
        return self.rate_hz / (2 * self.speed_m_s)


@dataclass(frozen=True)
class Bands:
    """The distance over which spectra are computed, and the bands of spatial frequency.

    A surface wave with k periods per metre excites a sensor that slides at v metres per second with f = k v hertz. So
    as a function of k, the spectra of a material are the same for all sensors, speeds and rates, up to each sensor's
    gain and its aperture, which passes the fraction exp(-2 (pi sigma k)^2) of an amplitude. Both are offsets of the
    logarithm. All sensors are analysed over the same distance and in the same bands, so that they resolve waves equally
    well, and only at frequencies that all of them sample densely enough.
    """

    distance_m: float
    edges_per_m: AnyFloats  # (band + 1,)

    @classmethod
    def common(cls, sensors: Sequence[Sampling], number: int = BANDS) -> Bands:
        """Return ``number`` bands of equal width on a logarithmic scale, within the range that all sensors resolve.

        The lowest edge has `MIN_PERIODS` periods in the shortest slide. The highest is `MAX_FREQUENCY_FRACTION` of the
        lowest Nyquist limit of the sensors. Raises `TacpipeError` if this range is empty.

        >>> Bands.common([Sampling(400, 100.0, 0.025), Sampling(75, 50.0, 0.05)]).edges_per_m[[0, -1]].round(3).tolist()
        [40.0, 300.0]
        """
        distance_m = min(sampling.distance_m for sampling in sensors)
        lowest = MIN_PERIODS / distance_m
        highest = MAX_FREQUENCY_FRACTION * min(sampling.max_per_m for sampling in sensors)
        if not lowest < highest:
            raise TacpipeError(
                f"The shortest slide is {distance_m:.3g} m long and resolves more than {lowest:.3g} periods per metre, "
                f"but a sensor resolves fewer than {highest:.3g}. Give longer slides, or the correct speeds."
            )
        return cls(distance_m, np.geomspace(lowest, highest, number + 1))

    def log_power(self, slides: AnyFloats, rate_hz: float, speed_m_s: float) -> AnyFloats:
        """Return the features of slides (slide, time, channel): (slide, band + 1), natural logarithms of power.

        The first columns are the power of each band minus the mean of all bands. The last is that mean, as a density
        over spatial frequency (m), minus the power of the pressure itself, so that neither gain nor force matters. Each
        is the median over the channels with the highest level, which ignores single faulty channels. Raises
        `TacpipeError` if slides are shorter than the distance or a value is not finite.
        """
        window = round(self.distance_m / speed_m_s * rate_hz)
        if slides.ndim != 3 or window > slides.shape[1]:
            raise TacpipeError(
                f"Slides of {slides.shape} are shorter than {self.distance_m:.3g} m; give (slide, time, channel) with "
                f"{window} frames or more."
            )
        if not np.isfinite(slides).all():
            raise TacpipeError("Some slides contain values that are not finite. Segment them again, or exclude these.")
        step_m = speed_m_s / rate_hz
        waves = self._waves(window, step_m)
        parts = [self._chunk_features(slides[first : first + CHUNK], waves) for first in range(0, len(slides), CHUNK)]
        features = np.concatenate(parts) if parts else np.empty((0, len(self.edges_per_m)))
        features[:, -1] += np.log(step_m)
        return features

    def _chunk_features(self, slides: AnyFloats, waves: NDArray[np.complex64]) -> AnyFloats:
        """Return the features (slide, band + 1) of a chunk of slides (slide, time, channel)."""
        level = np.maximum(slides.mean(axis=1, dtype=np.float64), 0)  # (slide, channel)
        leading_channels = np.argsort(-level, axis=1, kind="stable")[
            :, : max(1, round(LEADING_FRACTION * level.shape[1]))
        ]
        chosen = np.take_along_axis(slides, leading_channels[:, None], axis=2).astype(np.float32)
        level = np.take_along_axis(level, leading_channels, axis=1)
        spectra = [self._power(part, waves) for part in _windows(chosen, len(waves))]
        power = np.log(np.mean(spectra, axis=0) + ROUNDING_POWER)  # (slide, channel, band)
        mean = power.mean(axis=2)
        shape = np.median(power - mean[:, :, None], axis=1)
        strength = np.median(mean - 2 * np.log(level + 1), axis=1)
        return np.column_stack([shape - shape.mean(axis=1, keepdims=True), strength])

    def _power(self, part: AnyFloats, waves: NDArray[np.complex64]) -> AnyFloats:
        """Return the power (slide, channel, band), in counts^2, of a window of slides (slide, time, channel)."""
        moved = part - part.mean(axis=1, keepdims=True)
        lines = np.square(np.abs(np.tensordot(moved, waves, axes=(1, 0))))  # (slide, channel, line)
        power: AnyFloats = lines.reshape(*lines.shape[:2], -1, LINES_PER_BAND).mean(axis=3)
        return power

    def _waves(self, window: int, step_m: float) -> NDArray[np.complex64]:
        """Return the tapered waves (time, line) for the spectra, scaled so that the power of white noise is its variance."""
        width = np.diff(np.log(self.edges_per_m))[:, None]
        lines = np.log(self.edges_per_m[:-1, None]) + width * (np.arange(LINES_PER_BAND) + 0.5) / LINES_PER_BAND
        taper = np.hanning(window + 2)[1:-1]
        angle = 2 * np.pi * step_m * np.outer(np.arange(window), np.exp(lines).ravel())
        waves = (taper / np.sqrt(np.square(taper).sum()))[:, None] * np.exp(-1j * angle)
        return np.asarray(waves, np.complex64)


def _windows(slides: AnyFloats, window: int) -> Iterator[AnyFloats]:
    """Yield overlapping windows of slides (slide, time, channel)."""
    for first in range(0, slides.shape[1] - window + 1, max(1, round(HOP * window))):
        yield slides[:, first : first + window]
