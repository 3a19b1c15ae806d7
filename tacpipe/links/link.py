"""Define addresses, the interface of links, and the base classes of open links."""

from __future__ import annotations

import contextlib
import errno
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
DATAGRAM_SCHEMES = ("udp", "tcp+udp")
MAX_LENGTH = 4096  # maximum number of characters of a target, which is the limit of a path
Arrived = list[tuple[int, bytes]]  # (arrival on the monotonic clock in ns, bytes)

WRITE_S = 5.0  # a device that accepts no byte for this time is gone


class LinkLostError(DeviceError):
    """The link was lost: the device was unplugged or switched off, or the peer closed the connection."""


@dataclass(frozen=True)
class Address:
    """The address of a device: the kind of link, and the target, which is the text after the colon."""

    scheme: str
    target: str

    def __str__(self) -> str:
        return f"{self.scheme}:{self.target}"


class Link(Protocol):
    """An open link. Only one thread calls ``read``; others may call ``write`` and ``close``."""

    def read(self, timeout_s: float) -> list[tuple[int, bytes]]:
        """Wait for bytes and return them as (arrival on the monotonic clock in ns, bytes).

        Returns an empty list if nothing arrives within ``timeout_s``. If the link is packet-based, each entry is one packet.
        Raises `LinkLostError` if the device is gone.
        """

    def write(self, data: bytes) -> None:
        """Send ``data``. Raises `LinkLostError` if the device is gone."""

    def close(self) -> None:
        """Close the link. A second call does nothing."""

    @property
    def local(self) -> LocalAddress:
        """Values that a sensor may need to open its stream, such as the ``port`` on which this computer listens."""

    @property
    def overruns(self) -> int:
        """The number of packets that this computer dropped because they were not fetched in time; 0 if unknown."""

    @property
    def foreign(self) -> int:
        """The number of packets that were ignored because they are not from the sender in the address."""

    @property
    def kernel_stamped(self) -> bool:
        """True if the kernel stamps packets when they arrive, so that a late read does not change their timestamps."""


def parse(text: str) -> Address:
    """Return the address of a device that is given as in a rig file or on a command line.

    Raises `UsageError` for an unknown kind of link, or an empty or unprintable target.

    >>> parse("serial:/dev/ttyACM0")
    Address(scheme='serial', target='/dev/ttyACM0')
    """
    scheme, colon, target = text.partition(":")
    if scheme not in SCHEMES or not colon or not target.isprintable() or not 0 < len(target) <= MAX_LENGTH:
        examples = "; ".join(SCHEMES.values())
        raise UsageError(f"{excerpt(text)} is not an address of a device; write it like one of these: {examples}.")
    return Address(scheme, target)


class OpenLink:
    """The base class of open links. Subclasses receive, send, wake a waiting reader, and release their resources."""

    packets = False  # True if each entry of `read` is one packet

    def __init__(self, name: str) -> None:
        self.name = name  # stream and address, as named in errors
        self._closed = False
        self._closing, self._reading, self._writing = threading.Lock(), threading.Lock(), threading.Lock()

    def read(self, timeout_s: float) -> Arrived:
        """Return entries (arrival in ns, bytes).

        Returns an empty list after ``timeout_s``, or if the link is closed during the call. Raises `LinkLostError` if the
        device is gone or the link is already closed.
        """
        with self._reading:
            self._refuse_closed()
            return self._receive(timeout_s)

    def write(self, data: bytes) -> None:
        """Send ``data``. Raises `LinkLostError` if the device is gone."""
        with self._writing:
            self._refuse_closed()
            self._send(data)

    def reduce_latency(self) -> None:
        """Deliver bytes with less delay, if the link delays them."""

    def close(self) -> None:
        """Close the link after the reader has returned. A second call does nothing."""
        with self._closing:
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
        """The number of packets that this computer dropped; 0 if unknown."""
        return 0

    @property
    def foreign(self) -> int:
        """The number of ignored packets of other senders; 0 if any sender is accepted."""
        return 0

    @property
    def kernel_stamped(self) -> bool:
        """False: packets are stamped when they are read."""
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
        raise DeviceError(f"{self.name} cannot be written to. Use a sensor that needs no requests.")

    def _wake(self) -> None:
        """Make a waiting reader return, if that is possible."""

    def _release(self) -> None:
        """Release the resources of the link."""


