"""Run a live session: the rig is recorded as usual, and a separate process runs the model.

The `Supervisor` starts that process, reads its reports, and restarts it if it ends unexpectedly.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Literal, get_args

from tacpipe.errors import DamagedError, DeviceError, TacpipeError, UsageError
from tacpipe.io import Json
from tacpipe.live import wire
from tacpipe.live.settings import SessionOptions
from tacpipe.live.wire import RecorderTap, SessionFigures
from tacpipe.recording import clock
from tacpipe.recording.recorder import Recorder
from tacpipe.recording.spool import StreamNote
from tacpipe.recording.spool_folders import ClockReading
from tacpipe.sensors.framing import Chunks

MODULE = "tacpipe.live.process"  # module run as the model's process
RESTART_S = (0.5, 10.0)  # wait between the end of a model's process and the next start: first and maximum
STOP_S = 5.0  # timeout for the process to end and close its publishers
LOOK_S = 0.05
Counted = Literal["forecasts", "skipped", "late", "dropped"]  # figures that add up over processes
DIED, RESTARTED = "model_died", "model_restarted"  # notes in the recording
SWITCH_S = 0.0005  # maximum time that a thread delays another; reading threads must not wait 5 ms for the view


@contextlib.contextmanager
def run_model(recorder: Recorder, options: SessionOptions, is_over: Callable[[], bool]) -> Iterator[Supervisor]:
    """Run the model's process on a rig's data within the block, and yield its supervisor.

    Raises the error with which the process rejects the session.
    """
    supervisor = Supervisor(options, RecorderTap(options.streams))
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        supervisor.start(is_over)
        recorder.accompany(supervisor, options.streams)
        gc.collect()
        gc.freeze()  # a later full collection would delay the reading threads by 20 ms and more
        yield supervisor
    finally:
        gc.unfreeze()
        supervisor.stop()
        sys.setswitchinterval(before_s)


def describe_figures(figures: SessionFigures) -> list[str]:
    """Return the progress of a session in words.

    >>> describe_figures({"answers": "forecasts", "forecasts": 9, "skipped": 1, "restarts": 0, "cause": "",
    ...     "states": {"slip": "0.02, alarm off"},
    ...     "latency": {"count": 9, "p50_ms": 4.2, "p99_ms": 6.0, "max_ms": 6.5}})
    ['forecasts 9, skipped 1; latency median 4.2 ms, 99 % 6.0 ms, largest 6.5 ms; slip 0.02, alarm off']
    """
    latency = figures.get("latency")
    answers = figures.get("answers", "answers")
    parts = [f"{answers} {figures.get('forecasts', 0)}, skipped {figures.get('skipped', 0)}"]
    if latency and latency["count"]:
        parts.append(
            f"latency median {latency['p50_ms']:.1f} ms, 99 % {latency['p99_ms']:.1f} ms, "
            f"largest {latency['max_ms']:.1f} ms"
        )
    states = ", ".join(f"{name} {state}" for name, state in figures.get("states", {}).items())
    parts += [states] if states else []
    for count, label in (
        (figures.get("late"), "samples late"),
        (figures.get("dropped"), "messages not taken by subscribers"),
        (figures.get("overflows"), "times the model's process did not keep up"),
        (figures.get("restarts"), "restarts of the model's process"),
    ):
        parts += [f"{count} {label}"] if count else []
    line = "; ".join(parts)
    return [line, f"{figures.get('kind', 'model')}: {figures['cause']}"] if figures.get("cause") else [line]


class Supervisor:
    """Keeps the model's process of a session running; a `tacpipe.recording.recorder.Companion`."""

    def __init__(self, options: SessionOptions, tap: RecorderTap) -> None:
        self.options, self.tap = options, tap
        self._noted_stream = options.own_streams[0]  # stream for notes on the process
        self.report: SessionFigures = {}  # last report of the running process
        self.deaths = 0
        self.ready = False
        # sums over the processes that have ended
        self._totals: dict[Counted, int] = dict.fromkeys(get_args(Counted), 0)
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._lines = wire.LineCutter()
        self._offset_ns: int | None = None  # offset of the running recording
        self._beginning: Json | None = None  # state from which a new process continues
        self._restart_s = RESTART_S[0]
        self._due_s = 0.0
        self._refusal: tuple[str, int] | None = None

    def start(self, is_over: Callable[[], bool]) -> None:
        """Start the process and wait until it is ready. Raises the error with which it rejects the session."""
        self._spawn()
        while not is_over() and not self._is_ready():
            clock.sleep(LOOK_S)

    def _is_ready(self) -> bool:
        """Return whether the process is waiting for data. Raises its error if it rejects the session or has ended."""
        code = None if self._process is None else self._process.poll()
        self._read()
        if self._refusal is not None:
            sentence, number = self._refusal
            self.stop()
            kinds = {kind.exit_code: kind for kind in (TacpipeError, UsageError, DeviceError, DamagedError)}
            raise kinds.get(number, TacpipeError)(sentence)
        if code is not None:
            self.stop()
            raise TacpipeError(f"The model's process ended with {code} before it was ready; see above.")
        return self.ready

    def put(self, stream: str, content: Chunks | StreamNote) -> None:
        """Pass a block of a stream to the model's process."""
        self.tap.put(stream, content)

    def begin(self, clock: ClockReading) -> None:
        """Start a recording whose UTC is the monotonic clock plus a constant."""
        self._offset_ns = clock["utc_ns"] - clock["monotonic_ns"]
        self._beginning = None
        self.tap.note(StreamNote(clock["monotonic_ns"], "", wire.BEGIN, str(self._offset_ns)))

    def end(self) -> None:
        """End the recording; data until the next one are not predicted."""
        self._offset_ns = None
        self.tap.note(StreamNote(clock.now_ns(), "", wire.END))

    def look(self) -> list[StreamNote]:
        """Read the process's reports and restart it if it has ended; return notes on that.

        Never raises and never waits.
        """
        self.tap.flush()
        self._read()
        notes = []
        if self._process is not None and self._process.poll() is not None:
            code = self._process.returncode
            self.deaths += 1
            self._discard_process()
            self._due_s = clock.now_s() + self._restart_s
            self._restart_s = min(2 * self._restart_s, RESTART_S[1])
            notes.append(StreamNote(clock.now_ns(), self._noted_stream, DIED, f"exit code {code}; it is started anew"))
        if self._process is None and clock.now_s() >= self._due_s:
            with contextlib.suppress(OSError):  # there is too little memory for a process now: try again later
                self._spawn()
                notes.append(
                    StreamNote(clock.now_ns(), self._noted_stream, RESTARTED, f"restart {self.deaths} of this session")
                )
        return notes

    def stop(self) -> None:
        """Ask the process to end, and kill it if it does not."""
        process = self._process
        if process is None:
            return
        self.tap.note(StreamNote(clock.now_ns(), "", wire.STOP))
        until_s = clock.now_s() + STOP_S
        while process.poll() is None and clock.now_s() < until_s:
            self.tap.flush()
            self._read()
            clock.sleep(LOOK_S / 5)
        self._read()
        if process.poll() is None:
            process.kill()
        process.wait()
        self.tap.connect(None)
        if self._socket is not None:
            self._socket.close()
        self._process = self._socket = None

    def figures(self) -> SessionFigures:
        """Return the session's figures over all of its processes."""
        figures = self.report.copy()
        for name, count in self._totals.items():
            figures[name] = count + self.report.get(name, 0)
        figures["restarts"], figures["overflows"] = self.deaths, self.tap.overflows
        return figures

    def _spawn(self) -> None:
        """Start the model's process, and pass it the options and, during a recording, the state from which it continues."""
        ours, theirs = socket.socketpair()
        threads = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}  # more threads would only compete with the recorder
        environment = {**os.environ, **threads}
        command = [sys.executable, "-P", "-m", MODULE, str(theirs.fileno())]  # -P: not from the working directory
        try:
            self._process = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], env=environment, stdin=subprocess.DEVNULL, start_new_session=True
            )
        finally:
            theirs.close()
        self._socket, self._lines, self.ready = ours, wire.LineCutter(), False
        ours.sendall(self.options.to_json().encode())
        ours.setblocking(False)
        first_notes = (
            [] if self._offset_ns is None else [StreamNote(clock.now_ns(), "", wire.BEGIN, str(self._offset_ns))]
        )
        if first_notes and self._beginning is not None:
            first_notes.insert(0, StreamNote(clock.now_ns(), "", wire.CONTINUE, json.dumps(self._beginning)))
        self.tap.connect(ours, *first_notes)
        if first_notes:
            self.tap.put_begins()

    def _discard_process(self) -> None:
        """Close the connection to a process that has ended, and add its counts to the totals."""
        self.tap.connect(None)
        if self._socket is not None:
            self._socket.close()
        self._process = self._socket = None
        for name in self._totals:
            self._totals[name] += self.report.get(name, 0)
        before, self.report = self.report, {"cause": "the model's process is started anew"}
        if "latency" in before:
            self.report["latency"] = before["latency"]

    def _read(self) -> None:
        """Process the lines that the process has sent; never waits."""
        if self._socket is None:
            return
        while True:
            try:
                data = self._socket.recv(1 << 16)
            except OSError:
                return
            if not data:
                return
            for content in self._lines.feed(data):
                if "ready" in content:
                    self.ready = True
                elif "refused" in content:
                    self._refusal = content["refused"], content["exit_code"]
                elif "beginning" in content:
                    # a report with another offset belongs to the previous recording
                    if content["offset_ns"] == self._offset_ns:
                        self._beginning = content["beginning"]
                elif "report" in content:
                    self.report = content["report"]
                    self._restart_s = RESTART_S[0]
