"""Leases: which process computes which key, and which runs are active.

They are advisory. The kernel releases the leases of dead processes.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import platform
import shlex
import sys
import time
import uuid
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict, cast

from tacpipe.errors import DeniedError, LockedError, TacpipeError
from tacpipe.io import regular, terminal
from tacpipe.io.credentials import without_credentials
from tacpipe.io.files import create, make_folder, patiently, readable_errors, write_all
from tacpipe.io.hashing import DIGEST
from tacpipe.store import layout

LOCK_TIMEOUT_S = 3600.0  # default timeout; TACPIPE_LOCK_TIMEOUT_S overrides it
REPORT_AFTER_S = 2.0  # wait in seconds above which it is reported
LEASE_BYTES = 1 << 30  # maximum size of a lease, which is enough for 16 million objects
_POLL_S = 0.02
_UNKNOWN_S = 14 * 86400.0  # how long a run of another host counts as active on a file system without locks
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


class Holder(TypedDict, total=False):
    """The process that holds a lease, as it describes itself; another program may have written anything."""

    host: str
    pid: int
    command: str
    since_s: int  # seconds of UTC since 1970
    what: str  # its work
    manifests: list[str]  # digests of the manifests that it reads
    keys: list[str]  # keys of the results that it computes


@dataclass
class Run:
    """A process that uses a store, as described in its lease."""

    path: Path
    note: Holder
    objects: set[str] = field(default_factory=set)  # digests of the objects that it reads, stores and reuses

    @property
    def manifests(self) -> list[str]:
        """The digests of the manifests that it reads."""
        return list(self.note.get("manifests", ()))

    @property
    def keys(self) -> list[str]:
        """The keys that it computes; their records and objects are protected when they are written."""
        return [key for key in self.note.get("keys", ()) if isinstance(key, str) and DIGEST.fullmatch(key)]


class Leases:
    """The leases in one folder. ``note_denied`` is called for those that this user may not read."""

    def __init__(self, folder: Path, note_denied: layout.NoteDenied) -> None:
        self.folder = folder
        self._note_denied = note_denied

    @contextlib.contextmanager
    def hold(self, key: str, work: str = "", timeout_s: float | None = None) -> Iterator[None]:
        """Hold a key exclusively in the block, so that two processes do not both compute ``work``.

        The kernel releases the lease of a process that dies. While waiting, the holder is reported on stderr. Raises
        `LockedError` after ``timeout_s``.
        """
        path = self.folder / f"{key}.lock"
        handle = _try_lock(path)
        if handle is None:
            handle = _wait(path, work or f"key {key[:12]}", _timeout_s() if timeout_s is None else timeout_s)
        with _noted(path, handle, work):
            yield

    @contextlib.contextmanager
    def running(self, manifests: Iterable[str] = ()) -> Iterator[Announcing]:
        """Announce to ``gc`` during the block that a run reads these manifests.

        Yields an object that announces further objects.
        """
        path = self.folder / f"run-{uuid.uuid4().hex}.lock"
        handle = None
        while handle is None:  # gc may look at the file between its creation and the lock
            handle = _try_lock(path)
        try:
            with readable_errors(self.folder.parent):
                write_all(handle, note(manifests=sorted(manifests)) + b"\n")
            announcing = Announcing(path)
            yield announcing
            announcing.close()
        finally:
            _release(path, handle)

    def runs(self) -> list[Run]:
        """Return the active runs with their announcements, and remove the leases of dead ones.

        A run without announcements does not use anything yet. Leases that this user may not read are left out.
        """
        running = []
        for path in self._files():
            if not path.name.startswith("run-"):
                continue
            try:
                handle = _try_lock(path, create=False)
                if handle is None:
                    running.append(_read_lease(path))
                    continue
                if not _has_locks(handle) and _seems_alive(path):
                    running.append(_read_lease(path))
                else:
                    path.unlink(missing_ok=True)
                os.close(handle)
            except FileNotFoundError:
                continue
            except DeniedError as error:
                self._note_denied(f"leases/{path.name}", error)
        return running

    def sweep(self) -> None:
        """Remove the files of killed processes, whose locks are already released."""
        for path in self._files():
            with contextlib.suppress(FileNotFoundError, TacpipeError):
                handle = _try_lock(path, create=False)
                if handle is not None:
                    if _has_locks(handle):  # without locks the owner is unknown
                        path.unlink()
                    os.close(handle)

    def _files(self) -> Iterator[Path]:
        return layout.entries(self.folder.parent, self.folder.name)

    @contextlib.contextmanager
    def exclusive(self, work: str) -> Iterator[None]:
        """Run the block exclusively. Raises `LockedError` immediately if another process does the same ``work``."""
        path = self.folder / f"{work}.lock"
        handle = _try_lock(path)
        if handle is None:
            raise LockedError(f"{_holder(path)} already runs `tacpipe store {work}`. Wait for it.")
        with _noted(path, handle, work):
            yield


@contextlib.contextmanager
def _noted(path: Path, handle: int, work: str) -> Iterator[None]:
    """Describe this process in a lease that it holds, and release the lease after the block."""
    try:
        with contextlib.suppress(OSError):  # the note only informs waiting processes
            os.ftruncate(handle, 0)
            os.pwrite(handle, note(what=work), 0)
        yield
    finally:
        _release(path, handle)


class Announcing:
    """The file in which a run's processes announce the objects that they use, before checking that they exist.

    A garbage collector first moves objects aside and then reads the announcements, so at least one of the two notices
    the other.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = str(path)
        self._handle = -1
        self._read_lease: set[str] = set()

    def announce(self, names: Iterable[str]) -> None:
        """Announce that objects are used. Raises `TacpipeError` if the process that started the run has ended."""
        new = [name for name in names if name not in self._read_lease]
        if not new:
            return
        with readable_errors(Path(self.path).parent.parent):
            if self._handle < 0:
                try:
                    self._handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW)
                except FileNotFoundError:
                    raise TacpipeError(
                        "The process that started this run has ended, so nothing more is written."
                    ) from None
            write_all(self._handle, "".join(f"{name}\n" for name in new).encode())
        self._read_lease.update(new)

    def close(self) -> None:
        """Stop announcing."""
        if self._handle >= 0:
            with contextlib.suppress(OSError):  # the announcements are no longer needed
                os.close(self._handle)
            self._handle = -1


