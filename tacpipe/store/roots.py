"""Roots: which path contains which manifest. A root protects its manifest and everything that it was computed from."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NotRequired, Protocol, TypedDict, TypeGuard

from tacpipe.errors import DeniedError
from tacpipe.io import regular
from tacpipe.io.files import readable_errors
from tacpipe.io.hashing import DIGEST, digest
from tacpipe.store.layout import BESIDE_NAME

BESIDE, ABSOLUTE, PUSHED = "beside", "absolute", "pushed"  # kinds of roots
ROOT_BYTES = 1 << 24  # maximum size of a root, which is enough for a history of 100,000 entries
HISTORY = 20  # number of previous manifests in a path's history; ``lasting`` ones are kept forever
PUSHES = 100  # number of pushed manifests remembered per path
_MAX_TIME_S = 1 << 40  # maximum time in a root: the year 36,812


class RootProject(TypedDict):
    """The project that pushed a root."""

    id: str
    name: str


class WrittenManifest(TypedDict):
    """A current or previous manifest of a path."""

    manifest: str  # digest of the manifest
    written_s: NotRequired[int]  # seconds of UTC since 1970


class EarlierManifest(WrittenManifest):
    """A previous manifest of a path."""

    lasting: bool  # whether it is remembered forever


class Root(WrittenManifest):
    """A path, or the name under which a project pushed, and its manifest."""

    path: str
    kind: str
    previous: NotRequired[str | None]  # digest of the previous manifest
    history: NotRequired[list[EarlierManifest]]  # newest first
    key: NotRequired[str]  # key of the run that produced the manifest, or whose recordings were labelled
    pushed: NotRequired[list[str]]  # digests of this path's manifests that were pushed to other stores, newest first
    project: NotRequired[RootProject]
    missing_since_s: NotRequired[int]  # UTC time in s at which the path was first missing
    output: NotRequired[bool]  # whether a command wrote the dataset with a bucket as its store
    number: NotRequired[int]  # version of the file in a store without locks; it is not stored


class RootFiles(Protocol):
    """The files of a store, which is a `tacpipe.store.store.Store`, as its roots read and write them."""

    root: Path

    def listed(self, *patterns: str) -> list[Path]:
        """Return the paths that match one pattern per folder level."""
        ...

    def note_denied(self, name: str, error: DeniedError) -> None:
        """Note that this user may not read a file of the store."""
        ...

    def quarantine(self, path: str | Path) -> bool:
        """Move a damaged file to quarantine."""
        ...

    def sync(self, path: str | Path) -> None:
        """Make the name of a file in the store survive a power loss."""
        ...

    def write_file(self, path: Path | str, content: bytes) -> bool:
        """Write a file."""
        ...


class Roots:
    """The roots of a store."""

    def __init__(self, store: RootFiles) -> None:
        self.store = store

    def set(self, path: Path, manifest: str, *, durable: bool = False, lasting: bool = False, key: str = "") -> None:
        """Record that ``path`` now contains ``manifest``, the result of the run ``key``; the previous one becomes history.

        The previous one is ``lasting`` if it contained recordings or labels that the new one lacks; `gc` then keeps it.
        """
        kind, name = self.kind_and_name(path)
        current = self.get(path)
        if current is None or current["manifest"] != manifest:
            root = next_root(current, name, kind, manifest, lasting=lasting)
            if current and "pushed" in current:
                root["pushed"] = current["pushed"]
            if key:
                root["key"] = key
            self.write(root)
        if durable:
            self.store.sync(self._file(kind, name))

    def get(self, path: Path) -> Root | None:
        """Return the root of ``path``, or None if there is none. Its ``path`` is the dataset's present location."""
        return self.read(self._file(*self.kind_and_name(path)))

    def push(self, name: str, project: RootProject, manifest: str, before: Root | None, *, lasting: bool) -> bool:
        """Record that a project pushed ``manifest`` as its dataset ``name``, after ``before``. Return True.

        Previous versions stay in the history, forever if ``lasting``. A lease prevents concurrent pushes of the same
        name.
        """
        if before is None or before["manifest"] != manifest or before.get("project") != project:
            self.write({**next_root(before, name, PUSHED, manifest, lasting=lasting), "project": project})
        self.store.sync(self._file(PUSHED, name, project["id"]))
        return True

    def pushed(self, name: str, project: str) -> Root | None:
        """Return the root that the project with this id pushed as ``name``, or None."""
        return self.read(self._file(PUSHED, name, project))

    def note_pushed(self, path: Path, manifest: str) -> None:
        """Record that ``manifest`` of ``path`` was pushed to another store. Does nothing for a path without a root."""
        root = self.get(path)
        if root is not None:
            earlier = [pushed for pushed in root.get("pushed", []) if pushed != manifest]
            self.write({**root, "pushed": [manifest, *earlier][:PUSHES]})

    def all(self) -> list[Root]:
        """Return all roots, except for those that this user may not read.

        Damaged ones are quarantined; the next run of their stage writes them again.
        """
        return [root for _, root in self._readable()]

    def _readable(self) -> Iterator[tuple[Path, Root]]:
        """Yield the file of each root, and the root; those that this user may not read are noted in the store."""
        for file in self.store.listed("roots", "*.json"):
            try:
                root = self.read(file)
            except DeniedError as error:
                self.store.note_denied(f"roots/{file.name}", error)
                continue
            if root is not None:
                yield file, root

    def remove(self, root: Root) -> None:
        """Remove a root returned by `all`, whatever the name of its file."""
        for file, stored_root in self._readable():
            if stored_root == root:
                with readable_errors(self.store.root):
                    file.unlink(missing_ok=True)

    def write(self, root: Root) -> None:
        """Replace a root returned by `all`, possibly with additional fields."""
        kind, name = root["kind"], str(root["path"])
        if kind == BESIDE and Path(name).is_absolute():
            name = os.path.relpath(name, self.store.root.parent)
        self.store.write_file(self._file(kind, name, project_id(root)), encoded({**root, "path": name, "kind": kind}))

    def read(self, file: Path) -> Root | None:
        """Return the root in ``file``, or None if it does not exist or is damaged. A damaged file is quarantined."""
        try:
            with readable_errors(self.store.root, reading=True):
                value = regular.json_value(file, ROOT_BYTES)
        except FileNotFoundError:
            return None
        except (ValueError, RecursionError, regular.IrregularError):
            value = None
        root = decoded(value)
        if root is None:
            if DIGEST.fullmatch(file.stem):  # files with other names do not belong to the store
                self.store.quarantine(file)
            return None
        is_relative = root["kind"] == BESIDE
        return {**root, "path": str(self.store.root.parent / root["path"])} if is_relative else root

    def damaged(self) -> list[str]:
        """Return the names of damaged roots that have not been rewritten, so that their datasets are unknown."""
        names = {path.name[len("root-") :].partition(".")[0] for path in self.store.listed("quarantine", "root-*")}
        return sorted(name for name in names if not (self.store.root / "roots" / f"{name}.json").exists())

    def is_of(self, name: str, path: Path) -> bool:
        """Return whether the root with this name belongs to the dataset at ``path``."""
        return self._file(*self.kind_and_name(path)).stem == name

    def is_own(self, root: Root) -> bool:
        """Return whether this user wrote a root; in a shared store, roots of other users may name any path."""
        kind, name = root["kind"], str(root["path"])
        if kind == BESIDE and Path(name).is_absolute():
            name = os.path.relpath(name, self.store.root.parent)
        try:
            with readable_errors(self.store.root, reading=True):
                return self._file(kind, name, project_id(root)).lstat().st_uid == os.getuid()
        except FileNotFoundError:
            return False

    def kind_and_name(self, path: Path) -> tuple[str, str]:
        """Return kind and name of the root of a path.

        The name of a dataset next to its store is a relative path, so that both can be moved together.
        """
        parent = self.store.root.parent
        if self.store.root.name == BESIDE_NAME and path.is_relative_to(parent):
            return BESIDE, str(path.relative_to(parent))
        return ABSOLUTE, str(path)

    def _file(self, kind: str, name: str, project: str = "") -> Path:
        return self.store.root / "roots" / f"{name_of(kind, name, project)}.json"


