"""Move objects of a store without locks aside, and put them back or remove them.

Each collection moves objects aside under its own names, so several can run at the same time.
"""

from __future__ import annotations

import contextlib
import sys
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from tacpipe.io import threads
from tacpipe.io.hashing import DIGEST
from tacpipe.store import layout
from tacpipe.store.backend import MAX_CONCURRENT, Backend, Entry
from tacpipe.store.remote_roots import RemoteRoots

SNAPSHOTS = "snapshots"  # keys of the records of each manifest, so that a pull reads only these
Result = TypeVar("Result")


class RemoteCollections:
    """The part of a store on a backend without locks that collections use."""

    def __init__(self, files: Backend) -> None:
        self.files = files
        self.roots = RemoteRoots(files)
        self._asides: dict[str, str] = {}  # names of the objects that a collection moved aside, by digest

    def has(self, name: str, size: int | None = None) -> bool:
        """Return whether an object with this digest (and size in bytes) exists, without reading it."""
        entry = self.files.stat(layout.object_name(name))
        return entry is not None and size in (None, entry.bytes)

    def asides(self, name: str = "") -> Iterator[Entry]:
        """Yield the entries that collections have moved aside, of one object or of all."""
        return (entry for entry in self.files.list("tmp") if entry.name.startswith(f"tmp/{layout.ASIDE}{name}"))

    @contextlib.contextmanager
    def collecting(self, grace_days: float, *, dry_run: bool) -> Iterator[None]:
        """Run a collection in the block, after restoring what killed ones moved aside; several may run concurrently.

        Announcements that are too old for a living process are removed first.
        """
        if not dry_run:
            now_s, grace_s = self._now_s(), max(grace_days, 1.0) * 86400.0
            for lease in self.files.list("leases"):
                if now_s - lease.changed_s > grace_s:
                    self.files.delete(lease.name)
            for entry in list(self.asides()):
                self._restore(entry, is_dead=now_s - entry.changed_s > grace_s)
        yield

    def _now_s(self) -> float:
        """Return the time by the backend's clock in seconds, or 0 if another process removed the file that shows it."""
        name = f"leases/run-{uuid.uuid4().hex}.lock"
        self.files.create(name, b"{}")
        entry = self.files.stat(name)
        self.files.delete(name)
        return 0.0 if entry is None else entry.changed_s

    def _restore(self, entry: Entry, *, is_dead: bool) -> None:
        """Restore an object that another collection, running or killed, moved aside.

        A running one deletes the moved object after it was copied, so its copy is kept; that of a dead collection is
        not.
        """
        name = Path(entry.name).name.removeprefix(layout.ASIDE).partition("-")[0]
        if not DIGEST.fullmatch(name):
            return
        with contextlib.suppress(FileNotFoundError):
            if not self.has(name):
                self.files.create(layout.object_name(name), self.files.blocks(entry.name, sys.maxsize))
            if is_dead:
                self.files.delete(entry.name)

    def set_aside(self, names: Iterable[str]) -> list[str]:
        """Move objects aside under names of this collection, and return those that existed."""
        collection = uuid.uuid4().hex
        self._asides = {name: f"tmp/{layout.ASIDE}{name}-{collection}" for name in names}
        moved = self._map(lambda name: self.files.move(layout.object_name(name), self._asides[name]), self._asides)
        return [name for name, was_moved in zip(self._asides, moved, strict=True) if was_moved]

    def put_back(self, names: Iterable[str]) -> None:
        """Put back objects that were moved aside, except those that have been copied here again."""

        def restore(name: str) -> None:
            if self.has(name):
                self.files.delete(self._asides[name])
            else:
                self.files.move(self._asides[name], layout.object_name(name))

        self._map(restore, names)

    def discard(self, names: Iterable[str]) -> None:
        """Remove objects that were moved aside, after the lists of records of manifests among them.

        Versions of roots that no push can consider the newest are removed too.
        """
        removed = set(names)
        self._map(self.files.delete, self.roots.superseded())
        snapshots = [entry.name for entry in self.files.list(SNAPSHOTS) if entry.name.split("/")[1] in removed]
        self._map(self.files.delete, snapshots)
        self._map(self.files.delete, [self._asides[name] for name in removed])

    def _map(self, work: Callable[[str], Result], items: Iterable[str]) -> list[Result]:
        """Return the results of ``work`` for all items, computed concurrently."""
        return list(threads.map_in_threads(work, items, MAX_CONCURRENT))
