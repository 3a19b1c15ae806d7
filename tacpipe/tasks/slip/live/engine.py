"""Convert the blocks of a live session to probabilities of a slip, one per sample of the first finger.

The values are those that `SlipModel.table` computes from the recording, to the bit.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats, Floats
from tacpipe.io import Json
from tacpipe.live.engine import SETTLE_NS
from tacpipe.sensors.live import OFF, ON
from tacpipe.sensors.plan import NAME as PLAN
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.learning.examples import one_window
from tacpipe.tasks.learning.inputs import InputStream
from tacpipe.tasks.learning.live.windows import LiveRow, LiveWindows, RecordedWindows, WindowEngine
from tacpipe.tasks.slip.live.messages import SlipDescription, SlipMessage
from tacpipe.tasks.slip.model import SlipModel
from tacpipe.tasks.slip.planned import PlannedMotion
from tacpipe.tasks.slip.windows import FingerReader

DIGITS = 4  # decimal places of published touch


class PlannedWindows(RecordedWindows):
    """Windows of the fingers, and of the plan that a model reads."""

    def __init__(self, reader: FingerReader, beginning: Json | None) -> None:
        """Start without samples; ``beginning`` has the levels at rest that were measured before."""
        super().__init__(reader, beginning)
        self._reads_plans = reader.reads_plans
        self._plans = PlannedMotion()
        if self._reads_plans:
            self._late[PLAN] = 0

    @property
    def streams(self) -> Collection[str]:
        """The fingers, and the plan if the model reads it."""
        return (*super().streams, *([PLAN] if self._reads_plans else []))

    def push(self, stream: str, samples: Any) -> None:
        """Add samples of a finger, or plans, in the order of arrival."""
        if stream == PLAN:
            self._late[PLAN] += int((self._plans.push(samples) <= self.read_ns).sum())
        else:
            super().push(stream, samples)

    def take_over(self, previous: LiveWindows) -> None:
        """Take the plans of earlier windows of the session."""
        assert isinstance(previous, PlannedWindows)
        self._plans = previous._plans

    def _row(self, t_ns: int, arrival_ns: int) -> LiveRow:
        """Return the row at a time with its windows, and the planned motion as the last one."""
        row = super()._row(t_ns, arrival_ns)
        if not self._reads_plans or row.windows is None:
            return row
        ahead = self._plans.ahead(t_ns)
        self._plans.forget_before(t_ns)
        return row._replace(windows=[*row.windows, ahead])


class SlipEngine(WindowEngine):
    """A live session with a slip model."""

    def __init__(
        self,
        model: SlipModel,
        sensors: Mapping[str, Sensor],
        description: SlipDescription,
        level: float,
        *,
        settle_ns: int = SETTLE_NS,
    ) -> None:
        """Start without samples; ``level`` is the score from which the alarm is on."""
        super().__init__(sensors, lambda beginning: PlannedWindows(model.reader, beginning), settle_ns=settle_ns)
        self._model, self._description, self._level = model, description, level

    def describe(self, model: str) -> SlipDescription:
        """Return the description of the session's messages."""
        return self._description

    def answer(self, row: LiveRow) -> SlipMessage:
        """Return the message for a sample of the first finger."""
        assert row.windows is not None
        reader = self._model.reader
        score = float(self._model.scores(one_window(reader, row.windows, row.t_ns, row.start_ns))[0])
        probability = float(self._model.calibration.probability(np.array([score]))[0])
        state = ON if score >= self._level else OFF
        touch = {
            finger.stream: np.round(taxel_sizes(finger, window[-1]), DIGITS).tolist()
            for finger, window in zip(reader.streams, row.windows, strict=False)
        }
        return SlipMessage(self.next_seq(), row.t_ns, probability, score, state, touch, made_from_t_ns=row.arrival_ns)

    def no_answer(self, t_ns: int, cause: str) -> SlipMessage:
        """Return a message without a probability."""
        return SlipMessage(self.next_seq(), t_ns, cause=cause)


def taxel_sizes(finger: InputStream, values: AnyFloats) -> Floats:
    """Return the size of the values (channel,) of each taxel (taxel,), in the order of the first channels of the taxels."""
    names = [place.get("taxel", str(number)) for number, place in enumerate(finger.layout)]
    order = {name: number for number, name in enumerate(dict.fromkeys(names))}
    squares = np.zeros(len(order))
    np.add.at(squares, [order[name] for name in names], np.square(values))
    return np.asarray(np.sqrt(squares))
