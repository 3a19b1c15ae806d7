"""What starts and stops a trial: nothing, time, a key, a touch, or a word from one of the lab's own programs."""

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
RELEASE_S = 0.5  # without touch, after which a contact is over
TAP = "tap"  # the kind of the stream that hears the lab's own programs

Trigger = Callable[[], bool]


class Keys(Protocol):
    """Detects whether a key was pressed."""

    def __call__(self, *, must: bool = False) -> bool:
        """Return whether it was since the last call. With ``must``, raises `UsageError` where none can be any more."""


@contextlib.contextmanager
def keys() -> Iterator[Keys]:
    """Yield what states whether Enter or the space bar was pressed."""
    try:
        source = sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):  # there is none, or it is closed
        source = -1
    settings = None
    waiting, ended = b"", source < 0
    with contextlib.suppress(Exception):  # no terminal: lines of standard input represent keys
        import termios
        import tty

        settings = termios.tcgetattr(source)
        tty.setcbreak(source)

    def pressed(*, must: bool = False) -> bool:
        nonlocal waiting, ended
        if not ended and select.select([source], [], [], 0)[0]:
            read = b""
            with contextlib.suppress(OSError):  # of a terminal that was closed: no key can be pressed any more
                read = os.read(source, 4096)  # not through sys.stdin, which keeps what select does not see
            waiting, ended = waiting + read, not read
        taken, found = _pressed(waiting, lines=settings is None)
        waiting = waiting[taken:]
        if must and ended and not found:
            raise UsageError(
                "No key can be pressed: standard input is closed or at its end. Run it in a terminal, or start by time, "
                "contact or tap."
            )
        return found

    try:
        yield pressed
    finally:
        if settings is not None:
            with contextlib.suppress(termios.error):  # of a terminal that was closed
                termios.tcsetattr(source, termios.TCSADRAIN, settings)


def _pressed(typed: bytes, *, lines: bool) -> tuple[int, bool]:
    """Return how many bytes of what was typed are dealt with, and whether one of them is a key that counts.

    >>> _pressed(b"ab  ", lines=False), _pressed(b"go", lines=True), _pressed(b"go\\n\\n", lines=True)
    ((3, True), (0, False), (3, True))
    """
    found = [place for place in (typed.find(key) for key in ((b"\n",) if lines else (b"\n", b" "))) if place >= 0]
    if found:
        return min(found) + 1, True
    return (0 if lines else len(typed)), False


class Contact:
    """Detects from the tactile channels of all streams whether something is touched."""

    def __init__(self, watches: Mapping[str, Watch], threshold: float) -> None:
        found = {name: [place for place, _ in tactile_channels(watch.stream)] for name, watch in watches.items()}
        self._channels = {name: np.array(places) for name, places in found.items() if places}
        if not self._channels:
            raise UsageError(
                "No stream of this rig has tactile channels, so no contact can be seen. Start and stop by key, time or tap."
            )
        self._watches, self._threshold = watches, threshold
        self._touched_s: float | None = None

    def touched(self) -> bool:
        """Return whether a tactile channel is further from rest than the threshold."""
        for name, places in self._channels.items():
            watch = self._watches[name]
            if watch.newest is None or watch.rest is None:
                continue
            if np.abs(watch.newest[places] - watch.rest[places]).max() > self._threshold:
                self._touched_s = clock.now_s()
                return True
        return False

    def released(self) -> bool:
        """Return whether nothing has been touched for `RELEASE_S` after a touch."""
        touched = self.touched()
        return not touched and self._touched_s is not None and clock.now_s() - self._touched_s > RELEASE_S


class Tap:
    """Detects from what the lab's own programs state whether a trial begins or ends."""

    def __init__(self, watches: Mapping[str, Watch]) -> None:
        self._watches = [watch for watch in watches.values() if watch.stream.kind == TAP]
        if not self._watches:
            raise UsageError(
                'This rig has no stream of sensor "tap" that could state when to start or stop. Add one to the rig file, or '
                "start and stop by key, time or contact."
            )
        self._since_ns = [clock.now_ns() for _ in self._watches]

    def received(self, word: str) -> bool:
        """Return whether ``{"event": word}`` came since this was made; what came up to it, or at all, is dealt with."""
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
