"""Tell from the calls, without dying, what a kill or a loss of power leaves of a folder at each call.

A kill leaves what the calls so far have made. After a loss of power there is the content that was fsynced, and the
names in folders that were fsynced. Of what was written and not synced there may be all, a part, zeros or nothing; a
name that was made, moved or removed since its folder was synced may be as before, and in a folder the earlier of such
changes outlast the later ones. That is what POSIX promises; most disks keep more.
"""

from __future__ import annotations

import os
import random
from dataclasses import dataclass, field
from os import lstat  # Imported before a shim replaces it, like the next one.
from pathlib import Path

from tests.promises.operations_tree import File, State

_open = open
NAMES = frozenset(["create", "link", "symlink", "unlink", "replace", "rename", "mkdir", "rmdir"])
_WRITES = frozenset(["write", "sendfile", "copy_file_range", "truncate", "fallocate"])


@dataclass(eq=False)
class _Node:
    """A file, whatever its names: its content, and what of it is sure to outlast a loss of power."""

    content: bytes
    sure: bytes
    mode: int = 0o644
    torn: bytes | None = None  # The content after a write, with half of what that wrote.


@dataclass
class _Change:
    """A change of names: what it did, to which, and what the names stood for before."""

    operation: str
    path: str
    source: str
    before: dict[str, _Node | None]
    folders: tuple[str, ...] = ()  # made or removed

    @property
    def folder(self) -> str:
        return os.path.dirname(self.path)  # noqa: PTH120


@dataclass
class Disk:
    """A folder as a list of calls makes it: fed with each call after it was made."""

    root: str
    names: dict[str, _Node] = field(default_factory=dict)
    folders: set[str] = field(default_factory=set)
    unsynced: list[_Change] = field(default_factory=list)  # Changes of names since their folder was synced.

    @classmethod
    def from_state(cls, root: Path, state: State) -> Disk:
        """Return a disk that holds a state, all of it synced."""
        nodes = {file.node: _Node(file.content, file.content, file.mode) for file in state.files.values()}
        return cls(str(root), {path: nodes[file.node] for path, file in state.files.items()}, set(state.folders))

    def record_call(self, operation: str, path: str, source: str = "") -> None:
        """Take note of a call that was made, by absolute paths."""
        path, source = self._relative(path), self._relative(source) if source else ""
        if operation == "create" and path in self.names:
            self._read(path)  # it may have been cut
        elif operation in NAMES:
            self._rename(operation, path, source)
        elif operation in _WRITES:
            self._read(path)
        elif operation in ("fsync", "fdatasync"):
            if path in self.folders or not path:
                self.unsynced = [change for change in self.unsynced if change.folder != path]
            elif path in self.names:
                self.names[path].sure = self.names[path].content
        elif operation in ("chmod", "fchmod") and path in self.names:
            self.names[path].mode = lstat(f"{self.root}/{path}").st_mode & 0o777

    def killed(self) -> State:
        """Return what a kill leaves."""
        return self._state(self.names, self.folders, {})

    def torn(self, path: str) -> State | None:
        """Return what is left by a kill in the midst of the write that was noted last."""
        node = self.names.get(self._relative(path))
        return (
            None if node is None or node.torn is None else self._state(self.names, self.folders, {id(node): node.torn})
        )

    def lost(self, seed: int) -> State:
        """Return what a loss of power leaves: 0 the least, 1 all names and no content that is not sure, else by chance."""
        chance = random.Random(seed)
        names, folders = dict(self.names), set(self.folders)
        for change in reversed(self._undone(seed, chance)):
            if change.operation == "mkdir":
                folders -= set(change.folders)
            elif change.operation == "rmdir":
                folders |= set(change.folders)
            for path, node in change.before.items():
                if node is None:
                    names.pop(path, None)
                else:
                    names[path] = node
        names = {path: node for path, node in names.items() if _parents(path) <= folders}
        folders = {path for path in folders if _parents(path) <= folders}
        lost_contents = {
            id(node): _choose_content(node, seed, chance) for node in names.values() if node.content != node.sure
        }
        return self._state(names, folders, lost_contents)

    def _undone(self, seed: int, chance: random.Random) -> list[_Change]:
        staying: dict[str, int] = {}
        for folder in sorted({change.folder for change in self.unsynced}):
            number = sum(change.folder == folder for change in self.unsynced)
            staying[folder] = (0, number)[seed] if seed < 2 else chance.randint(0, number)
        undone = []
        for change in self.unsynced:
            staying[change.folder] -= 1
            if staying[change.folder] < 0:
                undone.append(change)
        return undone

    def _rename(self, operation: str, path: str, source: str) -> None:
        before = {name: self.names.get(name) for name in (path, source) if name}
        folders: tuple[str, ...] = ()
        if operation == "create":
            self.names[path] = _Node(b"", b"", lstat(f"{self.root}/{path}").st_mode & 0o777)
        elif operation == "link":
            self.names[path] = self.names[source]
            before.pop(source)
        elif operation == "unlink":
            del self.names[path]
        elif operation in ("replace", "rename"):
            self.names[path] = self.names.pop(source)
        elif operation == "mkdir":
            folders = (path,)
            self.folders.add(path)
        elif operation == "rmdir":
            folders = (path,)
            self.folders.discard(path)
        self.unsynced.append(_Change(operation, path, source, before, folders))

    def _read(self, path: str) -> None:
        node = self.names.get(path)
        if node is None:
            return  # it was unlinked, and nobody will see it
        with _open(f"{self.root}/{path}", "rb") as file:
            was, node.content = node.content, file.read()
        cut = len(was) if node.content.startswith(was) else 0
        node.torn = node.content[: cut + (len(node.content) - cut) // 2]

    def _relative(self, path: str) -> str:
        return path[len(self.root) + 1 :]

    @staticmethod
    def _state(names: dict[str, _Node], folders: set[str], contents: dict[int, bytes]) -> State:
        files = {path: File(id(node), contents.get(id(node), node.content), node.mode) for path, node in names.items()}
        return State(files, frozenset(folders))


def _choose_content(node: _Node, seed: int, chance: random.Random) -> bytes:
    """Return of a file's content what is sure, or a part of the rest, zeros behind it or nothing."""
    if seed < 2 or chance.random() < 0.3:
        return node.sure
    cut = chance.randint(0, len(node.content))
    return node.content[:cut] + (bytes(len(node.content) - cut) if chance.random() < 0.5 else b"")


def _parents(path: str) -> set[str]:
    return {str(parent) for parent in Path(path).parents if str(parent) != "."}
