"""Define addresses, the interface of links, and the base classes of open links."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from dataclasses import dataclass
from typing import Protocol

from tacpipe.errors import DeviceError, UsageError
from tacpipe.printable import excerpt
from tacpipe.sensors.sensor import LocalAddress

SCHEMES = {
    "serial": "serial:/dev/ttyACM0",
    "hid": "hid:16c0:0486",
    "udp": "udp:192.168.1.20:49152, or udp::4010 to listen there",
    "tcp": "tcp:192.168.1.20:30004",
    "tcp+udp": "tcp+udp:172.16.0.2:1337",
    "ws": "ws:127.0.0.1:5000",
    "can": "can:socketcan:can0",
    "folder": "folder:/data/clouds",
    "camera": "camera:0",
    "v4l2": "v4l2:/dev/video0",
    "mjpeg": "mjpeg:http://192.168.1.20:8080/stream",
    "lsl": "lsl:NAME, or lsl:?type=Force&source_id=ft-7",
}
LONGEST = 4096  # characters of a place, the limit of a path
Arrived = list[tuple[int, bytes]]  # (arrival on the monotonic clock in ns, bytes)

WRITE_S = 5.0  # a device that accepts no byte for so long is gone


class LinkLostError(DeviceError):
    """The device went away while it was read: unplugged, switched off, or the other end closed."""


@dataclass(frozen=True)
class Address:
    """The address of a device: the kind of link, and the text after the colon."""

    scheme: str
    place: str

    def __str__(self) -> str:
        return f"{self.scheme}:{self.place}"


class Link(Protocol):
    """An open link. Only one thread calls ``read``; others may call ``write`` and ``close``."""

    def read(self, timeout_s: float) -> list[tuple[int, bytes]]:
        """Wait for bytes and return them as (arrival on the monotonic clock in ns, bytes).

        The list is empty after ``timeout_s`` without any. Each entry of a link of packets is one packet.
        Raises `LinkLostError` when the device is gone.
        """

    def write(self, data: bytes) -> None:
        """Send ``data``. Raises `LinkLostError` when the device is gone."""

    def close(self) -> None:
        """Close the link. A second call does nothing."""

    @property
    def local(self) -> LocalAddress:
        """Values that a sensor may need to open its stream, such as the ``port`` on which this computer listens."""

    @property
    def overruns(self) -> int:
        """The number of packets that this computer dropped because they were not fetched in time, where it is stated."""

    @property
    def foreign(self) -> int:
        """The number of packets of other senders that were left out, where the address names one sender."""

    @property
    def kernel_stamped(self) -> bool:
        """True where the kernel stamps packets as they arrive, so that a late read does not change their stamps."""


def parse(text: str) -> Address:
    """Return the address that a rig file or a command line names.

    Raises `UsageError` for an unknown kind of link, or one without a place that can be printed.

    >>> parse("serial:/dev/ttyACM0")
    Address(scheme='serial', place='/dev/ttyACM0')
    """
    scheme, colon, place = text.partition(":")
    if scheme not in SCHEMES or not colon or not place.isprintable() or not 0 < len(place) <= LONGEST:
        examples = "; ".join(SCHEMES.values())
        raise UsageError(
            f"{excerpt(text)} is not an address of a device; it should read like one of these: {examples}."
        )
    return Address(scheme, place)


class Opened:
    """The base class of open links. Subclasses receive, send, wake a waiting reader and release their resources."""

    packets = False  # True where each entry of `read` is one packet

    def __init__(self, name: str) -> None:
        self.name = name  # stream and address, for sentences
        self._closed = False
        self._ending, self._reading, self._writing = threading.Lock(), threading.Lock(), threading.Lock()

    def read(self, timeout_s: float) -> Arrived:
        """Return entries of (arrival in ns, bytes), none after ``timeout_s`` or when the link is closed meanwhile.

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
        """Deliver bytes with less delay, where the link delays them."""

    def close(self) -> None:
        """Close the link after the reader has returned. A second call does nothing."""
        with self._ending:
            if self._closed:
                return
            self._closed = True
        self._wake()
        with self._reading, self._writing:
            self._release()

    @property
    def local(self) -> LocalAddress:
        """Values that a sensor may need to open its stream; empty here."""
        return {}

    @property
    def overruns(self) -> int:
        """The number of packets that this computer dropped, 0 where it is not stated."""
        return 0

    @property
    def foreign(self) -> int:
        """The number of packets of other senders that were left out, 0 where any sender counts."""
        return 0

    @property
    def kernel_stamped(self) -> bool:
        """False: arrivals are stamped when they are read."""
        return False

    def lost(self, reason: str, check: str = "its cable and its power") -> LinkLostError:
        """Return the error for a device that is gone, with the reason and what to check."""
        return LinkLostError(f"{self.name} is lost: {reason}. Check {check}.")

    def _refuse_closed(self) -> None:
        if self._closed:
            raise LinkLostError(f"{self.name} was closed; open it again.")

    def _receive(self, timeout_s: float) -> Arrived:
        raise NotImplementedError

    def _send(self, data: bytes) -> None:
        raise DeviceError(f"{self.name} cannot be written to. Use a sensor that needs no commands.")

    def _wake(self) -> None:
        """Make a waiting reader return, where that is possible."""

    def _release(self) -> None:
        """Release the resources of the link."""


