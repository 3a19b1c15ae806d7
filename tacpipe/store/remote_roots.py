"""The roots of a store in a place that knows no locks: versions with numbers of their own, of which none is written over."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tacpipe.errors import DamagedError, TacpipeError
from tacpipe.io import threads
from tacpipe.store.backend import AT_ONCE, Backend, read_twice
from tacpipe.store.roots import PUSHED, ROOT_BYTES, Root, decoded, encoded, name_of, project_id, succeeding

_OUTPUT = "output"  # whether a command wrote it, which worked on the bucket as its own store
_NUMBER = "number"  # of the version that a root was read from; it is not kept
_VERSION = re.compile(r"roots/([0-9a-f]{64})(?:/([0-9]{8}))?\.json")


class RemoteRoots:
    """The roots of a store without locks: which project pushed which manifest under which name.

    Each version has a number. The newest one counts, and holds the history of the name.
    """

    def __init__(self, files: Backend) -> None:
        self.files = files

    def all(self) -> list[Root]:
        """Return all roots; what is damaged is named by `damaged`."""
        return [root for _, root in self._read() if root is not None]

    def damaged(self) -> list[str]:
        """Return the names of roots whose newest version is damaged: nobody knows which datasets they represent."""
        return sorted(name for name, root in self._read() if root is None)

    def get(self, path: Path) -> Root | None:
        """Return None: no path of this computer is a root there."""
        return None

    def pushed(self, name: str, project: str = "") -> Root | None:
        """Return what the project of this id pushed as ``name``, or None.

        Raises `DamagedError` where nobody knows any more what it was.
        """
        wanted = name_of(PUSHED, name, project)
        for one, root in self._read(wanted):
            if root is None:
                raise DamagedError(
                    f"The newest file in {self.files.place}/roots/{one} is damaged: it was read twice, with the same bytes. "
                    f"Delete it, and the one before it counts."
                )
            return root
        return None

    def push(
        self,
        name: str,
        project: Mapping[str, str],
        manifest: str,
        before: Root | None,
        *,
        lasting: bool,
        output: bool = False,
    ) -> bool:
        """Note that a project pushed ``manifest`` as its dataset ``name``, after ``before``, as `pushed` gave it.

        What was pushed stays in the history until it is forgotten. The ``output`` of a command is no such snapshot: the next
        output takes its place, unless it is ``lasting``. Returns False where another push came first, and nothing was noted.
        """
        kept = before is not None and not before.get(_OUTPUT)  # as a snapshot
        same = before is not None and before["manifest"] == manifest and before.get("project") == project
        if same and (output or kept):
            return True
        root = {"path": name, "kind": PUSHED, "project": dict(project)}
        number = before.get(_NUMBER, 0) if before is not None and _name(before) == _name(root) else 0
        succeeded = succeeding(before, manifest, lasting=lasting)
        if before is not None and not kept and not lasting:
            succeeded["history"] = [one for one in succeeded["history"] if one["manifest"] != before["manifest"]]
        stated = {_OUTPUT: True} if output else {}
        return self._succeed({**root, **succeeded, **stated, _NUMBER: number})

    def write(self, root: Root) -> None:
        """Have ``root`` succeed its last version, as `all` gave it. Raises `TacpipeError` where another one came first."""
        if not self._succeed(root):
            raise TacpipeError(
                f"{root['path']} was pushed to {self.files.place} meanwhile. Run the same command again."
            )

    def remove(self, root: Root) -> None:
        """Remove a root, as `all` gave it, with all its earlier versions; one that was succeeded meanwhile stays."""
        name = _name(root)
        if dict(self._read(name)).get(name) == root:
            for _, file in self._versions().get(name, []):
                self.files.delete(file)

    def superseded(self) -> list[str]:
        """Return the names of versions that no push can take for the newest any more: all but the last two of each."""
        return [file for versions in self._versions().values() for _, file in versions[:-2]]

    def _succeed(self, root: Root) -> bool:
        name = _name(root)
        number = root[_NUMBER] + 1
        if not self.files.create(_version(name, number), encoded({key: root[key] for key in root if key != _NUMBER})):
            return False
        if number > 2:  # the version before stays, so that whoever read that one is refused this number
            self.files.delete(_version(name, number - 2))
        return True

    def _read(self, wanted: str = "") -> Iterator[tuple[str, Root | None]]:
        """Yield the name of each root, or of the one that is ``wanted``, and its newest version; None for a damaged one."""
        newest = {name: found[-1] for name, found in self._versions(wanted).items()}
        return zip(newest, threads.map_in_threads(self._at, newest.values(), AT_ONCE), strict=True)

    def _at(self, version: tuple[int, str]) -> Root | None:
        number, file = version
        with contextlib.suppress(FileNotFoundError):
            root = read_twice(self.files, file, ROOT_BYTES, _parse)
            return None if root is None else {**root, _NUMBER: number}
        return None

    def _versions(self, wanted: str = "") -> dict[str, list[tuple[int, str]]]:
        """Return number and file of the versions of each root, the newest last; a root of a folder that was copied is 0."""
        found: dict[str, list[tuple[int, str]]] = {}
        entries = list(self.files.list(f"roots/{wanted}" if wanted else "roots"))
        copied = self.files.stat(f"roots/{wanted}.json") if wanted and not entries else None
        for entry in [*entries, *([copied] if copied else [])]:
            match = _VERSION.fullmatch(entry.name)
            if match is not None:
                found.setdefault(match[1], []).append((int(match[2] or 0), entry.name))
        return {name: sorted(found[name]) for name in sorted(found)}


def _parse(content: bytes) -> Root | None:
    with contextlib.suppress(ValueError, RecursionError):
        return decoded(json.loads(content))
    return None


def _name(root: Mapping[str, Any]) -> str:
    return name_of(root["kind"], str(root["path"]), project_id(root))


def _version(name: str, number: int) -> str:
    return f"roots/{name}/{number:08d}.json"
