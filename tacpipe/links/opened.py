"""What all open links share: one reader, a writer and a closer that may be other threads, sentences that name them."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from collections.abc import Mapping
from typing import Any

from tacpipe.errors import DeviceError
from tacpipe.links.link import LinkLostError

Arrived = list[tuple[int, bytes]]  # (arrival on the monotonic clock in ns, bytes)

WRITE_S = 5.0  # a device that takes no byte for so long is gone


class Opened:
    """A link that is open. Subclasses state how to receive, send, wake a reader and release what they hold."""

    packets = False  # whether each entry of `read` is one packet

    def __init__(self, name: str) -> None:
        self.name = name  # stream and address, for sentences
        self._closed = False
        self._ending, self._reading, self._writing = threading.Lock(), threading.Lock(), threading.Lock()

    def read(self, timeout_s: float) -> Arrived:
        """Return what came as (arrival, bytes), nothing after ``timeout_s`` or when the link is closed meanwhile.

        Raises `LinkLostError` when the device is gone or the link was closed before.
        """
        with self._reading:
            self._refuse_closed()
            return self._receive(timeout_s)

    def write(self, data: bytes) -> None:
        """Send ``data``. Raises `LinkLostError` when the device is gone."""
        with self._writing:
            self._refuse_closed()
            self._send(data)

    def hasten(self) -> None:
        """Read what comes at once, as it is read anyway."""

    def close(self) -> None:
        """Close the link, when the reader has returned; once more does nothing."""
        with self._ending:
            if self._closed:
                return
            self._closed = True
        self._wake()
        with self._reading, self._writing:
            self._release()

    @property
    def local(self) -> Mapping[str, Any]:
        """What a sensor may need to know to open its stream: nothing."""
        return {}

    @property
    def overruns(self) -> int:
        """How many packets this computer dropped: 0 where it does not state."""
        return 0

    @property
    def foreign(self) -> int:
        """How many packets of other senders were left out: 0 where any sender counts."""
        return 0

    @property
    def kernel_stamped(self) -> bool:
        """Whether the kernel stamps what arrives: no, it is stamped when it is read."""
        return False

    def lost(self, why: str, check: str = "its cable and its power") -> LinkLostError:
        """Return the error that states that the device is gone."""
        return LinkLostError(f"{self.name} is lost: {why}. Check {check}.")

    def _refuse_closed(self) -> None:
        if self._closed:
            raise LinkLostError(f"{self.name} was closed; open it again.")

    def _receive(self, timeout_s: float) -> Arrived:
        raise NotImplementedError

    def _send(self, data: bytes) -> None:
        raise DeviceError(f"{self.name} cannot be written to; take a sensor there that needs no word from us.")

    def _wake(self) -> None:
        """Make a waiting reader return at once, where that is possible."""

    def _release(self) -> None:
        """Give back what is held."""


class Descriptor(Opened):
    """A link over a non-blocking file descriptor: one ``poll`` and one read a wake-up."""

    def __init__(self, name: str, fileno: int, *others: int) -> None:
        super().__init__(name)
        self._fileno = fileno
        self._alarm, self._bell = os.pipe()
        self._poll = select.poll()
        for watched in (fileno, *others, self._alarm):
            self._poll.register(watched, select.POLLIN)

    def _receive(self, timeout_s: float) -> Arrived:
        ready = self._poll.poll(timeout_s * 1000)
        return self._fetch(ready) if ready and not self._closed else []

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        """Return what lies ready; ``ready`` holds the descriptors and their events."""
        raise NotImplementedError

    def _send(self, data: bytes) -> None:
        left, begun = memoryview(data), time.monotonic()
        while left:
            try:
                left = left[os.write(self._fileno, left) :]
            except BlockingIOError:
                if time.monotonic() - begun > WRITE_S:
                    raise self.lost(f"it took no byte for {WRITE_S:g} s") from None
                select.select([], [self._fileno], [], 0.1)
            except OSError as error:
                raise self.lost(error.strerror or str(error)) from error

    def _wake(self) -> None:
        os.write(self._bell, b"!")

    def _release(self) -> None:
        for fileno in (self._alarm, self._bell):
            with contextlib.suppress(OSError):
                os.close(fileno)
