"""The store: objects by digest, records by key, leases and roots; see docs/format.md for its invariants."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import platform
import time
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.errors import DamagedError, LockedError, TacpipeError
from tacpipe.hashing import bytes_digest, digest

FORMAT = "1"
LOCK_TIMEOUT_S = 3600.0  # TACPIPE_LOCK_TIMEOUT_S overrides it
_POLL_S = 0.02


class MissingError(DamagedError):
    """An object is not in the store, or was damaged and is now in quarantine."""


@dataclass(frozen=True)
class Object:
    """What a manifest says of stored content."""

    digest: str
    bytes: int


class Store:
    """Content by digest and results by key, in one folder."""

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        self._root = str(root)

    # ---- places

    def object_path(self, name: str) -> str:
        """Return where the object ``name`` lies, whether or not it is there."""
        return f"{self._root}/objects/{name[:2]}/{name}"

    def record_path(self, key: str) -> str:
        """Return where the record of ``key`` lies, whether or not it is there."""
        return f"{self._root}/records/{key[:2]}/{key}.json"

    def prepare(self) -> None:
        """Create the store's folders if they are not there; refuse a store of another format."""
        mark = self.root / "format"
        if not mark.exists():
            with _readable_errors(self._root):
                for name in ("objects", "records", "roots", "leases", "checkpoints", "quarantine", "tmp"):
                    (self.root / name).mkdir(parents=True, exist_ok=True)
                self.write_file(mark, FORMAT.encode() + b"\n")
        found = mark.read_text().strip()
        if found != FORMAT:
            raise TacpipeError(f"The store {self._root} has format {found}; this tacpipe reads format {FORMAT}.")

    # ---- objects

    def has(self, name: str) -> bool:
        """Return whether an object of this digest is there; its bytes are not looked at."""
        return os.path.exists(self.object_path(name))  # noqa: PTH110  (called once a shard: os.path is 5x faster)

    def put(self, content: bytes, *, durable: bool = False) -> Object:
        """Store ``content`` and return its digest and size.

        An object that is there already is kept and freshened, after a look at its size: a damaged one is found on
        reading. What cannot be made again is ``durable``: its folder is synced too, and a copy that is there already
        is read and replaced if it is damaged.
        """
        name = bytes_digest(content)
        path = self.object_path(name)
        with contextlib.suppress(FileNotFoundError, MissingError), _readable_errors(self._root):
            if durable:
                self.read(name)
            if os.stat(path).st_size == len(content):  # noqa: PTH116
                os.utime(path)
                return Object(name, len(content))
        self.write_file(path, content, mode=0o444, durable=durable)
        return Object(name, len(content))

    def read(self, name: str) -> bytes:
        """Return the content of an object, verified.

        Raises `MissingError` if it is not there, or if its bytes do not hash to its name: those are then moved to
        ``quarantine/``.
        """
        path = self.object_path(name)
        try:
            with open(path, "rb", buffering=0) as file:
                content = file.readall()
        except FileNotFoundError:
            raise MissingError(f"Object {name[:12]} is not in the store {self._root}.") from None
        if bytes_digest(content) != name:
            self.quarantine(path)
            raise MissingError(f"Object {name[:12]} was damaged and is now in {self._root}/quarantine.")
        return content

    def quarantine(self, path: str | Path) -> None:
        """Move a damaged file out of the way, keeping it for whoever wants to know why."""
        target = self.root / "quarantine" / f"{Path(path).name}.{time.time_ns()}"
        with contextlib.suppress(FileNotFoundError):
            Path(path).replace(target)

    def write_file(
        self, path: Path | str, content: bytes, *, mode: int = 0o644, exclusive: bool = False, durable: bool = False
    ) -> bool:
        """Write ``content`` to ``path``: draft in ``tmp/``, fsync, rename. Return False if ``exclusive`` lost the race."""
        draft = f"{self._root}/tmp/{uuid.uuid4().hex}"
        with _readable_errors(self._root):
            try:
                _write_synced(draft, content, mode)
                try:
                    return _move(draft, str(path), exclusive)
                except FileNotFoundError:
                    os.makedirs(os.path.dirname(path), exist_ok=True)  # noqa: PTH103, PTH120
                    return _move(draft, str(path), exclusive)
            finally:
                with contextlib.suppress(OSError):  # a draft that stays is swept up by gc
                    os.unlink(draft)  # noqa: PTH108
                if durable:
                    _sync_folder(os.path.dirname(path))  # noqa: PTH120

    # ---- records

    def record(self, key: str) -> dict[str, Any] | None:
        """Return the record of ``key``, or None; a damaged one is quarantined and counts as none."""
        path = self.record_path(key)
        try:
            with open(path, "rb", buffering=0) as file:
                content = file.readall()
        except FileNotFoundError:
            return None
        try:
            record: dict[str, Any] = json.loads(content)
            body = {"identity": record["identity"], "result": record["result"]}
            if digest(record["identity"]) == key and digest(body) == record["digest"]:
                return record
        except (ValueError, KeyError, TypeError, TacpipeError):
            pass
        self.quarantine(path)
        return None

    def commit(
        self,
        identity: Mapping[str, Any],
        result: Mapping[str, Any],
        provenance: Mapping[str, Any],
        *,
        replace: bool = False,
        durable: bool = False,
    ) -> dict[str, Any]:
        """Record that ``identity`` gave ``result`` and return the record that holds: the first to finish wins.

        ``replace`` is for results whose old record names objects that are gone.
        """
        key = digest(identity)
        body = {"identity": identity, "result": result}
        record = {**body, "digest": digest(body), "provenance": provenance}
        content = json.dumps(record, sort_keys=True).encode()
        if self.write_file(self.record_path(key), content, exclusive=not replace, durable=durable):
            return record
        return self.record(key) or record

    def records(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield every key and its record."""
        for path in sorted(self.root.glob("records/*/*.json")):
            record = self.record(path.stem)
            if record is not None:
                yield path.stem, record

    # ---- leases

    @contextlib.contextmanager
    def lease(self, key: str, timeout_s: float | None = None) -> Iterator[None]:
        """Hold the key alone while in the block, so that two processes do not make it both.

        The kernel frees the lease of a process that dies. Raises `LockedError` after ``timeout_s``.
        """
        if timeout_s is None:
            timeout_s = float(os.environ.get("TACPIPE_LOCK_TIMEOUT_S", LOCK_TIMEOUT_S))
        path = self.root / "leases" / f"{key}.lock"
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
        path = self.root / "leases" / f"run-{uuid.uuid4().hex}.lock"
        handle = None
        while handle is None:  # gc may look at the file between its creation and the lock
            handle = _try_lock(path)
        try:
            note = {"host": platform.node(), "pid": os.getpid(), "manifests": manifests}
            with _readable_errors(self._root):
                os.write(handle, json.dumps(note).encode())
            yield
        finally:
            with contextlib.suppress(OSError):  # the kernel frees the lock in any case
                path.unlink()
            os.close(handle)

    def runs(self) -> Iterator[tuple[dict[str, Any], float]]:
        """Yield what each running process noted and when it began (seconds since the epoch); forget dead ones."""
        for path in (self.root / "leases").glob("run-*.lock"):
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

    # ---- roots

    def root_path(self, path: Path) -> Path:
        """Return where the root of the dataset at ``path`` lies."""
        return self.root / "roots" / f"{digest(str(path))}.json"

    def set_root(self, path: Path, manifest: str) -> None:
        """Note that ``path`` now holds ``manifest``; the one before stays known for `explain`."""
        known = self.get_root(path) or {"manifest": None, "previous": None}
        if known["manifest"] == manifest:
            return
        root = {"path": str(path), "manifest": manifest, "previous": known["manifest"], "written_s": int(time.time())}
        self.write_file(self.root_path(path), json.dumps(root, sort_keys=True).encode())

    def get_root(self, path: Path) -> dict[str, Any] | None:
        """Return the root of ``path``, or None."""
        return _read_json(self.root_path(path))

    def roots(self) -> list[dict[str, Any]]:
        """Return all roots."""
        found = (_read_json(path) for path in sorted((self.root / "roots").glob("*.json")))
        return [root for root in found if root is not None]


def locate(start: Path | None = None) -> Store:
    """Return the store to use: ``TACPIPE_STORE``, else ``.tacpipe`` beside the project that ``start`` lies in."""
    named = os.environ.get("TACPIPE_STORE")
    if named:
        return Store(Path(named).absolute())
    return Store(project(start) / ".tacpipe")


def project(start: Path | None = None) -> Path:
    """Return the folder of the project: the nearest one upwards with a store, a ``dvc.yaml`` or a git repository."""
    here = (start or Path.cwd()).absolute()
    for mark in (".tacpipe", "dvc.yaml", ".git"):
        for folder in (here, *here.parents):
            if (folder / mark).exists():
                return folder
    return here


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        value: dict[str, Any] = json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError):
        return None
    return value


def _write_synced(path: str, content: bytes, mode: int) -> None:
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    except FileNotFoundError:
        os.makedirs(os.path.dirname(path), exist_ok=True)  # noqa: PTH103, PTH120
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    try:
        view = memoryview(content)
        while view:
            view = view[os.write(handle, view) :]
        os.fsync(handle)
    finally:
        os.close(handle)


def _move(draft: str, path: str, exclusive: bool) -> bool:
    if not exclusive:
        os.replace(draft, path)  # noqa: PTH105
        return True
    try:
        os.link(draft, path)
    except FileExistsError:
        return False
    return True


def _sync_folder(path: str) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _try_lock(path: Path, *, create: bool = True) -> int | None:
    """Return an open handle that holds the lock, or None if somebody else does."""
    flags = os.O_RDWR | (os.O_CREAT if create else 0)
    with _readable_errors(str(path.parent.parent)):
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


@contextlib.contextmanager
def _readable_errors(root: str) -> Iterator[None]:
    """Turn what the file system says into a sentence."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise TacpipeError(
                f"The disk under {root} is full; nothing was half written. Free some space (`tacpipe store gc --dry-run` "
                f"shows what the store could give back) and run the same command again."
            ) from error
        if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
            raise TacpipeError(
                f"The store {root} cannot be written ({error.strerror}). Make it writable, or name another one in "
                f"TACPIPE_STORE."
            ) from error
        raise
