"""A rig at work: all its stations, what is told of them, and the spool while a recording runs."""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from tacpipe.errors import DeviceError, TacpipeError
from tacpipe.recording.rig import Rig, Stream
from tacpipe.recording.spool import Note, Spool
from tacpipe.recording.station import Station
from tacpipe.recording.watch import Watch
from tacpipe.sensors.framing import Chunks

TICK_S = 0.05  # between two looks at what came; what a crash costs is about as long
SYNC_S = 0.5  # between two syncs of the spool
FIRST_S = 3.0  # in which every stream that has a rate must give its first sample
PREROLL_S = 0.5  # before a trigger, that are recorded too

Recognise = Callable[[Stream, Iterable[Chunks]], str]  # a sentence on what speaks there instead


class Recorder:
    """The open rig. `tick` moves what came from the links to watches and spool; somebody calls it all the time."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.stations = {name: Station(stream) for name, stream in rig.streams.items()}
        self.watches = {name: Watch(stream) for name, stream in rig.streams.items()}
        self._spool: Spool | None = None
        self._before: dict[str, deque[tuple[int, list[Chunks | Note]]]] = {name: deque() for name in rig.streams}

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """Have all streams open while in the block. Raises `DeviceError` with a sentence for each that does not open."""
        began: list[Station] = []
        try:
            failed = []
            for station in self.stations.values():
                try:
                    station.start()
                    began.append(station)
                except DeviceError as error:
                    failed.append(str(error))
            if failed:
                raise DeviceError("\n".join(failed))
            yield
        finally:
            for station in began:
                station.stop()

    def tick(self) -> None:
        """Look at what came since the last tick."""
        for name, station in self.stations.items():
            self._took(name, station.take())
        if self._spool is not None:
            self._spool.write()

    def run(self, until: Callable[[], bool], each: Callable[[], None] = lambda: None) -> None:
        """Tick until ``until()``; ``each`` is called after every tick."""
        due_s = time.monotonic()
        while not until():
            self.tick()
            each()
            due_s = max(due_s + TICK_S, time.monotonic())
            time.sleep(max(0.0, due_s - time.monotonic()))

    def await_first(self, recognise: Recognise, stopped: Callable[[], bool]) -> None:
        """Wait until every stream with a rate gave a sample. Raises `DeviceError` naming those that do not, and why."""
        deadline_s = time.monotonic() + FIRST_S
        late = {name for name, watch in self.watches.items() if watch.stream.sensor.rate_hz}

        def settled() -> bool:
            late.difference_update({name for name in late if self.watches[name].samples})
            return not late or stopped() or time.monotonic() > deadline_s

        self.run(settled)
        if late and not stopped():
            raise DeviceError("\n".join(self._silent(name, recognise) for name in sorted(late)))

    @contextlib.contextmanager
    def recording(self, store: Path, header: Mapping[str, Any], *, preroll: bool = False) -> Iterator[Spool]:
        """Record what comes while in the block, and with ``preroll`` what came right before."""
        spool = Spool(store, {**header, "rig": self.rig.text}, list(self.stations))
        ended = threading.Event()
        syncing = threading.Thread(target=_sync, args=(spool, ended), daemon=True)
        for name, station in self.stations.items():
            number = spool.streams[name]
            self._took(name, station.begin(functools.partial(spool.tally, number)))
            for _, blocks in self._before[name] if preroll else ():
                _spooled(spool, name, blocks)
        self._spool = spool
        syncing.start()
        try:
            yield spool
        finally:
            self._spool = None
            for name, station in self.stations.items():
                blocks = station.end()
                self.watches[name].feed(blocks)
                _spooled(spool, name, blocks)
            ended.set()
            syncing.join()
            spool.close()

    def lost(self) -> list[str]:
        """Return the streams whose link is lost now, each with why."""
        return [f"{name}: {station.error}" for name, station in self.stations.items() if station.error is not None]

    def tare(self) -> list[str]:
        """Have every device take its present reading for zero; return those streams that have no such command."""
        none = [name for name, station in self.stations.items() if not station.tare()]
        for watch in self.watches.values():
            watch.tare()
        return none

    def _took(self, name: str, blocks: list[Chunks | Note]) -> None:
        now_ns = time.monotonic_ns()
        before = self._before[name]
        if blocks:
            self.watches[name].feed(blocks)
            before.append((now_ns, blocks))
        while before and before[0][0] < now_ns - PREROLL_S * 1e9:
            before.popleft()
        if self._spool is not None:
            _spooled(self._spool, name, blocks)

    def _silent(self, name: str, recognise: Recognise) -> str:
        station, watch = self.stations[name], self.watches[name]
        stream = station.stream
        if station.error is not None:
            return str(station.error)
        heard = sum(len(chunk.data) for chunk in watch.heard)
        if not heard:
            return (
                f"Stream {name}: {stream.address} is open and silent: {stream.kind} sent nothing in {FIRST_S:g} s. "
                f"Check its power and cable, and that its stream is on; `tacpipe sensors probe {stream.address}` listens at "
                f"all rates."
            )
        return (
            f"Stream {name}: {heard} bytes came from {stream.address} in {FIRST_S:g} s, and none make a frame of "
            f"{stream.kind}. {recognise(stream, watch.heard)}"
        )


def _sync(spool: Spool, ended: threading.Event) -> None:
    while not ended.wait(SYNC_S):
        with contextlib.suppress(TacpipeError):  # the next write says so in the thread that can act on it
            spool.sync()


def _spooled(spool: Spool, name: str, blocks: list[Chunks | Note]) -> None:
    for block in blocks:
        if isinstance(block, Note):
            spool.note(block)
        else:
            spool.append(name, block)