class Descriptor(Opened):
    """A link over a non-blocking file descriptor, with one ``poll`` and one read per wake-up."""

    def __init__(self, name: str, fileno: int, *extra_filenos: int) -> None:
        super().__init__(name)
        self._fileno = fileno
        self._alarm, self._bell = os.pipe()
        self._poll = select.poll()
        for watched in (fileno, *extra_filenos, self._alarm):
            self._poll.register(watched, select.POLLIN)

    def _receive(self, timeout_s: float) -> Arrived:
        ready = self._poll.poll(timeout_s * 1000)
        return self._fetch(ready) if ready and not self._closed else []

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        """Return the waiting entries. ``ready`` has the descriptors and their events."""
        raise NotImplementedError

    def _send(self, data: bytes) -> None:
        remaining, start_s = memoryview(data), time.monotonic()
        while remaining:
            try:
                remaining = remaining[os.write(self._fileno, remaining) :]
            except BlockingIOError:
                if time.monotonic() - start_s > WRITE_S:
                    raise self.lost(f"it accepted no byte for {WRITE_S:g} s") from None
                select.select([], [self._fileno], [], 0.1)
            except OSError as error:
                raise self.lost(error.strerror or str(error)) from error

    def _wake(self) -> None:
        os.write(self._bell, b"!")

    def _release(self) -> None:
        for fileno in (self._alarm, self._bell):
            with contextlib.suppress(OSError):
                os.close(fileno)


OLDEST_NS = 60_000_000_000  # an older stamp was made before the wall clock was set
READINGS = 3  # both clocks are read so often and the quickest reading counts: another program may run in between


class Arrivals:
    """Convert wall-clock stamps of arrivals to the monotonic clock, in times that never decrease.

    Distances between stamps stay as they are: the offset of the clocks changes only when a reading contradicts it.
    """

    def __init__(self) -> None:
        self._ahead_ns: int | None = None  # the monotonic clock's lead on the wall clock
        self._now_ns = self._wall_ns = 0
        self._last_ns = self._last_wall_ns = 0

    def look(self) -> None:
        """Read both clocks. Call it once per batch, after the fetch, so that no stamp lies ahead of the reading.

        The wall clock may be set at any time: the offset moves only as far as the readings require.
        """
        before_ns, self._wall_ns, self._now_ns = min((_readings() for _ in range(READINGS)), key=lambda r: r[2] - r[0])
        least_ns, most_ns = before_ns - self._wall_ns, self._now_ns - self._wall_ns
        offset_ns = (least_ns + most_ns) // 2 if self._ahead_ns is None else self._ahead_ns
        self._ahead_ns = min(max(offset_ns, least_ns), most_ns)

    def to_monotonic(self, wall_ns: int) -> int:
        """Return the monotonic time in ns of a stamp. A stamp of the future or the far past counts as arrived now.

        A later stamp gives a later time, by at least 1 ns even where the offset of the clocks shrank.
        """
        assert self._ahead_ns is not None, "look first"
        is_plausible = 0 <= self._wall_ns - wall_ns <= OLDEST_NS
        t_ns = wall_ns + self._ahead_ns if is_plausible else self._now_ns
        self._last_ns = max(t_ns, self._last_ns + (wall_ns > self._last_wall_ns))
        self._last_wall_ns = wall_ns
        return self._last_ns


def _readings() -> tuple[int, int, int]:
    """Return a reading of the monotonic clock, one of the wall clock and another of the monotonic clock, in ns."""
    before_ns = time.monotonic_ns()
    wall_ns = time.time_ns()
    return before_ns, wall_ns, time.monotonic_ns()