MAX_READ = 1 << 16  # maximum number of bytes per read


class DescriptorLink(OpenLink):
    """A link over a non-blocking file descriptor. Each wake-up of ``poll`` is followed by one read."""

    def __init__(self, name: str, fileno: int, *extra_filenos: int) -> None:
        """Poll the descriptor ``fileno`` and further ones that end a wait."""
        super().__init__(name)
        self._fileno = fileno
        self._wake_reader, self._wake_writer = os.pipe()
        self._poll = select.poll()
        for descriptor in (fileno, *extra_filenos, self._wake_reader):
            self._poll.register(descriptor, select.POLLIN)

    def _receive(self, timeout_s: float) -> Arrived:
        ready = self._poll.poll(timeout_s * 1000)
        return self._fetch(ready) if ready and not self._closed else []

    def _fetch(self, ready: list[tuple[int, int]]) -> Arrived:
        """Return the queued entries. ``ready`` has (descriptor, event) pairs of ``poll``."""
        raise NotImplementedError

    def _read_available(self, end: str, *check: str, max_bytes: int = MAX_READ) -> bytes:
        """Return the bytes that have arrived, none if there are none.

        Raises `LinkLostError` at their end, with ``end`` as its reason and ``check`` as what to check.
        """
        try:
            data = os.read(self._fileno, max_bytes)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self.lost(end if error.errno == errno.EIO else error.strerror or str(error)) from error
        if not data:
            raise self.lost(end, *check)
        return data

    def _send(self, data: bytes) -> None:
        """Write all bytes. Raises `LinkLostError` if the device accepts none for `WRITE_S` or is gone."""
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
        os.write(self._wake_writer, b"!")

    def _release(self) -> None:
        for fileno in (self._wake_reader, self._wake_writer):
            with contextlib.suppress(OSError):
                os.close(fileno)


MAX_AGE_NS = 60_000_000_000  # older timestamps were taken before the wall clock was set
READINGS = 3  # number of readings of both clocks; the quickest is used, because the program may be interrupted


class Arrivals:
    """Convert wall-clock timestamps of arrivals to non-decreasing times on the monotonic clock.

    Differences between timestamps are preserved: the offset between the clocks changes only if a reading contradicts it.
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None  # monotonic clock − wall clock
        self._now_ns = self._wall_ns = 0
        self._last_ns = self._last_wall_ns = 0

    def read_clocks(self) -> None:
        """Read both clocks. Call this once per batch after the fetch, so that no timestamp is later than the reading.

        The wall clock may be set at any time; the offset changes only as far as the readings require.
        """
        before_ns, self._wall_ns, self._now_ns = min((_readings() for _ in range(READINGS)), key=lambda r: r[2] - r[0])
        min_ns, max_ns = before_ns - self._wall_ns, self._now_ns - self._wall_ns
        offset_ns = (min_ns + max_ns) // 2 if self._offset_ns is None else self._offset_ns
        self._offset_ns = min(max(offset_ns, min_ns), max_ns)

    def to_monotonic(self, wall_ns: int) -> int:
        """Return the monotonic time in ns of a timestamp. Timestamps in the future or the far past count as now.

        A later timestamp gives a later time, by at least 1 ns, even if the offset between the clocks has decreased.
        """
        assert self._offset_ns is not None, "call read_clocks first"
        is_plausible = 0 <= self._wall_ns - wall_ns <= MAX_AGE_NS
        t_ns = wall_ns + self._offset_ns if is_plausible else self._now_ns
        self._last_ns = max(t_ns, self._last_ns + (wall_ns > self._last_wall_ns))
        self._last_wall_ns = wall_ns
        return self._last_ns


def _readings() -> tuple[int, int, int]:
    """Return a reading of the monotonic clock, one of the wall clock and another of the monotonic clock, in ns."""
    before_ns = time.monotonic_ns()
    wall_ns = time.time_ns()
    return before_ns, wall_ns, time.monotonic_ns()
