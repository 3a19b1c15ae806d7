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
from tacpipe.recording import clock, scheduling
from tacpipe.recording import rig as rigs
from tacpipe.recording import spool as spool_of
from tacpipe.recording.pace import STALL_NS
from tacpipe.recording.rig import Rig, RigStream
from tacpipe.recording.spool import Spool, StreamNote
from tacpipe.recording.spool_folders import ClockReading
from tacpipe.recording.station import LOST, Station, explain_silence
from tacpipe.recording.watch import SILENT_S, Watch
from tacpipe.sensors import variants
from tacpipe.sensors.framing import Chunks
from tacpipe.sensors.sensor import Options

TICK_S = 0.05  # period of moving bytes to the spool; a crash loses about this much
SYNC_S = 0.5  # period of syncing the spool
FIRST_S = 3.0  # timeout for the first sample of a stream that sends continuously
DRAIN_S = 2.0  # timeout for emptying the links at the end of a recording
DRAIN_PAUSE_S = 0.005  # pause between two looks whether they are empty
PREROLL_S = 0.5  # recorded time before a trigger


class Companion(Protocol):
    """A consumer of the bytes of a rig, such as a model in its own process. No method may block or raise."""

    def put(self, stream: str, content: Chunks | StreamNote) -> None:
        """Receive bytes or a note of a stream. The reading threads call this."""

    def begin(self, clock: ClockReading) -> None:
        """Start a recording. ``clock`` has one reading of the monotonic clock and of UTC."""

    def end(self) -> None:
        """End the recording."""

    def look(self) -> Iterable[StreamNote]:
        """Do the work that is due after a tick, and return notes for the recording."""


class Recorder:
    """An open rig. `tick` moves bytes from the links to the watches and the spool, and must be called every `TICK_S`."""

    def __init__(self, rig: Rig, *, realtime: bool = False) -> None:
        """Prepare the streams of a rig; if ``realtime``, recordings run before ordinary programs."""
        self.rig = rig
        self._realtime = realtime
        self.stations = {name: Station(stream) for name, stream in rig.streams.items()}
        self.watches = {name: Watch(stream) for name, stream in rig.streams.items()}
        self._spool: Spool | None = None
        self._companion: Companion | None = None
        self._last_tick_ns: int | None = None
        self._punctual_since_ns = 0  # end of the last delay of this program, during which streams only seemed silent
        self._delay_ns = 0  # total delay of this program
        self._preroll: dict[str, deque[tuple[int, list[Chunks | StreamNote]]]] = {name: deque() for name in rig.streams}

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """Keep all streams open in the block.

        Raises `DeviceError` with a sentence for each stream that cannot be opened.
        """
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
        """Spool the bytes received since the last tick, and pass them to the watches."""
        self._note_tick()
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

    def run(self, is_finished: Callable[[], bool], after_tick: Callable[[], None] = lambda: None) -> None:
        """Tick until ``is_finished()`` is true. ``after_tick`` is called after every tick."""
        due_s = clock.now_s()
        while not is_finished():
            self.tick()
            after_tick()
            due_s = max(due_s + TICK_S, clock.now_s())
            clock.sleep(max(0.0, due_s - clock.now_s()))

    def await_first(self, stopped: Callable[[], bool]) -> None:
        """Wait for a sample of every stream that sends continuously. Raises `DeviceError` with the reasons for silence."""
        deadline_s = clock.now_s() + FIRST_S
        silent_streams = {name for name, watch in self.watches.items() if watch.stream.sensor.awaited}

        previous_delay_ns = self._delay_ns

        def is_settled() -> bool:
            silent_streams.difference_update({name for name in silent_streams if self.watches[name].samples})
            self._note_tick()
            elapsed_s = clock.now_s() - (self._delay_ns - previous_delay_ns) / 1e9
            return not silent_streams or stopped() or elapsed_s > deadline_s

        self.run(is_settled)
        if silent_streams and not stopped():
            raise DeviceError("\n".join(self._explain_silence(name) for name in sorted(silent_streams)))

    def accompany(self, companion: Companion, streams: Iterable[str]) -> None:
        """Pass the bytes of these streams to a companion. The reading threads do so before the bytes are spooled."""
        self._companion = companion
        for name in streams:
            self.stations[name].listener = functools.partial(companion.put, name)

    def follow(self) -> None:
        """Start the companion without a recording. Nothing is spooled."""
        if self._companion is not None:
            self._companion.begin(spool_of.read_clocks())
        self._prioritize()
        for name, station in self.stations.items():
            self._watch(name, station.start_recording(lambda chunks, size, last_ns: None, None))

    def _prioritize(self) -> None:
        if self._realtime:
            scheduling.realtime(scheduling.RECORDER)

    @contextlib.contextmanager
    def recording(self, spool: Spool, *, preroll: bool = False) -> Iterator[None]:
        """Spool the bytes that arrive in the block, then finish the spool.

        With ``preroll``, the bytes of the `PREROLL_S` before the block are spooled too.
        """
        stopped = threading.Event()
        syncing = threading.Thread(target=_sync, args=(spool, stopped), daemon=True)
        preroll_start_ns = clock.now_ns() - round(PREROLL_S * 1e9)
        if self._companion is not None:
            self._companion.begin(spool.clock)
        self._prioritize()
        for name, station in self.stations.items():
            self._watch(name, station.take())
            preroll_blocks = _retained_blocks(self._preroll[name], preroll_start_ns) if preroll else None
            pending = station.start_recording(functools.partial(spool.tally, spool.streams[name]), preroll_blocks)
            if station.error is not None:  # the link was lost before the recording, so no note reports it
                spool.note(StreamNote(clock.now_ns(), name, LOST, str(station.error)))
            if preroll_blocks is not None:
                _spool_blocks(spool, name, [*preroll_blocks, *pending])
            self._watch(name, pending)
        self._spool = spool
        syncing.start()
        try:
            yield
        finally:
            self._spool = None
            if self._realtime:
                scheduling.ordinary()  # decoding and writing have no deadline
            if self._companion is not None:
                self._companion.end()
            self._note_tick()
            self._drain()
            last_blocks = {name: station.end_recording() for name, station in self.stations.items()}
            for name, blocks in last_blocks.items():
                _spool_blocks(spool, name, blocks)
            stopped.set()
            syncing.join()
            spool.finish()
            for name, blocks in last_blocks.items():
                self._watch(name, blocks)  # the next recording may need these blocks as preroll

    def lost(self) -> list[str]:
        """Return a sentence for each stream that is lost, or silent although its link is open.

        Time since the last tick is not counted: a slow disk or a delay of this program is not a silence.
        """
        sentences = []
        for name, station in self.stations.items():
            last_ns = max(self.watches[name].last_ns or 0, self._punctual_since_ns)
            silent_s = ((self._last_tick_ns or last_ns) - last_ns) / 1e9
            if station.error is not None:
                sentences.append(str(station.error))
            elif station.stream.sensor.awaited and silent_s > SILENT_S:
                sentences.append(
                    f"Stream {name} ({station.stream.address}): nothing was received for {silent_s:.1f} s, though it is "
                    f"open. The device hangs or is switched off: power-cycle it."
                )
        return sentences

    def tare(self) -> None:
        """Zero every device that has a command for it, and measure the rest levels again."""
        for station in self.stations.values():
            station.tare()
        for watch in self.watches.values():
            watch.tare()

    def _drain(self) -> None:
        """Wait for at most `DRAIN_S` until all links have been read empty."""
        start_ns = clock.now_ns()
        while clock.now_ns() - start_ns < DRAIN_S * 1e9:
            clock.sleep(DRAIN_PAUSE_S)
            if all(station.is_drained(start_ns) for station in self.stations.values()):
                return

    def _note_tick(self) -> None:
        """Record the time of this tick and its delay: after a delay, bytes may be queued in the links."""
        now_ns = clock.now_ns()
        elapsed_ns, self._last_tick_ns = now_ns - (self._last_tick_ns or now_ns), now_ns
        overdue_ns = elapsed_ns - round(TICK_S * 1e9)
        if overdue_ns > STALL_NS:
            self._punctual_since_ns, self._delay_ns = now_ns, self._delay_ns + overdue_ns

    def _watch(self, name: str, blocks: list[Chunks | StreamNote]) -> None:
        """Pass blocks to the watch, and retain those of the last `PREROLL_S`."""
        retained = self._preroll[name]
        if blocks:
            self.watches[name].feed(blocks)
            retained.append((clock.now_ns(), blocks))
        while retained and retained[0][0] < clock.now_ns() - PREROLL_S * 1e9:
            retained.popleft()

    def _explain_silence(self, name: str) -> str:
        """Return the error of a stream that sent no sample: of its link, of its driver, or that it is silent."""
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


