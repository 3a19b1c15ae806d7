"""Run the model of a live session in a separate process: receive samples, predict, publish, and report.

So neither its interpreter lock nor a crash affects the recording. The process sleeps until an answer is nearly due and
decodes the samples since, then sleeps until it is due and decodes the remaining few. At 1 kHz that costs a fifth of
waking up for each sample.
"""

from __future__ import annotations

import gc
import math
import os
import select
import socket
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np

from tacpipe.errors import FAILED, TacpipeError, UsageError
from tacpipe.io import Json
from tacpipe.live import publishing, wire
from tacpipe.live.engine import Engine
from tacpipe.live.messages import Message
from tacpipe.live.preparation import open_model
from tacpipe.live.publishing import Publishers
from tacpipe.live.settings import SessionOptions
from tacpipe.plugins import extras
from tacpipe.recording import rig as rigs
from tacpipe.recording import scheduling
from tacpipe.recording.spool import StreamNote

REPORT_NS = 250_000_000  # period of reports to the recording process
FETCH_BYTES = 1 << 18  # number of bytes read at once
SWITCH_S = 0.0005  # maximum time that a publisher's thread delays an answer
MAX_WAIT_S = 0.02
REFUSED = 2  # exit code if the session cannot start with this model and rig
SHORTEST_MS, LONGEST_MS = 0.01, 100_000.0
PER_DECADE = 100  # number of bins per decade of latency; quantiles are accurate to 2.3 %
BINS = PER_DECADE * round(math.log10(LONGEST_MS / SHORTEST_MS))


class Latencies:
    """A histogram of latencies, whose memory does not grow with the length of a session."""

    def __init__(self) -> None:
        self.count = 0
        self.max_ms = 0.0
        self._bins = np.zeros(BINS, dtype=np.int64)

    def add(self, latency_ms: float) -> None:
        """Count a latency."""
        clipped = min(max(latency_ms, SHORTEST_MS), LONGEST_MS * 0.999)
        self._bins[int(math.log10(clipped / SHORTEST_MS) * PER_DECADE)] += 1
        self.count += 1
        self.max_ms = max(self.max_ms, latency_ms)

    def quantile_ms(self, fraction: float) -> float:
        """Return a quantile of the latency, accurate to 2.3 % above it, or 0 if there is none.

        >>> latencies = Latencies()
        >>> for latency_ms in (1.0, 2.0, 3.0, 40.0):
        ...     latencies.add(latency_ms)
        >>> round(latencies.quantile_ms(0.5), 1), latencies.quantile_ms(1.0), latencies.above(20.0)
        (2.0, 40.0, 1)
        """
        if not self.count:
            return 0.0
        bin_index = int(np.searchsorted(np.cumsum(self._bins), math.ceil(fraction * self.count)))
        return min(SHORTEST_MS * 10 ** ((bin_index + 1) / PER_DECADE), self.max_ms)

    def above(self, limit_ms: float) -> int:
        """Return the number of longer latencies, to the width of a bin."""
        first = int(math.log10(limit_ms / SHORTEST_MS) * PER_DECADE) + 1
        return int(self._bins[first:].sum())

    def figures(self) -> wire.LatencyFigures:
        """Return count, median, 99th percentile and maximum."""
        return {
            "count": self.count,
            "p50_ms": round(self.quantile_ms(0.5), 3),
            "p99_ms": round(self.quantile_ms(0.99), 3),
            "max_ms": round(self.max_ms, 3),
        }


