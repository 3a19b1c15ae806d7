"""A model's forecasts next to what was measured: each at the time that it is a forecast of."""

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


@dataclass(frozen=True)
class Forecast:
    """What a model predicted of one finger ``step`` rows ahead, and what came; both are changes from rest."""

    step: int
    predicted: Taxels  # its t_ns are the times that were predicted
    measured: Taxels  # at the same times

    @property
    def residual(self) -> Taxels:
        """What the prediction was too high by, taxel by taxel."""
        return replace(self.predicted, change=self.predicted.change - self.measured.change)

    @property
    def error(self) -> Floats:
        """The mean absolute error over the channels (time,), as `tacpipe evaluate` averages it."""
        return np.asarray(np.abs(self.predicted.change - self.measured.change).mean(axis=(1, 2)))


def of_table(table: pa.Table, measured: Sequence[Taxels]) -> list[Forecast]:
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


def of_values(values: Mapping[str, float], measured: Sequence[Taxels]) -> list[Forecast]:
    """Return what a model predicted for the only reading of two BioTac SP, finger by finger, as forecasts of step 0.

    ``values`` are named by target, as `tacpipe.channels.biotac_sp.value_columns` names them.
    """
    found = []
    for taxels in measured:
        target = f"e_{taxels.finger}"
        if target not in biotac_sp.TARGETS or len(taxels.t_ns) != 1:
            continue
        named = dict(zip(biotac_sp.columns(target), biotac_sp.value_columns(target), strict=True))
        if all(named.get(channel) in values for channel in taxels.channels):
            predicted = np.array([values[named[channel]] for channel in taxels.channels], dtype=np.float64)
            found.append(Forecast(0, replace(taxels, change=predicted.reshape(1, -1, 1)), taxels))
    return found


def _of_step(table: pa.Table, t_ns: Times, step: int, there: set[str], taxels: Taxels) -> list[Forecast]:
    prefix = f"{taxels.stream}_" if taxels.stream else ""
    names = [f"{prefix}{channel}_t{step}" for channel in taxels.channels]
    if not set(names) <= there:
        return []
    target_ns = t_ns + step * int(np.median(np.diff(t_ns)))
    within = (target_ns >= taxels.t_ns[0]) & (target_ns <= taxels.t_ns[-1])
    shape = (int(within.sum()), *taxels.change.shape[1:])
    came = linear(taxels.t_ns, taxels.change.reshape(len(taxels.t_ns), -1), target_ns[within])
    predicted = matrix(table, names)[within]
    at = replace(taxels, t_ns=target_ns[within])
    return [Forecast(step, replace(at, change=predicted.reshape(shape)), replace(at, change=came.reshape(shape)))]