def _retained_blocks(
    retained: deque[tuple[int, list[Chunks | StreamNote]]], start_ns: int
) -> list[Chunks | StreamNote]:
    """Return the blocks that arrived at or after ``start_ns``. Blocks that arrived partly before are cut."""
    blocks = [block for _, batch in retained for block in batch]
    recent: list[Chunks | StreamNote] = []
    for block in blocks:
        if isinstance(block, Chunks):
            remaining = block.since(start_ns)
            recent += [remaining] if len(remaining.size) else []
        elif block.t_ns >= start_ns:
            recent.append(block)
    return recent


def _spool_blocks(spool: Spool, name: str, blocks: list[Chunks | StreamNote]) -> None:
    for block in blocks:
        if isinstance(block, StreamNote):
            spool.note(block)
        else:
            spool.append(name, block)


OPTIONS_S = 5.0  # timeout for a device to report its options


def complete_rig(rig: Rig) -> Rig:
    """Return the rig with the options that its devices report. Options in the rig file take precedence.

    Raises `DeviceError` if a device is missing or reports nothing. The options become part of the rig's text, so that a
    recording can be sealed without the device after a crash.
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
    """Return the options that a device reports. Raises `DeviceError` if it reports none within `OPTIONS_S`."""
    chunks: list[tuple[int, bytes]] = []
    deadline_s = clock.now_s() + OPTIONS_S
    with closing(opening.open_link(stream.address, stream.sensor, stream.name)) as link:
        while clock.now_s() < deadline_s:
            chunks += link.read(0.1)
            options = variants.guess_options(stream.kind, Chunks.from_pairs(chunks)) if chunks else []
            if options:
                return options[0]
    raise DeviceError(
        f"Stream {stream.name} ({stream.address}): the device did not report its options within {OPTIONS_S:g} s; "
        "write them into the rig file."
    )