class Loop:
    """Runs an engine on a socket until the other end closes it or a note ends the session."""

    def __init__(self, connection: socket.socket, engine: Engine, publishers: Publishers, blocks: wire.Blocks) -> None:
        self.connection, self.engine, self.publishers, self.blocks = connection, engine, publishers, blocks
        self.latencies = Latencies()
        self.forecasts = 0
        self.cause = ""  # the reason why the latest message has no prediction
        self._reported_ns = 0  # monotonic time of the last report
        self._reported: Json | None = None  # the continuation state reported last
        self._ended = False
        self._offset_ns = Message.offset_ns  # that of the latest recording

    def run(self) -> None:
        """Run until the session ends."""
        self.connection.setblocking(False)
        while not self._ended:
            now_ns = time.monotonic_ns()
            self._fetch()
            for message in self.engine.step(now_ns):
                self.publish(message)
            now_ns = time.monotonic_ns()
            if now_ns - self._reported_ns > REPORT_NS:
                self._reported_ns = now_ns
                self.report()
                gc.collect(1)  # a full collection would exceed the time for an answer
            wait_s = (self.engine.due_ns(time.monotonic_ns()) - time.monotonic_ns()) / 1e9
            if wait_s > 0:
                time.sleep(min(wait_s, MAX_WAIT_S))
        for message in self.engine.finish():
            self.publish(message)
        self.report()

    def publish(self, message: Message) -> None:
        """Send a message to all subscribers, and count it and its latency if it is an answer of the model."""
        if self.engine.offset_ns is not None:
            self._offset_ns = self.engine.offset_ns
        self.publishers.publish(message, self._stamp)
        self.cause = message.cause
        if message.answers:
            self.forecasts += 1
        if message.answers and math.isfinite(message.latency_ms):  # an answer about an ended recording has no latency
            self.latencies.add(message.latency_ms)

    def _stamp(self, message: Message) -> None:
        """Write the time of publishing and the latency into a message."""
        now_ns = time.monotonic_ns()
        message.stamp(now_ns, self._offset_ns)
        self.engine.published(message, now_ns)

    def report(self) -> None:
        """Report the session's state to the recording process; skipped if that process does not read."""
        figures: wire.SessionFigures = {
            "kind": self.publishers.about.kind,
            "answers": self.publishers.about.answers,
            "forecasts": self.forecasts,
            "skipped": self.engine.skipped,
            "late": self.engine.late,
            "overflows": self.engine.overflows,
            "dropped": self.publishers.dropped,
            "cause": self.cause,
            "states": {**self.publishers.states, **self.engine.states},
            "cpu_s": round(time.process_time(), 3),
            "latency": self.latencies.figures(),
            "above_10_ms": self.latencies.above(10.0),
            "above_20_ms": self.latencies.above(20.0),
        }
        send_line(self.connection, {"report": figures})
        beginning = self.engine.beginning if self.engine.running else None
        if beginning is not None and beginning != self._reported:
            send_line(self.connection, {"beginning": beginning, "offset_ns": self.engine.offset_ns})
        self._reported = beginning

    def _fetch(self) -> None:
        """Process all received blocks; the session ends if the recording process asks for it or has ended."""
        while True:
            try:
                data = self.connection.recv(FETCH_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                data = b""
            if not data:
                self._ended = True
                return
            for stream, block in self.blocks.feed(data):
                if not stream and isinstance(block, StreamNote) and block.what == wire.STOP:
                    self._ended = True
                self.engine.take(stream, block)


def send_line(connection: socket.socket, content: wire.ModelLine) -> None:
    """Send a line to the recording process, unless it does not read or has ended."""
    try:
        connection.send(wire.line(content))
    except OSError:
        return


def open_engine(options: SessionOptions) -> Engine:
    """Return the engine of a session. Raises `UsageError` if model, rig and settings do not match."""
    model = open_model(options.settings.model)
    rig = rigs.parse(options.rig)
    sensors = {name: rig.streams[name].sensor for name in options.streams}
    try:
        return model.live.engine(model.dataset, rig, sensors, options.settings)
    except TacpipeError as error:
        if error.exit_code != FAILED:
            raise
        raise UsageError(str(error)) from error  # the user chose a rig that the model cannot read


def main(arguments: Sequence[str], engine_for: Callable[[SessionOptions], Engine] = open_engine) -> int:
    """Run the model's process on an inherited socket with the given number; return its exit code."""
    connection = socket.socket(fileno=int(arguments[0]))
    connection.setblocking(True)
    options = SessionOptions.from_json(_read_first_line(connection))
    try:
        with extras.explain_missing("tacpipe live"):
            engine = engine_for(options)
            publishers = publishing.open_publishers(options, engine.describe(options.settings.model))
    except TacpipeError as error:
        send_line(connection, {"refused": str(error), "exit_code": error.exit_code})
        return REFUSED
    gc.collect()
    gc.freeze()
    gc.disable()
    os.nice(options.nice)
    sys.setswitchinterval(SWITCH_S)
    if options.settings.realtime:
        scheduling.realtime(scheduling.MODEL)
    send_line(connection, {"ready": True})
    from tacpipe.models.tensors import one_thread  # imports torch, which the engine has already loaded

    with publishers, one_thread():  # the number of threads is set once, not in each forecast
        Loop(connection, engine, publishers, wire.Blocks(options.streams)).run()
    return 0


def _read_first_line(connection: socket.socket) -> str:
    """Return the first line, which has the options. Exits if the connection is closed before its end."""
    text = b""
    while not text.endswith(b"\n"):
        select.select([connection], [], [])
        data = connection.recv(1)
        if not data:
            raise SystemExit(REFUSED)
        text += data
    return text.decode()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
