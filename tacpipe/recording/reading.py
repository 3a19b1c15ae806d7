"""Decode the bytes of one stream to samples, and report every loss once.

Counters that devices send are unrolled, which reveals missing samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Int64s, Times
from tacpipe.recording.losses import CLOCK, ESTIMATED, SILENT, ClockGap, ClockGaps, StreamFault, StreamLosses
from tacpipe.sensors.framing import Account, Chunks, FrameRun, FramingLoss
from tacpipe.sensors.sensor import Samples, Sensor
from tacpipe.signals.sampling import SILENCE_NS, SILENCE_PERIODS, SamplingClock

MAX_RATE_HZ = 100_000.0  # maximum rate of a device without a declared rate: no program sends records faster
RESET_FACTOR = 3.0  # a gap of more than this multiple of the expected samples is a restart of the device
RESET_SLACK = 32  # additional samples that a burst may contain
CLOCK_TOLERANCE = 0.05  # relative error allowed between counter and clock across an outage, in addition to the slack
LATE_NS = 250_000_000  # links reorder packets within this time; a counter that goes back later is a restart


@dataclass(frozen=True)
class UnrolledCounters:
    """A batch of counters and the events in it. All arrays have shape (sample,)."""

    seq: Int64s  # unrolled: increases by one per sample; a lost sample leaves a gap
    missing: Int64s  # number of samples that were lost right before this one
    duplicate: Bools  # the same sample was received before
    late: Bools  # the sample was counted as lost before
    reset: Bools  # the counter restarted or jumped too far; ``missing`` is then estimated from the clock, or 0


NAMES = tuple(field.name for field in fields(UnrolledCounters))


class CounterUnroller:
    """Unroll one counter of a recording. Differences are taken modulo its range; those above half the range are negative."""

    def __init__(self, modulus: int, rate_hz: float, step: int = 1) -> None:
        self.modulus, self.rate_hz, self.step = modulus, rate_hz, step
        # the highest count as sent and unwrapped, and its arrival time in ns
        self._last: tuple[int, int, int] | None = None
        # The last count before a reset and the size of the jump: a single wrong count looks like a reset.
        self._before_reset: tuple[int, int] | None = None
        self._may_have_restarted = False

    def note_reopened(self) -> None:
        """Note that the link was lost: the device may have restarted, so the next counter is compared with the clock.

        If they disagree or the counter went back, the device restarted. Without a declared rate, any increase up to
        `MAX_RATE_HZ` is accepted.
        """
        self._may_have_restarted = self._last is not None

    def feed(self, raw: Int64s, t_ns: Times) -> UnrolledCounters:
        """Unroll counters as sent (sample,), with the arrival time of each in ns.

        If two samples are further apart than half the counter's period, the arrival times determine how often it
        wrapped.
        """
        if not len(raw):
            empty = np.zeros(0, dtype=bool)
            return UnrolledCounters(raw, raw, empty, empty, empty)
        if self._may_have_restarted and self._last is not None:
            parts = self._unroll_after_outage(int(raw[0]), int(t_ns[0]), *self._last), self.feed(raw[1:], t_ns[1:])
            return UnrolledCounters(*(np.concatenate([getattr(part, name) for part in parts]) for name in NAMES))
        first = self._last is None
        last_raw, last_seq, last_ns = self._last or (int(raw[0]), int(raw[0]) // self.step, int(t_ns[0]))
        delta = self._signed_difference(np.diff(raw, prepend=last_raw))
        elapsed_ns = np.diff(t_ns, prepend=last_ns)
        slow = elapsed_ns * 1e-9 * self.rate_hz * self.step > self.modulus / 2  # never true without a declared rate
        if (delta[first:] == self.step).all() and not slow.any():  # the common case: no event
            seq = last_seq + np.arange(len(raw)) + (not first)
            self._last, self._before_reset = (int(raw[-1]), int(seq[-1]), int(t_ns[-1])), None
            empty = np.zeros(len(raw), dtype=bool)
            return UnrolledCounters(seq, np.zeros(len(raw), dtype=np.int64), empty, empty, empty)
        return self._unroll_rows(raw, t_ns, last_raw, last_seq, last_ns, first=first)

    def _signed_difference(self, delta: Int64s) -> Int64s:
        half = self.modulus // 2
        return (delta + half) % self.modulus - half

    def _unroll_after_outage(
        self, raw: int, at_ns: int, last_raw: int, last_seq: int, last_ns: int
    ) -> UnrolledCounters:
        """Unroll the first counter after an outage, which is a reset unless it agrees with the clock.

        The counter as sent is ``raw``, which arrived ``at_ns``; ``last_…`` describe the sample before the outage.
        """
        half_period, samples_per_wrap = self.modulus // 2, self.modulus // self.step
        steps, remainder = divmod((raw - last_raw + half_period) % self.modulus - half_period, self.step)
        expected = (at_ns - last_ns) * 1e-9 * self.rate_hz
        if self.rate_hz:
            steps += samples_per_wrap * round((expected - steps) / samples_per_wrap)
        agrees_with_clock = (
            abs(steps - expected) <= RESET_SLACK + CLOCK_TOLERANCE * expected
            if self.rate_hz
            else steps <= _max_samples(at_ns - last_ns)
        )
        reset = bool(remainder) or steps < 1 or not agrees_with_clock
        if reset:
            steps = max(1, round(expected))
        self._last, self._may_have_restarted = (raw, last_seq + steps, at_ns), False
        no_row = np.zeros(1, dtype=bool)
        return UnrolledCounters(np.array([last_seq + steps]), np.array([steps - 1]), no_row, no_row, np.array([reset]))

    def _steps_after_wrong_count(self, raw: int) -> int:
        """Return the increase since the previous count if that was a single wrong count; otherwise 0."""
        if self._before_reset is None:
            return 0
        before_reset, jump = self._before_reset
        half = self.modulus // 2
        steps, remainder = divmod((raw - before_reset + half) % self.modulus - half, self.step)
        return max(1, steps - jump) if not remainder and 0 < steps <= RESET_SLACK else 0

    def _unroll_rows(
        self, raw: Int64s, t_ns: Times, last_raw: int, last_seq: int, last_ns: int, *, first: bool
    ) -> UnrolledCounters:
        """Unroll counters one by one, and classify each unexpected one as a gap, a repetition, a late sample or a reset.

        ``last_…`` describe the previous sample. If ``first``, there is no previous sample, and they describe the first row.
        """
        seq, missing = np.zeros(len(raw), dtype=np.int64), np.zeros(len(raw), dtype=np.int64)
        duplicate, late, reset = (np.zeros(len(raw), dtype=bool) for _ in range(3))
        half_period = self.modulus // 2
        for row, (value, at_ns) in enumerate(zip(raw.tolist(), t_ns.tolist(), strict=True)):
            steps, remainder = divmod((value - last_raw + half_period) % self.modulus - half_period, self.step)
            expected = (at_ns - last_ns) * 1e-9 * self.rate_hz  # 0 without a declared rate
            samples_per_wrap = self.modulus // self.step
            if expected > samples_per_wrap / 2:
                steps += samples_per_wrap * round((expected - steps) / samples_per_wrap)
            steps_after_wrong, self._before_reset = self._steps_after_wrong_count(value), None
            if first:
                first, steps = False, 0
            elif steps_after_wrong and steps != 1:
                steps = steps_after_wrong
                reset[row], missing[row] = True, steps - 1
            elif (
                remainder
                or steps > (RESET_FACTOR * expected + RESET_SLACK if self.rate_hz else _max_samples(at_ns - last_ns))
                or (steps < 0 and (steps < -RESET_SLACK or at_ns - last_ns > LATE_NS))
            ):
                steps = max(1, round(expected))
                self._before_reset = last_raw, steps
                reset[row], missing[row] = True, steps - 1
            elif steps > 0:
                missing[row] = steps - 1
            else:
                duplicate[row], late[row] = steps == 0, steps < 0
                seq[row] = last_seq + steps
                continue
            seq[row] = last_seq = last_seq + steps
            last_raw, last_ns = value, at_ns
        self._last = last_raw, last_seq, last_ns
        return UnrolledCounters(seq, missing, duplicate, late, reset)


def _max_samples(elapsed_ns: int) -> float:
    """Return the largest number of samples that a device without a declared rate may have sent in this time."""
    return max(0, elapsed_ns) * 1e-9 * MAX_RATE_HZ + RESET_SLACK


LINK = "link"  # frames that the counter shows as missing and of which no byte arrived
DEVICE = "device"  # samples that the device itself skipped
DUPLICATE, LATE, RESET = "duplicate", "late", "counter_reset"
EXPLAINS_NS = 30_000_000_000  # a damaged frame explains a loss that is estimated within this time
NOTE_NS = 100_000_000  # a note on dropped packets may be this much later than the next packet


@dataclass(frozen=True)
class Batch:
    """Samples of one stream in order of arrival, and the faults between them."""

    t_ns: Times  # (sample,), arrival on the monotonic clock in ns
    values: tuple[AnyArray, ...]  # blocks (sample, channel)
    seq: Times | None = None  # (sample,), unrolled
    device_seq: Times | None = None  # (sample,), unrolled
    t_device_ns: Times | None = None  # (sample,)
    events: tuple[StreamFault, ...] = ()

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def counters(self) -> list[str]:
        """The names of the counters in this batch."""
        return [name for name in ("seq", "device_seq") if getattr(self, name) is not None]


class LinkReader:
    """Decode the bytes of a link to samples. The samples do not depend on how the bytes are split into chunks."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self.frames = 0  # number of frames with samples
        self.losses = StreamLosses()
        self._framer = sensor.framer()
        self._previous_account = Account()  # account of the previous links
        self._unroller = _make_unroller(sensor, sensor.counter)
        self._device_unroller = _make_unroller(sensor, sensor.device_counter)
        self._pending_losses: list[FramingLoss] = []  # losses whose frames the counter of a later sample will show
        self._last_ns: int | None = None
        self._device_ns: tuple[int, int] | None = None  # the device's last clock reading, as sent and unrolled
        self._sampling, self._gaps = self._make_estimators()
        self._outage_ns: int | None = None  # arrival of the last sample before the link was lost
        self._explaining: list[tuple[int, int]] = []  # times and numbers of lost frames that no gap has explained yet
        self._estimated = 0  # estimated losses that samples may take back

    @property
    def lost(self) -> int:
        """The number of lost frames, without estimated ones."""
        return self.losses.certain

    @property
    def account(self) -> Account:
        """The bytes of all links so far."""
        current = self._framer.account
        return Account(
            self._previous_account.received + current.received,
            self._previous_account.framed + current.framed,
            self._previous_account.lost + current.lost,
        )

    def feed(self, chunks: Chunks) -> Batch:
        """Return the samples that these bytes complete."""
        return self._batch(*self._framer.feed(chunks))

    def end_link(self) -> Batch:
        """Return the last samples of a lost link. The next bytes are read from a new link."""
        batch = self._batch(*self._framer.flush())
        batch = self._add_events(batch, self._gap_events(self._gaps.finish()))
        self._device_ns = None  # a device that lost power restarts its clock
        self._sampling, self._gaps = self._make_estimators()
        self._outage_ns = self._last_ns
        for unroller in (self._unroller, self._device_unroller):
            if unroller is not None:
                unroller.note_reopened()
        self._previous_account = self.account
        self._framer = self.sensor.framer()
        return batch

    def finish(self) -> Batch:
        """Return the last samples and events of the stream; the losses that no counter resolved count in full."""
        batch = self._batch(*self._framer.flush())
        final_events = tuple(_event(loss, loss.frames) for loss in self._pending_losses)
        self._pending_losses = []
        return self._add_events(batch, [*final_events, *self._gap_events(self._gaps.finish())])

    def note_dropped(self, fault: StreamFault) -> None:
        """Note frames that are known to be lost, so that they are not counted again by a clock or an estimate."""
        if fault.frames and self._unroller is None:
            self._explaining.append((fault.t_ns, fault.frames))

    def _make_estimators(self) -> tuple[SamplingClock, ClockGaps]:
        period_ns = 1e9 / self.sensor.rate_hz if self.sensor.rate_hz else None
        return SamplingClock(period_ns), ClockGaps()

    def _add_events(self, batch: Batch, events: Sequence[StreamFault]) -> Batch:
        """Return the batch with further events, which are added to the losses."""
        self.losses += StreamLosses.from_events(events)
        return replace(batch, events=(*batch.events, *events)) if events else batch

    def _batch(self, runs: Sequence[FrameRun], losses: Sequence[FramingLoss]) -> Batch:
        """Return the samples of new frames, without duplicates, and the faults of the frames and of framing losses."""
        pairs = ((run, self.sensor.decode(run.frames)) for run in runs)
        decoded = [(run, samples) for run, samples in pairs if len(samples)]
        stamps = [run.t_ns if samples.rows is None else run.t_ns[samples.rows] for run, samples in decoded]
        t_ns = np.concatenate(stamps) if stamps else np.zeros(0, dtype=np.int64)
        self.frames += sum(
            len(samples) if samples.rows is None else len(np.unique(samples.rows)) for _, samples in decoded
        )
        decoded_samples = [samples for _, samples in decoded]
        seq, device_seq, t_device_ns = (
            _concatenate(decoded_samples, name) for name in ("seq", "device_seq", "t_device_ns")
        )
        if t_device_ns is not None and self.sensor.device_wrap_ns is not None:
            t_device_ns = self._unroll_device_time(t_device_ns, self.sensor.device_wrap_ns)
        events: list[StreamFault] = []
        retained = np.ones(len(t_ns), dtype=bool)
        self._pending_losses += losses
        if self._unroller is not None:
            if seq is not None:
                counted = self._unroller.feed(seq, t_ns)
                seq, retained = counted.seq, ~counted.duplicate
                events += self._counter_faults(counted, t_ns)
                if self._device_unroller is not None and device_seq is not None:
                    skipped = self._device_unroller.feed(device_seq, t_ns)
                    device_seq = skipped.seq
                    events += _device_events(skipped, counted, t_ns)
        else:
            events += [_event(loss, loss.frames) for loss in self._pending_losses]
            self._pending_losses = []
            for event in events:
                self.note_dropped(event)
            if self.sensor.awaited and not self.sensor.lossless and len(t_ns):
                events += self._uncounted_losses(t_ns, t_device_ns)
        if len(t_ns):
            self._last_ns = int(t_ns[-1])
        blocks = tuple(
            np.concatenate(parts) for parts in zip(*(samples.values for samples in decoded_samples), strict=True)
        )
        batch = self._add_events(Batch(t_ns, blocks, seq, device_seq, t_device_ns), sorted(events))
        return batch if retained.all() else _select_rows(batch, retained)

    def _uncounted_losses(self, t_ns: Times, t_device_ns: Times | None) -> list[StreamFault]:
        """Return the losses of a device without a counter: those that its clock shows, and those that arrivals suggest."""
        period_ns, events = 1e9 / self.sensor.rate_hz, []
        if self._outage_ns is not None:
            at_ns, since_ns, self._outage_ns = int(t_ns[0]), self._outage_ns, None
            missing = self._unexplained(round((at_ns - since_ns) / period_ns) - 1, since_ns, at_ns)
            events += [StreamFault(at_ns, ESTIMATED, missing, detail="while the link was lost")] if missing > 0 else []
        elif self._last_ns is not None:
            steps_ns = np.diff(t_ns, prepend=self._last_ns)
            for row in np.flatnonzero(steps_ns > SILENCE_NS + SILENCE_PERIODS * period_ns).tolist():
                detail = f"{steps_ns[row] / 1e9:.1f} s; it is unknown whether samples were lost"
                events.append(StreamFault(int(t_ns[row]), SILENT, detail=detail))
        if t_device_ns is not None:
            events += self._gap_events(self._gaps.feed(t_device_ns, t_ns))
        for row, count in self._sampling.place(t_ns, None, t_device_ns).losses:
            at_ns = int(t_ns[row])
            missing = (
                self._unexplained(count, at_ns - EXPLAINS_NS, at_ns) if count > 0 else max(count, -self._estimated)
            )
            self._estimated += missing
            events += [StreamFault(at_ns, ESTIMATED, missing, detail="by the arrivals")] if missing else []
        return events

    def _gap_events(self, gaps: Sequence[ClockGap]) -> list[StreamFault]:
        """Return the losses that gaps in the device's clock show, without those that damaged bytes have shown."""
        counts = [(gap, self._unexplained(gap.skipped, gap.before_ns, gap.after_ns + NOTE_NS)) for gap in gaps]
        return [StreamFault(gap.after_ns, CLOCK, count) for gap, count in counts if count]

    def _unexplained(self, missing: int, since_ns: int, until_ns: int) -> int:
        """Return how many of the missing frames are not among those known to be lost between two times."""
        self._explaining = [
            (t_ns, count) for t_ns, count in self._explaining if count and t_ns > until_ns - 2 * EXPLAINS_NS
        ]
        for number, (t_ns, count) in enumerate(self._explaining):
            if since_ns < t_ns <= until_ns:
                explained = min(count, missing)
                self._explaining[number], missing = (t_ns, count - explained), missing - explained
        return missing

    def _unroll_device_time(self, sent_ns: Times, wrap_ns: int) -> Times:
        """Return device times (sample,) in ns without wrap-arounds. Smaller steps back are retained."""
        last_sent_ns, last_ns = self._device_ns or (int(sent_ns[0]), int(sent_ns[0]))
        steps_ns = np.diff(sent_ns, prepend=last_sent_ns)
        unrolled: Times = last_ns + np.cumsum(np.where(steps_ns < -wrap_ns // 2, steps_ns + wrap_ns, steps_ns))
        self._device_ns = int(sent_ns[-1]), int(unrolled[-1])
        return unrolled

    def _counter_faults(self, counted: UnrolledCounters, t_ns: Times) -> list[StreamFault]:
        """Return the faults of a batch whose sensor has a counter.

        The counter shows how many frames each pending framing loss cost.
        """
        events: list[StreamFault] = []
        fault_rows = np.flatnonzero((counted.missing > 0) | counted.duplicate | counted.late | counted.reset)
        for row in fault_rows.tolist():
            at_ns, missing = int(t_ns[row]), int(counted.missing[row])
            if counted.duplicate[row]:
                events.append(StreamFault(at_ns, DUPLICATE))
                continue
            if counted.late[row]:
                events.append(StreamFault(at_ns, LATE, frames=-1))
                continue
            if counted.reset[row]:
                events.append(StreamFault(at_ns, RESET, detail=f"began anew at {counted.seq[row]}"))
            for loss in [loss for loss in self._pending_losses if loss.t_ns <= at_ns]:
                count = min(loss.frames, missing)
                missing -= count
                events.append(_event(loss, count))
                self._pending_losses.remove(loss)
            if missing:
                events.append(StreamFault(at_ns, LINK, frames=missing))
        if len(t_ns):  # a loss without a gap in the counter cost no frame
            last_ns = int(t_ns[-1])
            events += [_event(loss, 0) for loss in self._pending_losses if loss.t_ns <= last_ns]
            self._pending_losses = [loss for loss in self._pending_losses if loss.t_ns > last_ns]
        return events


def _make_unroller(sensor: Sensor, modulus: int | None) -> CounterUnroller | None:
    return None if modulus is None else CounterUnroller(modulus, sensor.rate_hz, sensor.step)


def _concatenate(samples: Sequence[Samples], name: str) -> Times | None:
    arrays = [getattr(part, name) for part in samples]
    return np.concatenate(arrays) if arrays and arrays[0] is not None else None


def _event(loss: FramingLoss, frames: int) -> StreamFault:
    return StreamFault(loss.t_ns, loss.cause, frames, loss.bytes)


def _device_events(skipped: UnrolledCounters, counted: UnrolledCounters, t_ns: Times) -> list[StreamFault]:
    """Return the faults of samples that the device skipped: gaps of its own counter that lost packets do not explain.

    Resets of that counter are reported without a number of samples.
    """
    device_missing = np.where(skipped.reset, 0, skipped.missing - counted.missing)
    events = [
        StreamFault(int(t_ns[row]), DEVICE, frames=int(device_missing[row]))
        for row in np.flatnonzero(device_missing > 0)
    ]
    restarts = np.flatnonzero(skipped.reset & ~counted.reset)
    return events + [StreamFault(int(t_ns[row]), RESET, detail="the device's second counter") for row in restarts]


def _select_rows(batch: Batch, rows: Bools) -> Batch:
    """Return the rows of a batch for which ``rows`` (sample,) is True, with all of its events."""

    def select(values: Times | None) -> Times | None:
        return None if values is None else values[rows]

    blocks = tuple(block[rows] for block in batch.values)
    return Batch(
        batch.t_ns[rows], blocks, select(batch.seq), select(batch.device_seq), select(batch.t_device_ns), batch.events
    )
