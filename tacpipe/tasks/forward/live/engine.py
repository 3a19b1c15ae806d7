"""Forecast at each grid point of a live session, as soon as its samples have arrived.

If several grid points are due, this process fell behind: the newest is published, and the others are counted as
skipped.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from tacpipe.live import messages
from tacpipe.live.decoding import Decoder, batch_schema, likely_schema
from tacpipe.live.engine import SETTLE_NS, Engine
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import BEGAN
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.plan import NAME as PLAN
from tacpipe.sensors.sensor import Sensor
from tacpipe.tasks.forward.live.chain import Beginning, Cause, GridForecast
from tacpipe.tasks.forward.live.messages import ForecastDescription, ForecastMessage

if TYPE_CHECKING:
    import pyarrow as pa


PERIODS = 2.0  # periods without a forecast after which a message reports the cause
SLACK_NS = 5_000_000  # additional time that is allowed for jitter
EARLY_NS = 1_500_000  # time before a row is due at which earlier samples are decoded
LITTLE_NS = 300_000  # minimum wait for which the process sleeps instead of polling
STARTING_S = 0.005  # wait between two attempts while the grid is unknown
# Until the rest level is known, rows wait this long for samples that other threads have read but not passed yet: one that
# is missing would change the level of the whole session.
RESTING_NS = 250_000_000


class CausalChain(Protocol):
    """The part of `tacpipe.tasks.forward.live.chain.LiveChain` that an engine uses."""

    @property
    def streams(self) -> tuple[str, ...]:
        """The names of the streams that are read."""

    @property
    def master(self) -> str:
        """The stream whose samples start the grid."""

    @property
    def rate_hz(self) -> float:
        """Grid points per second."""

    @property
    def horizon(self) -> int:
        """The number of predicted steps."""

    @property
    def channels(self) -> tuple[str, ...]:
        """The names of the predicted channels."""

    @property
    def layout(self) -> tuple[Mapping[str, str], ...]:
        """Stream, taxel and axis of each channel."""

    @property
    def unit(self) -> str:
        """The unit of the predicted channels."""

    @property
    def late(self) -> Mapping[str, int]:
        """The number of late samples, by stream."""

    @property
    def beginning(self) -> Beginning | None:
        """The state that a chain needs to continue the session; None until it is known."""

    @property
    def rest_rows(self) -> str:
        """The rows that gave the level at rest, in words."""

    def push(self, stream: str, batch: Any) -> None:
        """Add samples of a stream."""

    def continue_cameras(self, previous: Any) -> None:
        """Continue the channels of the cameras of an earlier chain."""

    def advance(self, t_ns: int, *, newest_only: bool = False) -> list[GridForecast]:
        """Return the forecasts up to a time, or optionally of the newest grid point only."""


Opened = Callable[[Mapping[str, "pa.Schema"], "Beginning | None"], CausalChain]


class ForecastEngine(Engine):
    """Run the forecasts of a live session, with a new chain for each recording and after blocks were discarded."""

    def __init__(
        self,
        sensors: Mapping[str, Sensor],
        opened: Opened,
        steps: Sequence[int] | None = None,
        *,
        settle_ns: int = SETTLE_NS,
        quantiles: Sequence[int] = (),
    ) -> None:
        """Create the first chain from the likely schemas of the sensors' streams.

        ``opened`` creates a chain from schemas and an optional earlier beginning, ``alarms`` the alarms of a chain.
        Without ``steps`` all steps are published.
        """
        super().__init__(sensors, settle_ns)
        self.resting_ns = RESTING_NS
        self._open_chain = opened
        self.quantiles = tuple(quantiles)
        self.chain = opened({name: likely_schema(sensor) for name, sensor in self.sensors.items()}, None)
        self.steps = tuple(steps) if steps else tuple(range(1, self.chain.horizon + 1))
        self._late = 0  # late samples of earlier chains
        self._first: dict[str, pa.Schema] = {}  # schema of the first samples of each stream
        self._begun: set[str] = set()
        self._decoders = self._new_decoders()
        self._last_ns: int | None = None  # time of the last message, monotonic clock
        self._point_ns: int | None = None  # time of the last grid point
        self._why = ""  # why there is no grid although there is a chain
        self._continues: Beginning | None = None  # state of an earlier process that the next recording continues

    @property
    def period_ns(self) -> int:
        """The interval between grid points."""
        return round(1e9 / self.chain.rate_hz)

    @property
    def late(self) -> int:
        """The number of samples so far that arrived after their row was computed."""
        return self._late + sum(self.chain.late.values())

    @property
    def states(self) -> dict[str, str]:
        """The rows that gave the level at rest, and the numbers of late samples by stream."""
        states = {} if self.chain.beginning is None else {"level at rest": self.chain.rest_rows}
        late = ", ".join(f"{name} {count}" for name, count in self.chain.late.items() if count)
        return {**states, **({"late": late} if late else {})}

    @property
    def beginning(self) -> Beginning | None:
        """The state that another process needs to continue this recording; None before the rest level is known."""
        return self.chain.beginning

    def describe(self, model: str) -> ForecastDescription:
        """Return the description of the values in messages."""
        chain = self.chain
        return ForecastDescription(chain.channels, self.steps, chain.unit, chain.rate_hz, model, self.quantiles)

    def continue_recording(self, beginning: str) -> None:
        """Store grid and rest level of an earlier process, which the next recording continues."""
        self._continues = Beginning.from_json(json.loads(beginning))

    def begin_recording(self, offset_ns: int) -> None:
        """Start a recording with a new chain, or with one that continues the previous process."""
        self._begun = set()
        self._decoders = self._new_decoders()
        continues, self._continues = self._continues, None
        self._restart(
            "the recording begins" if continues is None else "the model's process was started anew", continues
        )

    def overflow(self) -> None:
        """Continue with a chain without the blocks that were discarded."""
        if self.running:
            self.overflows += 1
            previous = self.chain
            self._restart("blocks were thrown away under overload", previous.beginning)
            self.chain.continue_cameras(previous)

    def begin_stream(self, stream: str) -> None:
        """Start decoding a stream at the start of the recording."""
        self._begun.add(stream)
        self._decoders[stream] = Decoder(self.sensors[stream])

    def take_note(self, stream: str, note: StreamNote) -> None:
        """Process a note on a stream; lost bytes are passed to its decoder."""
        super().take_note(stream, note)
        if note.what != BEGAN:
            self._keep(stream, note)

    def take_chunks(self, stream: str, chunks: Chunks) -> None:
        """Store bytes of a stream that the chain reads; before a recording, detect the columns of the stream."""
        self._keep(stream, chunks)

    def _keep(self, stream: str, block: Chunks | StreamNote) -> None:
        if stream in self.chain.streams or stream == PLAN or stream not in self._first:
            self._decoders[stream].take(block)
        if not self.running and stream not in self._first:
            self._record_schema(stream)

    def due_ns(self, now_ns: int) -> int:
        """Return when to call `step` next, on the monotonic clock: first to decode, then when a row is due."""
        due_ns = self._row_ns
        if due_ns is None:
            return now_ns + round(STARTING_S * 1e9)
        if due_ns <= now_ns:
            return now_ns + round(STARTING_S * 1e9) // 5
        return max(due_ns - EARLY_NS, now_ns) if due_ns - EARLY_NS - now_ns > LITTLE_NS else due_ns

    def step(self, now_ns: int) -> list[ForecastMessage]:
        """Return the message that is due: the newest forecast, or that there has been no forecast for `PERIODS`.

        Before a row is due, new bytes are decoded and nothing is returned.
        """
        if self._offset_ns is None or len(self._begun) < len(self.sensors):
            return []
        began_s = time.perf_counter()
        is_resting = self.chain.beginning is None and self.resting_ns > self.settle_ns
        until_ns = now_ns - (self.resting_ns if is_resting else self.settle_ns)
        row_ns = self._row_ns
        self._decode(self._offset_ns, until_ns if row_ns is not None and row_ns <= now_ns else None)
        forecasts = self.chain.advance(until_ns + self._offset_ns, newest_only=True)
        if is_resting and self.chain.beginning is not None:  # the newest row is due, not the one that ended the wait
            self._decode(self._offset_ns, None)
            newest_ns = now_ns - self.settle_ns + self._offset_ns
            forecasts = self.chain.advance(newest_ns, newest_only=True) or forecasts
        if not forecasts:
            return self._silence(now_ns)
        self._why = ""
        self._point_ns, self._last_ns = forecasts[-1].t_ns, now_ns
        if not is_resting:  # rows that waited for the rest level are no sign of overload
            self.skipped += sum(Cause.SKIPPED in forecast.cause for forecast in forecasts)
        message = self._message(forecasts[-1], now_ns)
        message.late, message.compute_ms = self.late, (time.perf_counter() - began_s) * 1e3
        return [message]

    def published(self, message: messages.Message, now_ns: int) -> None:
        """Write latency and age into a message just before it is published."""
        super().published(message, now_ns)
        if self._offset_ns is None or not message.answers:
            return
        heard_ns = self._decoders[self.chain.master].heard_ns if self.chain.master in self._decoders else None
        message.age_ms = math.nan if heard_ns is None else (now_ns - heard_ns) / 1e6

    @property
    def _row_ns(self) -> int | None:
        """Return when the next row is due, on the monotonic clock, or None if unknown."""
        if self._point_ns is None or self._offset_ns is None:
            return None
        return self._point_ns + self.period_ns - self._offset_ns + self.settle_ns

    def _decode(self, offset_ns: int, until_ns: int | None) -> None:
        """Decode new bytes and pass them to the chain; if a row is due, only those with samples up to ``until_ns``."""
        for name, decoder in self._decoders.items():
            if until_ns is None or decoder.may_contain(until_ns):
                for batch in decoder.batches():
                    self.chain.push(name, decoder.columns(batch, offset_ns))

    def _message(self, forecast: GridForecast, now_ns: int) -> ForecastMessage:
        """Return the message with a forecast, or with its cause if the forecast has no values."""
        values, levels = None, None
        if forecast.count is not None and forecast.now is not None:
            published_rows = [step - 1 for step in self.steps]
            values = np.ascontiguousarray(forecast.count[published_rows], dtype=np.float32)
            if forecast.quantiles is not None:
                levels = np.ascontiguousarray(forecast.quantiles[published_rows].transpose(2, 0, 1), dtype=np.float32)
        return ForecastMessage(
            self.next_seq(),
            forecast.t_ns,
            values,
            describe_cause(forecast),
            forecast.cause.value,
            forecast.made_from_t_ns,
            skipped=self.skipped,
            levels=self.quantiles,
            quantiles=levels,
        )

    def _silence(self, now_ns: int) -> list[ForecastMessage]:
        """Return a message without a forecast if there has been none for too long."""
        assert self._offset_ns is not None
        if self._last_ns is None:
            self._last_ns = now_ns
        if now_ns - self._last_ns < PERIODS * self.period_ns + SLACK_NS:
            return []
        self._last_ns = now_ns
        limit_ns = PERIODS * self.period_ns + SLACK_NS
        silent = [
            name
            for name in self.chain.streams
            if name in self._decoders and now_ns - (self._decoders[name].heard_ns or 0) > limit_ns
        ]
        reasons = [self._why] if self._why else []
        reasons += [f"nothing comes from {', '.join(silent)}"] if silent else []
        cause = "; ".join(reasons) or "no row is complete"
        message = ForecastMessage(
            self.next_seq(), now_ns + self._offset_ns, None, cause, skipped=self.skipped, late=self.late
        )
        message.levels = self.quantiles
        return [message]

    def _restart(self, cause: str, beginning: Beginning | None) -> None:
        """Replace the chain by one with the layouts that are known, which continues ``beginning`` if it is not None."""
        self._late += sum(self.chain.late.values())
        layouts = {name: self._first.get(name) or likely_schema(sensor) for name, sensor in self.sensors.items()}
        self.chain = self._open_chain(layouts, beginning)
        self._point_ns = self._last_ns = None
        self._why = cause

    def _record_schema(self, stream: str) -> None:
        """Record the schema of a stream's samples before a recording starts."""
        for batch in self._decoders[stream].batches():
            self._first.setdefault(stream, batch_schema(batch, self.sensors[stream]))

    def _new_decoders(self) -> dict[str, Decoder]:
        return {name: Decoder(sensor) for name, sensor in self.sensors.items()}


def describe_cause(forecast: GridForecast) -> str:
    """Return the cause of a forecast in words.

    >>> describe_cause(GridForecast(0, 0, None, None, Cause.GAP | Cause.CONTEXT, ("xela2",)))
    'nothing new comes from xela2'
    """
    cause = forecast.cause
    if Cause.GAP in cause:
        return f"nothing new comes from {', '.join(forecast.gaps) or 'a stream'}"
    for flag, sentence in SENTENCES.items():
        if flag in cause:
            return sentence
    return ""


SENTENCES = {
    Cause.START: "the session begins: the level at rest is not known yet",
    Cause.VALUE: "a value is not finite",
    Cause.TIME: "it is not known when the newest row was measured",
    Cause.CONTEXT: "the model's context is being filled",
    Cause.PLAN_ENDED: "the plan has ended: the hand is taken to stay",
    Cause.NO_PLAN: "there is no plan: the hand is taken to move on",
}
