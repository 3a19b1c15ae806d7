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
from tacpipe.metrics.intervals import share_interval
from tacpipe.metrics.proportions import wilson
from tacpipe.tasks.material.classifier import UNKNOWN_ANSWER, Classifier
from tacpipe.tasks.material.slides import Slides

ANSWERS = "answers.csv"
Tree = dict[str, Any]


@dataclass
class Answers:
    """What a calibrated classifier answers of slides, by sensor; empty where it is not calibrated."""

    classifier: Classifier
    labels: Mapping[str, str] = field(default_factory=dict)  # recording to its label as text
    calibration: Tree = field(default_factory=dict)
    unknown: Tree = field(default_factory=dict)
    rows: list[tuple[Any, ...]] = field(default_factory=list)

    def add(self, slides: Slides, seen: Bools) -> Bools:
        """Measure slides of one sensor, of known classes and of others, and return which are of known ones (slide,).

        Slides that were ``seen`` (slide,) in training or validation do not count.
        """
        classifier, sensor = self.classifier, slides.layout.sensor
        known = np.isin(slides.materials, classifier.classes)
        if not classifier.known:
            return known
        scores = classifier.readers[sensor].read(slides.frames).scores
        self._measure(sensor, slides, scores, known, ~seen)
        return known

    def _measure(self, sensor: str, slides: Slides, scores: Float32s, known: Bools, fresh: Bools) -> None:
        bundle = self.classifier.known[sensor]
        held = self.classifier.config.get("held_out", {}).get(sensor, [])
        own = known & fresh & ~np.isin(slides.materials, held)
        other = ~known & fresh
        right = self.classifier.named(scores) == slides.materials
        each = bundle.each(scores, slides.frames)
        score = each[bundle.rule]
        if own.any():
            labels = np.searchsorted(self.classifier.classes, slides.materials[own])
            self.calibration[sensor] = {"n": int(own.sum()), "temperature": bundle.temperature}
            for name, one in (("before", 1.0), ("after", bundle.temperature)):
                found = calibration.probabilities(scores[own], one)
                confidence, correct = found.max(axis=1), right[own]
                self.calibration[sensor][name] = {
                    "calibration_error": calibration.calibration_error(confidence, correct),
                    "log_loss": calibration.log_loss(found, labels),
                    "confidence": float(confidence.mean()),
                    "reliability": calibration.reliability(confidence, correct),
                }
        if own.any() or other.any():
            refused = score < bundle.threshold
            tree: Tree = {"rule": bundle.rule, "threshold": bundle.threshold}
            labels = np.array([self.labels.get(name, "") for name in slides.names])
            tree |= _rate("false_unknown", refused[own])
            tree |= _rate("false_known", ~refused[other], labels[other])
            if own.any() and other.any():
                tree["auroc"] = {rule: calibration.auroc(one[own], one[other]) for rule, one in each.items()}
            if (own & ~refused).any():
                tree["accuracy_of_answers"] = float(right[own & ~refused].mean())
            self.unknown[sensor] = tree
        names = self.classifier.naming.named(self.classifier.named(scores))
        best = bundle.probabilities(scores).max(axis=1)
        for at, name in enumerate(slides.names):
            answer = UNKNOWN_ANSWER if score[at] < bundle.threshold else str(names[at])
            flags = [str(bool(flag)).lower() for flag in (known[at], not fresh[at])]
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
        """Return what ``metrics.json`` holds more: ``calibration`` and ``unknown`` by sensor."""
        found = {"calibration": self.calibration, "unknown": self.unknown}
        return {name: one for name, one in found.items() if one}

    def files(self) -> dict[str, bytes]:
        """Return ``answers.csv``: a row a slide: class named, its probability, score of known, answer, label."""
        if not self.classifier.known:
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
