"""Run an open rig: move the bytes of all stations to the watches, to a companion, and to the spool of a recording."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Protocol

from tacpipe.errors import DeviceError
from tacpipe.links import opening
from tacpipe.recording import clock
from tacpipe.recording import rig as rigs
from tacpipe.recording import spool as spool_of
from tacpipe.recording.pace import STALL_NS
from tacpipe.recording.rig import Rig, RigStream
from tacpipe.recording.spool import Spool, StreamNote
from tacpipe.recording.spool_folders import ClockReading
from tacpipe.recording.station import LOST, Station, explain_silence
from tacpipe.recording.watch import Watch
from tacpipe.sensors import variants
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Options

TICK_S = 0.05  # period of moving bytes to the spool; a crash costs about as much
SYNC_S = 0.5  # period of syncing the spool
FIRST_S = 3.0  # limit for the first sample of a stream that sends continuously
SILENT_S = 2.0  # such a stream counts as lost after so long without a sample, though its link is open
DRAIN_S = 2.0  # limit for emptying the links after this program was delayed
PREROLL_S = 0.5  # time before a trigger that is recorded too


class Companion(Protocol):
    """A follower of a rig while it is recorded, such as a model in its own process. No method may wait or raise."""

    def put(self, stream: str, content: Chunks | StreamNote) -> None:
        """Receive bytes or a note of a stream. The reading threads call this."""

    def begin(self, clock: ClockReading) -> None:
        """Begin a recording. ``clock`` has one reading of the monotonic clock and of UTC."""

    def end(self) -> None:
        """End the recording."""

    def look(self) -> Iterable[StreamNote]:
        """Do the work that is due after each tick, and return notes for the recording."""


class Recorder:
    """An open rig. `tick` moves bytes from the links to the watches and the spool, and must be called all the time."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.stations = {name: Station(stream) for name, stream in rig.streams.items()}
        self.watches = {name: Watch(stream) for name, stream in rig.streams.items()}
        self._spool: Spool | None = None
        self._companion: Companion | None = None
        self._looked_ns: int | None = None  # time of the last tick
        self._awake_ns = 0  # start of uninterrupted ticks: an earlier silence may be a delay of this program
        self._held_ns = 0  # total time that this program was delayed
        self._before: dict[str, deque[tuple[int, list[Chunks | StreamNote]]]] = {name: deque() for name in rig.streams}

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """Keep all streams open in the block. Raises `DeviceError` with a sentence for each that does not open."""
        started: list[Station] = []
        try:
            failed = []
            for station in self.stations.values():
                try:
                    station.start()
                    started.append(station)
                except DeviceError as error:
                    failed.append(str(error))
            if failed:
                raise DeviceError("\n".join(failed))
            yield
        finally:
            for station in started:
                station.stop()

    def tick(self) -> None:
        """Take the bytes since the last tick, spool them, and then pass them to the watches."""
        self._look()
        blocks_by_stream = {name: station.take() for name, station in self.stations.items()}
        if self._spool is not None:
            for name, blocks in blocks_by_stream.items():
                _spool_blocks(self._spool, name, blocks)
            self._spool.write()
        for name, blocks in blocks_by_stream.items():
            self._watch(name, blocks)
        for note in () if self._companion is None else self._companion.look():
            if self._spool is not None:
                self._spool.note(note)

    def run(self, until: Callable[[], bool], after_tick: Callable[[], None] = lambda: None) -> None:
        """Tick until ``until()`` is true. ``after_tick`` is called after every tick."""
        due_s = clock.now_s()
        while not until():
            self.tick()
            after_tick()
            due_s = max(due_s + TICK_S, clock.now_s())
            clock.sleep(max(0.0, due_s - clock.now_s()))

    def await_first(self, stopped: Callable[[], bool]) -> None:
        """Wait for a sample of every stream that sends continuously. Raises `DeviceError` with the reasons of late ones."""
        deadline_s = clock.now_s() + FIRST_S
        late = {name for name, watch in self.watches.items() if watch.stream.sensor.awaited}

        held_ns = self._held_ns

        def settled() -> bool:
            late.difference_update({name for name in late if self.watches[name].samples})
            self._look()
            return not late or stopped() or clock.now_s() - (self._held_ns - held_ns) / 1e9 > deadline_s

        self.run(settled)
        if late and not stopped():
            raise DeviceError("\n".join(self._explain_silence(name) for name in sorted(late)))

    def accompany(self, companion: Companion, streams: Iterable[str]) -> None:
        """Have a companion follow these streams. The reading threads pass it the bytes before they are spooled."""
        self._companion = companion
        for name in streams:
            self.stations[name].listener = functools.partial(companion.put, name)

    def follow(self) -> None:
        """Have the companion begin without a recording. Nothing is spooled."""
        if self._companion is not None:
            self._companion.begin(spool_of.read_clocks())
        for name, station in self.stations.items():
            self._watch(name, station.begin(lambda chunks, size, last_ns: None, None))

    @contextlib.contextmanager
    def recording(self, spool: Spool, *, preroll: bool = False) -> Iterator[None]:
        """Spool the bytes that arrive in the block, with ``preroll`` also those right before, then finish the spool."""
        stopped = threading.Event()
        syncing = threading.Thread(target=_sync, args=(spool, stopped), daemon=True)
        since_ns = clock.now_ns() - round(PREROLL_S * 1e9)
        if self._companion is not None:
            self._companion.begin(spool.clock)
        for name, station in self.stations.items():
            self._watch(name, station.take())
            early = _since(self._before[name], since_ns) if preroll else None
            pending = station.begin(functools.partial(spool.tally, spool.streams[name]), early)
            if station.error is not None:  # the loss came before the recording, so no note states it
                spool.note(StreamNote(clock.now_ns(), name, LOST, str(station.error)))
            if early is not None:
                _spool_blocks(spool, name, [*early, *pending])
            self._watch(name, pending)
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
                _spool_blocks(spool, name, blocks)
            stopped.set()
            syncing.join()
            spool.finish()
            for name, blocks in last.items():
                self._watch(name, blocks)  # the next recording may need them as preroll

    def lost(self) -> list[str]:
        """Return a sentence for each stream whose link is lost, or that is silent though its link is open.

        Only the silence up to the last tick counts: a slow disk or a delay of this program is not a silence.
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
        """Have every device with such a command take its present reading as zero."""
        for station in self.stations.values():
            station.tare()
        for watch in self.watches.values():
            watch.tare()

    def _drain(self) -> None:
        """Wait, at most `DRAIN_S`, until the links are read empty after this program was delayed."""
        since_ns = clock.now_ns()
        while clock.now_ns() - since_ns < DRAIN_S * 1e9:
            clock.sleep(TICK_S)
            if all(station.drained(since_ns) for station in self.stations.values()):
                return

    def _look(self) -> None:
        """Note the time of this tick, and whether it was overdue: bytes may then wait in the links."""
        now_ns = clock.now_ns()
        since_ns, self._looked_ns = now_ns - (self._looked_ns or now_ns), now_ns
        overdue_ns = since_ns - round(TICK_S * 1e9)
        if overdue_ns > STALL_NS:
            self._awake_ns, self._held_ns = now_ns, self._held_ns + overdue_ns

    def _watch(self, name: str, blocks: list[Chunks | StreamNote]) -> None:
        """Pass blocks to the watch, and keep them as long as a trigger may need them."""
        before = self._before[name]
        if blocks:
            self.watches[name].feed(blocks)
            before.append((clock.now_ns(), blocks))
        while before and before[0][0] < clock.now_ns() - PREROLL_S * 1e9:
            before.popleft()

    def _explain_silence(self, name: str) -> str:
        station, watch = self.stations[name], self.watches[name]
        if station.error is not None:
            return str(station.error)
        if watch.error:
            return f"Stream {name} ({station.stream.address}): {watch.error}"
        return explain_silence(
            station.stream, f"a frame of {station.stream.kind} was awaited for {FIRST_S:g} s", watch.heard
        )


def _sync(spool: Spool, stopped: threading.Event) -> None:
    while not stopped.wait(SYNC_S) and spool.failed is None:
        spool.sync()


def _since(before: deque[tuple[int, list[Chunks | StreamNote]]], since_ns: int) -> list[Chunks | StreamNote]:
    """Return the parts of blocks that arrived since ``since_ns``."""
    blocks = [block for _, part in before for block in part]
    recent: list[Chunks | StreamNote] = []
    for block in blocks:
        if isinstance(block, Chunks):
            block = block.since(since_ns)
            recent += [block] if len(block.size) else []
        elif block.t_ns >= since_ns:
            recent.append(block)
    return recent


def _spool_blocks(spool: Spool, name: str, blocks: list[Chunks | StreamNote]) -> None:
    for block in blocks:
        if isinstance(block, StreamNote):
            spool.note(block)
        else:
            spool.append(name, block)


STATED_S = 5.0  # limit for a device to state its options


def complete_rig(rig: Rig) -> Rig:
    """Return the rig with the options that its devices state. Options in the rig file have precedence.

    Raises `DeviceError` for a device that is missing or states nothing. The options become part of the rig's text, so that a
    recording that a crash cut off is sealed without the device.
    """
    if not any(stream.sensor.incomplete for stream in rig.streams.values()):
        return rig
    streams = {
        name: _complete_stream(stream) if stream.sensor.incomplete else stream for name, stream in rig.streams.items()
    }
    complete = replace(rig, streams=streams)
    return replace(complete, text=rigs.to_toml(complete))


def _complete_stream(stream: RigStream) -> RigStream:
    options = {**_read_options(stream), **stream.options}
    sensor = rigs.build_sensor(stream.kind, options, f"stream {stream.name}")
    return replace(stream, options=options, sensor=sensor)


def _read_options(stream: RigStream) -> Options:
    chunks: list[tuple[int, bytes]] = []
    until_s = clock.now_s() + STATED_S
    with closing(opening.open_link(stream.address, stream.sensor, stream.name)) as link:
        while clock.now_s() < until_s:
            chunks += link.read(0.1)
            options = variants.of(stream.kind, Chunks.of(chunks)) if chunks else []
            if options:
                return options[0]
    raise DeviceError(
        f"Stream {stream.name} ({stream.address}): the device did not state its options within {STATED_S:g} s; "
        "write them into the rig file."
    )
