"""The device's end of a link: where hosts come and go, what they write, and what is sent to them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from tacpipe.links.link import Address
from tacpipe.sensors.sensor import Device, Sensor
from tacpipe.simulation.emulation import byte_faults


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


class Writer:
    """Whoever watches the folder."""

    fault = byte_faults.SOUND

    def __init__(self, folder: Path, sensor: Sensor) -> None:
        self.folder, self.device = folder, sensor.device()
        self.suffix = str(getattr(sensor, "suffix", "")) or ".bin"
        self.pending_frames = 0
        self._count = 0

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Write a file each; it has another name until it is whole."""
        for piece in pieces:
            self._count += 1
            path = self.folder / f"frame{self._count:06d}{self.suffix}"
            draft = path.with_suffix(".part")
            draft.write_bytes(piece)
            draft.rename(path)
        return [len(piece) for piece in pieces]


class Folder:
    """A folder that fills with files."""

    def __init__(self, sensor: Sensor, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.sensor, self.folder = sensor, folder
        self.address = Address("folder", str(folder))
        self.peers = [Writer(folder, sensor)]

    def descriptors(self) -> list[int]:
        """Return nothing: nobody writes to the device."""
        return []

    def ready(self, descriptor: int) -> list[tuple[Writer, bytes]]:
        """Return nothing."""
        return []

    def look(self) -> list[tuple[Writer, bytes]]:
        """Return nothing."""
        return []

    def unplug(self) -> None:
        """Do nothing: no files come, which the faults see to."""

    def replug(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing: what was written stays."""
