"""Pair predictions with measurements: forecasts at their target times, and classes next to the label."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tacpipe.arrays import Floats, Times
from tacpipe.channels import biotac_sp
from tacpipe.signals.resampling import linear
from tacpipe.traces.curves import TIME, described, matrix
from tacpipe.traces.taxels import Taxels

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.plugins.stage import Attribute


@dataclass(frozen=True)
class DrawnForecast:
    """A model's prediction for one finger ``step`` rows ahead and the measured values; both are changes from rest."""

    step: int
    predicted: Taxels  # its t_ns are the times that were predicted
    measured: Taxels  # measured values at the same times

    @property
    def residual(self) -> Taxels:
        """The prediction minus the measured value, per taxel."""
        return replace(self.predicted, change=self.predicted.change - self.measured.change)

    @property
    def error(self) -> Floats:
        """The mean absolute error over the channels (time,), as `tacpipe evaluate` averages it."""
        return np.asarray(np.abs(self.predicted.change - self.measured.change).mean(axis=(1, 2)))


def of_table(table: pa.Table, measured: Sequence[Taxels]) -> list[DrawnForecast]:
    """Return the forecasts in a recording of `tacpipe predict`, or of `tacpipe evaluate`, finger by finger, step by step.

    A column is matched by its name: ``xela1_taxel01_z_t5`` is the channel ``taxel01_z`` of the stream ``xela1``, 5 rows
    ahead. Fingers without a column for each channel have no forecast. A row's stamp is the last row that the model read.
    """
    if TIME not in table.column_names or table.num_rows < 2:
        return []
    by_step: dict[int, set[str]] = {}
    for field in table.schema:
        step = described(field).get("step", "0")
        if step.isdigit() and int(step) > 0:
            by_step.setdefault(int(step), set()).add(str(field.name))
    t_ns = table.column(TIME).to_numpy()
    return [
        forecast
        for taxels in measured
        if len(taxels.t_ns) > 1
        for step in sorted(by_step)
        for forecast in _of_step(table, t_ns, step, by_step[step], taxels)
    ]


def of_values(values: Mapping[str, Attribute], measured: Sequence[Taxels]) -> list[DrawnForecast]:
    """Return what a model predicted for the only reading of two BioTac SP, finger by finger, as forecasts of step 0.

    ``values`` are named by target, as `tacpipe.channels.biotac_sp.value_columns` names them.
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


def _of_step(table: pa.Table, t_ns: Times, step: int, columns: set[str], taxels: Taxels) -> list[DrawnForecast]:
    prefix = f"{taxels.stream}_" if taxels.stream else ""
    names = [f"{prefix}{channel}_t{step}" for channel in taxels.channels]
    if not set(names) <= columns:
        return []
    target_ns = t_ns + step * int(np.median(np.diff(t_ns)))
    covered = (target_ns >= taxels.t_ns[0]) & (target_ns <= taxels.t_ns[-1])
    shape = (int(covered.sum()), *taxels.change.shape[1:])
    measured = linear(taxels.t_ns, taxels.change.reshape(len(taxels.t_ns), -1), target_ns[covered])
    predicted = matrix(table, names)[covered]
    at = replace(taxels, t_ns=target_ns[covered])
    return [
        DrawnForecast(step, replace(at, change=predicted.reshape(shape)), replace(at, change=measured.reshape(shape)))
    ]


MODEL, SCORE = "model", "score_"
LEADING = 5  # names of a chart


@dataclass(frozen=True)
class Classification:
    """The predicted classes of one recording next to its label, all as text."""

    key: str  # name of the label, such as ``material``
    label: str  # label of the recording, empty without one
    predicted: Mapping[str, str]  # class by predictor, the model first; predictors without an answer are left out
    scores: Mapping[str, float]  # scores of the model by class, in the order of columns

    @property
    def of_model(self) -> str:
        """The class that the model predicted."""
        return self.predicted[MODEL]

    def leading(self) -> dict[str, float]:
        """Return the names of the largest scores, the largest first, and that of the label behind them.

        >>> Classification("material", "7", {"model": "1"}, {str(one): -one for one in range(9)}).leading()
        {'0': 0, '1': -1, '2': -2, '3': -3, '7': -7}
        """
        order = sorted(self.scores, key=lambda name: -self.scores[name])
        first = order[:LEADING]
        if self.label in self.scores and self.label not in first:
            first[-1] = self.label
        return {name: self.scores[name] for name in first}

    @property
    def sentence(self) -> str:
        """A sentence with the predicted class, and whether it is the label.

        >>> Classification("material", "cork", {"model": "felt"}, {}).sentence
        'material: felt predicted, but labelled cork'
        """
        name = self.of_model
        if not self.label:
            return f"{self.key}: {name} predicted"
        return f"{self.key}: {name} predicted, {'as labelled' if name == self.label else f'but labelled {self.label}'}"


def of_row(row: pa.Table, attributes: Mapping[str, Attribute]) -> Classification | None:
    """Return the names in a recording's row of `tacpipe predict`, or of `tacpipe evaluate`, or None if it has none.

    The quantity of a column (``label``, ``prediction``, ``score``) states what it holds. A row of `predict` names the
    recording in a column of the label's own name; the label is then the recording's.
    """
    values = row.to_pylist()[0]
    by_quantity: dict[str, list[str]] = {}
    for field in row.schema:
        by_quantity.setdefault(described(field).get("quantity", ""), []).append(str(field.name))
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
    first = {MODEL: predictions.pop(MODEL)}
    return Classification(key, "" if label is None else str(label), {**first, **predictions}, scores)


def _class(column: str) -> str:
    """Return the name that a column of scores is of: numbers were filled with zeros.

    >>> _class("score_03"), _class("score_00"), _class("score_cork")
    ('3', '0', 'cork')
    """
    name = column.removeprefix(SCORE)
    return str(int(name)) if name.isascii() and name.isdigit() else name
