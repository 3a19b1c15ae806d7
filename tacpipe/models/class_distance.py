"""The score of how much a slide is like one of the learned classes, independent of the classifier.

Slides are described by statistics of each channel (`tacpipe.models.readout`) and by how often patterns occur
in them (`tacpipe.models.minirocket`), standardised and reduced to their principal components. The slides of each class
spread around its mean with one covariance, shrunk as by Ledoit and Wolf (2004). The score of a class is the logarithm of

    all * sqrt(plain_all) / (mean * nearest * plain_nearest)

of squared distances of a slide:

- ``mean``: Mahalanobis, to the mean of the class (Lee, Lee, Lee and Shin, A simple unified framework for detecting
  out-of-distribution samples, NeurIPS 2018),
- ``nearest``: Mahalanobis, to the nearest training slide of the class, because slides of one material form several clusters,
- ``all``: Mahalanobis, to the mean of all slides, under the covariance of slides of any class. What is unusual for each
  class alike then does not count (Ren et al., A simple fix to Mahalanobis distance for improving near-OOD detection, 2021).
  That covariance is the sum of those within and between classes. The empirical one of all slides is smaller than the shrunk
  one within classes along some components, and slides far from all classes would score highest,
- ``plain_nearest`` and ``plain_all``: Euclidean, to the nearest training slide of the class and to the mean of all slides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from tacpipe.arrays import AnyArray, Float32s, Floats, Int32s, Ints
from tacpipe.errors import TacpipeError
from tacpipe.models.minirocket import Rocket, with_profile
from tacpipe.models.readout import statistics
from tacpipe.models.tensors import tensors_under

COMPONENTS = 300  # upper limit
PATTERNS = "patterns."  # begins the names of the tensors of patterns
NAMES = ("classes", "centre", "projection", "gain", "overall", "slides", "labels")
STEADY = 1e-6  # standard deviation below which a feature is constant
SMALLEST = 1e-9  # squared distance


@dataclass(frozen=True)
class ClassDistance:
    """Training slides as components, and what measures distances between these."""

    classes: Int32s  # (class,), sorted
    centre: Floats  # (feature,), the mean of all training slides
    projection: Floats  # (feature, component), stored as float32
    gain: Floats  # (component,), makes the covariance within classes the identity
    overall: Floats  # (component, component), makes the covariance of slides of any class the identity, after ``gain``
    slides: Floats  # (slide, component), training slides
    labels: Int32s  # (slide,), indices of ``classes``
    patterns: Rocket

    @classmethod
    def fit(cls, frames: Float32s, labels: Ints) -> Self:
        """Return the distance to classes of slides (slide, time, channel) and their ``labels`` (slide,).

        Raises `TacpipeError` for what `Rocket.fit` refuses.
        """
        from sklearn.covariance import ledoit_wolf

        patterns = Rocket.fit(with_profile(frames))
        features = _features(frames, patterns)
        centre, spread = features.mean(axis=0), features.std(axis=0)
        standardise = np.where(spread > STEADY, 1 / np.maximum(spread, STEADY), 0)
        scaled = (features - centre) * standardise
        basis = np.linalg.svd(scaled, full_matrices=False)[2][:COMPONENTS].T  # (feature, component)
        classes, index = np.unique(labels, return_inverse=True)
        components = scaled @ basis
        covariance, _ = ledoit_wolf(components - _means(components, index)[index], assume_centered=True)
        variances, axes = np.linalg.eigh(covariance)
        gain = 1 / np.sqrt(np.maximum(variances, STEADY * variances.max() or 1.0))
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
        """Return how much slides (slide, time, channel) are like each class (slide, class), see the module."""
        plain = (_features(frames, self.patterns) - self.centre) @ self.projection
        scaled, training = plain * self.gain, self.slides * self.gain
        origin = np.zeros((1, plain.shape[1]))
        scores: Floats = (
            _log_distances(scaled @ self.overall, origin)
            + _log_distances(plain, origin) / 2
            - _log_distances(scaled, _means(training, self.labels))
            - self._nearest(_log_distances(scaled, training))
            - self._nearest(_log_distances(plain, self.slides))
        )
        return scores

    def _nearest(self, distances: Floats) -> Floats:
        """Return the smallest of the distances to training slides (slide, training slide) by class (slide, class)."""
        by_class = [distances[:, self.labels == label].min(axis=1) for label in range(len(self.classes))]
        return np.stack(by_class, axis=1)

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return all that `from_tensors` needs."""
        patterns = {f"{PATTERNS}{name}": tensor for name, tensor in self.patterns.to_tensors().items()}
        return {
            **{name: getattr(self, name) for name in NAMES},
            "projection": self.projection.astype(np.float32),
            **patterns,
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Self:
        """Return what `to_tensors` described. Raises `ValueError` where shapes do not fit one another.

        Raises `TacpipeError` for tensors of an earlier version, which held no training slides.
        """
        if "slides" not in tensors:
            raise TacpipeError(
                "The model was calibrated by an earlier version, with another score of unknown. Run `tacpipe calibrate` "
                "again."
            )
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


def _means(placed: Floats, labels: Ints) -> Floats:
    """Return the mean of each class (class, component) of slides (slide, component)."""
    return np.stack([placed[labels == label].mean(axis=0) for label in range(labels.max() + 1)])


def _log_distances(slides: Floats, references: Floats) -> Floats:
    """Return the logarithm of the squared distance of each slide (slide, component) to each reference (slide, reference)."""
    squared = np.stack([np.square(slide - references).sum(axis=1) for slide in slides])
    distances: Floats = np.log(np.maximum(squared, SMALLEST))
    return distances


def _features(frames: Float32s, patterns: Rocket) -> Floats:
    """Return the features of slides (slide, time, channel), (slide, feature).

    Patterns need slides of the learned length: a shorter one, as during a live session, is continued with its last row.
    """
    missing = max(patterns.frames - frames.shape[1], 0)
    continued = np.pad(frames, [(0, 0), (0, missing), (0, 0)], mode="edge")[:, : patterns.frames]
    occurrences = patterns.transform(with_profile(continued))
    return np.concatenate([statistics(frames), occurrences], axis=1, dtype=np.float64)