def _release(path: Path, handle: int) -> None:
    with contextlib.suppress(OSError):  # the kernel releases the lock anyway
        path.unlink()
    with contextlib.suppress(OSError):
        os.close(handle)


def _read_lease(path: Path) -> Run:
    return parse_lease(path, regular.content(path, LEASE_BYTES, follow=False))


def parse_lease(path: Path, content: bytes) -> Run:
    """Parse a lease: a line that describes its holder, then one line per used digest."""
    first, _, digests = content.decode("latin-1").partition("\n")
    try:
        value = json.loads(first)
    except ValueError:
        value = None  # the lease is still being written
    holder = cast("Holder", value if isinstance(value, dict) else {})
    return Run(path, holder, set(digests.split()))


def note(**extra: Any) -> bytes:
    """Return the description of a lease's holder as one line of JSON."""
    command = without_credentials(shlex.join(["tacpipe", *sys.argv[1:]]))
    value = {
        "host": platform.node(),
        "pid": os.getpid(),
        "command": command[:500],
        "since_s": int(time.time()),
        **extra,
    }
    return json.dumps(value).encode()


def _timeout_s() -> float:
    """Return the timeout in seconds that the environment sets. Raises `TacpipeError` if it is not a number."""
    text = os.environ.get("TACPIPE_LOCK_TIMEOUT_S", "")
    try:
        return float(text) if text else LOCK_TIMEOUT_S
    except ValueError:
        raise TacpipeError(f"TACPIPE_LOCK_TIMEOUT_S is {text!r}; it should be a number of seconds.") from None


