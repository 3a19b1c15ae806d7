"""A device that leaves a file for each frame in a folder, as cameras' programs do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tacpipe.links.link import Address
from tacpipe.sensors.sensor import Sensor
from tacpipe.simulation.emulation import byte_faults


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
