"""Run ``tacpipe`` with a recorder that gives devices as long as a busy computer may take.

A trial's duration is counted in samples there: it has lasted a second once every stream gave those of a second. How long a
device may be silent is tried over a clock that the test turns, in `test_schedule`; here such limits would measure the
computer.
"""

import importlib
import time
from dataclasses import replace

import pytest

from tacpipe.links import opening
from tacpipe.recording.recorder import Recorder
from tacpipe.recording.watch import Watch
from tacpipe.sensors.sensor import Ask

TIMES = 50
HANGS_S = 600.0
LIMITS = {
    "tacpipe.recording.recorder": ("FIRST_S", "SILENT_S"),
    "tacpipe.recording.watch": ("SILENT_S",),
    "tacpipe.recording.station": ("MUTE_S", "TARE_S", "REPLY_S", "STOP_S"),
    "tacpipe.recording.pace": ("STALL_NS",),
    "tacpipe.links.network": ("CONNECT_S",),
    "tacpipe.links.link": ("WRITE_S",),
}


def relax(patch: pytest.MonkeyPatch) -> None:
    """Make the limits so many times as long until ``patch`` is undone."""
    for name, limits in LIMITS.items():
        module = importlib.import_module(name)
        for limit in limits:
            patch.setattr(module, limit, getattr(module, limit) * TIMES)
    patch.setattr("tacpipe.recording.trials.clock", Samples(patch))
    reply = opening._wait_for_reply
    patch.setattr(opening, "_wait_for_reply", lambda link, ask, *args: reply(link, longer(ask), *args))


class Samples:
    """A clock of trials, which goes by what the slowest stream gave while a trial was recorded."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        tick, self.until_s = Recorder.tick, time.monotonic() + HANGS_S
        self.counts: dict[Watch, int] = {}

        def counted(recorder: Recorder) -> None:
            watches = [watch for watch in recorder.watches.values() if watch.stream.sensor.awaited]
            before = [watch.samples for watch in watches]
            tick(recorder)
            if recorder._spool is not None:  # samples between trials belong to no recording
                counts = [
                    self.counts.get(watch, 0) + watch.samples - previous
                    for watch, previous in zip(watches, before, strict=True)
                ]
                self.counts = dict(zip(watches, counts, strict=True))

        patch.setattr(Recorder, "tick", counted)

    def now_s(self) -> float:
        """Return the seconds of samples that every stream gave."""
        assert time.monotonic() < self.until_s, "a stream gives nothing"
        return min((count / watch.stream.sensor.rate_hz for watch, count in self.counts.items()), default=0.0)

    def now_ns(self) -> int:
        """Return the time that stamps notes, which is no other here."""
        return time.monotonic_ns()


def longer(ask: Ask) -> Ask:
    """Return a question whose reply is awaited for so many times as long."""
    return replace(ask, timeout_s=ask.timeout_s * TIMES)


if __name__ == "__main__":
    from tacpipe.cli import main

    relax(pytest.MonkeyPatch())
    main.main()
