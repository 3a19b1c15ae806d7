"""A rule on the forecast of a model of the task forward: the predicted rise and fall of shear, relative to the load.

The shear of an object that is about to slip rises until friction is overcome, and then drops. The score of a forecast is
the rise from its first step plus the fall after it, at the step at which the sum is largest, over the normal load. It is
the largest of all fingers. The model is opened by its path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

import tacpipe
from tacpipe.arrays import AnyArray, AnyFloats, Floats, Indices
from tacpipe.channels.schema import field_metadata
from tacpipe.codecs import tactile
from tacpipe.datasets.dataset import Model, Recording
from tacpipe.errors import TacpipeError
from tacpipe.tasks.recordings import OpenedChain, open_for_model
from tacpipe.tasks.slip.windows import FingerReader, GraspTrack
from tacpipe.tasks.task import PredictionRequest, task_of_model

STEPS = (1, 3, 5, 10)  # steps ahead of the forecasts
SMALLEST_LOAD = 1e-3  # minimum divisor, as a fraction of the largest load of a recording


def rise_and_fall(shear: AnyFloats, load: AnyFloats) -> Floats:
    """Return the score (row,) of forecasts of shear (row, step) at a normal load (row,).

    >>> rise_and_fall(np.array([[1.0, 3.0, 2.0], [1.0, 1.0, 1.0]]), np.array([2.0, 2.0])).tolist()
    [1.5, 0.0]
    """
    lowest = np.minimum.accumulate(shear[:, ::-1], axis=1)[:, ::-1]
    moved = ((shear - shear[:, :1]) + (shear - lowest)).max(axis=1)
    smallest = SMALLEST_LOAD * max(float(load.max(initial=0.0)), 1.0)
    return np.asarray(moved / np.maximum(load, smallest))


def score_forecasts(table: pa.Table) -> Floats:
    """Return the score of each row of a table of forecasts, by the metadata of its columns; 0 without shear."""
    columns: dict[tuple[str, str, int], list[str]] = {}
    for field in table.schema:
        about = field_metadata(field)
        if about.get("quantity") == "prediction" and "axis" in about and "quantile" not in about:
            columns.setdefault((about.get("stream", ""), about["axis"], int(about["step"])), []).append(field.name)
    steps = sorted({step for _, _, step in columns})
    scores = np.zeros(table.num_rows)

    def mean(stream: str, axis: str, step: int) -> Floats:
        names = columns.get((stream, axis, step), [])
        return np.asarray(tactile.matrix(table, names).mean(axis=1)) if names else np.zeros(table.num_rows)

    for stream in sorted({stream for stream, _, _ in columns}):
        shear = np.stack([np.hypot(mean(stream, "x", step), mean(stream, "y", step)) for step in steps], axis=1)
        scores = np.maximum(scores, rise_and_fall(shear, np.abs(mean(stream, "z", steps[0]))))
    return scores


@dataclass(frozen=True)
class RuleScorer:
    """The rule on the forecasts of one model."""

    path: str
    digest: str
    runs_live: bool = False  # the forecasts come from another model

    @cached_property
    def _forward_model(self) -> Model:
        """The model, opened once for all tracks."""
        return tacpipe.open(Path(self.path))

    def forecasts(self, recording: Recording) -> pa.Table:
        """Return the forecasts of a recording, with the metadata of their columns, which `ForwardModel.predict` lacks."""
        model = self._forward_model
        opened = open_for_model(recording, OpenedChain(model))
        result = task_of_model(model.files, self.path).predict(model, opened, PredictionRequest(STEPS))
        (output,) = result.recordings.values()
        rows = output.streams[""]
        return rows if isinstance(rows, pa.Table) else rows.read_all()

    def score(self, reader: FingerReader, track: GraspTrack, rows: Indices) -> Floats:
        """Return the scores of rows of a track (row,), each by the newest forecast; 0 before the first one.

        Raises `TacpipeError` for a track without recording.
        """
        if track.recording is None:
            raise TacpipeError("The rule needs the recordings of a dataset. Give a dataset instead of a table.")
        table = self.forecasts(track.recording)
        scores = np.append(score_forecasts(table), 0.0)
        times = table["t_ns"].to_numpy()
        return scores[np.searchsorted(times, track.t_ns[rows], side="right") - 1]

    def score_features(self, features: Floats) -> None:
        """Return None, because the rule reads forecasts instead of features."""
        return

    def score_window(self, reader: FingerReader, windows: Sequence[AnyFloats]) -> float:
        """Raise `TacpipeError`, because single windows have no forecast."""
        raise TacpipeError("The rule on forecasts does not run live. Train a model with --architecture boosting.")

    def arrays(self) -> dict[str, AnyArray]:
        """Return an empty array, because the rule learns nothing."""
        return {"none": np.zeros(1)}

    def describe(self) -> dict[str, object]:
        """Return the forward model."""
        return {"forward_model": self.path, "forward_digest": self.digest}

    @classmethod
    def load(cls, arrays: Mapping[str, AnyArray], described: Mapping[str, Any]) -> RuleScorer:
        """Return the rule that `describe` wrote."""
        return cls(str(described["forward_model"]), str(described["forward_digest"]))
