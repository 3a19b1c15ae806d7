"""Answer the windows of a session with a model of quantities or of classes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.io import Json
from tacpipe.live.engine import SETTLE_NS
from tacpipe.models.tensors import one_thread
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.learning import examples
from tacpipe.tasks.learning.answers import Quantities
from tacpipe.tasks.learning.live.messages import (
    BAND,
    ClassDescription,
    ClassMessage,
    EstimateDescription,
    EstimateMessage,
    LearnedDescription,
    LearnedMessage,
)
from tacpipe.tasks.learning.live.windows import LiveRow, LiveWindows, WindowEngine
from tacpipe.tasks.learning.model import LearnedModel
from tacpipe.tasks.learning.uncertainty import ClassProbabilities, ErrorQuantiles


def outputs_of(model: LearnedModel, rows: Sequence[LiveRow]) -> Floats:
    """Return the outputs (row, output) of a model for rows with full windows."""
    outputs = [_outputs(model, row) for row in rows]
    return np.concatenate([np.zeros((0, model.answers.output_count)), *outputs])


def _outputs(model: LearnedModel, row: LiveRow) -> Floats:
    assert row.windows is not None
    with one_thread():
        return model.estimator.outputs(examples.one_window(model.inputs, row.windows, row.t_ns, row.start_ns))


class AnswerEngine(WindowEngine):
    """A live session with a model of quantities or of classes."""

    def __init__(
        self,
        model: LearnedModel,
        sensors: Mapping[str, Sensor],
        open_windows: Callable[[Json | None], LiveWindows],
        *,
        settle_ns: int = SETTLE_NS,
    ) -> None:
        """Start without samples; ``open_windows`` returns windows that continue a beginning, or begin if it is None."""
        super().__init__(sensors, open_windows, settle_ns=settle_ns)
        self._model = model
        uncertainty = model.uncertainty
        self._band = (
            [uncertainty.percents.index(percent) if percent in uncertainty.percents else -1 for percent in BAND]
            if isinstance(uncertainty, ErrorQuantiles)
            else []
        )

    def prepare(self) -> None:
        """Answer windows of zeros."""
        windows = [np.zeros((stream.rows, len(stream.channels))) for stream in self._model.inputs.streams]
        _outputs(self._model, LiveRow(0, 0, 0, list(windows)))

    def describe(self, model: str) -> LearnedDescription:
        """Return the description of the session's messages."""
        answers, rate_hz = self._model.answers, self._model.inputs.streams[0].rate_hz
        if isinstance(answers, Quantities):
            units = tuple(target.unit or "1" for target in answers.targets)
            return EstimateDescription(model, answers.names, units, rate_hz)
        return ClassDescription(model, answers.names, (), rate_hz)

    def answer(self, row: LiveRow) -> LearnedMessage:
        """Return the message with the answer to a row."""
        model, outputs = self._model, _outputs(self._model, row)
        if isinstance(model.answers, Quantities):
            assert isinstance(model.uncertainty, ErrorQuantiles)
            estimates = model.answers.decode(outputs)
            bands = model.uncertainty.bands(estimates)[0]
            ends = [bands[:, place] if place >= 0 else np.full(len(bands), np.nan) for place in self._band]
            units = tuple(target.unit for target in model.answers.targets)
            return EstimateMessage(
                self.next_seq(),
                row.t_ns,
                model.answers.names,
                estimates[0],
                made_from_t_ns=row.arrival_ns,
                band=np.stack(ends),
                units=units,
            )
        assert isinstance(model.uncertainty, ClassProbabilities)
        probabilities = model.uncertainty.probabilities(outputs)
        (answer,) = model.uncertainty.answers(model.answers, probabilities)
        return ClassMessage(
            self.next_seq(),
            row.t_ns,
            model.answers.names,
            probabilities[0],
            made_from_t_ns=row.arrival_ns,
            answer=answer,
        )

    def no_answer(self, t_ns: int, cause: str) -> LearnedMessage:
        """Return a message without an answer."""
        names = self._model.answers.names
        nothing = np.full(len(names), np.nan)
        if isinstance(self._model.answers, Quantities):
            band = np.full((2, len(names)), np.nan)
            return EstimateMessage(self.next_seq(), t_ns, names, nothing, cause=cause, band=band)
        return ClassMessage(self.next_seq(), t_ns, names, nothing, cause=cause)
