"""Leases: who works on which key, and which runs are at work. Advisory; the kernel frees those of a process that dies."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import platform
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tacpipe.errors import LockedError
from tacpipe.files import readable_errors

LOCK_TIMEOUT_S = 3600.0  # TACPIPE_LOCK_TIMEOUT_S overrides it
_POLL_S = 0.02


class Leases:
    """The leases in one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @contextlib.contextmanager
    def hold(self, key: str, timeout_s: float | None = None) -> Iterator[None]:
        """Hold the key alone while in the block, so that two processes do not make it both.

        The kernel frees the lease of a process that dies. Raises `LockedError` after ``timeout_s``.
        """
        if timeout_s is None:
            timeout_s = float(os.environ.get("TACPIPE_LOCK_TIMEOUT_S", LOCK_TIMEOUT_S))
        path = self.folder / f"{key}.lock"
        deadline = time.monotonic() + timeout_s
        while True:
            handle = _try_lock(path)
            if handle is not None:
                break
            if time.monotonic() >= deadline:
                raise LockedError(
                    f"Another process has worked on {key[:12]} for over {timeout_s:g} s. "
                    f"Wait for it, stop it, or raise TACPIPE_LOCK_TIMEOUT_S."
                )
            time.sleep(_POLL_S)
        try:
            yield
        finally:
            with contextlib.suppress(OSError):  # the kernel frees the lock in any case
                path.unlink()
            os.close(handle)

    @contextlib.contextmanager
    def running(self, manifests: list[str]) -> Iterator[None]:
        """Tell ``gc`` while in the block that a run reads these manifests and writes objects."""
        path = self.folder / f"run-{uuid.uuid4().hex}.lock"
        handle = None
        while handle is None:  # gc may look at the file between its creation and the lock
            handle = _try_lock(path)
        try:
            note = {"host": platform.node(), "pid": os.getpid(), "manifests": manifests}
            with readable_errors(self.folder):
                os.write(handle, json.dumps(note).encode())
            yield
        finally:
            with contextlib.suppress(OSError):  # the kernel frees the lock in any case
                path.unlink()
            os.close(handle)

    def runs(self) -> Iterator[tuple[dict[str, Any], float]]:
        """Yield what each running process noted and when it began (seconds since the epoch); forget dead ones."""
        for path in self.folder.glob("run-*.lock"):
            try:
                begun_s, text = path.stat().st_mtime, path.read_text()
                handle = _try_lock(path, create=False)
            except FileNotFoundError:
                continue
            if handle is None:
                yield (json.loads(text) if text else {"manifests": []}), begun_s
            else:
                path.unlink(missing_ok=True)
                os.close(handle)

    @contextlib.contextmanager
    def alone(self, what: str) -> Iterator[None]:
        """Do ``what`` in the block while nobody else does. Raises `LockedError` at once if somebody does."""
        path = self.folder / f"{what}.lock"
        handle = _try_lock(path)
        if handle is None:
            raise LockedError(f"Another `tacpipe store {what}` is at work on this store. Wait for it.")
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
            os.close(handle)


def _try_lock(path: Path, *, create: bool = True) -> int | None:
    """Return an open handle that holds the lock, or None if somebody else does."""
    flags = os.O_RDWR | (os.O_CREAT if create else 0)
    with readable_errors(path.parent):
        try:
            handle = os.open(path, flags, 0o644)
        except FileNotFoundError:
            if not create:
                raise
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, flags, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(handle).st_ino == os.stat(path).st_ino:  # noqa: PTH116  (else it was unlinked meanwhile)
            return handle
    except (BlockingIOError, FileNotFoundError):
        pass
    os.close(handle)
    return None
