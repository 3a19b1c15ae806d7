"""Evaluation of a classifier of materials: on every slide, next to its baselines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Bools, Float32s, Int64s
from tacpipe.datasets import model_files, origin
from tacpipe.errors import TacpipeError
from tacpipe.io import progress
from tacpipe.metrics import headline
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.printable import listed
from tacpipe.tasks.material import headline as headlines
from tacpipe.tasks.material import metrics, naming
from tacpipe.tasks.material.classifier import CONFIG, MEAN_LEVEL, Classifier, NetworkReader, ReaderOutput, SpectraReader
from tacpipe.tasks.material.metrics import LAST_EPOCH, MODEL, SWAPPED, Tree
from tacpipe.tasks.material.network_training import HISTORY
from tacpipe.tasks.material.params import XLSTM, Raec
from tacpipe.tasks.material.slides import Slides
from tacpipe.tasks.material.unknown import Answers

if TYPE_CHECKING:
    from tacpipe.datasets.dataset import Dataset

PREDICTIONS = "predictions"


@dataclass
class Evaluated:
    """The slides of one sensor and the predictions for them."""

    slides: Slides
    seen: Bools  # (slide,): the model was trained on it
    output: ReaderOutput
    predicted: dict[str, Int64s]  # predictor -> the material it names (slide,)
    held: Bools  # (slide,): of a material whose label the sensor did not learn
    zero_shot: tuple[Int64s, Int64s] | None = None  # another sensor's names: of all materials, of held-out ones
    counted: Bools = field(default_factory=lambda: np.zeros(0, bool))  # (slide,)

    def right(self, predictor: str, chosen: Bools) -> Bools:
        """Return which of the chosen slides a predictor named rightly."""
        found: Bools = (self.predicted[predictor] == self.slides.materials)[chosen]
        return found


def evaluate(model: Mapping[str, bytes], recordings: Dataset) -> Result:
    """Return metrics, confusions and predictions of a model, its files given, on slides, next to its baselines.

    Every slide counts. Slides that the model was trained or chosen on are recognised by their digests and reported
    apart, under ``seen``. Raises `TacpipeError` where slides have no label or are not what the model reads.
    """
    classifier = Classifier.load(model)
    known = set(classifier.config["trained_on"].values())
    evaluated = {}
    key = classifier.naming.key
    answers = Answers(
        classifier,
        {name: naming.text(recording.attributes.get(key, "")) for name, recording in recordings.recordings.items()},
    )
    with progress.bar("evaluate", 2 * len(recordings.recordings)) as advance:  # each slide is read, then named
        for sensor, slides in _read(classifier, recordings, advance).items():
            named = answers.add(slides, np.array([one in known for one in slides.digests], bool))
            if named.any() or not classifier.known:
                some = slides.some(named) if classifier.known else slides
                evaluated[sensor] = _evaluated(classifier, some, known)
            advance(len(slides), sensor)
    if not evaluated:
        raise TacpipeError(
            "There is no slide to evaluate the model on. Give a dataset that `tacpipe segment slides` made."
        )
    tree = {**_summary(evaluated, classifier, seen=False), **answers.trees()}
    seen = _summary(evaluated, classifier, seen=True)
    if any(seen["counts"]["slides"].values()):
        tree["seen"] = seen
    zero = _zero_shot(evaluated, classifier)
    if zero:
        tree["zero_shot"] = zero
    rows = [
        (sensor, one, int(at)) for sensor, one in evaluated.items() for at in np.flatnonzero(one.counted & ~one.seen)
    ]
    files = {
        headline.FILE: headline.write(_headlines(evaluated, classifier)),
        "metrics.json": model_files.to_json(tree),
        "confusion.csv": metrics.confusion_csv(
            [sensor for sensor, _, _ in rows],
            [classifier.naming.named(one.slides.materials[[at]])[0] for _, one, at in rows],
            [classifier.naming.named(one.predicted[MODEL][[at]])[0] for _, one, at in rows],
        ),
        **answers.files(),
        **{name: model[name] for name in (CONFIG, HISTORY) if name in model},
    }
    attributes = {name: shard.attributes for name, shard in recordings.recordings.items()}
    table = predictions_table(evaluated, classifier, {name: one.get("session") for name, one in attributes.items()})
    return Result({PREDICTIONS: RecordingOutput(table, origin.together(attributes.values()))}, files)


def _read(classifier: Classifier, recordings: Dataset, advance: Callable[..., None]) -> dict[str, Slides]:
    """Return labelled slides; of a calibrated classifier their classes may be others than those that it knows."""
    key = classifier.naming.key
    every = all(shard.attributes.get(key) is not None for shard in recordings.recordings.values())
    return classifier.read(recordings, labelled=not (classifier.known and every), advance=advance)


def _evaluated(classifier: Classifier, slides: Slides, known: set[str]) -> Evaluated:
    """Return the predictions of all predictors for the slides of one sensor."""
    sensor = slides.layout.sensor
    foreign = [index for index, one in enumerate(slides.materials) if int(one) not in classifier.classes]
    if foreign:
        raise TacpipeError(
            f"{slides.names[foreign[0]]} is of {classifier.naming.key} "
            f"{classifier.naming.name(int(slides.materials[foreign[0]]))}, not one of those the model names: "
            f"{listed(classifier.names, 20)}. Leave it out."
        )
    output = classifier.readers[sensor].read(slides.frames)
    predicted = {MODEL: classifier.named(output.scores)}
    if sensor in classifier.last:
        predicted[LAST_EPOCH] = classifier.named(classifier.last[sensor].read(slides.frames).scores)
    params = classifier.params
    mapped = isinstance(params, Raec) and bool(params.frozen_sensor)  # all have the frozen sensor's classifier already
    if classifier.config.get("joint") and output.latents is not None and not mapped:
        predicted[SWAPPED] = _exchanged(classifier, sensor, output.latents)
    for name, by_sensor in classifier.baselines.items():
        frames = slides.frames
        if name != MEAN_LEVEL and output.latents is not None:
            frames = output.latents[:, None]
        fitted = by_sensor[sensor]
        predicted[name] = np.asarray(fitted.classes)[fitted.scores(frames).argmax(axis=1)].astype(np.int64)
    held_out = classifier.config.get("held_out", {}).get(sensor, [])
    counted = np.ones(len(slides), bool)
    if isinstance(params, Raec | XLSTM) and params.drop_last:
        counted[len(slides) // params.batch * params.batch or len(slides) :] = False  # fewer than one batch count all
    found = Evaluated(
        slides,
        np.array([digest in known for digest in slides.digests], bool),
        output,
        predicted,
        np.isin(slides.materials, held_out),
        counted=counted,
    )
    if held_out and output.latents is not None:
        found.zero_shot = _by_another(classifier, sensor, output.latents, held_out)
    return found


def _exchanged(classifier: Classifier, sensor: str, latents: Float32s) -> Int64s:
    """Return the materials that the classifier of another sensor gives latents, in this sensor's names of materials.

    Sensors that were aligned by permuted classes share a space in which one's material lies where another's does; the
    name is then taken back through that permutation.
    """
    scores = _partner_scores(classifier, sensor, latents)
    named = classifier.named(scores)
    partners = {int(one): int(other) for one, other in classifier.config.get("partners", {}).items()}
    first, partner = next(iter(classifier.layouts)), classifier.partner(sensor)
    if not partners or first not in (sensor, partner):
        return named
    back = partners if partner == first else {other: one for one, other in partners.items()}
    return np.array([back[int(one)] for one in named], np.int64)


def _partner_scores(classifier: Classifier, sensor: str, latents: Float32s) -> Float32s:
    own, reader = classifier.readers[sensor], classifier.readers[classifier.partner(sensor)]
    if isinstance(own, SpectraReader):
        return own.expected(latents)
    assert isinstance(reader, NetworkReader)
    return reader.scores_of(latents)


def _by_another(classifier: Classifier, sensor: str, latents: Float32s, held_out: list[int]) -> tuple[Int64s, Int64s]:
    """Return the materials by the classes that other sensors learned: of all materials, and of those held out alone."""
    scores = _partner_scores(classifier, sensor, latents)
    among = np.isin(classifier.classes, held_out)
    return classifier.named(scores), classifier.named(np.where(among, scores, -np.inf))


def _summary(evaluated: Mapping[str, Evaluated], classifier: Classifier, *, seen: bool) -> Tree:
    """Return the metrics on the slides that the model has seen, or on those it has not."""
    chosen = {sensor: (one.seen == seen) & one.counted & ~one.held for sensor, one in evaluated.items()}
    predictors = sorted({name for one in evaluated.values() for name in one.predicted})
    right = {
        name: {sensor: one.right(name, chosen[sensor]) for sensor, one in evaluated.items() if name in one.predicted}
        for name in predictors
    }
    return metrics.summary(right, len(classifier.classes))


def _headlines(evaluated: Mapping[str, Evaluated], classifier: Classifier) -> list[headline.Headline]:
    """Return how the model compares with its baselines on the slides of each sensor that it has not seen."""
    found = []
    for sensor, one in evaluated.items():
        chosen = ~one.seen & one.counted & ~one.held
        names = np.array(one.slides.names)[chosen]
        right = {
            predictor: {
                (0, str(name)): (int(correct), 1)
                for name, correct in zip(names, one.right(predictor, chosen), strict=True)
            }
            for predictor in one.predicted
        }
        made = headlines.headline(classifier.config["architecture"], sensor, right, len(classifier.classes))
        found += [made] if made else []
    return found


def _zero_shot(evaluated: Mapping[str, Evaluated], classifier: Classifier) -> Tree:
    """Return how well another sensor's classifier names materials whose labels a sensor did not learn."""
    every, among, chances = {}, {}, {}
    for sensor, one in evaluated.items():
        if one.zero_shot is None:
            continue
        chosen = one.held & ~one.seen
        every[sensor] = (one.zero_shot[0] == one.slides.materials)[chosen]
        among[sensor] = (one.zero_shot[1] == one.slides.materials)[chosen]
        chances[sensor] = 1 / len(classifier.config["held_out"][sensor])
    if not every:
        return {}
    tree = metrics.accuracy(every)
    tree["chance"] = {sensor: 1 / len(classifier.classes) for sensor in every}
    tree["among_held_out"] = {**metrics.accuracy(among), "chance": chances}
    return tree


