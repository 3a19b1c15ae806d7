"""The device's end of a link: where hosts come and go, what they write, and what is sent to them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from tacpipe.links.link import Address
from tacpipe.sensors.sensor import Device


class Peer(Protocol):
    """A host at the other end, and the device as it is to this host."""

    device: Device
    pending_frames: int  # frames that the host asked for and did not get yet

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send frames or replies; return how many bytes of each went out."""

    @property
    def fault(self) -> str:
        """The cause, of `byte_faults.CAUSES`, that harms bytes to this host; empty for none."""


class Endpoint(Protocol):
    """One stream's end of its link. All is called by the one thread that paces."""

    address: Address  # address for the host's rig file

    @property
    def peers(self) -> Sequence[Peer]:
        """The hosts that there are."""

    def descriptors(self) -> Sequence[int]:
        """Return what the pacing thread waits on: something came there, or a host did."""

    def ready(self, descriptor: int) -> Sequence[tuple[Peer, bytes]]:
        """Return what hosts wrote, after ``descriptor`` became readable; a new host has written nothing."""

    def look(self) -> Sequence[tuple[Peer, bytes]]:
        """Manage what no descriptor states, a few times a tenth of a second; as `ready`."""

    def unplug(self) -> None:
        """Take the device away; hosts lose their link."""

    def replug(self) -> None:
        """Bring it back, under the same address."""

    def close(self) -> None:
        """End."""


def stretched(sizes: Sequence[int], sent: int) -> list[int]:
    """Return how many bytes of pieces of these sizes are among the first ``sent`` of all.

    >>> stretched([4, 4, 4], 6)
    [4, 2, 0]
    """
    parts = []
    for size in sizes:
        part = min(size, sent)
        parts.append(part)
        sent -= part
    return parts
