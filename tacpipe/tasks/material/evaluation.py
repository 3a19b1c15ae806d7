"""Evaluate a classifier of materials on every slide, next to its baselines, with intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from tacpipe.arrays import Bools, Float32s, Int64s
from tacpipe.datasets import model_files, selection
from tacpipe.datasets.dataset import Dataset
from tacpipe.errors import TacpipeError
from tacpipe.io import terminal
from tacpipe.plugins.stage import Attribute, RecordingOutput, Result
from tacpipe.printable import listed
from tacpipe.scores import headline, table
from tacpipe.scores.intervals import mcnemar, wilson
from tacpipe.scores.table import Question, ScoreTable
from tacpipe.tasks.material import headline as headlines
from tacpipe.tasks.material.calibration import Answers
from tacpipe.tasks.material.classifier import CONFIG, Classifier, ReaderOutput
from tacpipe.tasks.material.headline import SensorAccuracy, ZeroShotAccuracy
from tacpipe.tasks.material.network_training import HISTORY
from tacpipe.tasks.material.predictions import (
    LAST,
    LEVEL,
    MODEL,
    PREDICTIONS,
    SWAPPED,
    read_slides,
    score_tables,
)
from tacpipe.tasks.material.slides import Slides


def accuracy(correct: Mapping[str, Bools]) -> SensorAccuracy:
    """Return accuracy, correct and total number, and 95 % Wilson interval by sensor; sensors without slides are omitted.

    Accuracy is the fraction of correct predictions. Equation (4) of the paper, taken literally, would be a mean squared
    difference of labels.

    >>> import numpy as np
    >>> accuracy({"biotac": np.array([True, False])})["accuracy"]
    {'biotac': 0.5}
    """
    evaluated = {sensor: right for sensor, right in correct.items() if len(right)}
    counts = {sensor: int(right.sum()) for sensor, right in evaluated.items()}
    ends = {sensor: wilson(counts[sensor], len(right)) for sensor, right in evaluated.items()}
    return {
        "accuracy": {sensor: counts[sensor] / len(right) for sensor, right in evaluated.items()},
        "correct": counts,
        "n": {sensor: len(right) for sensor, right in evaluated.items()},
        "low": {sensor: low for sensor, (low, _) in ends.items()},
        "high": {sensor: high for sensor, (_, high) in ends.items()},
    }


def summary(tables: Mapping[str, ScoreTable], predictors: Sequence[str], classes: int) -> dict[str, Any]:
    """Return the metrics of tables of scores by sensor: accuracies, and the comparison with the mean level, if there is one.

    ``skill`` is the fraction of the mean level's errors that the model corrects, and ``mcnemar`` the exact p of McNemar's
    test. Guessing is among ``classes``.
    """
    right = {
        name: {
            sensor: np.array([correct == 1 for correct, _ in scored.sums[name].values()], bool)
            for sensor, scored in tables.items()
            if name in scored.sums
        }
        for name in predictors
    }
    n = {sensor: len(scored.sums.get(MODEL, {})) for sensor, scored in tables.items()}
    guessed = {sensor: count for sensor, count in n.items() if count}
    metrics: dict[str, Any] = {name: accuracy(by_sensor) for name, by_sensor in right.items()}
    metrics["chance"] = {"accuracy": dict.fromkeys(guessed, 1 / classes), "n": guessed}
    metrics["counts"] = {"slides": n}
    if LEVEL in right:
        pairs = {sensor: (right[MODEL][sensor], level) for sensor, level in right[LEVEL].items()}
        metrics["skill"] = {
            sensor: float(1 - (~model).mean() / (~level).mean())
            for sensor, (model, level) in pairs.items()
            if not level.all()
        }
        metrics["mcnemar"] = {"model_vs_mean_level": {sensor: mcnemar(*pair) for sensor, pair in pairs.items()}}
    return metrics


def confusion_csv(slides: pd.DataFrame) -> bytes:
    """Return the confusion counts of each sensor's slides, rows of `read_slides`, as CSV."""
    counts = slides.groupby(["sensor", "material", MODEL]).size().rename("count").reset_index()
    return counts.rename(columns={MODEL: "predicted"}).to_csv(index=False, lineterminator="\n").encode()


@dataclass
class Evaluated:
    """Slides of one sensor and the predictions for them."""

    slides: Slides
    in_training: Bools  # (slide,), whether the model was trained on it
    output: ReaderOutput
    predicted: dict[str, Int64s]  # predictor -> predicted material (slide,)
    held_out: Bools  # (slide,), whether this sensor did not learn its material's label
    zero_shot: tuple[Int64s, Int64s] | None = None  # another sensor's predictions: among all, held-out


