"""Watch a folder. Each new file is one entry once it is completely written."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import threading
import time
from pathlib import Path

from tacpipe.errors import DeviceError
from tacpipe.links.link import Arrivals, Arrived, Opened
from tacpipe.sensors.sensor import Sensor

LOOK_S = 0.02  # pause between scans of the folder
SETTLED_S = 0.1  # a file counts as written when it did not change for so long
UNFINISHED = (
    ".tmp",
    ".part",
    ".partial",
    ".crdownload",
    ".swp",
    "~",
)  # endings of names that writers rename at the end
Face = tuple[int, int, int]  # inode, size in bytes, time of the last change in ns


def open_folder(place: str, sensor: Sensor, name: str) -> FolderLink:
    """Return a watch on a folder, which ignores the files that exist already.

    Raises `DeviceError` for a folder that is missing or may not be read.
    """
    folder = Path(place).expanduser()
    try:
        faces = _faces(folder)
    except FileNotFoundError:
        raise DeviceError(f"{name}: there is no folder {folder}; make it, or correct the transport.") from None
    except OSError as error:
        raise DeviceError(f"{name}: the folder {folder} cannot be read: {error.strerror}.") from error
    return FolderLink(name, folder, faces)


class FolderLink(Opened):
    """A watch on a folder. A file is complete when no process has it open for writing and it stopped changing."""

    packets = True

    def __init__(self, name: str, folder: Path, existing: dict[str, Face]) -> None:
        super().__init__(name)
        self.folder = folder
        self._delivered = existing  # files as they were when they were delivered, or when the watch began
        self._growing: dict[str, tuple[Face, float]] = {}  # changed files, and since when they have not changed again
        self._arrivals = Arrivals()
        self._woken = threading.Event()

    def _receive(self, timeout_s: float) -> Arrived:
        until = time.monotonic() + timeout_s
        while True:
            entries = self._look()
            left_s = until - time.monotonic()
            if entries or left_s <= 0 or self._woken.wait(min(LOOK_S, left_s)):
                return entries

    def _look(self) -> Arrived:
        """Return the content of the files that became complete, in the order of their last change."""
        try:
            faces = _faces(self.folder)
        except OSError as error:
            raise self.lost(f"the folder cannot be read any more ({error.strerror})") from error
        now = time.monotonic()
        self._delivered = {name: face for name, face in self._delivered.items() if name in faces}
        new = {name: face for name, face in faces.items() if self._delivered.get(name) != face}
        self._growing = {name: _since(self._growing.get(name), face, now) for name, face in new.items()}
        settled = [name for name, (_, since) in self._growing.items() if now - since >= SETTLED_S]
        self._arrivals.look()
        entries: Arrived = []
        for name in sorted(settled, key=lambda name: (new[name][2], name)):
            data = _read_complete(self.folder / name, new[name])
            if data is not None:
                entries.append((self._arrivals.to_monotonic(new[name][2]), data))
                self._delivered[name] = new[name]
                del self._growing[name]
        return entries

    def _wake(self) -> None:
        self._woken.set()


def _since(before: tuple[Face, float] | None, face: Face, now: float) -> tuple[Face, float]:
    return before if before is not None and before[0] == face else (face, now)


def _faces(folder: Path) -> dict[str, Face]:
    """Return the face of each file in a folder, without empty files and files that will be renamed."""
    faces = {}
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(".") or entry.name.endswith(UNFINISHED):
                continue
            with contextlib.suppress(FileNotFoundError):
                status = entry.stat()
                if entry.is_file() and status.st_size:
                    faces[entry.name] = (status.st_ino, status.st_size, status.st_mtime_ns)
    return faces


def _read_complete(path: Path, face: Face) -> bytes | None:
    """Return the content of a file, or None while it is written, or where it is gone or no longer has this face."""
    try:
        with path.open("rb") as file:
            if _is_written(file.fileno()):
                return None
            data = file.read()
            status = os.fstat(file.fileno())
    except OSError:
        return None
    return data if (status.st_ino, status.st_size, status.st_mtime_ns) == face and len(data) == status.st_size else None


def _is_written(fileno: int) -> bool:
    """Return whether a process has the file open for writing: only then Linux refuses a read lease with EAGAIN."""
    try:
        fcntl.fcntl(
            fileno, fcntl.F_SETSIG, signal.SIGURG
        )  # ignored by default; a broken lease would otherwise send SIGIO
        fcntl.fcntl(fileno, fcntl.F_SETLEASE, fcntl.F_RDLCK)
    except BlockingIOError:
        return True
    except (OSError, AttributeError):  # another user's file, or a file system or an operating system without leases
        return False
    fcntl.fcntl(fileno, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    return False
