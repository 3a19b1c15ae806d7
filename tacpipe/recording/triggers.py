"""What starts and stops a trial: nothing, time, a key, a touch, or a word from one of the lab's own programs."""

from __future__ import annotations

import contextlib
import json
import select
import sys
import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from tacpipe.errors import UsageError
from tacpipe.recording.watch import Watch, tactile_channels

STARTS, STOPS = ("now", "key", "contact", "tap"), ("duration", "key", "contact", "tap")
RELEASE_S = 0.5  # without touch, after which a contact is over
TAP = "tap"  # the kind of the stream that hears the lab's own programs

Trigger = Callable[[], bool]


@contextlib.contextmanager
def keys() -> Iterator[Trigger]:
    """Yield a function that tells whether Enter or the space bar was pressed since the last call."""
    if not sys.stdin or sys.stdin.closed:
        yield lambda: False
        return
    settings = None
    with contextlib.suppress(Exception):  # no terminal: lines of standard input stand for keys
        import termios
        import tty

        settings = termios.tcgetattr(sys.stdin)
        tty.setcbreak(sys.stdin)
    ended = False

    def pressed() -> bool:
        nonlocal ended
        if ended or not select.select([sys.stdin], [], [], 0)[0]:
            return False
        read = sys.stdin.read(1) if settings else sys.stdin.readline()
        ended = not read
        return bool(read) and (settings is None or read in " \n")

    try:
        yield pressed
    finally:
        if settings is not None:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, settings)


class Contact:
    """Tells from the tactile channels of all streams whether something is touched."""

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
                self._touched_s = time.monotonic()
                return True
        return False

    def released(self) -> bool:
        """Return whether nothing has been touched for `RELEASE_S` after a touch."""
        touched = self.touched()
        return not touched and self._touched_s is not None and time.monotonic() - self._touched_s > RELEASE_S


class Tap:
    """Tells from what the lab's own programs say whether a trial begins or ends."""

    def __init__(self, watches: Mapping[str, Watch]) -> None:
        self._watches = [watch for watch in watches.values() if watch.stream.kind == TAP]
        if not self._watches:
            raise UsageError(
                'This rig has no stream of sensor "tap" that could say when to start or stop. Add one to the rig file, or '
                "start and stop by key, time or contact."
            )
        self._since_ns = time.monotonic_ns()

    def said(self, word: str) -> bool:
        """Return whether ``{"event": word}`` came since the last time it did, or since this was made."""
        for watch in self._watches:
            for chunk in watch.heard:
                for t_ns, packet in zip(chunk.t_ns.tolist(), chunk.packets(), strict=True):
                    if t_ns > self._since_ns and word in _events(packet):
                        self._since_ns = t_ns
                        return True
        return False


def _events(packet: bytes) -> list[str]:
    """Return the events that the records of a packet name."""
    try:
        records = [json.loads(line) for line in packet.splitlines() if line.strip()]
    except (ValueError, RecursionError):
        return []
    return [str(record.get("event", "")) for record in records if isinstance(record, dict)]
