"""Evaluate a slip model next to its baselines, on recordings that it was not trained on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyFloats, Floats
from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset
from tacpipe.datasets.selection import combine_origins
from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import RecordingOutput, Result
from tacpipe.scores import headline
from tacpipe.scores.table import MODEL, Question, ScoreTable, headlines, rounded
from tacpipe.tasks.learning.examples import Examples
from tacpipe.tasks.slip import metrics
from tacpipe.tasks.slip.calibration import ScoredTrack
from tacpipe.tasks.slip.metrics import PARTS, QUESTIONS, AreaLayout, WindowScores
from tacpipe.tasks.slip.model import SlipModel
from tacpipe.tasks.slip.training import TASK, labelled_tracks, scored_tracks, scores_of
from tacpipe.tasks.slip.windows import STABLE, read_examples

WINDOWS, EVENTS = "windows", "events.json"


def evaluate(files: Mapping[str, bytes], recordings: Dataset) -> Result:
    """Return the metrics of a model and of its baselines. Raises `TacpipeError` if no unseen recording has slip labels."""
    model = SlipModel.load(files)
    seen = set(model.config["trained_on"].values())
    tracks = [track for track in labelled_tracks(model.reader, recordings) if track.digest not in seen]
    if not tracks:
        raise TacpipeError(
            "No recording has labels of slips, except those that the model was trained on. Give recordings with the role "
            "test, with labels."
        )
    examples = read_examples(model.reader, tracks, model.params)
    outputs = {name: baseline.outputs(examples) for name, baseline in model.baselines.items()}
    scores = {MODEL: model.scores(examples), **{name: scores_of(values) for name, values in outputs.items()}}
    probabilities = {name: 1 / (1 + np.exp(-values)) for name, values in scores.items()}
    probabilities[MODEL] = model.calibration.probability(scores[MODEL])
    evaluated = EvaluatedSlips.from_examples(examples, scores, probabilities, model.calibration.levels)
    architecture = str(model.config["architecture"])
    origin = combine_origins(recordings.recordings[track.name].attributes for track in evaluated.tracks)
    return Result(
        {WINDOWS: RecordingOutput(evaluated.to_table(), origin)},
        {
            model_files.CONFIG: files[model_files.CONFIG],
            "metrics.json": model_files.to_json(evaluated.measure(model.horizon_ns)),
            EVENTS: evaluated.events_json(),
            headline.FILE: headline.write(headlines_of(architecture, evaluated)),
        },
        model.notes(),
    )


@dataclass(frozen=True)
class EvaluatedSlips:
    """The counted windows of evaluated recordings with the scores of all predictors."""

    tracks: tuple[ScoredTrack, ...]  # with the scores of the model
    scores: Mapping[str, tuple[Floats, ...]]  # predictor -> recording -> (row,)
    probabilities: Mapping[str, tuple[Floats, ...]]
    levels: Mapping[str, Mapping[str, float]]  # recording -> false alarms per minute -> level of the model's alarm
    known_objects: frozenset[str] = frozenset()  # objects of the recordings that the model was trained on
    folds: tuple[
        int, ...
    ] = ()  # recording -> its fold, if there are several; scores of different folds are not compared

    @classmethod
    def from_examples(
        cls,
        examples: Examples,
        scores: Mapping[str, Floats],
        probabilities: Mapping[str, Floats],
        levels: Mapping[str, float],
    ) -> EvaluatedSlips:
        """Return the evaluation of windows, by the scores and probabilities (window,) of each predictor."""
        tracks = tuple(scored_tracks(examples, scores[MODEL]))

        def split_by_track(values: Mapping[str, Floats]) -> dict[str, tuple[Floats, ...]]:
            masks = [examples.owner == index for index in range(len(tracks))]
            return {name: tuple(column[mask] for mask in masks) for name, column in values.items()}

        return cls(
            tracks, split_by_track(scores), split_by_track(probabilities), {track.name: levels for track in tracks}
        )

    def pooled(self, others: Sequence[EvaluatedSlips]) -> EvaluatedSlips:
        """Return this evaluation together with those of further folds.

        A recording that several folds test (``split --apart object``) counts once, if possible in a fold that did not train
        on its object.
        """
        fold_and_index: dict[str, tuple[EvaluatedSlips, int]] = {}  # recording -> its fold, and its index in that fold
        for fold in (self, *others):
            for index, track in enumerate(fold.tracks):
                if track.name not in fold_and_index or track.object not in fold.known_objects:
                    fold_and_index[track.name] = (fold, index)
        folds = fold_and_index.values()
        tracks = tuple(fold.tracks[index] for fold, index in folds)
        numbers = {id(fold): number for number, fold in enumerate((self, *others))}
        scores = {name: tuple(fold.scores[name][index] for fold, index in folds) for name in self.scores}
        probabilities = {name: tuple(fold.probabilities[name][index] for fold, index in folds) for name in self.scores}
        levels = {name: fold.levels[name] for name, (fold, _) in fold_and_index.items()}
        return EvaluatedSlips(
            tracks, scores, probabilities, levels, folds=tuple(numbers[id(fold)] for fold, _ in folds)
        )

    def scored_by(self, predictor: str) -> list[ScoredTrack]:
        """Return the recordings with the scores of a predictor."""
        return [
            replace(track, scores=scores) for track, scores in zip(self.tracks, self.scores[predictor], strict=True)
        ]

    @property
    def objects(self) -> dict[str, str]:
        """The object of each recording."""
        return {track.name: track.object for track in self.tracks}

    def tables(self, objects: Iterable[str] = ()) -> dict[str, ScoreTable]:
        """Return the table of scores of each part of `PARTS`.

        ``objects`` are those of all results that are compared, by default of these recordings.
        """
        layout = AreaLayout(objects or self.objects.values())
        folds = self.folds or (0,) * len(self.tracks)
        sums: dict[str, dict[str, dict[str, AnyFloats]]] = {part: {} for part in PARTS}
        for name in self.scores:
            tracks = list(zip(folds, self.scored_by(name), self.probabilities[name], strict=True))
            for number in sorted(set(folds)):
                windows = WindowScores([track for fold, track, _ in tracks if fold == number])
                probabilities = metrics.joined(values for fold, _, values in tracks if fold == number)
                for part in PARTS:
                    sums[part].setdefault(name, {}).update(windows.sums(part, layout, probabilities))
        return {part: ScoreTable(layout.measure(), by_predictor, self.objects) for part, by_predictor in sums.items()}

    def measure(self, horizon_ns: int) -> dict[str, Any]:
        """Return the metrics of each predictor, and the margin of the model over each baseline."""
        tables, windows = self.tables(), WindowScores(self.tracks)
        by_predictor: dict[str, Any] = {}
        for name in self.scores:
            probabilities = metrics.joined(self.probabilities[name])
            by_predictor[name] = {
                "auc": {part: metrics.to_json(table.score(name)) for part, table in tables.items()},
                "brier": rounded(metrics.brier(probabilities, windows.states > STABLE, windows.weights)),
                "accuracy": metrics.accuracy(probabilities, windows),
            }
            if name != MODEL:
                by_predictor[name]["margin"] = metrics.to_json(tables["before"].gain_over(name))
        counts = {
            "recordings": len(self.tracks),
            "objects": windows.object_count,
            "slips": sum(len(track.events) for track in self.tracks),
            "windows": len(windows.scores),
            "before": int((windows.states > STABLE).sum()),
        }
        by_predictor[MODEL]["alarms"] = self.alarms(horizon_ns)
        return {**by_predictor, "counts": counts, "parts": metrics.PARTS}

    def alarms(self, horizon_ns: int) -> dict[str, metrics.SlipAlarmScore]:
        """Return the score of the model's alarm for each rate of false alarms."""
        return {
            rate: metrics.score_alarm(
                self.tracks, {name: levels[rate] for name, levels in self.levels.items()}, horizon_ns
            )
            for rate in next(iter(self.levels.values()))
        }

    def to_table(self) -> pa.Table:
        """Return the table of all windows."""
        sizes = [len(track.t_ns) for track in self.tracks]
        table = {
            "recording": pa.array(np.repeat([track.name for track in self.tracks], sizes)),
            "object": pa.array(np.repeat([track.object for track in self.tracks], sizes)),
            "t_ns": pa.array(np.concatenate([track.t_ns for track in self.tracks]), pa.int64()),
            "since_s": pa.array(np.concatenate([track.since_s for track in self.tracks])),
            "state": pa.array(np.concatenate([track.states for track in self.tracks]), pa.int8()),
            "weight": pa.array(np.concatenate([track.weights for track in self.tracks])),
        }
        for name in self.scores:
            table[f"score_{name}"] = pa.array(np.concatenate(self.scores[name]))
            table[f"probability_{name}"] = pa.array(np.concatenate(self.probabilities[name]))
        return pa.table(table)

    def events_json(self) -> bytes:
        """Return the slips and the alarm levels of each recording."""
        content = {
            track.name: {"object": track.object, "slips": track.events.tolist(), "levels": self.levels[track.name]}
            for track in self.tracks
        }
        return model_files.to_json(content)

    @classmethod
    def from_result(cls, result: Dataset) -> EvaluatedSlips:
        """Return the evaluation that is stored in a result."""
        table = result.recordings[WINDOWS].table()
        events_by_recording = model_files.tree(result.files, EVENTS)
        names = table["recording"].to_numpy(zero_copy_only=False)
        predictors = [name.removeprefix("score_") for name in table.column_names if name.startswith("score_")]
        values = {name: table[name].to_numpy() for name in table.column_names if name not in ("recording", "object")}
        tracks, rows_by_track = [], []
        for name, described in sorted(events_by_recording.items()):
            rows = np.flatnonzero(names == name)
            rows_by_track.append(rows)
            slips = np.array(described["slips"], np.int64).reshape(-1, 2)
            since_s = values["since_s"][rows]
            tracks.append(
                ScoredTrack(
                    name,
                    str(described["object"]),
                    values["t_ns"][rows],
                    values["state"][rows].astype(np.int64),
                    values[f"score_{MODEL}"][rows],
                    slips,
                    values["weight"][rows],
                    since_s,
                )
            )

        def column_by_track(prefix: str) -> dict[str, tuple[Floats, ...]]:
            return {name: tuple(values[f"{prefix}_{name}"][rows] for rows in rows_by_track) for name in predictors}

        levels = {name: described["levels"] for name, described in events_by_recording.items()}
        known = frozenset(model_files.tree(result.files, model_files.CONFIG, {"objects": list})["objects"])
        return cls(tuple(tracks), column_by_track("score"), column_by_track("probability"), levels, known)


def questions(tables: Mapping[str, ScoreTable]) -> dict[Question, ScoreTable]:
    """Return the tables of scores of `QUESTIONS`, which have a verdict."""
    return {
        Question(target=target, place=place): tables[part] for place, (part, target) in enumerate(QUESTIONS.items())
    }


def headlines_of(method: str, evaluated: EvaluatedSlips) -> list[headline.Headline]:
    """Return the areas under the curve of the model next to those of its baselines for each of `QUESTIONS`.

    The intervals are over objects. A question without pairs of windows is omitted.
    """
    compared = headlines(TASK, method, questions(evaluated.tables()))
    return [each for each in compared if np.isfinite(each.model.values[0])]