def predictions_table(
    evaluated: Mapping[str, Evaluated], classifier: Classifier, sessions: Mapping[str, Any] | None = None
) -> pa.Table:
    """Return one row a slide: what it is, what each predictor named, and the model's scores and latents.

    ``sessions`` maps a slide to its session, where one is recorded.
    """
    named, count = classifier.naming.named, {sensor: len(one.slides) for sensor, one in evaluated.items()}
    columns: list[tuple[pa.Field, Any]] = [
        (pa.field("recording", pa.string()), [name for one in evaluated.values() for name in one.slides.names]),
        (pa.field("sensor", pa.string()), [sensor for sensor, number in count.items() for _ in range(number)]),
        naming.field("material", named(_joined(one.slides.materials for one in evaluated.values())), "label"),
        (pa.field("seen", pa.bool_()), _joined(one.seen for one in evaluated.values())),
    ]
    held = [(sessions or {}).get(name) for one in evaluated.values() for name in one.slides.names]
    columns.append((pa.field("session", pa.string()), [None if one is None else str(one) for one in held]))
    for name in sorted({name for one in evaluated.values() for name in one.predicted}):
        values = [one.predicted.get(name, np.full(len(one.slides), naming.UNKNOWN)) for one in evaluated.values()]
        columns.append(naming.field(name, named(_joined(values)), "prediction"))
    columns += score_columns(classifier, _joined(one.output.scores for one in evaluated.values()))
    latents = [one.output.latents for one in evaluated.values() if one.output.latents is not None]
    if latents:
        columns += latent_columns(_joined(latents))
    arrays = [pa.array(values, field.type) for field, values in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema([field for field, _ in columns]))


def score_columns(classifier: Classifier, scores: Float32s) -> list[tuple[pa.Field, Any]]:
    """Return a column of scores a material."""
    about = {"quantity": "score"}
    return [
        (pa.field(f"score_{name.zfill(2)}", pa.float32(), metadata=about), scores[:, number])
        for number, name in enumerate(classifier.names)
    ]


def latent_columns(latents: Float32s) -> list[tuple[pa.Field, Any]]:
    """Return a column a latent."""
    about = {"quantity": "latent"}
    return [
        (pa.field(f"z{number + 1:02d}", pa.float32(), metadata=about), latents[:, number])
        for number in range(latents.shape[1])
    ]


def _joined(parts: Any) -> Any:
    return np.concatenate(list(parts))
