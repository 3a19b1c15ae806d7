"""The roots of a store on a backend without locks: numbered versions that are never overwritten."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator
from pathlib import Path

from tacpipe.errors import DamagedError, TacpipeError
from tacpipe.io import threads
from tacpipe.store.backend import MAX_CONCURRENT, Backend, read_twice
from tacpipe.store.roots import PUSHED, ROOT_BYTES, Root, RootProject, decoded, encoded, name_of, next_root, project_id

_VERSION = re.compile(r"roots/([0-9a-f]{64})(?:/([0-9]{8}))?\.json")


class RemoteRoots:
    """The roots of a store without locks: which project pushed which manifest under which name.

    Each version has a number. The newest one is valid and contains the history of the name.
    """

    def __init__(self, files: Backend) -> None:
        self.files = files

    def all(self) -> list[Root]:
        """Return all valid roots; `damaged` lists the others."""
        return [root for _, root in self._read() if root is not None]

    def damaged(self) -> list[str]:
        """Return the names of roots whose newest version is damaged, so that their datasets are unknown."""
        return sorted(name for name, root in self._read() if root is None)

    def get(self, path: Path) -> Root | None:
        """Return None, because paths of this computer have no roots there."""
        return None

    def pushed(self, name: str, project: str) -> Root | None:
        """Return the root that a project pushed as ``name``, or None if there is none.

        Raises `DamagedError` if its newest version is damaged.
        """
        digest_of_name = name_of(PUSHED, name, project)
        for root_name, root in self._read(digest_of_name):
            if root is None:
                raise DamagedError(
                    f"The newest file in {self.files.place}/roots/{root_name} is damaged: two reads gave the same "
                    "bytes. Delete it, and the previous one counts."
                )
            return root
        return None

    def push(
        self,
        name: str,
        project: RootProject,
        manifest: str,
        before: Root | None,
        *,
        lasting: bool,
        output: bool = False,
    ) -> bool:
        """Record that a project pushed ``manifest`` as its dataset ``name``, after ``before`` as returned by `pushed`.

        Pushed versions stay in the history until they are forgotten. The ``output`` of a command is not a snapshot: the
        next output replaces it, unless it is ``lasting``. Returns False without a change if another push came first.
        """
        is_snapshot = before is not None and not before.get("output")  # whether ``before`` is a snapshot
        is_same = before is not None and before["manifest"] == manifest and before.get("project") == project
        if is_same and (output or is_snapshot):
            return True
        root = next_root(before, name, PUSHED, manifest, lasting=lasting)
        root["project"] = project
        if before is not None and not is_snapshot and not lasting:
            root["history"] = [version for version in root["history"] if version["manifest"] != before["manifest"]]
        root["number"] = before.get("number", 0) if before is not None and _name(before) == _name(root) else 0
        if output:
            root["output"] = True
        return self._create_next(root)

    def write(self, root: Root) -> None:
        """Write ``root`` as the successor of the version from `all`. Raises `TacpipeError` if another one came first."""
        if not self._create_next(root):
            raise TacpipeError(
                f"{root['path']} was pushed to {self.files.place} meanwhile. Run the same command again."
            )

    def remove(self, root: Root) -> None:
        """Remove a root from `all` with all its versions, unless it was replaced in the meantime."""
        name = _name(root)
        if dict(self._read(name)).get(name) == root:
            for _, file in self._versions().get(name, []):
                self.files.delete(file)

    def superseded(self) -> list[str]:
        """Return the names of versions that no push can still consider the newest: all but the last two of each root."""
        return [file for versions in self._versions().values() for _, file in versions[:-2]]

    def _create_next(self, root: Root) -> bool:
        """Create the next version of a root; return False if another process created it first."""
        name = _name(root)
        number = root["number"] + 1
        if not self.files.create(_version(name, number), encoded(root)):
            return False
        # the previous version stays, so that a process that read the deleted one cannot reuse its number
        if number > 2:
            self.files.delete(_version(name, number - 2))
        return True

    def _read(self, only: str = "") -> Iterator[tuple[str, Root | None]]:
        """Yield the name and newest version of each root, or only of one; None for a damaged root."""
        newest = {name: versions[-1] for name, versions in self._versions(only).items()}
        return zip(newest, threads.map_in_threads(self._read_version, newest.values(), MAX_CONCURRENT), strict=True)

    def _read_version(self, version: tuple[int, str]) -> Root | None:
        """Return the root in a version (number, file) with its number, or None if it is gone or damaged."""
        number, file = version
        with contextlib.suppress(FileNotFoundError):
            root = read_twice(self.files, file, ROOT_BYTES, _parse)
            return None if root is None else {**root, "number": number}
        return None

    def _versions(self, only: str = "") -> dict[str, list[tuple[int, str]]]:
        """Return number and file of the versions of each root, or ``only`` of this one, the newest last.

        Roots of a copied folder have number 0.
        """
        versions: dict[str, list[tuple[int, str]]] = {}
        entries = list(self.files.list(f"roots/{only}" if only else "roots"))
        copied = self.files.stat(f"roots/{only}.json") if only and not entries else None
        for entry in [*entries, *([copied] if copied else [])]:
            match = _VERSION.fullmatch(entry.name)
            if match is not None:
                versions.setdefault(match[1], []).append((int(match[2] or 0), entry.name))
        return {name: sorted(versions[name]) for name in sorted(versions)}


def _parse(content: bytes) -> Root | None:
    with contextlib.suppress(ValueError, RecursionError):
        return decoded(json.loads(content))
    return None


def _name(root: Root) -> str:
    return name_of(root["kind"], str(root["path"]), project_id(root))


def _version(name: str, number: int) -> str:
    return f"roots/{name}/{number:08d}.json"
