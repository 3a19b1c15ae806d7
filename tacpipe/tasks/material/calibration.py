"""Calibrate the probabilities of a trained classifier, add the answer ``unknown``, and evaluate both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Float32s
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.scores import calibration
from tacpipe.scores.headline import MIN_CLUSTERS
from tacpipe.scores.intervals import share_interval, wilson
from tacpipe.tasks.material.classifier import CONFIG, UNKNOWN_ANSWER, Classifier
from tacpipe.tasks.material.headline import MaterialMetrics, ProbabilityMeasures, StatedProbabilities, UnknownMeasures
from tacpipe.tasks.material.params import UnknownDescription
from tacpipe.tasks.material.sensor_calibration import (
    CALIBRATION_FILE,
    SensorCalibration,
    ValidationSlides,
    fit_calibration,
    pack_calibrations,
)
from tacpipe.tasks.material.slides import BySensor, Slides
from tacpipe.tasks.task import CalibrationRequest


def calibrate(
    model: Mapping[str, bytes], request: CalibrationRequest, training: Dataset, validation: Dataset
) -> dict[str, bytes]:
    """Return the files of a classifier with probabilities and a threshold of unknown calibrated on validation slides.

    Raises `TacpipeError` if the model was trained on these slides, a sensor has none, or there are too few.
    """
    classifier = Classifier.load(model)
    training_by_sensor, validation_by_sensor = (classifier.read(part, labelled=True) for part in (training, validation))
    _check_slides(classifier, training_by_sensor, validation_by_sensor)
    calibrations: dict[str, SensorCalibration] = {}
    descriptions: dict[str, UnknownDescription] = {}
    for sensor in classifier.layouts:
        held_out = set(classifier.config.get("held_out", {}).get(sensor, []))
        training_slides, validation_slides = (
            _select_learned(classifier, part[sensor], held_out) for part in (training_by_sensor, validation_by_sensor)
        )
        scores = classifier.readers[sensor].read(validation_slides.frames).scores
        labels = np.searchsorted(classifier.classes, validation_slides.materials)
        scored_slides = ValidationSlides(scores, validation_slides.frames, labels)
        classes = np.array(classifier.classes)
        calibrations[sensor], areas = fit_calibration(
            (training_slides.frames, training_slides.materials), scored_slides, classes, request.false_unknown
        )
        descriptions[sensor] = {
            "slides": len(validation_slides),
            "temperature": calibrations[sensor].temperature,
            "rule": calibrations[sensor].rule,
            "threshold": calibrations[sensor].threshold,
            "false_unknown": request.false_unknown,
            "auroc_left_out": areas,
            "calibration_error": _calibration_errors(scores, labels, calibrations[sensor].temperature),
        }
    config = classifier.config.copy()
    config["known"] = descriptions
    return {**model, CONFIG: model_files.to_json(config), CALIBRATION_FILE: pack_calibrations(calibrations)}


def _calibration_errors(scores: Any, labels: Any, temperature: float) -> dict[str, float]:
    """Return the expected calibration error before and after scaling by the temperature, on the slides it was fitted on."""
    errors = {}
    for name, divisor in (("before", 1.0), ("after", temperature)):
        probabilities = calibration.probabilities(scores, divisor)
        errors[name] = calibration.calibration_error(probabilities.max(axis=1), probabilities.argmax(axis=1) == labels)
    return errors


def _select_learned(classifier: Classifier, slides: Slides, held_out: set[int]) -> Slides:
    """Return the slides of classes whose labels the sensor learned."""
    return slides.select(np.isin(slides.materials, [number for number in classifier.classes if number not in held_out]))


def _check_slides(classifier: Classifier, training: BySensor, validation: BySensor) -> None:
    """Raise `TacpipeError` for a sensor without slides, and `UsageError` for slides that the model was trained on."""
    for part, role in ((training, "train"), (validation, "val")):
        missing = sorted(set(classifier.layouts) - set(part))
        if missing:
            raise TacpipeError(
                f"No slide of {missing[0]} has the role {role}, and each sensor of the model is calibrated by slides of its "
                f"own. Give a split that has some."
            )
    seen_digests = set(classifier.config["trained_on"].values())
    has_seen = any(not seen_digests.isdisjoint(slides.digests) for slides in validation.values())
    if getattr(classifier.params, "use_validation", False) and has_seen:
        raise UsageError(
            "The model was trained on these validation slides, so its errors on them are too small. Train it with "
            "--no-use-validation."
        )


ANSWERS = "answers.csv"


@dataclass
class Answers:
    """Answers of a calibrated classifier for slides, by sensor; empty if it is not calibrated."""

    classifier: Classifier
    labels: Mapping[str, str] = field(default_factory=dict)  # recording -> its label as text
    calibration: dict[str, ProbabilityMeasures] = field(default_factory=dict)
    unknown: dict[str, UnknownMeasures] = field(default_factory=dict)
    rows: list[tuple[Any, ...]] = field(default_factory=list)

    def add(self, slides: Slides, in_training: Bools) -> Bools:
        """Evaluate slides of one sensor, and return a mask (slide,) of those of known classes.

        Slides that are ``in_training`` (slide,), for training or validation, are excluded from the measures.
        """
        classifier, sensor = self.classifier, slides.layout.sensor
        is_known = np.isin(slides.materials, classifier.classes)
        if not classifier.calibrations:
            return is_known
        scores = classifier.readers[sensor].read(slides.frames).scores
        self._add_measures(sensor, slides, scores, is_known, ~in_training)
        return is_known

    def _add_measures(self, sensor: str, slides: Slides, scores: Float32s, is_known: Bools, fresh: Bools) -> None:
        """Add the measures and the rows of a sensor's slides, given their scores (slide, class).

        ``is_known`` (slide,) marks slides of known materials, and ``fresh`` (slide,) slides that were not used for training
        or validation; only these are measured.
        """
        sensor_calibration = self.classifier.calibrations[sensor]
        held_out = self.classifier.config.get("held_out", {}).get(sensor, [])
        learned = is_known & fresh & ~np.isin(slides.materials, held_out)
        unknown = ~is_known & fresh
        right = self.classifier.best_classes(scores) == slides.materials
        scores_by_rule = sensor_calibration.scores_by_rule(scores, slides.frames)
        score = scores_by_rule[sensor_calibration.rule]
        if learned.any():
            labels = np.searchsorted(self.classifier.classes, slides.materials[learned])
            temperature = sensor_calibration.temperature
            self.calibration[sensor] = {
                "n": int(learned.sum()),
                "temperature": temperature,
                "before": _probability_fit(scores[learned], labels, right[learned], 1.0),
                "after": _probability_fit(scores[learned], labels, right[learned], temperature),
            }
        if learned.any() or unknown.any():
            refused = score < sensor_calibration.threshold
            measures: UnknownMeasures = {"rule": sensor_calibration.rule, "threshold": sensor_calibration.threshold}
            _add_false_unknown(measures, refused[learned])
            materials = [self.labels.get(name, "") for name in slides.select(unknown).names]
            _add_false_known(measures, ~refused[unknown], materials)
            if learned.any() and unknown.any():
                measures["auroc"] = {
                    rule: calibration.auroc(rule_scores[learned], rule_scores[unknown])
                    for rule, rule_scores in scores_by_rule.items()
                }
            if (learned & ~refused).any():
                measures["accuracy_of_answers"] = float(right[learned & ~refused].mean())
            self.unknown[sensor] = measures
        names = self.classifier.naming.names_for(self.classifier.best_classes(scores))
        best = sensor_calibration.probabilities(scores).max(axis=1)
        for index, name in enumerate(slides.names):
            answer = UNKNOWN_ANSWER if score[index] < sensor_calibration.threshold else str(names[index])
            flags = [str(bool(flag)).lower() for flag in (is_known[index], not fresh[index])]
            numbers = [f"{best[index]:.6g}", f"{score[index]:.6g}"]
            self.rows.append((name, sensor, *flags, names[index], *numbers, answer, self.labels.get(name, "")))

    def metrics(self) -> MaterialMetrics:
        """Return the entries of ``metrics.json``."""
        metrics: MaterialMetrics = {}
        if self.calibration:
            metrics["calibration"] = self.calibration
        if self.unknown:
            metrics["unknown"] = self.unknown
        return metrics

    def files(self) -> dict[str, bytes]:
        """Return ``answers.csv`` with one row per slide: best class, its probability, score of known, answer, label.

        Empty for an uncalibrated model.
        """
        if not self.classifier.calibrations:
            return {}
        heads = ("recording", "sensor", "known", "seen", "named", "probability", "score", "answer", "label")
        return {ANSWERS: model_files.to_csv(heads, self.rows)}


def _probability_fit(scores: Float32s, labels: AnyArray, right: Bools, divisor: float) -> StatedProbabilities:
    """Return how the softmax of scores (slide, class) / temperature fits the slides' labels (slide,)."""
    probabilities = calibration.probabilities(scores, divisor)
    confidence = probabilities.max(axis=1)
    return {
        "calibration_error": calibration.calibration_error(confidence, right),
        "log_loss": calibration.log_loss(probabilities, labels),
        "confidence": float(confidence.mean()),
        "reliability": calibration.reliability(confidence, right),
    }


def _add_false_unknown(measures: UnknownMeasures, refused: Bools) -> None:
    """Add the fraction of refused slides (slide,) of learned classes, with Wilson's interval over slides."""
    if len(refused):
        low, high = wilson(int(refused.sum()), len(refused))
        measures["false_unknown"], measures["false_unknown_n"] = float(refused.mean()), len(refused)
        measures["false_unknown_low"], measures["false_unknown_high"] = low, high


def _add_false_known(measures: UnknownMeasures, answered: Bools, materials: Sequence[str]) -> None:
    """Add the fraction of slides of other classes that are assigned to a class (slide,).

    Its interval is over materials, because the rate concerns unseen materials and slides of one material are similar.
    It is omitted if there are fewer than `MIN_CLUSTERS` materials.
    """
    if not len(answered):
        return
    measures["false_known"], measures["false_known_n"] = float(answered.mean()), len(answered)
    measures["false_known_materials"] = len(set(materials))
    if len(set(materials)) >= MIN_CLUSTERS:
        weights = np.ones((len(answered), 1))
        interval = share_interval(answered[:, None].astype(np.float64), weights, np.array(materials)).first
        measures["false_known_low"], measures["false_known_high"] = interval.low, interval.high
