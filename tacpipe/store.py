"""The store: objects by digest, records by key, roots; see docs/format.md for its invariants."""

from __future__ import annotations

import contextlib
import json
import os
import time
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tacpipe.errors import DamagedError, TacpipeError
from tacpipe.files import read_json, readable_errors, sync_folder, write_whole
from tacpipe.hashing import bytes_digest, digest
from tacpipe.leases import Leases

FORMAT = "1"


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
        self.leases = Leases(self.root / "leases")

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
            with readable_errors(self.root):
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

    def keep(self, name: str) -> bool:
        """Return whether an object is there, and freshen it: a collection that runs meanwhile then leaves it alone."""
        try:
            os.utime(self.object_path(name))
        except FileNotFoundError:
            return False
        except OSError:  # a store that may only be read has no collection to fear
            return self.has(name)
        return True

    def put(self, content: bytes, *, durable: bool = False) -> Object:
        """Store ``content`` and return its digest and size.

        An object that is there already is kept and freshened, after a look at its size: a damaged one is found on
        reading. What cannot be made again is ``durable``: its folder is synced too, and a copy that is there already
        is read and replaced if it is damaged.
        """
        name = bytes_digest(content)
        path = self.object_path(name)
        with contextlib.suppress(FileNotFoundError, MissingError), readable_errors(self.root):
            if durable:
                self.read(name)
            if os.stat(path).st_size == len(content):  # noqa: PTH116
                os.utime(path)
                return Object(name, len(content))
        self.write_file(path, content, mode=0o444)
        if durable:
            sync_folder(os.path.dirname(path))  # noqa: PTH120
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

    def write_file(self, path: Path | str, content: bytes, *, mode: int = 0o644, exclusive: bool = False) -> bool:
        """Write a file of the store whole or not at all; return False if ``exclusive`` lost the race."""
        with readable_errors(self.root):
            draft = f"{self._root}/tmp/{uuid.uuid4().hex}"
            return write_whole(str(path), content, draft, mode=mode, exclusive=exclusive)

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
        path = self.record_path(key)
        if self.write_file(path, content, exclusive=not replace):
            if durable:
                sync_folder(os.path.dirname(path))  # noqa: PTH120
            return record
        return self.record(key) or record

    def records(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield every key and its record."""
        for path in sorted(self.root.glob("records/*/*.json")):
            record = self.record(path.stem)
            if record is not None:
                yield path.stem, record

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
        return read_json(self.root_path(path))

    def roots(self) -> list[dict[str, Any]]:
        """Return all roots."""
        found = (read_json(path) for path in sorted((self.root / "roots").glob("*.json")))
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
