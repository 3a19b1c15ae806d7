"""The counters that devices send along, unrolled, and what they state is missing."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from tacpipe.arrays import Bools, Int64s, Times

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
