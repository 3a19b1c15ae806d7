"""Evaluation of calibrated probabilities and of the answer ``unknown``, on slides of known classes and of others."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Float32s
from tacpipe.metrics import calibration
from tacpipe.metrics.headline import FEWEST
from tacpipe.metrics.intervals import share_interval, wilson
from tacpipe.tasks.material.classifier import UNKNOWN_ANSWER, Classifier
from tacpipe.tasks.material.slides import Slides

ANSWERS = "answers.csv"
Tree = dict[str, Any]


@dataclass
class Answers:
    """The answers of a calibrated classifier for slides, by sensor; empty if it is not calibrated."""

    classifier: Classifier
    labels: Mapping[str, str] = field(default_factory=dict)  # recording to its label as text
    calibration: Tree = field(default_factory=dict)
    unknown: Tree = field(default_factory=dict)
    rows: list[tuple[Any, ...]] = field(default_factory=list)

    def add(self, slides: Slides, in_training: Bools) -> Bools:
        """Measure slides of one sensor, of known classes and of others, and return which are of known ones (slide,).

        Slides that were ``in_training`` (slide,) in training or validation do not count.
        """
        classifier, sensor = self.classifier, slides.layout.sensor
        is_known = np.isin(slides.materials, classifier.classes)
        if not classifier.calibrations:
            return is_known
        scores = classifier.readers[sensor].read(slides.frames).scores
        self._measure(sensor, slides, scores, is_known, ~in_training)
        return is_known

    def _measure(self, sensor: str, slides: Slides, scores: Float32s, is_known: Bools, fresh: Bools) -> None:
        sensor_calibration = self.classifier.calibrations[sensor]
        held_out = self.classifier.config.get("held_out", {}).get(sensor, [])
        learned = is_known & fresh & ~np.isin(slides.materials, held_out)
        unknown = ~is_known & fresh
        right = self.classifier.best_classes(scores) == slides.materials
        scores_by_rule = sensor_calibration.scores_by_rule(scores, slides.frames)
        score = scores_by_rule[sensor_calibration.rule]
        if learned.any():
            labels = np.searchsorted(self.classifier.classes, slides.materials[learned])
            self.calibration[sensor] = {"n": int(learned.sum()), "temperature": sensor_calibration.temperature}
            for name, divisor in (("before", 1.0), ("after", sensor_calibration.temperature)):
                probabilities = calibration.probabilities(scores[learned], divisor)
                confidence, correct = probabilities.max(axis=1), right[learned]
                self.calibration[sensor][name] = {
                    "calibration_error": calibration.calibration_error(confidence, correct),
                    "log_loss": calibration.log_loss(probabilities, labels),
                    "confidence": float(confidence.mean()),
                    "reliability": calibration.reliability(confidence, correct),
                }
        if learned.any() or unknown.any():
            refused = score < sensor_calibration.threshold
            tree: Tree = {"rule": sensor_calibration.rule, "threshold": sensor_calibration.threshold}
            labels = np.array([self.labels.get(name, "") for name in slides.names])
            tree |= _rate("false_unknown", refused[learned])
            tree |= _rate("false_known", ~refused[unknown], labels[unknown])
            if learned.any() and unknown.any():
                tree["auroc"] = {
                    rule: calibration.auroc(rule_scores[learned], rule_scores[unknown])
                    for rule, rule_scores in scores_by_rule.items()
                }
            if (learned & ~refused).any():
                tree["accuracy_of_answers"] = float(right[learned & ~refused].mean())
            self.unknown[sensor] = tree
        names = self.classifier.naming.names_for(self.classifier.best_classes(scores))
        best = sensor_calibration.probabilities(scores).max(axis=1)
        for at, name in enumerate(slides.names):
            answer = UNKNOWN_ANSWER if score[at] < sensor_calibration.threshold else str(names[at])
            flags = [str(bool(flag)).lower() for flag in (is_known[at], not fresh[at])]
            self.rows.append(
                (
                    name,
                    sensor,
                    *flags,
                    names[at],
                    f"{best[at]:.6g}",
                    f"{score[at]:.6g}",
                    answer,
                    self.labels.get(name, ""),
                )
            )

    def trees(self) -> Tree:
        """Return the parts ``calibration`` and ``unknown`` of ``metrics.json``, by sensor."""
        parts = {"calibration": self.calibration, "unknown": self.unknown}
        return {name: by_sensor for name, by_sensor in parts.items() if by_sensor}

    def files(self) -> dict[str, bytes]:
        """Return ``answers.csv``: a row a slide: class named, its probability, score of known, answer, label."""
        if not self.classifier.calibrations:
            return {}
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(("recording", "sensor", "known", "seen", "named", "probability", "score", "answer", "label"))
        writer.writerows(self.rows)
        return {ANSWERS: text.getvalue().encode()}


def _rate(name: str, flags: Bools, materials: AnyArray | None = None) -> Tree:
    """Return the fraction of slides that are so, of how many, and its 95 % interval; nothing without slides.

    With ``materials`` (slide,) the interval is over materials, because the rate is about materials that nobody has seen,
    and slides of one are alike: it is left out where these are fewer than `FEWEST`. Else it is Wilson's over slides.
    """
    if not len(flags):
        return {}
    tree: Tree = {name: float(flags.mean()), f"{name}_n": len(flags)}
    if materials is None:
        low, high = wilson(int(flags.sum()), len(flags))
        return {**tree, f"{name}_low": low, f"{name}_high": high}
    tree[f"{name}_materials"] = len(np.unique(materials))
    if tree[f"{name}_materials"] < FEWEST:
        return tree
    interval = share_interval(flags[:, None].astype(np.float64), np.ones((len(flags), 1)), materials).first
    return {**tree, f"{name}_low": interval.low, f"{name}_high": interval.high}
