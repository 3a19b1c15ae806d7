"""Give a trained classifier calibrated probabilities and the answer ``unknown``: from validation slides to one more file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.metrics import calibration
from tacpipe.tasks.material import known as known_of
from tacpipe.tasks.material.classifier import CONFIG, Classifier
from tacpipe.tasks.material.known import FILE, Known, Watched
from tacpipe.tasks.material.readouts import config_file

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset
    from tacpipe.tasks.calibrated import Asked
    from tacpipe.tasks.material.slides import BySensor, Slides


def calibrate(model: Mapping[str, bytes], asked: Asked, training: Dataset, validation: Dataset) -> dict[str, bytes]:
    """Return the files of a classifier whose probabilities are calibrated on validation slides, with a threshold of unknown.

    Raises `TacpipeError` where the model learned from these validation slides, where a sensor has none, and for too few.
    """
    classifier = Classifier.load(model)
    learned, watched = (classifier.read(part, labelled=True) for part in (training, validation))
    _check(classifier, learned, watched)
    found: dict[str, Known] = {}
    about: dict[str, Any] = {}
    for sensor in classifier.layouts:
        held = set(classifier.config.get("held_out", {}).get(sensor, []))
        known, some = (_of_classes(classifier, part[sensor], held) for part in (learned, watched))
        scores = classifier.readers[sensor].read(some.frames).scores
        labels = np.searchsorted(classifier.classes, some.materials)
        seen = Watched(scores, some.frames, labels)
        classes = np.array(classifier.classes)
        found[sensor], areas = known_of.fit((known.frames, known.materials), seen, classes, asked.false_unknown)
        about[sensor] = {
            "slides": len(some),
            "temperature": found[sensor].temperature,
            "rule": found[sensor].rule,
            "threshold": found[sensor].threshold,
            "false_unknown": asked.false_unknown,
            "auroc_left_out": areas,
            "calibration_error": _errors(scores, labels, found[sensor].temperature),
        }
    config = {**classifier.config, "known": about}
    return {**model, CONFIG: config_file(config), FILE: known_of.packed(found)}


def _errors(scores: Any, labels: Any, temperature: float) -> dict[str, float]:
    """Return the expected calibration error on the slides that the temperature was fitted on, before it and after."""
    found = {}
    for name, one in (("before", 1.0), ("after", temperature)):
        each = calibration.probabilities(scores, one)
        found[name] = calibration.calibration_error(each.max(axis=1), each.argmax(axis=1) == labels)
    return found


def _of_classes(classifier: Classifier, slides: Slides, held: set[int]) -> Slides:
    """Return the slides of classes whose labels the sensor learned."""
    return slides.some(np.isin(slides.materials, [one for one in classifier.classes if one not in held]))


def _check(classifier: Classifier, learned: BySensor, watched: BySensor) -> None:
    """Refuse sensors without slides, and validation slides that the model learned from."""
    for part, role in ((learned, "train"), (watched, "val")):
        missing = sorted(set(classifier.layouts) - set(part))
        if missing:
            raise TacpipeError(
                f"No slide of {missing[0]} has the role {role}, and each sensor of the model is calibrated by slides of its "
                f"own. Give a split that has some."
            )
    known = set(classifier.config["trained_on"].values())
    if getattr(classifier.params, "use_validation", False) and any(
        digest in known for some in watched.values() for digest in some.digests
    ):
        raise UsageError(
            "The model learned from these validation slides too, so that they state nothing of its errors. Train it with "
            "--no-use-validation."
        )
