"""A rig at work: all its stations, what is informed of them, and the spool while a recording runs."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Protocol

from tacpipe.errors import DeviceError
from tacpipe.recording import clock, silence_diagnosis
from tacpipe.recording import spool as spool_of
from tacpipe.recording.pace import STALL_NS
from tacpipe.recording.rig import Rig
from tacpipe.recording.spool import Spool
from tacpipe.recording.spool_blocks import Note
from tacpipe.recording.station import LOST, Station
from tacpipe.recording.watch import Watch
from tacpipe.sensors.framing import Chunks

TICK_S = 0.05  # between two looks at what came; what a crash costs is about as long
SYNC_S = 0.5  # between two syncs of the spool
FIRST_S = 3.0  # in which every stream that should send all the time must give its first sample
SILENT_S = 2.0  # without a sample, after which such a stream counts as lost though its link is open
DRAIN_S = 2.0  # after this program was held up, in which links are read until nothing waits in them
PREROLL_S = 0.5  # before a trigger, that are recorded too


class Companion(Protocol):
    """What follows a rig while it is recorded, as a model in a process of its own; nothing of it may wait or raise."""

    def put(self, stream: str, content: Chunks | Note) -> None:
        """Take what came of a stream; called by the threads that read."""

    def begin(self, clock: Mapping[str, int]) -> None:
        """Take note that a recording begins, with one reading of the monotonic clock and of UTC."""

    def end(self) -> None:
        """Take note that the recording ends."""

    def look(self) -> Iterable[Note]:
        """Do what is due, after each look at what came; return notes for the recording."""


class Recorder:
    """The open rig. `tick` moves what came from the links to watches and spool; somebody calls it all the time."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.stations = {name: Station(stream) for name, stream in rig.streams.items()}
        self.watches = {name: Watch(stream) for name, stream in rig.streams.items()}
        self._spool: Spool | None = None
        self._companion: Companion | None = None
        self._looked_ns: int | None = None  # when what came was last looked for
        self._awake_ns = (
            0  # since when that happens all the time: a silence that began before may be this program's own
        )
        self._held_ns = 0  # for how long in all this program was held up
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
        """Look at what came since the last tick: first it is spooled, then looked at."""
        self._look()
        came = {name: station.take() for name, station in self.stations.items()}
        if self._spool is not None:
            for name, blocks in came.items():
                _spooled(self._spool, name, blocks)
            self._spool.write()
        for name, blocks in came.items():
            self._watched(name, blocks)
        for note in () if self._companion is None else self._companion.look():
            if self._spool is not None:
                self._spool.note(note)

    def run(self, until: Callable[[], bool], each: Callable[[], None] = lambda: None) -> None:
        """Tick until ``until()``; ``each`` is called after every tick."""
        due_s = clock.now_s()
        while not until():
            self.tick()
            each()
            due_s = max(due_s + TICK_S, clock.now_s())
            clock.sleep(max(0.0, due_s - clock.now_s()))

    def await_first(self, stopped: Callable[[], bool]) -> None:
        """Wait until every stream that should gave a sample. Raises `DeviceError` naming those that do not, and why."""
        deadline_s = clock.now_s() + FIRST_S
        late = {name for name, watch in self.watches.items() if watch.stream.sensor.awaited}

        held_ns = self._held_ns

        def settled() -> bool:
            late.difference_update({name for name in late if self.watches[name].samples})
            self._look()
            return not late or stopped() or clock.now_s() - (self._held_ns - held_ns) / 1e9 > deadline_s

        self.run(settled)
        if late and not stopped():
            raise DeviceError("\n".join(self._silent(name) for name in sorted(late)))

    def accompany(self, companion: Companion, streams: Iterable[str]) -> None:
        """Have a companion follow these streams: it gets what comes before it is spooled, from the threads that read."""
        self._companion = companion
        for name in streams:
            self.stations[name].listener = functools.partial(companion.put, name)

    def follow(self) -> None:
        """Have the companion begin without a recording: what comes from now on is followed and not kept."""
        if self._companion is not None:
            self._companion.begin(spool_of.now())
        for name, station in self.stations.items():
            self._watched(name, station.begin(lambda chunks, size, last_ns: None, None))

    @contextlib.contextmanager
    def recording(self, spool: Spool, *, preroll: bool = False) -> Iterator[None]:
        """Spool what comes while in the block, and with ``preroll`` what came right before; then finish the spool."""
        ended = threading.Event()
        syncing = threading.Thread(target=_sync, args=(spool, ended), daemon=True)
        since_ns = clock.now_ns() - round(PREROLL_S * 1e9)
        if self._companion is not None:
            self._companion.begin(spool.clock)
        for name, station in self.stations.items():
            self._watched(name, station.take())
            early = _since(self._before[name], since_ns) if preroll else None
            found = station.begin(functools.partial(spool.tally, spool.streams[name]), early)
            if station.error is not None:  # of what happened before a recording nothing else would state
                spool.note(Note(clock.now_ns(), name, LOST, str(station.error)))
            if early is not None:
                _spooled(spool, name, [*early, *found])
            self._watched(name, found)
        self._spool = spool
        syncing.start()
        try:
            yield
        finally:
            self._spool = None
            if self._companion is not None:
                self._companion.end()
            self._look()
            if clock.now_ns() - self._awake_ns < DRAIN_S * 1e9:
                self._drain()
            last = {name: station.end() for name, station in self.stations.items()}
            for name, blocks in last.items():
                _spooled(spool, name, blocks)
            ended.set()
            syncing.join()
            spool.finish()
            for name, blocks in last.items():
                self._watched(name, blocks)  # the next recording may want what came right before it

    def lost(self) -> list[str]:
        """Return a sentence for each stream whose link is lost now, or open and silent where it should not be.

        What counts is the silence up to the last look at what came: a slow disk, or this program being stopped, is none.
        """
        sentences = []
        for name, station in self.stations.items():
            heard_ns = max(self.watches[name].last_ns or 0, self._awake_ns)
            silent_s = ((self._looked_ns or heard_ns) - heard_ns) / 1e9
            if station.error is not None:
                sentences.append(str(station.error))
            elif station.stream.sensor.awaited and silent_s > SILENT_S:
                sentences.append(
                    f"Stream {name} ({station.stream.address}): nothing came for {silent_s:.1f} s, though it is open. "
                    f"The device hangs or is switched off: switch it off and on."
                )
        return sentences

    def tare(self) -> None:
        """Have every device that knows how take its present reading for zero."""
        for station in self.stations.values():
            station.tare()
        for watch in self.watches.values():
            watch.tare()

    def _drain(self) -> None:
        """Wait for those that read the links to fetch what waited while this program was held up; not for ever."""
        since_ns = clock.now_ns()
        while clock.now_ns() - since_ns < DRAIN_S * 1e9:
            clock.sleep(TICK_S)
            if all(station.drained(since_ns) for station in self.stations.values()):
                return

    def _look(self) -> None:
        """Take note that what came is looked at now, and where that was overdue: links may then hold what waited."""
        now_ns = clock.now_ns()
        since_ns, self._looked_ns = now_ns - (self._looked_ns or now_ns), now_ns
        overdue_ns = since_ns - round(TICK_S * 1e9)
        if overdue_ns > STALL_NS:
            self._awake_ns, self._held_ns = now_ns, self._held_ns + overdue_ns

    def _watched(self, name: str, blocks: list[Chunks | Note]) -> None:
        """Look at what came, and keep it as long as a trigger may want it."""
        before = self._before[name]
        if blocks:
            self.watches[name].feed(blocks)
            before.append((clock.now_ns(), blocks))
        while before and before[0][0] < clock.now_ns() - PREROLL_S * 1e9:
            before.popleft()

    def _silent(self, name: str) -> str:
        station, watch = self.stations[name], self.watches[name]
        if station.error is not None:
            return str(station.error)
        if watch.error:
            return f"Stream {name} ({station.stream.address}): {watch.error}"
        return silence_diagnosis.sentence(
            station.stream, f"a frame of {station.stream.kind} was awaited for {FIRST_S:g} s", watch.heard
        )


def _sync(spool: Spool, ended: threading.Event) -> None:
    while not ended.wait(SYNC_S) and spool.failed is None:
        spool.sync()


def _since(before: deque[tuple[int, list[Chunks | Note]]], since_ns: int) -> list[Chunks | Note]:
    """Return what arrived since a moment, of blocks that were taken at any time after."""
    blocks = [block for _, several in before for block in several]
    kept: list[Chunks | Note] = []
    for block in blocks:
        if isinstance(block, Chunks):
            block = block.since(since_ns)
            kept += [block] if len(block.size) else []
        elif block.t_ns >= since_ns:
            kept.append(block)
    return kept


def _spooled(spool: Spool, name: str, blocks: list[Chunks | Note]) -> None:
    for block in blocks:
        if isinstance(block, Note):
            spool.note(block)
        else:
            spool.append(name, block)
