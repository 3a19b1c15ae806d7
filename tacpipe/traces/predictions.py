"""Pair predictions with measurements: forecasts at their target times, and predicted classes with the label."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Floats, Times
from tacpipe.channels import biotac_sp
from tacpipe.channels.schema import field_metadata
from tacpipe.plugins.stage import Attribute
from tacpipe.signals.resampling import linear
from tacpipe.traces.curves import TIME, matrix
from tacpipe.traces.taxels import Taxels


@dataclass(frozen=True)
class DrawnForecast:
    """A prediction for one finger ``step`` rows ahead, and the measured values; both are changes from rest."""

    step: int
    predicted: Taxels  # its t_ns are the predicted times
    measured: Taxels  # measured values at the same times

    @property
    def residual(self) -> Taxels:
        """The prediction minus the measured value, per taxel."""
        return replace(self.predicted, change=self.predicted.change - self.measured.change)

    @property
    def error(self) -> Floats:
        """The mean absolute error over the channels (time,), as `tacpipe evaluate` computes it."""
        return np.asarray(np.abs(self.predicted.change - self.measured.change).mean(axis=(1, 2)))


def forecasts_from_table(table: pa.Table, measured: Sequence[Taxels]) -> list[DrawnForecast]:
    """Return the forecasts in a recording of `tacpipe predict` or `tacpipe evaluate`, by finger and step.

    A column is matched by its name: ``xela1_taxel01_z_t5`` is the channel ``taxel01_z`` of the stream ``xela1``, 5 rows
    ahead. Fingers with missing columns have no forecast. A row's timestamp is that of the last row that the model read.
    """
    if TIME not in table.column_names or table.num_rows < 2:
        return []
    columns_by_step: dict[int, set[str]] = {}
    for field in table.schema:
        step = field_metadata(field).get("step", "0")
        if step.isdigit() and int(step) > 0:
            columns_by_step.setdefault(int(step), set()).add(str(field.name))
    t_ns = table.column(TIME).to_numpy()
    forecasts = []
    for taxels in measured:
        if len(taxels.t_ns) > 1:
            for ahead in sorted(columns_by_step):
                forecasts += _forecasts_for_step(table, t_ns, ahead, columns_by_step[ahead], taxels)
    return forecasts


def forecasts_from_values(values: Mapping[str, Attribute], measured: Sequence[Taxels]) -> list[DrawnForecast]:
    """Return the predictions for a single reading of two BioTac SP sensors, by finger, as forecasts of step 0.

    ``values`` are named by target, see `tacpipe.channels.biotac_sp.value_columns`.
    """
    forecasts = []
    for taxels in measured:
        target = f"e_{taxels.finger}"
        if target not in biotac_sp.TARGETS or len(taxels.t_ns) != 1:
            continue
        value_names = dict(zip(biotac_sp.columns(target), biotac_sp.value_columns(target), strict=True))
        if all(value_names.get(channel) in values for channel in taxels.channels):
            predicted = np.array([values[value_names[channel]] for channel in taxels.channels], dtype=np.float64)
            forecasts.append(DrawnForecast(0, replace(taxels, change=predicted.reshape(1, -1, 1)), taxels))
    return forecasts


def _forecasts_for_step(
    table: pa.Table, t_ns: Times, step: int, columns: set[str], taxels: Taxels
) -> list[DrawnForecast]:
    """Return a list with a finger's forecast of a step, at target times with measurements; empty if columns are missing."""
    prefix = f"{taxels.stream}_" if taxels.stream else ""
    names = [f"{prefix}{channel}_t{step}" for channel in taxels.channels]
    if not set(names) <= columns:
        return []
    target_ns = t_ns + step * int(np.median(np.diff(t_ns)))
    is_measured = (target_ns >= taxels.t_ns[0]) & (target_ns <= taxels.t_ns[-1])
    shape = (int(is_measured.sum()), *taxels.change.shape[1:])
    measured = linear(taxels.t_ns, taxels.change.reshape(len(taxels.t_ns), -1), target_ns[is_measured])
    predicted = matrix(table, names)[is_measured]
    target_taxels = replace(taxels, t_ns=target_ns[is_measured])
    return [
        DrawnForecast(
            step,
            replace(target_taxels, change=predicted.reshape(shape)),
            replace(target_taxels, change=measured.reshape(shape)),
        )
    ]


MODEL, SCORE = "model", "score_"
MAX_CHART_CLASSES = 5  # number of classes in a chart


@dataclass(frozen=True)
class Classification:
    """The predicted classes of one recording and its label, all as text."""

    key: str  # name of the label, such as ``material``
    label: str  # the label of the recording; empty if it has none
    predicted: Mapping[str, str]  # predictor -> class, the model first, without predictors that predicted none
    scores: Mapping[str, float]  # class -> score of the model, in the order of columns

    @property
    def model_class(self) -> str:
        """The class that the model predicted."""
        return self.predicted[MODEL]

    def leading_scores(self) -> dict[str, float]:
        """Return the classes with the largest scores, in descending order; the last may be the label instead.

        >>> Classification("material", "7", {"model": "1"}, {str(number): -number for number in range(9)}).leading_scores()
        {'0': 0, '1': -1, '2': -2, '3': -3, '7': -7}
        """
        order = sorted(self.scores, key=lambda name: -self.scores[name])
        first = order[:MAX_CHART_CLASSES]
        if self.label in self.scores and self.label not in first:
            first[-1] = self.label
        return {name: self.scores[name] for name in first}

    @property
    def sentence(self) -> str:
        """A sentence with the predicted class, and whether it is the label.

        >>> Classification("material", "cork", {"model": "felt"}, {}).sentence
        'material: felt predicted, but labelled cork'
        """
        name = self.model_class
        if not self.label:
            return f"{self.key}: {name} predicted"
        return f"{self.key}: {name} predicted, {'as labelled' if name == self.label else f'but labelled {self.label}'}"


def classification_from_row(row: pa.Table, attributes: Mapping[str, Attribute]) -> Classification | None:
    """Return the classes in a recording's row of `tacpipe predict` or `tacpipe evaluate`, or None if there are none.

    The quantity of a column (``label``, ``prediction``, ``score``) describes its content. In a row of `predict`, the
    column of predicted classes has the label's name; the label is then the recording's attribute.
    """
    values = row.to_pylist()[0]
    by_quantity: dict[str, list[str]] = {}
    for field in row.schema:
        by_quantity.setdefault(field_metadata(field).get("quantity", ""), []).append(str(field.name))
    columns = [name for name in by_quantity.get("prediction", []) if values[name] is not None]
    scores = {_class(name): float(values[name]) for name in by_quantity.get("score", []) if values[name] is not None}
    if not columns or not scores:
        return None
    labels = by_quantity.get("label", [])
    key = labels[0] if labels else columns[0]
    label = values[labels[0]] if labels else attributes.get(key)
    predictions = (
        {name.replace("_", " "): str(values[name]) for name in columns} if labels else {MODEL: str(values[key])}
    )
    if MODEL not in predictions:
        return None
    model_prediction = {MODEL: predictions.pop(MODEL)}
    return Classification(key, "" if label is None else str(label), {**model_prediction, **predictions}, scores)


def _class(column: str) -> str:
    """Return the class of a column of scores; numbers in column names are zero-padded."""
    name = column.removeprefix(SCORE)
    return str(int(name)) if name.isascii() and name.isdigit() else name
