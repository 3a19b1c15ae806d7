"""State how uncertain answers are: quantiles of errors, or probabilities of classes and the answer ``unknown``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Ints
from tacpipe.printable import round_to
from tacpipe.scores import calibration
from tacpipe.tasks.learning.answers import Classes, ModelAnswers, Quantities

PERCENTS = (5, 10, 25, 50, 75, 90, 95)  # levels of the stored quantiles
BINS, BIN_EXAMPLES = (
    5,
    200,
)  # maximum number of bins of estimates with own quantiles, and minimum number of examples in each
FALSE_UNKNOWN = 0.05  # fraction of examples of learned classes that are answered with unknown
UNKNOWN = "unknown"


@dataclass(frozen=True)
class ErrorQuantiles:
    """Quantiles of the errors of examples that were not learned from, by the size of the estimate."""

    edges: tuple[tuple[float, ...], ...]  # target -> estimates between its bins
    quantiles: tuple[tuple[tuple[float, ...], ...], ...]  # target -> bin -> level
    percents: tuple[int, ...] = PERCENTS

    @classmethod
    def fit(
        cls, answers: Quantities, estimates: AnyFloats, values: AnyFloats, percents: tuple[int, ...] = PERCENTS
    ) -> ErrorQuantiles:
        """Return the quantiles for estimates and true values (example, target).

        With n errors, the level p is that of the order statistic p (n + 1), as for conformal prediction.
        """
        errors = answers.difference(values, estimates)
        count = int(np.clip(len(values) // BIN_EXAMPLES, 1, BINS))
        edges, quantiles = [], []
        for estimate, error in zip(estimates.T, errors.T, strict=True):
            inner = np.unique(np.quantile(estimate, np.arange(1, count) / count))
            bins = np.searchsorted(inner, estimate, side="right")
            rows = []
            for number in range(len(inner) + 1):
                own = error[bins == number] if (bins == number).any() else error
                levels = np.clip(np.array(percents) / 100 * (len(own) + 1) - 0.5, 0, len(own)) / max(len(own), 1)
                rows.append(tuple(_stored(np.quantile(own, levels, method="hazen"))))
            edges.append(tuple(_stored(inner)))
            quantiles.append(tuple(rows))
        return cls(tuple(edges), tuple(quantiles), percents)

    def bands(self, estimates: AnyFloats) -> Floats:
        """Return the quantiles (example, target, level) of the values, given estimates (example, target)."""
        bands = np.empty((*estimates.shape, len(self.percents)))
        for index, (edges, rows) in enumerate(zip(self.edges, self.quantiles, strict=True)):
            bins = np.searchsorted(np.array(edges), estimates[:, index], side="right")
            bands[:, index] = estimates[:, [index]] + np.array(rows)[bins]
        return bands

    def to_config(self) -> dict[str, Any]:
        """Return the quantiles as ``config.json`` has them."""
        return {"edges": self.edges, "quantiles": self.quantiles, "percents": self.percents}

    @classmethod
    def from_config(cls, config: Mapping[str, Any], targets: int) -> ErrorQuantiles:
        """Return the quantiles that `to_config` wrote. Raises `ValueError` if they do not fit one another."""
        edges = tuple(tuple(map(float, row)) for row in config["edges"])
        quantiles = tuple(tuple(tuple(map(float, row)) for row in rows) for rows in config["quantiles"])
        percents = tuple(map(int, config["percents"]))
        fits = len(edges) == len(quantiles) == targets and all(
            len(rows) == len(inner) + 1 and all(len(row) == len(percents) for row in rows)
            for inner, rows in zip(edges, quantiles, strict=True)
        )
        if not fits:
            raise ValueError(f"quantiles of {len(quantiles)} targets for {targets}")
        return cls(edges, quantiles, percents)


@dataclass(frozen=True)
class ClassProbabilities:
    """The temperature of scores, and the probability below which the answer is ``unknown``."""

    temperature: float
    threshold: float

    @classmethod
    def fit(cls, scores: AnyFloats, labels: Ints, false_unknown: float = FALSE_UNKNOWN) -> ClassProbabilities:
        """Return the temperature and threshold for scores (example, class) of examples that were not learned from."""
        temperature = round_to(calibration.temperature(scores, labels), 9)
        best = calibration.probabilities(scores, temperature).max(axis=1)
        return cls(temperature, round_to(np.quantile(best, false_unknown), 9))

    def probabilities(self, scores: AnyFloats) -> Floats:
        """Return the probability of each class (example, class)."""
        return calibration.probabilities(scores, self.temperature)

    def answers(self, classes: Classes, probabilities: AnyFloats) -> list[str]:
        """Return the best class of each example, or ``unknown`` where its probability is below the threshold."""
        best = probabilities.argmax(axis=1).tolist()
        known = (probabilities.max(axis=1) >= self.threshold).tolist()
        return [classes.classes[number] if is_known else UNKNOWN for number, is_known in zip(best, known, strict=True)]

    def to_config(self) -> dict[str, Any]:
        """Return the calibration as ``config.json`` has it."""
        return dict(vars(self))

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> ClassProbabilities:
        """Return the calibration that `to_config` wrote. Raises `ValueError` for a temperature that is not positive."""
        if not float(config["temperature"]) > 0:
            raise ValueError(f"a temperature of {config['temperature']}")
        return cls(float(config["temperature"]), float(config["threshold"]))


def measure_uncertainty(
    answers: ModelAnswers,
    outputs: AnyFloats,
    values: AnyFloats,
    percents: tuple[int, ...] = PERCENTS,
    false_unknown: float = FALSE_UNKNOWN,
) -> ErrorQuantiles | ClassProbabilities:
    """Return the uncertainty of outputs (example, output) for examples that were not learned from.

    Classes that were not learned are left out.
    """
    if isinstance(answers, Quantities):
        return ErrorQuantiles.fit(answers, answers.decode(outputs), values, percents)
    labels = values[:, 0].astype(np.intp)
    return ClassProbabilities.fit(outputs[labels >= 0], labels[labels >= 0], false_unknown)


def _stored(values: AnyFloats) -> list[float]:
    return [round_to(value, 9) for value in values.tolist()]
