"""Convert the blocks of a live session to probabilities of a slip, one per sample of the first finger.

The engine keeps the last rows of each finger and the newest plan, and computes a probability as soon as all samples that
arrived by then have been decoded. The values are those that `SlipModel.table` computes from the recording, to the bit.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import AnyFloats, Floats, Times
from tacpipe.io import Json
from tacpipe.live.decoding import Decoder
from tacpipe.live.engine import SETTLE_NS, Engine
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import LOST
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.live import OFF, ON
from tacpipe.sensors.plan import NAME as PLAN
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.slip.live.messages import SlipDescription, SlipMessage
from tacpipe.tasks.slip.model import SlipModel
from tacpipe.tasks.slip.planned import PlannedMotion
from tacpipe.tasks.slip.windows import Finger, fill_missing, measure_rest

EVERY_NS = 1_000_000  # time between two checks for new samples
BEHIND = 4  # maximum number of probabilities that are computed at once; older ones are skipped
SILENT_NS = 250_000_000  # time without a sample after which a message reports it
SPARE_ROWS = 512  # number of rows that are retained in addition to a window
DIGITS = 4  # decimal places of published touch


@dataclass(frozen=True)
class RestLevels:
    """The levels at rest, with which another process can continue the recording."""

    by_stream: Mapping[str, list[float]]

    def to_json(self) -> Json:
        """Return the levels by stream."""
        return {"rest": dict(self.by_stream)}


class FingerSoFar:
    """The rows of a finger up to now."""

    def __init__(self, finger: Finger, rest_ns: int, rest: list[float] | None = None) -> None:
        """Start without rows; ``rest`` are levels that were measured before, None to measure them over ``rest_ns``."""
        self.finger, self.rest_ns = finger, rest_ns
        self.rest: Floats | None = np.array(rest) if rest is not None else None
        self._first: list[tuple[Times, AnyFloats]] = []  # batches of rows before the rest level is measured
        self._filled = np.zeros(len(finger.scale))  # the newest value of each channel
        self.t_ns: Times = np.zeros(0, np.int64)
        self.values: AnyFloats = np.zeros((0, len(finger.scale)))
        self._dropped = 0  # number of rows that have been dropped
        self._begin = 0  # first row after the rest level was measured

    def add(self, t_ns: Times, raw: AnyFloats) -> None:
        """Append rows with times (row,) and values (row, channel). They are buffered until the rest level is measured."""
        times, values = t_ns, raw
        if self.rest is None:
            self._first.append((t_ns, raw))
            times, values = (np.concatenate([batch[part] for batch in self._first]) for part in (0, 1))
            measured = measure_rest(times, values, self.rest_ns)
            if measured is None:
                return
            self.rest, self._begin = measured
            self._first = []
        scaled = fill_missing((values - self.rest) / self.finger.scale, self._filled)
        if len(scaled):
            self._filled = scaled[-1]
        self.t_ns, self.values = np.concatenate([self.t_ns, times]), np.concatenate([self.values, scaled])
        retained_rows = self.finger.rows + SPARE_ROWS
        if len(self.t_ns) > 2 * retained_rows:
            self._dropped += len(self.t_ns) - retained_rows
            self.t_ns, self.values = self.t_ns[-retained_rows:], self.values[-retained_rows:]

    def newest_row(self, t_ns: int) -> int:
        """Return the index of the newest row at a time; -1 before the first one."""
        return int(np.searchsorted(self.t_ns, t_ns, side="right")) - 1

    def window(self, t_ns: int) -> AnyFloats | None:
        """Return the window (time, channel) of the newest row at a time, or None if it is not full."""
        row = self.newest_row(t_ns)
        if row + self._dropped < self._begin + self.finger.rows - 1 or row + 1 < self.finger.rows:
            return None
        return self.values[row + 1 - self.finger.rows : row + 1]


class SlipEngine(Engine):
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
        super().__init__(sensors, settle_ns)
        self._model, self._description, self._level = model, description, level
        self._late = 0
        self._rest: Mapping[str, list[float]] = {}
        self._decoders: dict[str, Decoder] = {}
        self._columns: dict[str, tuple[int, ...]] = {}
        self._plans = PlannedMotion()
        self._pending: deque[int] = deque()  # times of samples of the first finger without a probability
        self._read_ns = 0  # time of the newest probability
        self._heard_ns: int | None = None  # monotonic time of the latest message
        self._why = ""
        self._restart()

    @property
    def late(self) -> int:
        """Number of samples so far that arrived after the probability for their time."""
        return self._late

    @property
    def beginning(self) -> RestLevels | None:
        """The levels at rest; None until all are measured."""
        levels = {name: so_far.rest for name, so_far in self._fingers.items()}
        measured = {name: level.tolist() for name, level in levels.items() if level is not None}
        return RestLevels(measured) if len(measured) == len(levels) else None

    def describe(self, model: str) -> SlipDescription:
        """Return the description of the session's messages."""
        return self._description

    def continue_recording(self, beginning: str) -> None:
        """Take the levels at rest of a process that ended."""
        self._rest = json.loads(beginning)["rest"]

    def begin_recording(self, offset_ns: int) -> None:
        """Begin a recording; plans of the previous one are not in it."""
        self._decoders = {}
        self._plans = PlannedMotion()
        self._restart(self._rest)
        self._rest = {}
        self._heard_ns = None

    def overflow(self) -> None:
        """Continue without the rows so far, because blocks were dropped."""
        super().overflow()
        if self.running:
            levels = self.beginning
            self._restart(levels.by_stream if levels is not None else {})
            self._why = "blocks were dropped under overload"

    def begin_stream(self, stream: str) -> None:
        """Decode a stream from the start of the recording."""
        if stream in self._fingers or (stream == PLAN and self._model.reader.reads_plans):
            self._decoders[stream] = Decoder(self.sensors[stream])

    def take_note(self, stream: str, note: StreamNote) -> None:
        """Process a note on a stream; lost bytes are reported to its decoder."""
        super().take_note(stream, note)
        if note.what == LOST and stream in self._decoders:
            self._decoders[stream].take(note)

    def take_chunks(self, stream: str, chunks: Chunks) -> None:
        """Store bytes of a finger or of plans."""
        if stream in self._decoders:
            self._decoders[stream].take(chunks)

    def due_ns(self, now_ns: int) -> int:
        """Return when `step` must be called next."""
        return now_ns + EVERY_NS

    def step(self, now_ns: int) -> list[SlipMessage]:
        """Return the message of each sample whose time has come."""
        if self._offset_ns is None:
            return []
        began_s = time.perf_counter()
        self._decode(self._offset_ns)
        until_ns = now_ns + self._offset_ns - self.settle_ns
        due = []
        while self._pending and self._pending[0] <= until_ns:
            due.append(self._pending.popleft())
        self.skipped += max(0, len(due) - BEHIND)
        messages = [self._predict(t_ns) for t_ns in due[-BEHIND:]]
        if not messages:
            return self._silence(now_ns)
        self._heard_ns = now_ns
        for message in messages:
            message.skipped, message.late = self.skipped, self._late
            message.compute_ms = (time.perf_counter() - began_s) * 1e3 / len(messages)
        return messages

    def _restart(self, rest: Mapping[str, list[float]] | None = None) -> None:
        """Discard all rows; ``rest`` are known levels at rest by stream, others are measured again."""
        reader = self._model.reader
        self._fingers = {
            finger.stream: FingerSoFar(finger, reader.rest_ns, (rest or {}).get(finger.stream))
            for finger in reader.fingers
        }
        self._pending.clear()
        self._read_ns, self._why = 0, ""

    def _decode(self, offset_ns: int) -> None:
        """Decode new samples and plans, and note the times of the first finger's samples."""
        first = self._model.reader.fingers[0].stream
        for name, decoder in self._decoders.items():
            for batch in decoder.batches():
                columns = decoder.columns(batch, offset_ns)
                if name == PLAN:
                    self._late += int((self._plans.push(columns) <= self._read_ns).sum())
                    continue
                if name not in self._columns:
                    names = self._fingers[name].finger.channels
                    self._columns[name] = tuple(columns.schema.get_field_index(channel) for channel in names)
                t_ns = np.asarray(columns.column(0), np.int64)
                self._late += int((t_ns <= self._read_ns).sum())
                self._fingers[name].add(t_ns, columns.columns_of(self._columns[name]))
                if name == first:
                    self._pending.extend(t_ns.tolist())

    def _predict(self, t_ns: int) -> SlipMessage:
        """Return the message for the sample of the first finger at ``t_ns``, with a cause if a window is not full."""
        windows = [self._fingers[finger.stream].window(t_ns) for finger in self._model.reader.fingers]
        self._read_ns = max(self._read_ns, t_ns)
        missing = [
            finger.stream for finger, window in zip(self._model.reader.fingers, windows, strict=True) if window is None
        ]
        if missing:
            cause = self._why or f"the window of {', '.join(missing)} is being filled"
            return SlipMessage(self.next_seq(), t_ns, cause=cause)
        self._why = ""
        full = [window for window in windows if window is not None]
        ahead = [self._plans.ahead(t_ns)] if self._model.reader.reads_plans else []
        self._plans.forget_before(t_ns)
        score = self._model.scorer.score_window(self._model.reader, [*full, *ahead])
        probability = float(self._model.calibration.probability(np.array([score]))[0])
        newest = [int(so_far.t_ns[so_far.newest_row(t_ns)]) for so_far in self._fingers.values()]
        state = ON if score >= self._level else OFF
        touch = {
            finger.stream: np.round(taxel_sizes(finger, window[-1]), DIGITS).tolist()
            for finger, window in zip(self._model.reader.fingers, full, strict=True)
        }
        return SlipMessage(self.next_seq(), t_ns, probability, score, state, touch, made_from_t_ns=max(newest))

    def _silence(self, now_ns: int) -> list[SlipMessage]:
        """Return a message without a probability if there was no sample for too long, else nothing."""
        assert self._offset_ns is not None
        if self._heard_ns is None:
            self._heard_ns = now_ns
        if now_ns - self._heard_ns < SILENT_NS:
            return []
        self._heard_ns = now_ns
        first = self._model.reader.fingers[0].stream
        message = SlipMessage(self.next_seq(), now_ns + self._offset_ns, cause=f"no sample comes from {first}")
        message.skipped, message.late = self.skipped, self._late
        return [message]


def taxel_sizes(finger: Finger, values: AnyFloats) -> Floats:
    """Return the size of the values (channel,) of each taxel (taxel,), in the order of the first channels of the taxels."""
    names = [place.get("taxel", str(number)) for number, place in enumerate(finger.layout)]
    order = {name: number for number, name in enumerate(dict.fromkeys(names))}
    squares = np.zeros(len(order))
    np.add.at(squares, [order[name] for name in names], np.square(values))
    return np.asarray(np.sqrt(squares))
