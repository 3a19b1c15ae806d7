"""A watched folder: each new file, once it is whole, is one entry."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import threading
import time
from pathlib import Path

from tacpipe.errors import DeviceError
from tacpipe.links.arrival import Arrivals
from tacpipe.links.opened import Arrived, Opened
from tacpipe.sensors.sensor import Sensor

LOOK_S = 0.02  # between looks at the folder
SETTLED_S = 0.1  # that a file must not have grown or changed for
UNFINISHED = (".tmp", ".part", ".partial", ".crdownload", ".swp", "~")  # ends of names that writers rename later
Face = tuple[int, int, int]  # inode, bytes, and when it was changed, in ns


def open_folder(place: str, sensor: Sensor, name: str) -> FolderLink:
    """Return a watch on a folder; the files that are there already are left alone.

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
    """A watch on a folder. A file is whole when nobody has it open for writing and it held still for a while."""

    packets = True

    def __init__(self, name: str, folder: Path, taken: dict[str, Face]) -> None:
        super().__init__(name)
        self.folder = folder
        self._taken = taken  # as they looked when they were given out, or when the watch began
        self._growing: dict[str, tuple[Face, float]] = {}  # and since when they look so
        self._arrivals = Arrivals()
        self._woken = threading.Event()

    def _receive(self, timeout_s: float) -> Arrived:
        until = time.monotonic() + timeout_s
        while True:
            found = self._look()
            left_s = until - time.monotonic()
            if found or left_s <= 0 or self._woken.wait(min(LOOK_S, left_s)):
                return found

    def _look(self) -> Arrived:
        """Return the content of the files that became whole, in the order of their writing."""
        try:
            faces = _faces(self.folder)
        except OSError as error:
            raise self.lost(f"the folder cannot be read any more ({error.strerror})") from error
        now = time.monotonic()
        self._taken = {name: face for name, face in self._taken.items() if name in faces}
        new = {name: face for name, face in faces.items() if self._taken.get(name) != face}
        self._growing = {name: _since(self._growing.get(name), face, now) for name, face in new.items()}
        settled = [name for name, (_, since) in self._growing.items() if now - since >= SETTLED_S]
        self._arrivals.look()
        found: Arrived = []
        for name in sorted(settled, key=lambda name: (new[name][2], name)):
            data = _whole(self.folder / name, new[name])
            if data is not None:
                found.append((self._arrivals.of(new[name][2]), data))
                self._taken[name] = new[name]
                del self._growing[name]
        return found

    def _wake(self) -> None:
        self._woken.set()


def _since(before: tuple[Face, float] | None, face: Face, now: float) -> tuple[Face, float]:
    return before if before is not None and before[0] == face else (face, now)


def _faces(folder: Path) -> dict[str, Face]:
    """Return how the files of a folder look, those left out that hold nothing or have a name to be changed later."""
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


def _whole(path: Path, face: Face) -> bytes | None:
    """Return the content of a file, None while it is being written, is gone, or is no longer the one that was seen."""
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
    """Whether anyone has the file open for writing: then, and only then, Linux refuses a read lease with EAGAIN."""
    try:
        fcntl.fcntl(fileno, fcntl.F_SETSIG, signal.SIGURG)  # one that is ignored: a lease that breaks sends SIGIO else
        fcntl.fcntl(fileno, fcntl.F_SETLEASE, fcntl.F_RDLCK)
    except BlockingIOError:
        return True
    except (OSError, AttributeError):  # another user's file, or a file system or an operating system without leases
        return False
    fcntl.fcntl(fileno, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    return False
