"""Give a trained classifier calibrated probabilities and the answer ``unknown``: from validation slides to one more file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.datasets import model_files
from tacpipe.errors import TacpipeError, UsageError
from tacpipe.metrics import calibration
from tacpipe.tasks.material import known as known_of
from tacpipe.tasks.material.classifier import CONFIG, Classifier
from tacpipe.tasks.material.known import FILE, SensorCalibration, ValidationSlides

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.tasks.calibrated import CalibrationRequest
    from tacpipe.tasks.material.slides import BySensor, Slides


def calibrate(
    model: Mapping[str, bytes], request: CalibrationRequest, training: Dataset, validation: Dataset
) -> dict[str, bytes]:
    """Return the files of a classifier whose probabilities are calibrated on validation slides, with a threshold of unknown.

    Raises `TacpipeError` where the model learned from these validation slides, where a sensor has none, and for too few.
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
        calibrations[sensor], areas = known_of.fit(
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
    return {**model, CONFIG: model_files.to_json(config), FILE: known_of.packed(calibrations)}


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
