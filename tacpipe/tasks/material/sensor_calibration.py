"""The calibration of each sensor of a classifier: its probabilities, and when it answers ``unknown``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Self, get_args

import numpy as np
from safetensors.numpy import save
from scipy.special import logsumexp

from tacpipe.arrays import AnyArray, AnyFloats, Float32s, Floats, Int64s, Ints
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError
from tacpipe.metrics import calibration
from tacpipe.models.class_distance import ClassDistance
from tacpipe.models.tensors import tensors_under

CALIBRATION_FILE = "known.safetensors"
Rule = Literal["probability", "distance"]
RULES: tuple[Rule, ...] = get_args(Rule)
DISTANCE = "distance."  # begins the names of the tensors of `ClassDistance`


@dataclass(frozen=True)
class SensorCalibration:
    """The temperature of a sensor's scores, and below which score a slide is of no known class."""

    temperature: float
    rule: Rule  # the kind of score
    threshold: float
    distance: ClassDistance

    def probabilities(self, scores: AnyFloats) -> Float32s:
        """Return a probability of each class (slide, class) of a classifier's scores."""
        return calibration.probabilities(scores, self.temperature).astype(np.float32)

    def score(self, scores: AnyFloats, frames: Float32s) -> Floats:
        """Return how known slides look (slide,), by the rule that was chosen; below ``threshold`` they are unknown.

        ``scores`` (slide, class) are the classifier's, ``frames`` (slide, time, channel) what it read.
        """
        return self.scores_by_rule(scores, frames)[self.rule]

    def scores_by_rule(self, scores: AnyFloats, frames: Float32s) -> dict[Rule, Floats]:
        """Return `score` by rule.

        ``probability`` is the log odds of the largest probability, ``distance`` minus half the squared distance to the
        nearest class.
        """
        return {
            "probability": _log_odds(scores / self.temperature),
            "distance": self.distance.scores(frames).max(axis=1),
        }

    def to_tensors(self) -> dict[str, AnyArray]:
        """Return all that `from_tensors` needs."""
        numbers = np.array([self.temperature, self.threshold, RULES.index(self.rule)], np.float64)
        return {"numbers": numbers, **{f"{DISTANCE}{k}": v for k, v in self.distance.to_tensors().items()}}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, AnyArray]) -> Self:
        """Return what `to_tensors` described. Raises `ValueError` where it cannot be."""
        temperature, threshold, rule = (float(number) for number in tensors["numbers"])
        if temperature <= 0 or not 0 <= int(rule) < len(RULES):
            raise ValueError(f"the temperature is {temperature} and the rule {rule}")
        distance = ClassDistance.from_tensors(tensors_under(DISTANCE, tensors))
        return cls(temperature, RULES[int(rule)], threshold, distance)


@dataclass(frozen=True)
class ValidationSlides:
    """Validation slides of one sensor, with the scores of the classifier."""

    scores: Float32s  # (slide, class), the classifier's
    frames: Float32s  # (slide, time, channel)
    labels: Ints  # (slide,), columns of ``scores``


def fit_calibration(
    training: tuple[Float32s, Int64s], validation: ValidationSlides, classes: Ints, false_unknown: float
) -> tuple[SensorCalibration, dict[Rule, float]]:
    """Return the calibration of a sensor, and the area under the curve of each rule.

    The distance is fitted on ``training``, frames (slide, time, channel) and classes (slide,) of training slides; all else
    on ``validation``. The rule is the one that distinguishes validation slides better from themselves with their own class
    left out of the answers (area under the curve); no slide of an unknown class is needed. The threshold is that of split
    conformal prediction: a new slide of a known class falls below it with a probability of at most ``false_unknown``.
    Raises `TacpipeError` with too few slides for that.
    """
    count = len(validation.labels)
    if calibration.most_promised(count) < 1 - false_unknown:
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
    """Return calibrations by sensor as a file."""
    tensors = {
        f"{name}.{key}": value
        for name, sensor_calibration in calibrations.items()
        for key, value in sensor_calibration.to_tensors().items()
    }
    return save({name: np.ascontiguousarray(value) for name, value in tensors.items()})


def unpack_calibrations(content: bytes, sensors: Mapping[str, object]) -> dict[str, SensorCalibration]:
    """Return the calibrations that `pack_calibrations` wrote. Raises `TacpipeError` for another file."""
    tensors = model_files.arrays(content, CALIBRATION_FILE)
    return {name: SensorCalibration.from_tensors(tensors_under(f"{name}.", tensors)) for name in sensors}


def _log_odds(scores: AnyFloats) -> Floats:
    """Return the logarithm of p / (1 - p) of the largest probability p of each slide (slide,)."""
    wide = scores.astype(np.float64)
    best = wide.argmax(axis=1)[:, None]
    other_scores = wide.copy()
    np.put_along_axis(other_scores, best, -np.inf, axis=1)
    remainder = logsumexp(other_scores, axis=1)
    log_odds: Floats = np.take_along_axis(wide, best, axis=1)[:, 0] - np.where(np.isfinite(remainder), remainder, -1e6)
    return log_odds
