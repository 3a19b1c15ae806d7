"""Emulate a rig without threads or devices: a script lists what each stream sends, and waiting moves the clock."""

from collections.abc import Callable, Iterable

import pytest

from tacpipe.recording import clock, recorder
from tacpipe.recording.rig import RigStream
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.station import Tally
from tacpipe.sensors.framing import Chunks

START_NS = 1_000_000_000_000
Sent = list[tuple[float, bytes]]  # seconds after the start, and bytes


class Script:
    """The time, what every stream of the next rig sends, and what else happens at which second."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.t_ns = START_NS
        self.sent: dict[str, Sent] = {}
        self.happens: list[tuple[float, Callable[[], object]]] = []
        self.tared: list[float] = []
        self.drained_s = 0.0  # the time at which readers have fetched all that waited
        monkeypatch.setattr(clock, "now_ns", lambda: self.t_ns)
        monkeypatch.setattr(clock, "sleep", self.sleep)
        monkeypatch.setattr(recorder, "Station", lambda stream: Station(self, stream))

    @property
    def t_s(self) -> float:
        """Seconds after the start."""
        return (self.t_ns - START_NS) / 1e9

    def sleep(self, seconds: float) -> None:
        """Let time pass, and what happens meanwhile happen."""
        until_ns = self.t_ns + round(seconds * 1e9)
        self.happens.sort(key=lambda event: event[0])
        while self.happens and START_NS + self.happens[0][0] * 1e9 <= until_ns:
            at_s, happen = self.happens.pop(0)
            self.t_ns = max(self.t_ns, START_NS + round(at_s * 1e9))
            happen()
        self.t_ns = max(self.t_ns, until_ns)

    def send(self, stream: str, frames: Iterable[bytes], rate_hz: float, start_s: float = 0.0) -> None:
        """Have a stream send frames at a rate."""
        self.sent[stream] = [(start_s + number / rate_hz, frame) for number, frame in enumerate(frames)]


class Station:
    """Replace `tacpipe.recording.station.Station` and give what is due."""

    def __init__(self, script: Script, stream: RigStream) -> None:
        self.script, self.stream = script, stream
        self.error = None
        self._unread = [(START_NS + round(t_s * 1e9), data) for t_s, data in script.sent.get(stream.name, [])]
        self._tally: Tally | None = None
        self._chunks = self._bytes = 0

    def start(self) -> None:
        """Begin now: what was sent before nobody heard."""
        self._unread = [chunk for chunk in self._unread if chunk[0] >= self.script.t_ns]

    def stop(self) -> None:
        """End."""

    def take(self) -> list[Chunks | StreamNote]:
        """Return what came since the last call."""
        due = [chunk for chunk in self._unread if chunk[0] <= self.script.t_ns]
        self._unread = self._unread[len(due) :]
        if due and self._tally is not None:
            self._chunks, self._bytes = self._chunks + len(due), self._bytes + sum(len(data) for _, data in due)
            self._tally(self._chunks, self._bytes, due[-1][0])
        return [Chunks.from_pairs(due)] if due else []

    def start_recording(self, tally: Tally, early: list[Chunks | StreamNote] | None) -> list[Chunks | StreamNote]:
        """Return what came since the last call, and report to ``tally`` from now on."""
        blocks = self.take()
        counted = [] if early is None else [block for block in (*early, *blocks) if isinstance(block, Chunks)]
        self._chunks = sum(len(block.size) for block in counted)
        self._bytes = sum(len(block.data) for block in counted)
        self._tally = tally
        return blocks

    def end_recording(self) -> list[Chunks | StreamNote]:
        """Return what came since the last call, and stop reporting."""
        blocks = self.take()
        self._tally = None
        return blocks

    def is_drained(self, since_ns: int) -> bool:
        """Return whether what waited was fetched."""
        return self.script.t_s >= self.script.drained_s

    def tare(self) -> bool:
        """Remember when the device was to tare."""
        self.script.tared.append(self.script.t_s)
        return True
