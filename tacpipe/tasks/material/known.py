"""What makes a classifier's probabilities frequencies, and lets it answer ``unknown``: one bundle a sensor."""

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
from tacpipe.metrics import calibration, conformal
from tacpipe.models.class_distance import ClassDistance
from tacpipe.models.tensors import under

FILE = "known.safetensors"
Rule = Literal["probability", "distance"]
RULES: tuple[Rule, ...] = get_args(Rule)
DISTANCE = "distance."  # begins the names of the tensors of `ClassDistance`


@dataclass(frozen=True)
class Known:
    """The temperature of a sensor's scores, and below which score a slide is of no known class."""

    temperature: float
    rule: Rule  # what the score is
    threshold: float
    distance: ClassDistance

    def probabilities(self, scores: AnyFloats) -> Float32s:
        """Return a probability of each class (slide, class) of a classifier's scores."""
        return calibration.probabilities(scores, self.temperature).astype(np.float32)

    def score(self, scores: AnyFloats, frames: Float32s) -> Floats:
        """Return how known slides look (slide,), by the rule that was chosen; below ``threshold`` they are unknown.

        ``scores`` (slide, class) are the classifier's, ``frames`` (slide, time, channel) what it read.
        """
        return self.each(scores, frames)[self.rule]

    def each(self, scores: AnyFloats, frames: Float32s) -> dict[Rule, Floats]:
        """Return that by each rule: the log odds of the largest probability, and minus half the squared distance to the
        nearest class."""
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
        temperature, threshold, rule = (float(one) for one in tensors["numbers"])
        if temperature <= 0 or not 0 <= int(rule) < len(RULES):
            raise ValueError(f"the temperature is {temperature} and the rule {rule}")
        distance = ClassDistance.from_tensors(under(DISTANCE, tensors))
        return cls(temperature, RULES[int(rule)], threshold, distance)


@dataclass(frozen=True)
class Watched:
    """Validation slides of a sensor: what they are fitted by."""

    scores: Float32s  # (slide, class), the classifier's
    frames: Float32s  # (slide, time, channel)
    labels: Ints  # (slide,), columns of ``scores``


def fit(
    learned: tuple[Float32s, Int64s], watched: Watched, classes: Ints, false_unknown: float
) -> tuple[Known, dict[Rule, float]]:
    """Return the bundle of a sensor, and by which measure its rule was chosen.

    The distance is fitted on ``learned``, frames (slide, time, channel) and classes (slide,) of training slides; all else
    on ``watched``. The rule is the one that distinguishes validation slides better from themselves with their own class left
    out of the answers (area under the curve); no slide of an unknown class is needed. The threshold is that of split
    conformal prediction: a new slide of a known class falls below it with a probability of at most ``false_unknown``.
    Raises `TacpipeError` with too few slides for that.
    """
    count = len(watched.labels)
    if conformal.most_promised(count) < 1 - false_unknown:
        raise TacpipeError(
            f"{count} validation slides cannot set a threshold that at most {100 * false_unknown:g} % of known slides fall "
            f"below; it takes {int(np.ceil(1 / false_unknown - 1 - 1e-9))} or more. Split with more of them "
            f"(`tacpipe split --val`), or allow more with --false-unknown."
        )
    temperature = calibration.temperature(watched.scores, watched.labels)
    made = Known(temperature, "probability", 0.0, ClassDistance.fit(*learned))
    own = watched.labels[:, None] == np.arange(len(classes))
    away = made.distance.scores(watched.frames)
    left_out = np.asarray(classes)[watched.labels][:, None] == made.distance.classes
    whole = made.each(watched.scores, watched.frames)
    without: dict[Rule, Floats] = {
        "probability": _log_odds(np.where(own, -np.inf, watched.scores / temperature)),
        "distance": np.where(left_out, -np.inf, away).max(axis=1),
    }
    areas = {rule: calibration.auroc(whole[rule], without[rule]) for rule in RULES}
    rule = max(RULES, key=lambda one: areas[one])
    threshold = -conformal.quantile(-whole[rule], np.arange(count), 1 - false_unknown, promised=True)
    return Known(temperature, rule, threshold, made.distance), areas


def packed(known: Mapping[str, Known]) -> bytes:
    """Return bundles by sensor as a file."""
    tensors = {f"{name}.{key}": value for name, one in known.items() for key, value in one.to_tensors().items()}
    return save({name: np.ascontiguousarray(value) for name, value in tensors.items()})


def unpacked(content: bytes, sensors: Mapping[str, object]) -> dict[str, Known]:
    """Return the bundles that `packed` wrote. Raises `TacpipeError` for another file."""
    found = model_files.arrays(content, FILE)
    return {name: Known.from_tensors(under(f"{name}.", found)) for name in sensors}


def _log_odds(scores: AnyFloats) -> Floats:
    """Return the logarithm of p / (1 - p) of the largest probability p of each slide (slide,)."""
    wide = scores.astype(np.float64)
    best = wide.argmax(axis=1)[:, None]
    others = wide.copy()
    np.put_along_axis(others, best, -np.inf, axis=1)
    rest = logsumexp(others, axis=1)
    found: Floats = np.take_along_axis(wide, best, axis=1)[:, 0] - np.where(np.isfinite(rest), rest, -1e6)
    return found
