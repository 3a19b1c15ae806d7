"""Decode the bytes of one stream to samples: frame, decode and count them, and report every loss once.

Counters that devices send are unrolled, which shows missing samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from tacpipe.arrays import AnyArray, Bools, Int64s, Times
from tacpipe.sensors.framing import Account, Chunks, FrameRun, FramingLoss
from tacpipe.sensors.sensor import Samples, Sensor

MOST_RATE_HZ = 100_000.0  # limit for a device without a stated rate: no program sends records faster
RESET_TIMES = 3.0  # a gap longer than so many times what the clock allows is a device that began anew
RESET_SLACK = 32  # samples beyond that which a burst may bring
AGREES = 0.05  # beyond the slack, of what the clock estimates for an outage through which the device continued counting
LATE_NS = 250_000_000  # a link that reorders does so within this; a count that goes back later is a device's restart


@dataclass(frozen=True)
class Counted:
    """A batch of counters made sense of; all are (sample,)."""

    seq: Int64s  # unrolled: grows by one a sample, a lost one leaves a gap
    missing: Int64s  # samples that were lost right before
    duplicate: Bools  # the same sample once more
    late: Bools  # it was passed over before, and counted as lost
    reset: Bools  # it began to count anew, or jumped beyond what time allows; ``missing`` is by the clock, or 0


NAMES = tuple(field.name for field in fields(Counted))


class Counting:
    """One counter through a recording: differences are taken modulo, those of over half its range are backward."""

    def __init__(self, modulus: int, rate_hz: float, step: int = 1) -> None:
        self.modulus, self.rate_hz, self.step = modulus, rate_hz, step
        self._last: tuple[int, int, int] | None = None  # highest count as sent, unrolled, and its arrival
        # The last count before a reset, which may have been a single false count, and the positions of that count.
        self._before: tuple[int, int] | None = None
        self._doubted = False  # True where the device may have restarted since

    def reopened(self) -> None:
        """Take note that the link was lost: the device may have been off, so the clock must confirm the next counter.

        Where it does not, or the counter went back, the device began anew. Without a rate one that grew is taken as it is,
        up to what `MOST_RATE_HZ` allows.
        """
        self._doubted = self._last is not None

    def feed(self, raw: Int64s, t_ns: Times) -> Counted:
        """Return what counters (sample,) as sent state, with the arrival of each.

        Where the samples come further apart than half the counter's range lasts, the arrival states how often it went round.
        """
        if not len(raw):
            empty = np.zeros(0, dtype=bool)
            return Counted(raw, raw, empty, empty, empty)
        if self._doubted and self._last is not None:
            restarted, following = self._restart(int(raw[0]), int(t_ns[0]), *self._last), self.feed(raw[1:], t_ns[1:])
            return Counted(
                *(np.concatenate([getattr(part, name) for part in (restarted, following)]) for name in NAMES)
            )
        first = self._last is None
        last_raw, last_seq, last_ns = self._last or (int(raw[0]), int(raw[0]) // self.step, int(t_ns[0]))
        delta = self._signed(np.diff(raw, prepend=last_raw))
        elapsed_ns = np.diff(t_ns, prepend=last_ns)
        slow = elapsed_ns * 1e-9 * self.rate_hz * self.step > self.modulus / 2  # never where no rate is known
        if (delta[first:] == self.step).all() and not slow.any():  # nothing happened, as nearly always
            seq = last_seq + np.arange(len(raw)) + (not first)
            self._last, self._before = (int(raw[-1]), int(seq[-1]), int(t_ns[-1])), None
            empty = np.zeros(len(raw), dtype=bool)
            return Counted(seq, np.zeros(len(raw), dtype=np.int64), empty, empty, empty)
        return self._slowly(raw, t_ns, last_raw, last_seq, last_ns, first=first)

    def _signed(self, delta: Int64s) -> Int64s:
        half = self.modulus // 2
        signed: Int64s = (delta + half) % self.modulus - half
        return signed

    def _restart(self, raw: int, at_ns: int, last_raw: int, last_seq: int, last_ns: int) -> Counted:
        """Return what the first counter after an outage states, if the clock agrees with it."""
        half, rounds = self.modulus // 2, self.modulus // self.step
        steps, off = divmod((raw - last_raw + half) % self.modulus - half, self.step)
        expected = (at_ns - last_ns) * 1e-9 * self.rate_hz
        if self.rate_hz:
            steps += rounds * round((expected - steps) / rounds)
        agrees = (
            abs(steps - expected) <= RESET_SLACK + AGREES * expected
            if self.rate_hz
            else steps <= _most_counts(at_ns - last_ns)
        )
        reset = bool(off) or steps < 1 or not agrees
        if reset:
            steps = max(1, round(expected))
        self._last, self._doubted = (raw, last_seq + steps, at_ns), False
        no_row = np.zeros(1, dtype=bool)
        return Counted(np.array([last_seq + steps]), np.array([steps - 1]), no_row, no_row, np.array([reset]))

    def _went_on(self, raw: int) -> int:
        """Return by how much a count continues behind a false one, as if that had been right; 0 where it does not."""
        if self._before is None:
            return 0
        before, positions = self._before
        half = self.modulus // 2
        steps, off = divmod((raw - before + half) % self.modulus - half, self.step)
        return max(1, steps - positions) if not off and 0 < steps <= RESET_SLACK else 0

    def _slowly(self, raw: Int64s, t_ns: Times, last_raw: int, last_seq: int, last_ns: int, *, first: bool) -> Counted:
        seq, missing = np.zeros(len(raw), dtype=np.int64), np.zeros(len(raw), dtype=np.int64)
        duplicate, late, reset = (np.zeros(len(raw), dtype=bool) for _ in range(3))
        half = self.modulus // 2
        for row, (value, at_ns) in enumerate(zip(raw.tolist(), t_ns.tolist(), strict=True)):
            steps, off = divmod((value - last_raw + half) % self.modulus - half, self.step)
            expected = (at_ns - last_ns) * 1e-9 * self.rate_hz  # 0 where no rate is known
            rounds = self.modulus // self.step
            if expected > rounds / 2:
                steps += rounds * round((expected - steps) / rounds)
            went_on, self._before = self._went_on(value), None
            if first:
                first, steps = False, 0
            elif went_on and steps != 1:
                steps = went_on
                reset[row], missing[row] = True, steps - 1
            elif (
                off
                or steps > (RESET_TIMES * expected + RESET_SLACK if self.rate_hz else _most_counts(at_ns - last_ns))
                or (steps < 0 and (steps < -RESET_SLACK or at_ns - last_ns > LATE_NS))
            ):
                steps = max(1, round(expected))
                self._before = last_raw, steps
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
        return Counted(seq, missing, duplicate, late, reset)


def _most_counts(elapsed_ns: int) -> float:
    """Return how many samples a device of unknown rate may have sent in this time."""
    return max(0, elapsed_ns) * 1e-9 * MOST_RATE_HZ + RESET_SLACK


LINK = "link"  # frames that the counter misses and of which no byte arrived
DEVICE = "device"  # samples that the device itself skipped
DUPLICATE, LATE, RESET = "duplicate", "late", "counter_reset"
SILENT = "silent"  # a device without counter sent nothing for too long, and no burst made up for it
SILENT_PERIODS, SILENT_NS = 5.0, 50_000_000  # the longer of both is the limit


class StreamFault(NamedTuple):
    """A fault of a stream: when, why, and how many frames and bytes it cost."""

    t_ns: int
    cause: str
    frames: int = 0  # lost frames; negative for a frame that was counted as lost and came late
    bytes: int = 0  # discarded bytes
    detail: str = ""


@dataclass(frozen=True)
class Batch:
    """Samples of one stream in the order of their arrival, and the faults meanwhile."""

    t_ns: Times  # (sample,), arrival on the monotonic clock
    values: tuple[AnyArray, ...]  # blocks (sample, channel)
    seq: Times | None = None  # (sample,), unrolled
    device_seq: Times | None = None  # (sample,), unrolled
    t_device_ns: Times | None = None  # (sample,)
    events: tuple[StreamFault, ...] = ()

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def counters(self) -> list[str]:
        """The names of the counters that the samples have."""
        return [name for name in ("seq", "device_seq") if getattr(self, name) is not None]


class LinkReader:
    """Decodes the bytes of a link to samples. The same bytes give the same samples, however they are cut."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self.frames = 0  # number of frames with samples
        self.lost = 0  # number of lost frames, by counter where there is one
        self._framer = sensor.framer()
        self._before = Account()  # account of the links before the present one
        self._counting = _counting(sensor, sensor.counter)
        self._device_counting = _counting(sensor, sensor.device_counter)
        self._unexplained: list[FramingLoss] = []  # losses whose cost the counter of a later sample states
        self._last_ns: int | None = None
        self._device_ns: tuple[int, int] | None = None  # the device's last clock reading, as sent and unrolled
        self._silence: StreamFault | None = None  # the last silence, which a burst may still make up for

    @property
    def account(self) -> Account:
        """The bytes of all links so far."""
        now = self._framer.account
        return Account(
            self._before.received + now.received, self._before.framed + now.framed, self._before.lost + now.lost
        )

    def feed(self, chunks: Chunks) -> Batch:
        """Return the samples that these bytes complete."""
        return self._batch(*self._framer.feed(chunks))

    def broken(self) -> Batch:
        """Return the last samples of a lost link. The next bytes are those of a new link."""
        batch = self._batch(*self._framer.flush())
        self._device_ns = None  # a device that was without power restarts its clock
        for counting in (self._counting, self._device_counting):
            if counting is not None:
                counting.reopened()
        self._before = self.account
        self._framer = self.sensor.framer()
        return batch

    def finish(self) -> Batch:
        """Return the last samples and events of the stream."""
        batch = self._batch(*self._framer.flush())
        final_events = tuple(_event(loss, loss.frames) for loss in self._unexplained)
        final_events += () if self._silence is None else (self._silence,)
        self.lost += sum(event.frames for event in final_events)
        self._unexplained, self._silence = [], None
        return replace(batch, events=batch.events + final_events)

    def _batch(self, runs: Sequence[FrameRun], losses: Sequence[FramingLoss]) -> Batch:
        decoded = [(run, self.sensor.decode(run.frames)) for run in runs]
        decoded = [(run, samples) for run, samples in decoded if len(samples)]
        stamps = [run.t_ns if samples.rows is None else run.t_ns[samples.rows] for run, samples in decoded]
        t_ns = np.concatenate(stamps) if stamps else np.zeros(0, dtype=np.int64)
        self.frames += sum(len(s) if s.rows is None else len(np.unique(s.rows)) for _, s in decoded)
        decoded_samples = [samples for _, samples in decoded]
        seq, device_seq, t_device_ns = (_joined(decoded_samples, name) for name in ("seq", "device_seq", "t_device_ns"))
        if t_device_ns is not None and self.sensor.device_wrap_ns is not None:
            t_device_ns = self._unrolled(t_device_ns, self.sensor.device_wrap_ns)
        events: list[StreamFault] = []
        retained = np.ones(len(t_ns), dtype=bool)
        self._unexplained += losses
        if self._counting is not None:
            if seq is not None:
                counted = self._counting.feed(seq, t_ns)
                seq, retained = counted.seq, ~counted.duplicate
                events += self._explained(counted, t_ns)
                if self._device_counting is not None and device_seq is not None:
                    skipped = self._device_counting.feed(device_seq, t_ns)
                    device_seq = skipped.seq
                    events += _device_events(skipped, counted, t_ns)
        else:
            events += [_event(loss, loss.frames) for loss in self._unexplained]
            self._unexplained = []
            events += self._silences(t_ns)
        self.lost += sum(event.frames for event in events)
        if len(t_ns):
            self._last_ns = int(t_ns[-1])
        blocks = tuple(
            np.concatenate(parts) for parts in zip(*(samples.values for samples in decoded_samples), strict=True)
        )
        batch = Batch(t_ns, blocks, seq, device_seq, t_device_ns, tuple(sorted(events)))
        return batch if retained.all() else _select_rows(batch, retained)

    def _unrolled(self, sent_ns: Times, wrap_ns: int) -> Times:
        """Return device times (sample,) that continue where the clock wraps to 0. A smaller step back stays a step back."""
        last_sent_ns, last_ns = self._device_ns or (int(sent_ns[0]), int(sent_ns[0]))
        steps_ns = np.diff(sent_ns, prepend=last_sent_ns)
        unrolled: Times = last_ns + np.cumsum(np.where(steps_ns < -wrap_ns // 2, steps_ns + wrap_ns, steps_ns))
        self._device_ns = int(sent_ns[-1]), int(unrolled[-1])
        return unrolled

    def _explained(self, counted: Counted, t_ns: Times) -> list[StreamFault]:
        """Return the events of a batch with a counter. Each loss costs as many frames as the counter states."""
        events: list[StreamFault] = []
        odd = np.flatnonzero((counted.missing > 0) | counted.duplicate | counted.late | counted.reset)
        for row in odd.tolist():
            at_ns, missing = int(t_ns[row]), int(counted.missing[row])
            if counted.duplicate[row]:
                events.append(StreamFault(at_ns, DUPLICATE))
                continue
            if counted.late[row]:
                events.append(StreamFault(at_ns, LATE, frames=-1))
                continue
            if counted.reset[row]:
                events.append(StreamFault(at_ns, RESET, detail=f"began anew at {counted.seq[row]}"))
            for loss in [loss for loss in self._unexplained if loss.t_ns <= at_ns]:
                count = min(loss.frames, missing)
                missing -= count
                events.append(_event(loss, count))
                self._unexplained.remove(loss)
            if missing:
                events.append(StreamFault(at_ns, LINK, frames=missing))
        if len(t_ns):  # a loss after which the counter continued cost no frame
            last_ns = int(t_ns[-1])
            events += [_event(loss, 0) for loss in self._unexplained if loss.t_ns <= last_ns]
            self._unexplained = [loss for loss in self._unexplained if loss.t_ns > last_ns]
        return events

    def _silences(self, t_ns: Times) -> list[StreamFault]:
        """Return the silences that ended. Samples of a burst after a silence were late, not lost."""
        if not self.sensor.awaited or not len(t_ns):
            return []
        period_ns = 1e9 / self.sensor.rate_hz
        apart_ns = np.diff(t_ns, prepend=int(t_ns[0]) if self._last_ns is None else self._last_ns)
        silent = apart_ns > max(SILENT_NS, SILENT_PERIODS * period_ns)
        if self._silence is None and not silent.any():
            return []
        events = []
        for at_ns, step_ns, begins in zip(t_ns.tolist(), apart_ns.tolist(), silent.tolist(), strict=True):
            if self._silence is not None and (begins or step_ns > period_ns / 2):
                events.append(self._silence)
                self._silence = None
            elif self._silence is not None:
                self._silence = self._silence._replace(frames=max(0, self._silence.frames - 1))
            if begins:
                lost = max(0, round(step_ns / period_ns) - 1)
                self._silence = StreamFault(at_ns, SILENT, lost, detail=f"{step_ns / 1e6:.0f} ms, by the clock")
        return events


def _counting(sensor: Sensor, modulus: int | None) -> Counting | None:
    return None if modulus is None else Counting(modulus, sensor.rate_hz, sensor.step)


def _joined(samples: Sequence[Samples], name: str) -> Times | None:
    arrays = [getattr(part, name) for part in samples]
    return np.concatenate(arrays) if arrays and arrays[0] is not None else None


def _event(loss: FramingLoss, frames: int) -> StreamFault:
    return StreamFault(loss.t_ns, loss.cause, frames, loss.bytes)


def _device_events(skipped: Counted, counted: Counted, t_ns: Times) -> list[StreamFault]:
    """Return the events of samples that the device skipped: those that its own counter misses beyond lost packets.

    A counter that restarted, or jumped further than the time allows, states no such samples.
    """
    beyond = np.where(skipped.reset, 0, skipped.missing - counted.missing)
    events = [StreamFault(int(t_ns[row]), DEVICE, frames=int(beyond[row])) for row in np.flatnonzero(beyond > 0)]
    restarts = np.flatnonzero(skipped.reset & ~counted.reset)
    return events + [StreamFault(int(t_ns[row]), RESET, detail="the device's second counter") for row in restarts]


def _select_rows(batch: Batch, rows: Bools) -> Batch:
    def select(values: Times | None) -> Times | None:
        return None if values is None else values[rows]

    blocks = tuple(block[rows] for block in batch.values)
    return Batch(
        batch.t_ns[rows], blocks, select(batch.seq), select(batch.device_seq), select(batch.t_device_ns), batch.events
    )
