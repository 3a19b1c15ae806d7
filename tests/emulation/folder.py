"""Emulate a program that writes each frame to a file of a folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tacpipe.links.link import Address


class Writer:
    """The host of a folder."""

    def __init__(self, folder: Path, suffix: str) -> None:
        self.folder, self.suffix = folder, suffix
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

    def __init__(self, folder: Path, suffix: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.address = Address("folder", str(folder))
        self.peers = [Writer(folder, suffix)]

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
