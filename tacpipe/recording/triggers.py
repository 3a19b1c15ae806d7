"""Start and stop trials by a key, a contact, or a message of another program."""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

import numpy as np

from tacpipe.errors import UsageError
from tacpipe.recording import clock
from tacpipe.recording.watch import Watch, tactile_channels

STARTS, STOPS = ("now", "key", "contact", "tap"), ("duration", "key", "contact", "tap")
RELEASE_S = 0.5  # a contact ends after this time without touch
TAP = "tap"  # sensor kind of streams that receive messages of other programs

Trigger = Callable[[], bool]


class Keys(Protocol):
    """A function that detects key presses."""

    def __call__(self, *, must: bool = False) -> bool:
        """Return whether a key was pressed since the last call.

        With ``must``, raises `UsageError` if no key can be pressed any more.
        """


@contextlib.contextmanager
def watch_keys() -> Iterator[Keys]:
    """Yield a function that returns whether Enter or the space bar was pressed since its last call.

    With ``must``, that function raises `UsageError` if standard input is closed, so that no key can be pressed.
    """
    try:
        source = sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):  # standard input is missing or closed
        source = -1
    settings = None
    typed, closed = b"", source < 0
    with contextlib.suppress(Exception):  # without a terminal, each line of standard input counts as a key
        settings = termios.tcgetattr(source)
        tty.setcbreak(source)

    def pressed(*, must: bool = False) -> bool:
        nonlocal typed, closed
        if not closed and select.select([source], [], [], 0)[0]:
            received = b""
            with contextlib.suppress(OSError):  # the terminal was closed, so no key can be pressed
                received = os.read(source, 4096)  # sys.stdin would buffer bytes that select does not see
            typed, closed = typed + received, not received
        count, is_pressed = _find_key(typed, lines=settings is None)
        typed = typed[count:]
        if must and closed and not is_pressed:
            raise UsageError(
                "Keys cannot be read, because standard input is closed. Run the command in a terminal, or start by "
                "time, contact or tap."
            )
        return is_pressed

    try:
        yield pressed
    finally:
        if settings is not None:
            with contextlib.suppress(termios.error):  # the terminal was closed
                termios.tcsetattr(source, termios.TCSADRAIN, settings)


def _find_key(typed: bytes, *, lines: bool) -> tuple[int, bool]:
    r"""Return the number of typed bytes that are consumed, and whether one of them is Enter or the space bar.

    With ``lines``, only Enter counts.

    >>> _find_key(b"ab  ", lines=False), _find_key(b"go", lines=True), _find_key(b"go\n\n", lines=True)
    ((3, True), (0, False), (3, True))
    """
    match = re.search(rb"\n" if lines else rb"[\n ]", typed)
    if match:
        return match.end(), True
    return (0 if lines else len(typed)), False


class ContactTrigger:
    """Detect contact and release by the tactile channels of all streams."""

    def __init__(self, watches: Mapping[str, Watch], threshold: float) -> None:
        """Watch the tactile channels of all streams. Raises `UsageError` if there is none.

        ``threshold`` is the distance from the rest level that counts as a contact, in the channel's unit.
        """
        tactile = {
            name: [position for position, _ in tactile_channels(watch.stream)] for name, watch in watches.items()
        }
        self._channels = {name: np.array(positions) for name, positions in tactile.items() if positions}
        if not self._channels:
            raise UsageError(
                "No stream of this rig has tactile channels to detect contact. Start and stop by key, time or tap."
            )
        self._watches, self._threshold = watches, threshold
        self._touched_s: float | None = None

    def touched(self) -> bool:
        """Return whether a tactile channel differs from its rest level by more than the threshold.

        Stores the time of contact.
        """
        for name, positions in self._channels.items():
            watch = self._watches[name]
            if watch.newest is None or watch.rest_level is None:
                continue
            if np.abs(watch.newest[positions] - watch.rest_level[positions]).max() > self._threshold:
                self._touched_s = clock.now_s()
                return True
        return False

    def released(self) -> bool:
        """Return whether a contact ended at least `RELEASE_S` ago."""
        touched = self.touched()
        return not touched and self._touched_s is not None and clock.now_s() - self._touched_s > RELEASE_S


class MessageTrigger:
    """Detect messages of other programs that start or stop a trial."""

    def __init__(self, watches: Mapping[str, Watch]) -> None:
        """Watch the streams that receive messages. Raises `UsageError` if there is none."""
        self._watches = [watch for watch in watches.values() if watch.stream.kind == TAP]
        if not self._watches:
            raise UsageError(
                'This rig has no stream of sensor "tap" to receive start and stop messages. Add one to the rig file, or '
                "start and stop by key, time or contact."
            )
        self._last_ns = [clock.now_ns() for _ in self._watches]  # arrival of the last processed message of each stream

    def received(self, word: str) -> bool:
        """Return whether a new message ``{"event": word}`` was received.

        Messages up to it are consumed; if there is none, all are.
        """
        for number, watch in enumerate(self._watches):
            for chunk in watch.heard:
                for t_ns, packet in zip(chunk.t_ns.tolist(), chunk.packets(), strict=True):
                    if t_ns <= self._last_ns[number]:
                        continue
                    self._last_ns[number] = t_ns
                    if word in _events(packet):
                        return True
        return False


def _events(packet: bytes) -> list[str]:
    """Return the ``event`` of each JSON record in a packet."""
    try:
        records = [json.loads(line) for line in packet.splitlines() if line.strip()]
    except (ValueError, RecursionError):
        return []
    return [str(record.get("event", "")) for record in records if isinstance(record, dict)]
