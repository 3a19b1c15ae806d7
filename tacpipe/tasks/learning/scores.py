"""Measure answers next to those of baselines: errors of quantities, and accuracy of classes, by recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyFloats, Floats
from tacpipe.datasets.dataset import Dataset
from tacpipe.scores import calibration, intervals
from tacpipe.scores.pairing import Measure
from tacpipe.scores.table import MODEL, Question, ScoreTable, rounded
from tacpipe.tasks.learning.answers import Classes, Quantities, Target
from tacpipe.tasks.learning.examples import Examples
from tacpipe.tasks.learning.model import LearnedModel
from tacpipe.tasks.learning.uncertainty import ClassProbabilities, ErrorQuantiles

PREDICTIONS = "predictions"  # the recording of a result
RECORDING, CLUSTER, TRUE = "recording", "group", "true"
SEPARATOR = " by "  # between target and predictor in names of columns
BAND = (10, 90)  # percents of the band whose coverage is measured


@dataclass(frozen=True)
class Answered:
    """The answers of all predictors for rows of recordings with known answers."""

    recordings: tuple[str, ...]  # (row,)
    clusters: tuple[str, ...]  # (row,), the group of each row's recording
    t_ns: AnyFloats  # (row,)
    answers: Quantities | Classes
    true: Floats  # (row, target), for classes their numbers, -1 for another class
    # predictor -> estimates (row, target), or probabilities (row, class)
    predicted: Mapping[str, Floats]
    bands: Floats | None = None  # (row, target, end) of `BAND`, for quantities

    @classmethod
    def by_model(cls, model: LearnedModel, examples: Examples) -> Answered:
        """Return the answers for examples that the model was not trained on."""
        outputs = {MODEL: model.estimator.outputs(examples)}
        outputs |= {name: baseline.outputs(examples) for name, baseline in model.baselines.items()}
        bands = None
        if isinstance(model.answers, Quantities):
            predicted = {name: model.answers.decode(values) for name, values in outputs.items()}
            if isinstance(model.uncertainty, ErrorQuantiles) and set(BAND) <= set(model.uncertainty.percents):
                places = [model.uncertainty.percents.index(percent) for percent in BAND]
                bands = model.uncertainty.bands(predicted[MODEL])[..., places]
        else:
            assert isinstance(model.uncertainty, ClassProbabilities)
            predicted = {name: calibration.probabilities(values) for name, values in outputs.items()}
            predicted[MODEL] = model.uncertainty.probabilities(outputs[MODEL])
        times = [examples.recordings[owner].t_ns[row] for owner, row in zip(examples.owner, examples.rows, strict=True)]
        return cls(
            tuple(examples.names),
            tuple(examples.example_groups),
            np.array(times),
            model.answers,
            examples.values,
            predicted,
            bands,
        )

    def to_table(self) -> pa.Table:
        """Return the table of all answers."""
        fields = [pa.field(RECORDING, pa.string()), pa.field(CLUSTER, pa.string()), pa.field("t_ns", pa.int64())]
        columns: list[Any] = [list(self.recordings), list(self.clusters), self.t_ns]
        for index, name in enumerate(self.answers.value_names):
            unit = self.answers.targets[index].unit if isinstance(self.answers, Quantities) else ""
            about = {"unit": unit} if unit else {}
            fields.append(pa.field(f"{name}{SEPARATOR}{TRUE}", pa.float64(), metadata=about))
            columns.append(self.true[:, index])
        for predictor, values in self.predicted.items():
            for index, name in enumerate(self.answers.names):
                fields.append(pa.field(f"{name}{SEPARATOR}{predictor}", pa.float64()))
                columns.append(values[:, index])
        if self.bands is not None:
            for index, name in enumerate(self.answers.names):
                for end, percent in enumerate(BAND):
                    fields.append(pa.field(f"{name}{SEPARATOR}p{percent}", pa.float64()))
                    columns.append(self.bands[:, index, end])
        arrays = [pa.array(values, field.type) for values, field in zip(columns, fields, strict=True)]
        return pa.Table.from_arrays(arrays, schema=pa.schema(fields))

    @classmethod
    def from_result(cls, result: Dataset, answers: Quantities | Classes, predictors: Sequence[str]) -> Answered:
        """Return the answers that are stored in a result."""
        table = result.recordings[PREDICTIONS].table()

        def stacked(names: Sequence[str], kind: str) -> Floats:
            return np.stack([table[f"{name}{SEPARATOR}{kind}"].to_numpy() for name in names], axis=1)

        has_bands = f"{answers.names[0]}{SEPARATOR}p{BAND[0]}" in table.column_names
        return cls(
            tuple(table[RECORDING].to_pylist()),
            tuple(table[CLUSTER].to_pylist()),
            table["t_ns"].to_numpy(),
            answers,
            stacked(answers.value_names, TRUE),
            {name: stacked(answers.names, name) for name in predictors},
            np.stack([stacked(answers.names, f"p{percent}") for percent in BAND], axis=2) if has_bands else None,
        )

    @property
    def groups(self) -> dict[str, str]:
        """The group of each recording."""
        return dict(zip(self.recordings, self.clusters, strict=True))

    def tables(self) -> dict[Question, ScoreTable]:
        """Return the table of scores of each target, or of the classes."""
        if isinstance(self.answers, Classes):
            return {Question(): self._table(class_measure(self._unit), self._class_parts)}
        return {
            Question(target=target.name, place=place): self._table(
                quantity_measure(target, self._unit), self._quantity_parts(place)
            )
            for place, target in enumerate(self.answers.targets)
        }

    def _table(self, measure: Measure, parts: Mapping[str, Floats]) -> ScoreTable:
        return ScoreTable.from_rows(measure, self.recordings, parts, self.groups)

    @property
    def _unit(self) -> str:
        return "recordings" if set(self.clusters) == set(self.recordings) else "groups"

    def _quantity_parts(self, target: int) -> dict[str, Floats]:
        assert isinstance(self.answers, Quantities)
        parts = {}
        for name, estimates in self.predicted.items():
            error = self.answers.difference(estimates, self.true)[:, target]
            parts[name] = np.stack([np.ones(len(error)), np.abs(error), np.square(error)], axis=1)
        return parts

    @property
    def _class_parts(self) -> dict[str, Floats]:
        labels = self.true[:, 0].astype(np.intp)
        parts = {}
        for name, probabilities in self.predicted.items():
            right = probabilities.argmax(axis=1) == labels
            own = np.where(labels >= 0, probabilities[np.arange(len(labels)), np.maximum(labels, 0)], 0.0)
            losses = -np.log(np.maximum(own, calibration.MIN_PROBABILITY))
            parts[name] = np.stack([np.ones(len(labels)), right.astype(np.float64), losses], axis=1)
        return parts

    def metrics(self) -> dict[str, Any]:
        """Return the values of each predictor by target, with their intervals and the coverage of the band."""
        by_target: dict[str, Any] = {}
        for index, (question, table) in enumerate(self.tables().items()):
            own = table.to_json()
            if self.bands is not None:
                inside = (self.true[:, index] >= self.bands[:, index, 0]) & (
                    self.true[:, index] <= self.bands[:, index, 1]
                )
                own["band"] = {"percent": BAND[1] - BAND[0], "covered": rounded(100 * inside.mean())}
            by_target[question.target or "classes"] = own
        counts = {
            "rows": len(self.recordings),
            "recordings": len(set(self.recordings)),
            "groups": len(set(self.clusters)),
        }
        return {**by_target, "counts": counts}


def method_name(architecture: str, chosen: str) -> str:
    """Return the name of a model in tables, with the estimator that cross-validation chose.

    >>> method_name("auto", "last_row"), method_name("trees", "trees")
    ('auto (last row)', 'trees')
    """
    return architecture if architecture == chosen else f"{architecture} ({chosen.replace('_', ' ')})"


def quantity_measure(target: Target, cluster: str) -> Measure:
    """Return the `Measure` of the mean absolute error of a target; sums are rows, absolute and squared errors."""

    def mean(sums: AnyFloats, part: int = 1) -> AnyFloats:
        return np.where(sums[:, 0] > 0, sums[:, part] / np.maximum(sums[:, 0], 1), np.nan)

    def values(sums: AnyFloats) -> tuple[float, ...]:
        return float(mean(sums[None])[0]), float(np.sqrt(mean(sums[None], 2)[0]))

    unit = f" ({target.unit})" if target.unit and target.unit != "1" else ""
    return Measure(
        (f"mean absolute error{unit}", f"RMSE{unit}"),
        target.unit or "1",
        "the mean absolute error",
        "skill",
        cluster,
        mean,
        intervals.skill,
        values,
        scored=f"mean absolute error{unit}",
        weight=lambda sums: sums[:, 1],
        reference="constant",
    )


def class_measure(cluster: str) -> Measure:
    """Return the `Measure` of the accuracy of classes; sums are rows, right answers and log losses."""

    def wrong(sums: AnyFloats) -> AnyFloats:
        return np.where(sums[:, 0] > 0, 1 - sums[:, 1] / np.maximum(sums[:, 0], 1), np.nan)

    return Measure(
        ("accuracy (%)", "log loss"),
        "percent of windows",
        "accuracy",
        "points",
        cluster,
        wrong,
        lambda error, baseline: 100 * (baseline - error),
        lambda sums: (100 * (1 - float(wrong(sums[None])[0])), float(sums[2] / sums[0]) if sums[0] else float("nan")),
        lambda error: 100 * (1 - error),
        "accuracy (%)",
        rises=True,
        weight=lambda sums: sums[:, 0],
        reference="constant",
    )
