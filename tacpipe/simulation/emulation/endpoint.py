"""Define the device's end of an emulated link: its address, its hosts, and the bytes sent to and received from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from tacpipe.links.link import Address


class Peer(Protocol):
    """A host that is connected to the device."""

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send frames without waiting, and return the number of sent bytes of each."""


class Endpoint(Protocol):
    """The device's end of a stream's link. Only the sending thread calls its methods once it has started."""

    address: Address  # address for the host's rig file

    @property
    def peers(self) -> Sequence[Peer]:
        """The connected hosts."""

    def descriptors(self) -> Sequence[int]:
        """Return the file descriptors that become readable when a host connects or writes."""

    def ready(self, descriptor: int) -> Sequence[tuple[Peer, bytes]]:
        """Return (host, bytes) after ``descriptor`` became readable. The bytes of a new host are empty."""

    def look(self) -> Sequence[tuple[Peer, bytes]]:
        """Poll for events without a descriptor, every 20 ms. Returns like `ready`."""

    def close(self) -> None:
        """Release the link. Hosts lose it."""


def sent_sizes(sizes: Sequence[int], sent: int) -> list[int]:
    """Return the number of bytes of each piece among the first ``sent`` bytes. ``sizes`` are the sizes of the pieces.

    >>> sent_sizes([4, 4, 4], 6)
    [4, 2, 0]
    """
    parts = []
    for size in sizes:
        sent_bytes = min(size, sent)
        parts.append(sent_bytes)
        sent -= sent_bytes
    return parts
