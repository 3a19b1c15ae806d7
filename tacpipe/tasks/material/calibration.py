"""Give a trained classifier calibrated probabilities and the answer ``unknown``, and evaluate both."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Float32s
from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.metrics import calibration
from tacpipe.metrics.headline import MIN_CLUSTERS
from tacpipe.metrics.intervals import share_interval, wilson
from tacpipe.tasks.material.classifier import CONFIG, UNKNOWN_ANSWER, Classifier
from tacpipe.tasks.material.sensor_calibration import (
    CALIBRATION_FILE,
    SensorCalibration,
    ValidationSlides,
    fit_calibration,
    pack_calibrations,
)
from tacpipe.tasks.material.slides import Slides

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.tasks.material.slides import BySensor, Slides
    from tacpipe.tasks.task import CalibrationRequest


def calibrate(
    model: Mapping[str, bytes], request: CalibrationRequest, training: Dataset, validation: Dataset
) -> dict[str, bytes]:
    """Return the files of a classifier whose probabilities are calibrated on validation slides, with a threshold of unknown.

    Raises `TacpipeError` if the model learned from these validation slides, where a sensor has none, and for too few.
    """
    classifier = Classifier.load(model)
    training_by_sensor, validation_by_sensor = (classifier.read(part, labelled=True) for part in (training, validation))
    _check(classifier, training_by_sensor, validation_by_sensor)
    calibrations: dict[str, SensorCalibration] = {}
    about: dict[str, Any] = {}
    for sensor in classifier.layouts:
        held_out = set(classifier.config.get("held_out", {}).get(sensor, []))
        training_slides, validation_slides = (
            _with_learned_labels(classifier, part[sensor], held_out)
            for part in (training_by_sensor, validation_by_sensor)
        )
        scores = classifier.readers[sensor].read(validation_slides.frames).scores
        labels = np.searchsorted(classifier.classes, validation_slides.materials)
        scored_slides = ValidationSlides(scores, validation_slides.frames, labels)
        classes = np.array(classifier.classes)
        calibrations[sensor], areas = fit_calibration(
            (training_slides.frames, training_slides.materials), scored_slides, classes, request.false_unknown
        )
        about[sensor] = {
            "slides": len(validation_slides),
            "temperature": calibrations[sensor].temperature,
            "rule": calibrations[sensor].rule,
            "threshold": calibrations[sensor].threshold,
            "false_unknown": request.false_unknown,
            "auroc_left_out": areas,
            "calibration_error": _errors(scores, labels, calibrations[sensor].temperature),
        }
    config = {**classifier.config, "known": about}
    return {**model, CONFIG: model_files.to_json(config), CALIBRATION_FILE: pack_calibrations(calibrations)}


def _errors(scores: Any, labels: Any, temperature: float) -> dict[str, float]:
    """Return the expected calibration error on the slides that the temperature was fitted on, before it and after."""
    errors = {}
    for name, divisor in (("before", 1.0), ("after", temperature)):
        probabilities = calibration.probabilities(scores, divisor)
        errors[name] = calibration.calibration_error(probabilities.max(axis=1), probabilities.argmax(axis=1) == labels)
    return errors


def _with_learned_labels(classifier: Classifier, slides: Slides, held_out: set[int]) -> Slides:
    """Return the slides of classes whose labels the sensor learned."""
    return slides.select(np.isin(slides.materials, [number for number in classifier.classes if number not in held_out]))


def _check(classifier: Classifier, training: BySensor, validation: BySensor) -> None:
    """Refuse sensors without slides, and validation slides that the model learned from."""
    for part, role in ((training, "train"), (validation, "val")):
        missing = sorted(set(classifier.layouts) - set(part))
        if missing:
            raise TacpipeError(
                f"No slide of {missing[0]} has the role {role}, and each sensor of the model is calibrated by slides of its "
                f"own. Give a split that has some."
            )
    seen_digests = set(classifier.config["trained_on"].values())
    if getattr(classifier.params, "use_validation", False) and any(
        digest in seen_digests for slides in validation.values() for digest in slides.digests
    ):
        raise UsageError(
            "The model learned from these validation slides too, so that they state nothing of its errors. Train it with "
            "--no-use-validation."
        )


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
    and slides of one are alike: it is left out where these are fewer than `MIN_CLUSTERS`. Else it is Wilson's over slides.
    """
    if not len(flags):
        return {}
    tree: Tree = {name: float(flags.mean()), f"{name}_n": len(flags)}
    if materials is None:
        low, high = wilson(int(flags.sum()), len(flags))
        return {**tree, f"{name}_low": low, f"{name}_high": high}
    tree[f"{name}_materials"] = len(np.unique(materials))
    if tree[f"{name}_materials"] < MIN_CLUSTERS:
        return tree
    interval = share_interval(flags[:, None].astype(np.float64), np.ones((len(flags), 1)), materials).first
    return {**tree, f"{name}_low": interval.low, f"{name}_high": interval.high}