def evaluate(model: Mapping[str, bytes], recordings: Dataset) -> Result:
    """Return metrics, confusions and predictions of a model and its baselines on slides.

    ``model`` contains the files of the model. Every slide counts. Slides used for training or model selection are
    recognised by their digests and reported under ``seen``. Raises `TacpipeError` if slides have no label or do not fit
    the model.
    """
    classifier = Classifier.load(model)
    trained_on = set(classifier.config["trained_on"].values())
    evaluated = {}
    key = classifier.naming.key
    attributes = {name: recording.attributes for name, recording in recordings.recordings.items()}
    answers = Answers(
        classifier, {name: headlines.label_text(labels.get(key, "")) for name, labels in attributes.items()}
    )
    with terminal.progress_bar("evaluate", 2 * len(recordings.recordings)) as advance:  # read, then classify
        for sensor, slides in _read_slides(classifier, recordings, advance).items():
            is_learned = answers.add(slides, np.array([digest in trained_on for digest in slides.digests], bool))
            if is_learned.any() or not classifier.calibrations:
                learned_slides = slides.select(is_learned) if classifier.calibrations else slides
                evaluated[sensor] = _evaluate_sensor(classifier, learned_slides, trained_on)
            advance(len(slides), sensor)
    if not evaluated:
        raise TacpipeError(
            "There is no slide to evaluate the model on. Give a dataset that `tacpipe segment slides` made."
        )
    metrics = answers.metrics()
    if zero_shot := _zero_shot(evaluated, classifier):
        metrics["zero_shot"] = zero_shot
    sessions = {name: labels.get("session") for name, labels in attributes.items()}
    predicted, classes = predictions_table(evaluated, classifier, sessions), len(classifier.classes)
    predictors = sorted({name for result in evaluated.values() for name in result.predicted})
    rows = read_slides(predicted, classifier.config, predictors)
    learned, unseen = rows[~rows["held_out"]], rows[~rows["seen"]]
    tables, seen = (score_tables(learned[learned["seen"] == is_seen], evaluated, classes) for is_seen in (False, True))
    tree = {**summary(tables, predictors, classes), **metrics}
    if learned["seen"].any():
        tree["seen"] = summary(seen, predictors, classes)
    questions = {Question(headlines.sensor_title(sensor)): scored for sensor, scored in tables.items()}
    files = {
        headline.FILE: headline.write(table.headlines(headlines.TASK, classifier.config["architecture"], questions)),
        "metrics.json": model_files.to_json(tree),
        "confusion.csv": confusion_csv(unseen),
        **answers.files(),
        **{name: model[name] for name in (CONFIG, HISTORY) if name in model},
    }
    return Result({PREDICTIONS: RecordingOutput(predicted, selection.combine_origins(attributes.values()))}, files)


def _read_slides(classifier: Classifier, recordings: Dataset, advance: Callable[..., None]) -> dict[str, Slides]:
    """Return labelled slides; with a calibrated classifier their classes may be unknown to it."""
    key = classifier.naming.key
    all_labelled = all(shard.attributes.get(key) is not None for shard in recordings.recordings.values())
    return classifier.read(recordings, labelled=not (classifier.calibrations and all_labelled), advance=advance)


def _evaluate_sensor(classifier: Classifier, slides: Slides, trained_on: set[str]) -> Evaluated:
    """Return the predictions of all predictors for the slides of one sensor.

    ``trained_on`` are the digests of training slides. Raises `TacpipeError` for a slide of another class than the
    model's.
    """
    sensor = slides.layout.sensor
    other_class_rows = [
        index for index, material in enumerate(slides.materials) if int(material) not in classifier.classes
    ]
    if other_class_rows:
        raise TacpipeError(
            f"{slides.names[other_class_rows[0]]} is of {classifier.naming.key} "
            f"{classifier.naming.name(int(slides.materials[other_class_rows[0]]))}, not one of those the model names: "
            f"{listed(classifier.names, 20)}. Leave it out."
        )
    output = classifier.readers[sensor].read(slides.frames)
    predicted = {MODEL: classifier.best_classes(output.scores)}
    if sensor in classifier.last:
        predicted[LAST] = classifier.best_classes(classifier.last[sensor].read(slides.frames).scores)
    params = classifier.params
    is_aligned = bool(params.aligned_sensor)  # all sensors already have the frozen sensor's classifier
    if classifier.config.get("joint") and output.latents is not None and not is_aligned:
        predicted[SWAPPED] = _exchanged_predictions(classifier, sensor, output.latents)
    for name, by_sensor in classifier.baselines.items():
        frames = slides.frames
        if name != LEVEL and output.latents is not None:
            frames = output.latents[:, None]
        fitted = by_sensor[sensor]
        predicted[name] = np.asarray(fitted.classes)[fitted.scores(frames).argmax(axis=1)].astype(np.int64)
    held_out = classifier.config.get("held_out", {}).get(sensor, [])
    evaluated = Evaluated(
        slides,
        np.array([digest in trained_on for digest in slides.digests], bool),
        output,
        predicted,
        np.isin(slides.materials, held_out),
    )
    if held_out and output.latents is not None:
        evaluated.zero_shot = _zero_shot_predictions(classifier, sensor, output.latents, held_out)
    return evaluated


