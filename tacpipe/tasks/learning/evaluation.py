"""Evaluate a model of a label or a quantity next to its baselines, on recordings that it was not trained on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Indices
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.selection import combine_origins
from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.printable import listed
from tacpipe.scores import headline, table
from tacpipe.tasks.learning.answers import Classes
from tacpipe.tasks.learning.examples import Examples
from tacpipe.tasks.learning.model import LearnedModel
from tacpipe.tasks.learning.scores import PREDICTIONS, Answered, method_name

IMPORTANCE_ROWS = 1000  # maximum number of windows in which taxels are permuted


def evaluate(files: Mapping[str, bytes], recordings: Dataset) -> Result:
    """Return the metrics of a model and of its baselines. Raises `TacpipeError` if no unseen recording has an answer."""
    model = LearnedModel.load(files)
    seen = set(model.config["trained_on"].values())
    unseen = [recording for _, recording in sorted(recordings.recordings.items()) if recording.digest not in seen]
    examples = model.labelled(unseen)
    if not len(examples):
        raise TacpipeError(
            f"No recording has a known {listed(model.answers.value_names, 3)}, except those that the model was trained on. "
            f"Give recordings with the role test, with labels."
        )
    answered = Answered.by_model(model, examples)
    names = sorted(set(answered.recordings))
    origin = combine_origins(recordings.recordings[name].attributes for name in names)
    metrics: dict[str, Any] = {**answered.metrics(), "importance": importance(model, examples)}
    method = method_name(model.config["architecture"], model.config["chosen"])
    return Result(
        {PREDICTIONS: RecordingOutput(answered.to_table(), origin)},
        {
            model_files.CONFIG: files[model_files.CONFIG],
            "metrics.json": model_files.to_json(metrics),
            headline.FILE: headline.write(table.headlines(model.config["task"], method, answered.tables())),
        },
        _notes(model, answered),
    )


def importance(model: LearnedModel, examples: Examples) -> dict[str, float]:
    """Return how much larger the mean loss is if the channels of a taxel are those of other windows, by taxel.

    It is a fraction of the loss of the model's outputs (permutation importance: Breiman, Random Forests, 2001).
    """
    examples = examples.select(np.flatnonzero(examples.values[:, 0] >= 0)) if model.params.KIND == "class" else examples
    if len(examples) < 2:
        return {}
    chosen = np.unique(np.linspace(0, len(examples) - 1, IMPORTANCE_ROWS).astype(np.intp))
    examples = examples.select(chosen)
    windows = examples.windows()
    rng = np.random.default_rng(model.params.seed)
    order = rng.permutation(len(examples))
    loss = _mean_loss(model, examples, windows)
    losses = {}
    for name, places in taxels(model).items():
        permuted = [part.copy() for part in windows]
        for stream, channels in places.items():
            permuted[stream][:, :, channels] = windows[stream][order][:, :, channels]
        losses[name] = float(f"{_mean_loss(model, examples, permuted) / max(loss, 1e-12) - 1:.4g}")
    return losses


def taxels(model: LearnedModel) -> dict[str, dict[int, Indices]]:
    """Return the channels of each taxel by stream; a channel without a taxel is one of its own."""
    places: dict[str, dict[int, list[int]]] = {}
    for number, stream in enumerate(model.inputs.streams):
        for channel, (name, about) in enumerate(zip(stream.channels, stream.layout, strict=True)):
            taxel = f"taxel {about['taxel']}" if "taxel" in about else name
            several = len(model.inputs.streams) > 1 or bool(about.get("stream"))
            owner = about.get("stream", stream.stream)
            full = f"{owner} {taxel}" if several and owner and "taxel" in about else taxel
            places.setdefault(full, {}).setdefault(number, []).append(channel)
    return {name: {stream: np.array(own) for stream, own in by_stream.items()} for name, by_stream in places.items()}


def _mean_loss(model: LearnedModel, examples: Examples, windows: Sequence[AnyFloats]) -> float:
    outputs: Floats = model.estimator.outputs(examples.with_windows(windows))
    return float(model.answers.losses(outputs, examples.values).mean())


def _notes(model: LearnedModel, answered: Answered) -> list[str]:
    """Return notes on classes that the model does not know, and on a model that is a baseline."""
    notes = []
    if isinstance(model.answers, Classes) and (unknown := int((answered.true[:, 0] < 0).sum())):
        share = f"{unknown:,} of {len(answered.true):,} windows"
        notes.append(
            f"{share} have a class of {model.answers.label} that the model did not learn; they count as wrong."
        )
    if model.config["chosen_is_baseline"]:
        notes.append(f"The model is the baseline {model.config['chosen'].replace('_', ' ')}; no estimator was better.")
    if level_from := model.config.get("level_from"):
        notes.append(f"The level of {listed(level_from, 3)} was subtracted.")
    elif model.params.recentre:
        notes.append(
            f"The median over all rows of each {model.params.recentre} was subtracted, which a live session cannot know."
        )
    return notes
