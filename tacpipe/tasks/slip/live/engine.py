"""Convert the blocks of a live session to probabilities of a slip, one per sample of the first finger.

The engine also keeps the newest plan. The values are those that `SlipModel.table` computes from the recording, to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tacpipe.arrays import AnyFloats, Floats
from tacpipe.live.decoding import Decoder
from tacpipe.live.engine import SETTLE_NS
from tacpipe.sensors.live import OFF, ON
from tacpipe.sensors.plan import NAME as PLAN
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.learning.examples import one_window
from tacpipe.tasks.learning.inputs import InputStream
from tacpipe.tasks.learning.live.engine import WindowEngine
from tacpipe.tasks.learning.live.windows import LiveRow, RecordedWindows
from tacpipe.tasks.slip.live.messages import SlipDescription, SlipMessage
from tacpipe.tasks.slip.model import SlipModel
from tacpipe.tasks.slip.planned import PlannedMotion

DIGITS = 4  # decimal places of published touch


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
        super().__init__(sensors, lambda rest: RecordedWindows(model.reader, rest), settle_ns=settle_ns)
        self._model, self._description, self._level = model, description, level
        self._plans = PlannedMotion()
        self._late_plans = 0

    @property
    def late(self) -> int:
        """Number of samples and plans so far that arrived after the probability for their time."""
        return super().late + self._late_plans

    def describe(self, model: str) -> SlipDescription:
        """Return the description of the session's messages."""
        return self._description

    def begin_recording(self, offset_ns: int) -> None:
        """Begin a recording; plans of the previous one are not in it."""
        super().begin_recording(offset_ns)
        self._plans = PlannedMotion()

    def begin_stream(self, stream: str) -> None:
        """Decode a finger, or plans, from the start of the recording."""
        super().begin_stream(stream)
        if stream == PLAN and self._model.reader.reads_plans:
            self._decoders[stream] = Decoder(self.sensors[stream])

    def push(self, stream: str, samples: Any) -> None:
        """Add samples of a finger, or plans."""
        if stream == PLAN:
            assert isinstance(self.windows, RecordedWindows)
            self._late_plans += int((self._plans.push(samples) <= self.windows.read_ns).sum())
        else:
            super().push(stream, samples)

    def answer(self, row: LiveRow) -> SlipMessage:
        """Return the message for a sample of the first finger."""
        assert row.windows is not None
        reader = self._model.reader
        ahead = [self._plans.ahead(row.t_ns)] if reader.reads_plans else []
        self._plans.forget_before(row.t_ns)
        score = float(self._model.scores(one_window(reader, [*row.windows, *ahead], row.t_ns, row.start_ns))[0])
        probability = float(self._model.calibration.probability(np.array([score]))[0])
        state = ON if score >= self._level else OFF
        touch = {
            finger.stream: np.round(taxel_sizes(finger, window[-1]), DIGITS).tolist()
            for finger, window in zip(reader.streams, row.windows, strict=True)
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
