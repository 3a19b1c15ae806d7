"""Calibrate the probabilities of each sensor of a classifier, and its threshold for the answer ``unknown``.

The score of a class measures how similar a slide is to it, independently of the classifier. Slides are described by
statistics of each channel (`tacpipe.models.readout`) and by the frequencies of patterns (`tacpipe.models.minirocket`),
standardised and reduced to principal components. All classes share one covariance about their means, shrunk as by
Ledoit and Wolf (2004). The score of a class is the logarithm of

    all * sqrt(plain_all) / (mean * nearest * plain_nearest)

of squared distances of a slide:

- ``mean``: Mahalanobis, to the mean of the class (Lee, Lee, Lee and Shin, A simple unified framework for detecting
  out-of-distribution samples, NeurIPS 2018),
- ``nearest``: Mahalanobis, to the nearest training slide of the class, because slides of one material form several
  clusters,
- ``all``: Mahalanobis, to the mean of all slides, under the covariance of slides of any class. It cancels deviations
  that are equally unusual for every class (Ren et al., A simple fix to Mahalanobis distance for improving near-OOD
  detection, 2021). That covariance is the sum of those within and between classes. The empirical covariance of all
  slides is smaller than the shrunk covariance within classes along some components, so slides far from all classes
  would score highest,
- ``plain_nearest`` and ``plain_all``: Euclidean, to the nearest training slide of the class and to the mean of all
  slides.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, Self, get_args

import numpy as np
from safetensors.numpy import save
from scipy.special import logsumexp

from tacpipe.arrays import AnyArray, AnyFloats, Float32s, Floats, Int32s, Int64s, Ints
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.models.minirocket import Rocket, with_profile
from tacpipe.models.readout import statistics
from tacpipe.models.tensors import tensors_under
from tacpipe.scores import calibration

COMPONENTS = 300  # maximum number of components
PATTERNS = "patterns."  # prefix of the tensor names of patterns
NAMES = ("classes", "centre", "projection", "gain", "overall", "slides", "labels")
MIN_STD = 1e-6  # standard deviation below which a feature counts as constant
MIN_SQUARED_DISTANCE = 1e-9  # lower bound of squared distances


@dataclass(frozen=True)
class ClassDistance:
    """Distance of slides to classes, from training slides in principal components."""

    classes: Int32s  # (class,), ascending
    centre: Floats  # (feature,), mean of all training slides
    projection: Floats  # (feature, component), stored as float32
    gain: Floats  # (component,), whitens the covariance within classes
    overall: Floats  # (component, component), whitens the covariance of slides of any class, after ``gain``
    slides: Floats  # (slide, component), training slides
    labels: Int32s  # (slide,), indices of ``classes``
    patterns: Rocket

    @classmethod
    def fit(cls, frames: Float32s, labels: Ints) -> Self:
        """Return the distance to classes fitted on slides (slide, time, channel) with ``labels`` (slide,).

        Raises `TacpipeError` as `Rocket.fit`.
        """
        from sklearn.covariance import ledoit_wolf

        patterns = Rocket.fit(with_profile(frames))
        features = _features(frames, patterns)
        centre, spread = features.mean(axis=0), features.std(axis=0)
        standardise = np.where(spread > MIN_STD, 1 / np.maximum(spread, MIN_STD), 0)
        scaled = (features - centre) * standardise
        basis = np.linalg.svd(scaled, full_matrices=False)[2][:COMPONENTS].T  # (feature, component)
        classes, index = np.unique(labels, return_inverse=True)
        components = scaled @ basis
        covariance, _ = ledoit_wolf(components - _means(components, index)[index], assume_centered=True)
        variances, axes = np.linalg.eigh(covariance)
        gain = 1 / np.sqrt(np.maximum(variances, MIN_STD * variances.max() or 1.0))
        means = _means(components @ axes * gain, index)
        offsets = means - means.mean(axis=0)
        between, directions = np.linalg.eigh(offsets.T @ offsets / max(1, len(classes) - 1))
        projection = (standardise[:, None] * (basis @ axes)).astype(np.float32).astype(np.float64)
        return cls(
            classes.astype(np.int32),
            centre,
            projection,
            gain,
            directions / np.sqrt(1 + np.maximum(between, 0)),
            (features - centre) @ projection,
            index.astype(np.int32),
            patterns,
        )

    def scores(self, frames: Float32s) -> Floats:
        """Return the similarity (slide, class) of slides (slide, time, channel) to each class; see the module docstring."""
        plain = (_features(frames, self.patterns) - self.centre) @ self.projection
        scaled, training = plain * self.gain, self.slides * self.gain
        origin = np.zeros((1, plain.shape[1]))
        return (
            _log_distances(scaled @ self.overall, origin)
            + _log_distances(plain, origin) / 2
            - _log_distances(scaled, _means(training, self.labels))
            - self._nearest(_log_distances(scaled, training))
            - self._nearest(_log_distances(plain, self.slides))
        )

    def _nearest(self, distances: Floats) -> Floats:
        """Return the minimum by class (slide, class) of the distances to training slides (slide, training slide)."""
        by_class = [distances[:, self.labels == label].min(axis=1) for label in range(len(self.classes))]
        return np.stack(by_class, axis=1)

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return the tensors that `from_tensors` reads."""
        patterns = {f"{PATTERNS}{name}": tensor for name, tensor in self.patterns.to_tensors().items()}
        return {
            **{name: getattr(self, name) for name in NAMES},
            "projection": self.projection.astype(np.float32),
            **patterns,
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Self:
        """Return the distance stored by `to_tensors`. Raises `ValueError` for inconsistent shapes."""
        stored = {name: tensors[name] for name in NAMES}
        stored["projection"] = stored["projection"].astype(np.float64)
        distance = cls(**stored, patterns=Rocket.from_tensors(tensors_under(PATTERNS, tensors)))
        components, slides = len(distance.gain), len(distance.labels)
        shapes = {
            "projection": (len(distance.centre), components),
            "overall": (components, components),
            "slides": (slides, components),
        }
        for name, shape in shapes.items():
            if getattr(distance, name).shape != shape:
                raise ValueError(f"{name} is {getattr(distance, name).shape}, not {shape}")
        if set(distance.labels.tolist()) != set(range(len(distance.classes))):
            raise ValueError(f"the {slides} training slides are not of {len(distance.classes)} classes")
        return distance


def _means(components: Floats, labels: Ints) -> Floats:
    """Return the mean of each class (class, component) of slides (slide, component)."""
    return np.stack([components[labels == label].mean(axis=0) for label in range(labels.max() + 1)])


def _log_distances(slides: Floats, references: Floats) -> Floats:
    """Return the log squared distances (slide, reference) between slides and references, both (…, component)."""
    squared = np.stack([np.square(slide - references).sum(axis=1) for slide in slides])
    distances: Floats = np.log(np.maximum(squared, MIN_SQUARED_DISTANCE))
    return distances


def _features(frames: Float32s, patterns: Rocket) -> Floats:
    """Return the features (slide, feature) of slides (slide, time, channel).

    Patterns require slides of the training length; shorter ones, as in a live session, are padded with their last row.
    """
    missing = max(patterns.frames - frames.shape[1], 0)
    continued = np.pad(frames, [(0, 0), (0, missing), (0, 0)], mode="edge")[:, : patterns.frames]
    occurrences = patterns.transform(with_profile(continued))
    return np.concatenate([statistics(frames), occurrences], axis=1, dtype=np.float64)


CALIBRATION_FILE = "known.safetensors"
Rule = Literal["probability", "distance"]
RULES: tuple[Rule, ...] = get_args(Rule)
DISTANCE = "distance."  # prefix of the tensor names of `ClassDistance`


@dataclass(frozen=True)
class SensorCalibration:
    """Temperature of a sensor's scores, and threshold below which a slide is of no known class."""

    temperature: float
    rule: Rule  # selected kind of score
    threshold: float
    distance: ClassDistance

    def probabilities(self, scores: AnyFloats) -> Float32s:
        """Return the calibrated probabilities (slide, class) of a classifier's scores."""
        return calibration.probabilities(scores, self.temperature).astype(np.float32)

    def score(self, scores: AnyFloats, frames: Float32s) -> Floats:
        """Return the score of known (slide,) by the selected rule; slides below ``threshold`` are unknown.

        ``scores`` (slide, class) are the classifier's, and ``frames`` (slide, time, channel) its input.
        """
        return self.scores_by_rule(scores, frames)[self.rule]

    def scores_by_rule(self, scores: AnyFloats, frames: Float32s) -> dict[Rule, Floats]:
        """Return `score` by rule.

        ``probability`` is the log odds of the highest probability, ``distance`` minus half the squared distance to the
        nearest class.
        """
        return {
            "probability": _log_odds(scores / self.temperature),
            "distance": self.distance.scores(frames).max(axis=1),
        }

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return the tensors that `from_tensors` reads."""
        numbers = np.array([self.temperature, self.threshold, RULES.index(self.rule)], np.float64)
        return {"numbers": numbers, **{f"{DISTANCE}{k}": v for k, v in self.distance.to_tensors().items()}}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Self:
        """Return the calibration stored by `to_tensors`. Raises `ValueError` if it is invalid."""
        temperature, threshold, rule = (float(number) for number in tensors["numbers"])
        if temperature <= 0 or not 0 <= int(rule) < len(RULES):
            raise ValueError(f"the temperature is {temperature} and the rule {rule}")
        distance = ClassDistance.from_tensors(tensors_under(DISTANCE, tensors))
        return cls(temperature, RULES[int(rule)], threshold, distance)


@dataclass(frozen=True)
class ValidationSlides:
    """Validation slides of one sensor, with the classifier's scores."""

    scores: Float32s  # (slide, class), from the classifier
    frames: Float32s  # (slide, time, channel)
    labels: Ints  # (slide,), columns of ``scores``


def fit_calibration(
    training: tuple[Float32s, Int64s], validation: ValidationSlides, classes: Ints, false_unknown: float
) -> tuple[SensorCalibration, dict[Rule, float]]:
    """Return the calibration of a sensor, and the area under the curve of each rule.

    The distance is fitted on ``training``, with frames (slide, time, channel) and classes (slide,); everything else on
    ``validation``. Of both rules, the one is selected that better separates validation slides from the same slides with
    their own class removed from the answers (area under the curve); slides of unknown classes are not needed. The
    threshold is that of split conformal prediction: a new slide of a known class is below it with a probability of at
    most ``false_unknown``. Raises `TacpipeError` if there are too few slides for that.
    """
    count = len(validation.labels)
    if calibration.highest_promised_level(count) < 1 - false_unknown:
        raise TacpipeError(
            f"{count} validation slides cannot set a threshold that at most {100 * false_unknown:g} % of known slides fall "
            f"below; it takes {int(np.ceil(1 / false_unknown - 1 - 1e-9))} or more. Split with more of them "
            f"(`tacpipe split --val`), or allow more with --false-unknown."
        )
    temperature = calibration.temperature(validation.scores, validation.labels)
    unset = SensorCalibration(temperature, "probability", 0.0, ClassDistance.fit(*training))
    is_label = validation.labels[:, None] == np.arange(len(classes))
    distances = unset.distance.scores(validation.frames)
    is_left_out = np.asarray(classes)[validation.labels][:, None] == unset.distance.classes
    scores = unset.scores_by_rule(validation.scores, validation.frames)
    scores_without_class: dict[Rule, Floats] = {
        "probability": _log_odds(np.where(is_label, -np.inf, validation.scores / temperature)),
        "distance": np.where(is_left_out, -np.inf, distances).max(axis=1),
    }
    areas = {rule: calibration.auroc(scores[rule], scores_without_class[rule]) for rule in RULES}
    rule = max(RULES, key=lambda candidate: areas[candidate])
    threshold = -calibration.conformal_quantile(-scores[rule], np.arange(count), 1 - false_unknown, promised=True)
    return SensorCalibration(temperature, rule, threshold, unset.distance), areas


def pack_calibrations(calibrations: Mapping[str, SensorCalibration]) -> bytes:
    """Return the file content of calibrations by sensor."""
    tensors: dict[str, AnyArray] = {}
    for name, sensor_calibration in calibrations.items():
        tensors |= {
            f"{name}.{key}": np.ascontiguousarray(value) for key, value in sensor_calibration.to_tensors().items()
        }
    return save(tensors)


def unpack_calibrations(content: bytes, sensors: Iterable[str]) -> dict[str, SensorCalibration]:
    """Return the calibrations stored by `pack_calibrations`. Raises `TacpipeError` for another file."""
    tensors = model_files.arrays(content, CALIBRATION_FILE)
    return {name: SensorCalibration.from_tensors(tensors_under(f"{name}.", tensors)) for name in sensors}


def _log_odds(scores: AnyFloats) -> Floats:
    """Return log(p / (1 - p)) of the highest probability p of each slide (slide,)."""
    floats = scores.astype(np.float64)
    best = floats.argmax(axis=1)[:, None]
    other_scores = floats.copy()
    np.put_along_axis(other_scores, best, -np.inf, axis=1)
    remainder = logsumexp(other_scores, axis=1)
    return np.take_along_axis(floats, best, axis=1)[:, 0] - np.where(np.isfinite(remainder), remainder, -1e6)