def _exchanged_predictions(classifier: Classifier, sensor: str, latents: Float32s) -> Int64s:
    """Return the materials (slide,) predicted by another sensor's classifier, in terms of this sensor's materials.

    Sensors aligned with permuted classes share a space in which each material has the position of its partner.
    Predictions are then mapped back by the inverse permutation.
    """
    scores = _partner_scores(classifier, sensor, latents)
    materials = classifier.best_classes(scores)
    partner_of = {int(first): int(partner) for first, partner in classifier.config.get("partners", {}).items()}
    first_sensor, partner_sensor = next(iter(classifier.layouts)), classifier.partner(sensor)
    if not partner_of or first_sensor not in (sensor, partner_sensor):
        return materials
    inverse = {partner: first for first, partner in partner_of.items()}
    original = partner_of if partner_sensor == first_sensor else inverse
    return np.array([original[int(material)] for material in materials], np.int64)


def _partner_scores(classifier: Classifier, sensor: str, latents: Float32s) -> Float32s:
    return classifier.readers[sensor].scores_by(classifier.readers[classifier.partner(sensor)], latents)


def _zero_shot_predictions(
    classifier: Classifier, sensor: str, latents: Float32s, held_out: list[int]
) -> tuple[Int64s, Int64s]:
    """Return another sensor's predictions (slide,): among all materials, and among held-out ones only."""
    scores = _partner_scores(classifier, sensor, latents)
    is_held_out = np.isin(classifier.classes, held_out)
    return classifier.best_classes(scores), classifier.best_classes(np.where(is_held_out, scores, -np.inf))


def _zero_shot(evaluated: Mapping[str, Evaluated], classifier: Classifier) -> ZeroShotAccuracy | None:
    """Return the accuracy of another sensor's classifier on materials whose labels a sensor did not learn, or None."""
    correct, correct_among_held_out, chances = {}, {}, {}
    for sensor, result in evaluated.items():
        if result.zero_shot is None:
            continue
        mask = result.held_out & ~result.in_training
        correct[sensor] = (result.zero_shot[0] == result.slides.materials)[mask]
        correct_among_held_out[sensor] = (result.zero_shot[1] == result.slides.materials)[mask]
        chances[sensor] = 1 / len(classifier.config["held_out"][sensor])
    if not correct:
        return None
    return {
        **accuracy(correct),
        "chance": {sensor: 1 / len(classifier.classes) for sensor in correct},
        "among_held_out": {**accuracy(correct_among_held_out), "chance": chances},
    }


def predictions_table(
    evaluated: Mapping[str, Evaluated], classifier: Classifier, sessions: Mapping[str, Attribute] | None = None
) -> pa.Table:
    """Return one row per slide: its description, all predictions, and the model's scores and latents.

    ``sessions`` maps slides to their sessions, if recorded.
    """
    names_for, results = classifier.naming.names_for, list(evaluated.values())
    recordings = [name for result in results for name in result.slides.names]
    sensors = [sensor for sensor, result in evaluated.items() for _ in result.slides.names]
    materials = names_for(_concatenate(result.slides.materials for result in results))
    session_values = [(sessions or {}).get(name) for name in recordings]
    session_names = [None if session is None else str(session) for session in session_values]
    columns: list[tuple[pa.Field, Any]] = [
        (pa.field("recording", pa.string()), recordings),
        (pa.field("sensor", pa.string()), sensors),
        headlines.label_field("material", materials, "label"),
        (pa.field("seen", pa.bool_()), _concatenate(result.in_training for result in results)),
        (pa.field("session", pa.string()), session_names),
    ]
    for name in sorted({name for result in results for name in result.predicted}):
        predicted = [result.predicted.get(name, np.full(len(result.slides), headlines.UNKNOWN)) for result in results]
        columns.append(headlines.label_field(name, names_for(_concatenate(predicted)), "prediction"))
    columns += score_columns(classifier, _concatenate(result.output.scores for result in results))
    latents = [result.output.latents for result in results if result.output.latents is not None]
    if latents:
        columns += latent_columns(_concatenate(latents))
    arrays = [pa.array(values, field.type) for field, values in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema([field for field, _ in columns]))


def score_columns(classifier: Classifier, scores: Float32s) -> list[tuple[pa.Field, Any]]:
    """Return a field and the scores (slide,) of each material."""
    metadata = {"quantity": "score"}
    return [
        (pa.field(f"score_{name.zfill(2)}", pa.float32(), metadata=metadata), scores[:, number])
        for number, name in enumerate(classifier.names)
    ]


def latent_columns(latents: Float32s) -> list[tuple[pa.Field, Any]]:
    """Return a field and the values (slide,) of each latent."""
    metadata = {"quantity": "latent"}
    return [
        (pa.field(f"z{number + 1:02d}", pa.float32(), metadata=metadata), latents[:, number])
        for number in range(latents.shape[1])
    ]


def _concatenate(parts: Any) -> Any:
    return np.concatenate(list(parts))