def _wait(path: Path, work: str, timeout_s: float) -> int:
    """Wait until the lock is free and return its handle; report the holder on stderr.

    Raises `LockedError` after ``timeout_s``.
    """
    began_s = time.monotonic()
    reported = False
    while True:
        waited_s = time.monotonic() - began_s
        if waited_s >= timeout_s:
            raise LockedError(
                f"{_holder(path)} has held {work} for over {timeout_s:g} s. Wait for it or stop it; "
                f"TACPIPE_LOCK_TIMEOUT_S sets how long to wait."
            )
        if not reported and waited_s >= REPORT_AFTER_S:
            reported = True
            terminal.report_progress(f"waiting for {_holder(path, 'another process')}, which is at work on {work}.")
        time.sleep(_POLL_S)
        handle = _try_lock(path)
        if handle is not None:
            return handle


def _holder(path: Path, unknown: str = "Another process") -> str:
    """Return a phrase with the holder of a lease and whether it is stopped, or ``unknown`` if there is no note on it."""
    note: Holder = {}
    with contextlib.suppress(OSError, TacpipeError):  # the holder's name only informs the user
        note = _read_lease(path).note
    if "pid" not in note:
        return unknown
    stopped = ", which is stopped: `kill -CONT` lets it continue," if _is_stopped(note) else ""
    prefix = "process" if unknown[0].islower() else "Process"
    return f"{prefix} {note['pid']} on {note.get('host')} ({note.get('command')}){stopped}"


def _is_stopped(note: Holder) -> bool:
    """Return whether the holder is a process of this computer that a signal has stopped."""
    if note.get("host") != platform.node():
        return False
    try:
        return Path(f"/proc/{note['pid']}/stat").read_text().rpartition(")")[2].split()[0] in "Tt"
    except (OSError, IndexError):  # no such process, or another operating system
        return False


def _seems_alive(path: Path) -> bool:
    """Return whether a run may be active, for file systems without locks.

    On this computer its process must exist; on another, its lease must be younger than `_UNKNOWN_S`.
    """
    note = _read_lease(path).note
    if note.get("host") == platform.node() and "pid" in note:
        try:
            os.kill(note["pid"], 0)
        except ProcessLookupError:
            return False
        except PermissionError:  # the process belongs to another user
            return True
        return True
    return time.time() - path.stat().st_mtime < _UNKNOWN_S


def _has_locks(handle: int) -> bool:
    """Return whether the file system of an open file supports locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _try_lock(path: Path, *, create: bool = True) -> int | None:
    """Return an open handle that holds the lock, or None if another process holds it or deletes the file.

    ``create``: whether a missing file is created; otherwise `FileNotFoundError` is raised. On a file system without locks,
    every caller gets the lock: a lease saves duplicate work, but no result depends on it.
    """
    with readable_errors(path.parent.parent):
        handle = patiently(lambda: _open(path, is_new=create))
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(handle).st_ino == os.stat(path).st_ino:  # noqa: PTH116  (else it was unlinked meanwhile)
            return handle
    except (BlockingIOError, FileNotFoundError):
        pass
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return handle
        os.close(handle)
        if error.errno == errno.ESTALE:  # another computer on a network file system deleted it in the meantime
            return None
        with readable_errors(path.parent.parent):
            raise
    os.close(handle)
    return None


def _open(path: Path, *, is_new: bool) -> int:
    """Return a handle on a lease file; if it ``is_new``, the file and its folder are created if they do not exist.

    Raises `FileNotFoundError` for others, and `PermissionError` if the file can be neither written nor read.
    """
    flags = os.O_RDWR | os.O_NOFOLLOW
    try:
        return create(path, flags | os.O_CREAT) if is_new else os.open(path, flags)
    except FileNotFoundError:
        if not is_new:
            raise
        make_folder(path.parent)
        return create(path, flags | os.O_CREAT)
    except PermissionError as error:
        try:
            # belongs to another user of the store: read-only access is enough to wait for it
            return os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
        except FileNotFoundError:
            raise error from None