def name_of(kind: str, name: str, project: str = "") -> str:
    """Return the digest that is the file name of a root."""
    if kind == ABSOLUTE:
        return digest(name)
    return digest([kind, project, name] if project else [kind, name])


def encoded(root: Root) -> bytes:
    """Return an encoded root that includes a digest of itself."""
    content = {key: value for key, value in root.items() if key not in ("check", "number")}
    return json.dumps({**content, "check": digest(content)}, sort_keys=True).encode()


def decoded(value: object) -> Root | None:
    """Return the root in a JSON value, or None if it is damaged."""
    root = dict(value) if isinstance(value, dict) else {}
    check = root.pop("check", None)
    return root if check is not None and check == digest(root) and _is_valid_root(root) else None


def project_id(root: Root) -> str:
    """Return the id of the project that pushed a root, or empty if none did."""
    return root["project"]["id"] if "project" in root else ""


def next_root(current: Root | None, path: str, kind: str, manifest: str, *, lasting: bool) -> Root:
    """Return a new root for ``manifest``, whose history starts with the manifest of ``current``."""
    return {
        "path": path,
        "kind": kind,
        "manifest": manifest,
        "previous": None if current is None else current["manifest"],
        "written_s": int(time.time()),
        "history": [] if current is None else _history(current, manifest, lasting=lasting),
    }


def _is_valid_root(root: dict[object, Any]) -> TypeGuard[Root]:
    """Return whether the values of a root have the right types; another program may have written it."""
    project, history = root.get("project", {"id": "", "name": ""}), root.get("history", [])
    if not (
        isinstance(project, dict)
        and isinstance(history, list)
        and all(isinstance(version, dict) for version in history)
    ):
        return False
    texts = [root.get("path"), *(project.get(key) for key in ("id", "name"))]
    texts += [version.get("manifest") for version in (root, *history)]
    times = [version.get("written_s", 0) for version in (root, *history)] + [root.get("missing_since_s", 0)]
    return (
        all(isinstance(text, str) and "\0" not in text for text in texts)
        and all(isinstance(time_s, int) and 0 <= time_s < _MAX_TIME_S for time_s in times)
        and all(isinstance(version.get("lasting"), bool) for version in history)
        and isinstance(root.get("previous"), str | None)
        and root.get("kind") in (BESIDE, ABSOLUTE, PUSHED)
    )


def _history(current: Root, manifest: str, *, lasting: bool) -> list[EarlierManifest]:
    """Return the versions before ``manifest``, newest first: all lasting ones and `HISTORY` others."""
    newest: EarlierManifest = {
        "manifest": current["manifest"],
        "written_s": current.get("written_s", 0),
        "lasting": lasting,
    }
    older = [
        version for version in current.get("history", []) if version["manifest"] not in (manifest, newest["manifest"])
    ]
    retained, room = [], HISTORY
    for version in [newest, *older]:
        room -= not version["lasting"]
        if version["lasting"] or room >= 0:
            retained.append(version)
    return retained
