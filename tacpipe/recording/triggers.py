"""Start and stop trials by a key, a touch, or a message of one of the lab's own programs."""

from __future__ import annotations

import contextlib
import json
import os
import select
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

import numpy as np

from tacpipe.errors import UsageError
from tacpipe.recording import clock
from tacpipe.recording.watch import Watch, tactile_channels

STARTS, STOPS = ("now", "key", "contact", "tap"), ("duration", "key", "contact", "tap")
RELEASE_S = 0.5  # a contact ends after so long without touch
TAP = "tap"  # kind of the stream that receives messages of the lab's own programs

Trigger = Callable[[], bool]


class Keys(Protocol):
    """Detects whether a key was pressed."""

    def __call__(self, *, must: bool = False) -> bool:
        """Return whether a key was pressed since the last call.

        With ``must``, raises `UsageError` where no key can be pressed any more.
        """


@contextlib.contextmanager
def keys() -> Iterator[Keys]:
    """Yield a function that detects whether Enter or the space bar was pressed."""
    try:
        source = sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):  # standard input is missing or closed
        source = -1
    settings = None
    waiting, closed = b"", source < 0
    with contextlib.suppress(Exception):  # without a terminal, lines of standard input are keys
        import termios
        import tty

        settings = termios.tcgetattr(source)
        tty.setcbreak(source)

    def pressed(*, must: bool = False) -> bool:
        nonlocal waiting, closed
        if not closed and select.select([source], [], [], 0)[0]:
            read = b""
            with contextlib.suppress(OSError):  # the terminal was closed, so no key can be pressed
                read = os.read(source, 4096)  # sys.stdin would buffer bytes that select does not see
            waiting, closed = waiting + read, not read
        count, is_pressed = _find_key(waiting, lines=settings is None)
        waiting = waiting[count:]
        if must and closed and not is_pressed:
            raise UsageError(
                "Keys cannot be read, because standard input is closed. Run the command in a terminal, or start by time, "
                "contact or tap."
            )
        return is_pressed

    try:
        yield pressed
    finally:
        if settings is not None:
            with contextlib.suppress(termios.error):  # the terminal was closed
                termios.tcsetattr(source, termios.TCSADRAIN, settings)


def _find_key(typed: bytes, *, lines: bool) -> tuple[int, bool]:
    r"""Return how many typed bytes are processed, and whether one of them is Enter or the space bar.

    >>> _find_key(b"ab  ", lines=False), _find_key(b"go", lines=True), _find_key(b"go\n\n", lines=True)
    ((3, True), (0, False), (3, True))
    """
    places = [place for place in (typed.find(key) for key in ((b"\n",) if lines else (b"\n", b" "))) if place >= 0]
    if places:
        return min(places) + 1, True
    return (0 if lines else len(typed)), False


class ContactTrigger:
    """Detects a contact by the tactile channels of all streams."""

    def __init__(self, watches: Mapping[str, Watch], threshold: float) -> None:
        tactile = {name: [place for place, _ in tactile_channels(watch.stream)] for name, watch in watches.items()}
        self._channels = {name: np.array(places) for name, places in tactile.items() if places}
        if not self._channels:
            raise UsageError(
                "No stream of this rig has tactile channels, so contact cannot be detected. Start and stop by key, "
                "time or tap."
            )
        self._watches, self._threshold = watches, threshold
        self._touched_s: float | None = None

    def touched(self) -> bool:
        """Return whether a tactile channel differs from rest by more than the threshold."""
        for name, places in self._channels.items():
            watch = self._watches[name]
            if watch.newest is None or watch.rest_level is None:
                continue
            if np.abs(watch.newest[places] - watch.rest_level[places]).max() > self._threshold:
                self._touched_s = clock.now_s()
                return True
        return False

    def released(self) -> bool:
        """Return whether nothing has been touched for `RELEASE_S` after a touch."""
        touched = self.touched()
        return not touched and self._touched_s is not None and clock.now_s() - self._touched_s > RELEASE_S


class MessageTrigger:
    """Detects by messages of the lab's own programs whether a trial begins or ends."""

    def __init__(self, watches: Mapping[str, Watch]) -> None:
        self._watches = [watch for watch in watches.values() if watch.stream.kind == TAP]
        if not self._watches:
            raise UsageError(
                'This rig has no stream of sensor "tap" that could state when to start or stop. Add one to the rig file, or '
                "start and stop by key, time or contact."
            )
        self._since_ns = [clock.now_ns() for _ in self._watches]

    def received(self, word: str) -> bool:
        """Return whether a new ``{"event": word}`` came. Messages up to it, or all if there is none, are then processed."""
        for number, watch in enumerate(self._watches):
            for chunk in watch.heard:
                for t_ns, packet in zip(chunk.t_ns.tolist(), chunk.packets(), strict=True):
                    if t_ns <= self._since_ns[number]:
                        continue
                    self._since_ns[number] = t_ns
                    if word in _events(packet):
                        return True
        return False


def _events(packet: bytes) -> list[str]:
    """Return the events that the records of a packet name."""
    try:
        records = [json.loads(line) for line in packet.splitlines() if line.strip()]
    except (ValueError, RecursionError):
        return []
    return [str(record.get("event", "")) for record in records if isinstance(record, dict)]
