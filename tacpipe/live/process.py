"""The model's process of a live session: it fetches what the links gave, predicts, publishes, and reports.

It is an interpreter of its own, so neither its lock nor its crash touches the recording. It sleeps until a grid point is
nearly due and decodes what came since, then until it is due and takes the rest: at 1 kHz that costs a fifth of waking for
each sample, and the forecast waits for the decoding of a few samples alone.
"""

from __future__ import annotations

import gc
import os
import select
import socket
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from tacpipe.errors import TacpipeError
from tacpipe.live import publishing, scheduling, wire
from tacpipe.live.latency import Latencies
from tacpipe.live.messages import About, Published
from tacpipe.live.options import Options
from tacpipe.live.publishing import Publishers
from tacpipe.plugins import extras
from tacpipe.recording.spool_blocks import Note

REPORT_NS = 250_000_000  # between two reports to the recording process
FETCH_BYTES = 1 << 18
SWITCH_S = 0.0005  # that a publisher's thread may hold up a forecast
LONGEST_S = 0.02  # that a wait lasts at most
REFUSED = 2  # exit code: the session cannot begin with this model and rig


class Continued(Protocol):
    """What a process that is started anew needs to continue a recording."""

    def to_json(self) -> dict[str, Any]:
        """Return it as the note `wire.CONTINUE` holds it."""


class Engine(Protocol):
    """An object that turns blocks of bytes into messages; each task has its own."""

    skipped: int  # messages so far that were left out under overload
    overflows: int  # times that blocks were thrown away

    @property
    def late(self) -> int:
        """Samples so far that came too late to be read."""

    @property
    def running(self) -> bool:
        """Whether a recording has begun."""

    @property
    def offset_ns(self) -> int | None:
        """What is added to the monotonic clock to have the recording's UTC."""

    @property
    def beginning(self) -> Continued | None:
        """What another process needs to continue the recording; None as long as it is not known."""

    def about(self, model: str) -> About:
        """Return what its messages are."""

    def ready(self) -> dict[str, Any]:
        """Return what the recording process is to know before the session begins."""

    def take(self, stream: str, block: Any) -> None:
        """Take a block of a stream, or a note on all."""

    def due_ns(self, now_ns: int) -> int:
        """Return when `step` is to be called next, on the monotonic clock."""

    def step(self, now_ns: int) -> Sequence[Any]:
        """Return the messages that are due."""

    def published(self, message: Any, now_ns: int) -> None:
        """Write into a message how long it took, when it is about to go out."""

    def finish(self) -> Sequence[Any]:
        """Return the messages that are left when the session is over."""


class Loop:
    """Runs an engine on a socket until the other end closes it or a note ends the session."""

    def __init__(self, connection: socket.socket, engine: Engine, publishers: Publishers, blocks: wire.Blocks) -> None:
        self.connection, self.engine, self.publishers, self.blocks = connection, engine, publishers, blocks
        self.latencies = Latencies()
        self.forecasts = 0
        self.cause = ""
        self._reported_ns = 0
        self._beginning: Any = None  # that was reported
        self._ended = False

    def run(self) -> None:
        """Work until the session is over."""
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
                gc.collect(1)  # between forecasts: a collection of all would take longer than a forecast may
            wait_s = (self.engine.due_ns(time.monotonic_ns()) - time.monotonic_ns()) / 1e9
            if wait_s > 0:
                time.sleep(min(wait_s, LONGEST_S))
        for message in self.engine.finish():
            self.publish(message)
        self.report()

    def publish(self, message: Published) -> None:
        """Send a message to all subscribers, and count how long it took."""
        self.publishers.publish(message, lambda one: self.engine.published(one, time.monotonic_ns()))
        self.cause = message.cause
        if message.answers:
            self.forecasts += 1
            self.latencies.add(message.latency_ms)

    def report(self) -> None:
        """Send the recording process what the session did so far; where it does not read, the report is left out."""
        figures = {
            "kind": self.publishers.kind,
            "forecasts": self.forecasts,
            "skipped": self.engine.skipped,
            "late": self.engine.late,
            "overflows": self.engine.overflows,
            "dropped": self.publishers.dropped,
            "cause": self.cause,
            "states": dict(self.publishers.states),
            "cpu_s": round(time.process_time(), 3),
            "latency": self.latencies.figures(),
            "above_10_ms": self.latencies.above(10.0),
            "above_20_ms": self.latencies.above(20.0),
        }
        send(self.connection, {"report": figures})
        beginning = self.engine.beginning if self.engine.running else None
        if beginning is not None and beginning != self._beginning:
            send(self.connection, {"beginning": beginning.to_json(), "offset_ns": self.engine.offset_ns})
        self._beginning = beginning

    def _fetch(self) -> None:
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
                if not stream and isinstance(block, Note) and block.what == wire.STOP:
                    self._ended = True
                self.engine.take(stream, block)


def send(connection: socket.socket, content: dict[str, Any]) -> None:
    """Send a line to the recording process, unless it does not read or is gone."""
    try:
        connection.send(wire.line(content))
    except OSError:
        return


def engine_of(options: Options) -> Engine:
    """Return the engine of a session: the model's chain, and alarms with their levels. Raises `TacpipeError`."""
    from tacpipe.live import opening

    return opening.engine(options)


def main(arguments: Sequence[str], made: Callable[[Options], Engine] = engine_of) -> int:
    """Run the model's process on an inherited socket, whose number is given; return its exit code."""
    connection = socket.socket(fileno=int(arguments[0]))
    connection.setblocking(True)
    options = Options.from_json(_first_line(connection))
    try:
        with extras.named("tacpipe live"):
            engine = made(options)
            publishers = publishing.opened(options, engine)
    except TacpipeError as error:
        send(connection, {"refused": str(error), "exit_code": error.exit_code})
        return REFUSED
    gc.collect()
    gc.freeze()
    gc.disable()
    os.nice(options.nice)
    sys.setswitchinterval(SWITCH_S)
    if options.realtime:
        scheduling.realtime(scheduling.MODEL)
    send(connection, {"ready": engine.ready()})
    from tacpipe.models.threads import one_thread  # torch, which the engine has loaded

    with publishers, one_thread():  # once, not in each forecast
        Loop(connection, engine, publishers, wire.Blocks(options.streams)).run()
    return 0


def _first_line(connection: socket.socket) -> str:
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
