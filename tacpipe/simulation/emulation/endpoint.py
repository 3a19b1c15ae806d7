"""Define the device's end of an emulated link: its hosts, the bytes that they write, and the frames sent to them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from tacpipe.links.link import Address
from tacpipe.sensors.sensor import Device, Sensor
from tacpipe.simulation.emulation import byte_faults


class Peer(Protocol):
    """A host, and the state of the device for this host."""

    device: Device
    pending_frames: int  # number of requested frames that were not sent yet

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Send frames or replies, and return the number of sent bytes of each."""

    @property
    def fault(self) -> str:
        """The cause in `byte_faults.CAUSES` that damages bytes to this host; empty if there is none."""


class Endpoint(Protocol):
    """The device's end of a stream's link. Only the sending thread calls its methods."""

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

    def unplug(self) -> None:
        """Unplug the device. Hosts lose their link."""

    def replug(self) -> None:
        """Plug the device in again, at the same address."""

    def close(self) -> None:
        """Release the link."""


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


class Writer:
    """The host of a folder."""

    fault = byte_faults.SOUND

    def __init__(self, folder: Path, sensor: Sensor) -> None:
        self.folder, self.device = folder, sensor.device()
        self.suffix = str(getattr(sensor, "suffix", "")) or ".bin"
        self.pending_frames = 0
        self._count = 0

    def send(self, pieces: Sequence[bytes]) -> list[int]:
        """Write each piece to a file, under a temporary name until it is complete."""
        for piece in pieces:
            self._count += 1
            path = self.folder / f"frame{self._count:06d}{self.suffix}"
            draft = path.with_suffix(".part")
            draft.write_bytes(piece)
            draft.rename(path)
        return [len(piece) for piece in pieces]


class Folder:
    """A folder to which files are written."""

    def __init__(self, sensor: Sensor, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.sensor, self.folder = sensor, folder
        self.address = Address("folder", str(folder))
        self.peers = [Writer(folder, sensor)]

    def descriptors(self) -> list[int]:
        """Return nothing, because hosts do not write to the device."""
        return []

    def ready(self, descriptor: int) -> list[tuple[Writer, bytes]]:
        """Return nothing."""
        return []

    def look(self) -> list[tuple[Writer, bytes]]:
        """Return nothing."""
        return []

    def unplug(self) -> None:
        """Do nothing: the faults suppress files."""

    def replug(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing: files are retained."""
