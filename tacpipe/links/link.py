"""What a link is: it opens, gives what came with its arrival, states when it is lost, and closes; all kinds alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from tacpipe.errors import DeviceError, UsageError
from tacpipe.printable import excerpt

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
    "lsl": "lsl:NAME, or lsl:?type=Force&source_id=ft-7",
}
LONGEST = 4096  # characters of a place, as of a path


class LinkLostError(DeviceError):
    """The device went away while it was read: unplugged, switched off, or the other end closed."""


@dataclass(frozen=True)
class Address:
    """Where a device is: the kind of link, and what is given behind the colon."""

    scheme: str
    place: str

    def __str__(self) -> str:
        return f"{self.scheme}:{self.place}"


class Link(Protocol):
    """An open link. ``read`` is called by one thread alone; ``write`` and ``close`` may come from another."""

    def read(self, timeout_s: float) -> list[tuple[int, bytes]]:
        """Return what came since the last call as (arrival on the monotonic clock in ns, bytes), waiting for it at first.

        An empty list after ``timeout_s`` without any. Of a link of packets each entry is one packet.
        Raises `LinkLostError` when the device is gone.
        """

    def write(self, data: bytes) -> None:
        """Send ``data``. Raises `LinkLostError` when the device is gone."""

    def close(self) -> None:
        """Close the link; once more does nothing."""

    @property
    def local(self) -> Mapping[str, Any]:
        """What a sensor may need to know to open its stream, as the ``port`` that packets are awaited on."""

    @property
    def overruns(self) -> int:
        """How many packets this computer dropped so far because they were not fetched in time, where it states."""

    @property
    def foreign(self) -> int:
        """How many packets of other senders were left out so far, where the address names the one that counts."""

    @property
    def kernel_stamped(self) -> bool:
        """Whether the kernel stamps what arrives: its stamps are right however late it is read."""


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
