"""How far a slide is from every class that was learned, in a space that does not depend on the classifier.

Slides are described by statistics of each channel (`tacpipe.models.statistics_classifier`) and by how often patterns occur
in them (`tacpipe.models.minirocket`), standardised and reduced to their principal components. Models that were calibrated
before hold no patterns, and there only statistics count. In that space each class is a mean, all with one covariance,
shrunk as by Ledoit and Wolf (2004). The score is minus half the squared Mahalanobis distance to the nearest mean (Lee, Lee,
Lee and Shin, A simple unified framework for detecting out-of-distribution samples, NeurIPS 2018), less the same to the mean
of all slides, with the covariance of all: the relative Mahalanobis distance (Ren et al., A simple fix to Mahalanobis
distance for improving near-OOD detection, 2021). What is unusual for every class alike then does not count.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from tacpipe.arrays import AnyArray, AnyFloats, Float32s, Floats, Int32s, Ints
from tacpipe.models.minirocket import Rocket
from tacpipe.models.minirocket_classifier import with_profile
from tacpipe.models.statistics_classifier import statistics
from tacpipe.models.tensors import under

COMPONENTS = 150  # upper limit; also at most a third of the slides
PATTERNS = "patterns."  # begins the names of the tensors of patterns
NAMES = ("classes", "centre", "projection", "means", "middle", "overall")
STEADY = 1e-6  # standard deviation below which a feature is constant


@dataclass(frozen=True)
class ClassDistance:
    """What was fitted on labelled slides."""

    classes: Int32s  # (class,), sorted
    centre: AnyFloats  # (feature,)
    projection: AnyFloats  # (feature, component), into a space in which the covariance within classes is the identity
    means: AnyFloats  # (class, component)
    middle: AnyFloats  # (component,), the mean of all slides
    overall: AnyFloats  # (component, component), into a space in which the covariance of all slides is the identity
    patterns: Rocket | None = None  # None: only statistics are features

    @classmethod
    def fit(cls, frames: Float32s, labels: Ints) -> Self:
        """Return the distance to classes of slides (slide, time, channel) and their ``labels`` (slide,).

        Raises `TacpipeError` for what `Rocket.fit` refuses.
        """
        from sklearn.covariance import ledoit_wolf

        patterns = Rocket.fit(with_profile(frames))
        read = _features(frames, patterns)
        centre, spread = read.mean(axis=0), read.std(axis=0)
        gain = np.where(spread > STEADY, 1 / np.maximum(spread, STEADY), 0)
        scaled = (read - centre) * gain
        count = max(1, min(COMPONENTS, len(scaled) // 3, scaled.shape[1]))
        basis = np.linalg.svd(scaled, full_matrices=False)[2][:count].T  # (feature, component)
        placed = scaled @ basis
        classes, index = np.unique(labels, return_inverse=True)
        means = np.stack([placed[index == one].mean(axis=0) for one in range(len(classes))])
        covariance, _ = ledoit_wolf(placed - means[index], assume_centered=True)
        values, vectors = np.linalg.eigh(covariance)
        whiten = vectors / np.sqrt(np.maximum(values, STEADY * values.max() or 1.0))
        within = placed @ whiten
        spread, axes = np.linalg.eigh(np.atleast_2d(np.cov(within, rowvar=False)))
        overall = axes / np.sqrt(np.maximum(spread, 0) + STEADY)
        projection = gain[:, None] * (basis @ whiten)
        return cls(classes.astype(np.int32), centre, projection, means @ whiten, within.mean(axis=0), overall, patterns)

    def scores(self, frames: Float32s) -> Floats:
        """Return minus half the squared relative distance of slides (slide, time, channel) to each class (slide, class)."""
        placed = (_features(frames, self.patterns) - self.centre) @ self.projection
        away = np.square((placed - self.middle) @ self.overall).sum(axis=1)  # (slide,), from all slides
        found: Floats = (away[:, None] - np.square(placed[:, None] - self.means[None]).sum(axis=2)) / 2
        return found

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return all that `from_tensors` needs."""
        patterns = {} if self.patterns is None else self.patterns.to_tensors()
        return {**{name: getattr(self, name) for name in NAMES}, **{f"{PATTERNS}{k}": v for k, v in patterns.items()}}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Self:
        """Return what `to_tensors` described. Raises `ValueError` where shapes do not fit one another."""
        patterns = under(PATTERNS, tensors)
        rocket = Rocket.from_tensors(patterns) if patterns else None
        classifier = cls(**{name: tensors[name] for name in NAMES}, patterns=rocket)
        sizes = (len(classifier.centre), classifier.means.shape[1])
        if classifier.projection.shape != sizes or len(classifier.means) != len(classifier.classes):
            raise ValueError(f"the projection of slides is {classifier.projection.shape}, not {sizes}")
        if classifier.overall.shape != (sizes[1], sizes[1]) or classifier.middle.shape != (sizes[1],):
            raise ValueError(f"the space of all slides is {classifier.overall.shape}, not of {sizes[1]} components")
        return classifier


def _features(frames: Float32s, patterns: Rocket | None) -> Floats:
    """Return the features of slides (slide, time, channel), (slide, feature).

    Patterns need slides of the learned length: a shorter one, as during a live session, is continued with its last row.
    """
    features = [statistics(frames)]
    if patterns is not None:
        missing = max(patterns.frames - frames.shape[1], 0)
        continued = np.pad(frames, [(0, 0), (0, missing), (0, 0)], mode="edge")[:, : patterns.frames]
        features.append(patterns.transform(with_profile(continued)))
    return np.concatenate(features, axis=1, dtype=np.float64)
