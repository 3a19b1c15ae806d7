"""Frames of the last session that a device kept and sends first, stated by the jump of its counter and thrown away."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tacpipe.arrays import Bytes, Int64s
from tacpipe.sensors.framing import Account, Chunks, Framer, Loss, Run

STALE = "stale"  # a frame that the device kept from its last session
SETTLE_NS = 500_000_000  # time after the first frame in which the jump is awaited: a stale queue arrives at once
Counters = Callable[[Bytes], Int64s]


class FreshFramer:
    """Holds back what another framer gives in the first half second, then drops all before the counter's last jump.

    A jump is a step backward, or forward by more than ``most``. Where there is none, nothing is dropped.
    """

    def __init__(self, framer: Framer, counters: Counters, modulus: int, most: int) -> None:
        self._framer, self._counters, self._modulus, self._most = framer, counters, modulus, most
        self._held: list[Run] | None = []
        self.account: Account = framer.account  # delayed frames are pending

    def feed(self, chunks: Chunks) -> tuple[list[Run], list[Loss]]:
        """Return the frames that are known to be of this session, and what was lost."""
        runs, losses = self._framer.feed(chunks)
        if self._held is None or not (runs or self._held):
            return runs, losses
        return self._decide(runs, losses, ended=False)

    def flush(self) -> tuple[list[Run], list[Loss]]:
        """Return what is left, and what is held back."""
        runs, losses = self._framer.flush()
        return (runs, losses) if self._held is None else self._decide(runs, losses, ended=True)

    def _decide(self, runs: list[Run], losses: list[Loss], *, ended: bool) -> tuple[list[Run], list[Loss]]:
        assert self._held is not None
        self.account.framed -= sum(run.frames.size for run in runs)
        self._held += runs
        if not ended and self._held[-1].t_ns[-1] - self._held[0].t_ns[0] < SETTLE_NS:
            return [], losses
        held, self._held = self._held, None
        stale, fresh = self._parted(held)
        for run in fresh:
            self.account.framed += run.frames.size
        for run in stale:
            self.account.lost += run.frames.size
            losses.append(Loss(int(run.t_ns[-1]), STALE, 0, run.frames.size))
        return fresh, losses

    def _parted(self, runs: list[Run]) -> tuple[list[Run], list[Run]]:
        """Return the runs before the last jump and those from it on."""
        if not runs:
            return [], []
        counters = np.concatenate([self._counters(run.frames) for run in runs])
        t_ns = np.concatenate([run.t_ns for run in runs])
        half = self._modulus // 2
        steps = (np.diff(counters[t_ns - t_ns[0] < SETTLE_NS]) + half) % self._modulus - half
        jumps = np.flatnonzero((steps < 0) | (steps > self._most))
        dropped = int(jumps[-1]) + 1 if len(jumps) else 0  # frames to drop
        stale, fresh = [], []
        for run in runs:
            count = min(dropped, len(run.t_ns))
            dropped -= count
            if count:
                stale.append(Run(run.frames[:count], run.t_ns[:count]))
            if count < len(run.t_ns):
                fresh.append(Run(run.frames[count:], run.t_ns[count:]))
        return stale, fresh
