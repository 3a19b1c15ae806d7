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
from tacpipe.links.link import Arrivals, Arrived, OpenLink
from tacpipe.sensors.sensor import Sensor

SCAN_S = 0.02  # pause between scans of the folder
SETTLED_S = 0.1  # a file counts as complete if it did not change for this time
# suffixes of temporary names
UNFINISHED = (".tmp", ".part", ".partial", ".crdownload", ".swp", "~")
FileState = tuple[int, int, int]  # inode, size in bytes, time of the last change in ns


def open_folder(target: str, sensor: Sensor, name: str) -> FolderLink:
    """Watch a folder for new files. Files that already exist are ignored.

    Raises `DeviceError` if the folder does not exist or is not readable.
    """
    folder = Path(target).expanduser()
    try:
        states = _file_states(folder)
    except FileNotFoundError:
        raise DeviceError(f"{name}: the folder {folder} does not exist; create it, or correct the transport.") from None
    except OSError as error:
        raise DeviceError(f"{name}: the folder {folder} cannot be read: {error.strerror}.") from error
    return FolderLink(name, folder, states)


class FolderLink(OpenLink):
    """A watch on a folder. A file is complete if no process has it open for writing and it has stopped changing."""

    packets = True

    def __init__(self, name: str, folder: Path, existing: dict[str, FileState]) -> None:
        """Watch a folder whose ``existing`` files are not delivered."""
        super().__init__(name)
        self.folder = folder
        self._delivered = existing  # states of files when they were delivered, or when the watch started
        self._growing: dict[str, tuple[FileState, float]] = {}  # changed files, and the time of their last change
        self._arrivals = Arrivals()
        self._wake_event = threading.Event()

    def _receive(self, timeout_s: float) -> Arrived:
        """Return the files that become complete within ``timeout_s``.

        Raises `LinkLostError` if the folder cannot be read.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            entries = self._take_complete_files()
            left_s = deadline - time.monotonic()
            if entries or left_s <= 0 or self._wake_event.wait(min(SCAN_S, left_s)):
                return entries

    def _take_complete_files(self) -> Arrived:
        """Return the content of the files that became complete, in order of their last change.

        Raises `LinkLostError` if the folder cannot be read.
        """
        try:
            states = _file_states(self.folder)
        except OSError as error:
            raise self.lost(f"the folder cannot be read any more ({error.strerror})") from error
        now_s = time.monotonic()
        self._delivered = {name: state for name, state in self._delivered.items() if name in states}
        new_states = {name: state for name, state in states.items() if self._delivered.get(name) != state}
        self._growing = {
            name: _state_and_time(self._growing.get(name), state, now_s) for name, state in new_states.items()
        }
        complete = [name for name, (_, changed_s) in self._growing.items() if now_s - changed_s >= SETTLED_S]
        self._arrivals.read_clocks()
        arrived: Arrived = []
        for name in sorted(complete, key=lambda name: (new_states[name][2], name)):
            data = _read_complete(self.folder / name, new_states[name])
            if data is not None:
                arrived.append((self._arrivals.to_monotonic(new_states[name][2]), data))
                self._delivered[name] = new_states[name]
                del self._growing[name]
        return arrived

    def _wake(self) -> None:
        self._wake_event.set()


def _state_and_time(previous: tuple[FileState, float] | None, state: FileState, now: float) -> tuple[FileState, float]:
    return previous if previous is not None and previous[0] == state else (state, now)


def _file_states(folder: Path) -> dict[str, FileState]:
    """Return the state of each file in a folder. Empty files and temporary names are skipped."""
    states = {}
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(".") or entry.name.endswith(UNFINISHED):
                continue
            with contextlib.suppress(FileNotFoundError):
                status = entry.stat()
                if entry.is_file() and status.st_size:
                    states[entry.name] = (status.st_ino, status.st_size, status.st_mtime_ns)
    return states


def _read_complete(path: Path, state: FileState) -> bytes | None:
    """Return the content of a file, or None if it is being written, was removed, or its state differs from ``state``."""
    try:
        with path.open("rb") as file:
            if _is_open_for_writing(file.fileno()):
                return None
            data = file.read()
            status = os.fstat(file.fileno())
    except OSError:
        return None
    is_same = (status.st_ino, status.st_size, status.st_mtime_ns) == state and len(data) == status.st_size
    return data if is_same else None


def _is_open_for_writing(fileno: int) -> bool:
    """Return whether a process has the file open for writing. Only then does Linux refuse a read lease with EAGAIN."""
    try:
        # SIGURG is ignored by default; a broken lease would otherwise send SIGIO
        fcntl.fcntl(fileno, fcntl.F_SETSIG, signal.SIGURG)
        fcntl.fcntl(fileno, fcntl.F_SETLEASE, fcntl.F_RDLCK)
    except BlockingIOError:
        return True
    except (OSError, AttributeError):  # another user's file, or a file system or operating system without leases
        return False
    fcntl.fcntl(fileno, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    return False
