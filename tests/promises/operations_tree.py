"""Read the content of a folder as a value, compare such values, and restore them."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

PAST_NS = 1_500_000_000 * 10**9  # when everything was written at first, so that whatever is written since stands out
# This differs from run to run in names.
_CHANCE = re.compile(r"[0-9a-f]{32}(?![0-9a-f])|\d{19}|(?<=\.)[0-9a-f]{12}(?=\.draft)")
_Traits = tuple[int, int, int, int]  # inode, size, mode, time


@dataclass(frozen=True)
class File:
    """A file's content and mode; names that stand for the same file have the same ``node``."""

    node: int
    content: bytes
    mode: int = 0o644


@dataclass(frozen=True)
class State:
    """The files and folders below a folder, by path."""

    files: Mapping[str, File]
    folders: frozenset[str]

    def described(self, before: State) -> str:
        """Return a digest of how this differs from ``before``, apart from what differs between any two runs."""
        changes: list[list[str]] = [["folder", path] for path in self.folders ^ before.folders]
        for path in {*self.files, *before.files}:
            now, was = self.files.get(path), before.files.get(path)
            if now is None:
                changes.append(["gone", path])
            elif was is None or now.content != was.content:
                changes.append([_CHANCE.sub("?", path), sha256(_lasting(path, now.content)).hexdigest()])
        return sha256(json.dumps(sorted(changes)).encode()).hexdigest()


class Place:
    """A folder that is brought to one state after another; its first one is remembered."""

    def __init__(self, root: Path) -> None:
        self.root = root
        for path, traits in _scan(root).items():
            if traits is not None:
                os.utime(root / path, ns=(PAST_NS, PAST_NS))
        self._read_files: dict[str, tuple[_Traits, File]] = {}  # Each file as it was when it was read or written last.
        self.before = self.look()

    def look(self) -> State:
        """Return what lies there now; files that are as they were first are not read again."""
        files, folders = {}, set()
        for path, traits in _scan(self.root).items():
            if traits is None:
                folders.add(path)
                continue
            read_before = self._read_files.get(path)
            if read_before is None or read_before[0] != traits:
                file = File(traits[0], (self.root / path).read_bytes(), traits[2] & 0o777)
                if not hasattr(self, "before"):
                    self._read_files[path] = traits, file
            else:
                file = read_before[1]
            files[path] = file
        return State(files, frozenset(folders))

    def restore(self) -> None:
        """Bring back what was there first, hard links included."""
        now = _scan(self.root)
        for path in sorted(set(now) - set(self.before.files) - self.before.folders, reverse=True):
            self._remove(path)
        for path in sorted(self.before.folders):
            (self.root / path).mkdir(exist_ok=True)
        for paths in _paths_by_node(self.before).values():
            if any(now.get(path) != self._read_files[path][0] for path in paths):
                self._write(paths)

    def restore_state(self, state: State) -> None:
        """Bring the folder to a state."""
        self.restore()
        for path in sorted(set(self.before.files) - set(state.files)):
            self._remove(path)
        for path in sorted(self.before.folders - state.folders, reverse=True):
            self._remove(path)
        for path in sorted(state.folders):
            (self.root / path).mkdir(exist_ok=True)
        for paths in _paths_by_node(state).values():
            stays = [path for path in paths if self.before.files.get(path) == state.files[path]]
            for path in paths:
                if path not in stays:
                    self._remove(path)
            first = self.root / (stays or paths)[0]
            if not stays:
                first.write_bytes(state.files[paths[0]].content)
                first.chmod(state.files[paths[0]].mode)
                os.utime(first, ns=(PAST_NS, PAST_NS))  # long ago, as for whoever runs the command again
            for path in paths:
                if path not in stays and self.root / path != first:
                    os.link(first, self.root / path)

    def _remove(self, path: str) -> None:
        place = self.root / path
        if place.is_dir() and not place.is_symlink():
            shutil.rmtree(place)
        elif os.path.lexists(place):
            place.unlink()

    def _write(self, paths: list[str]) -> None:
        """Write a file of the first state anew, under all of its names."""
        first, *other_paths = [self.root / path for path in paths]
        for name in paths:
            self._remove(name)
        was = self.before.files[paths[0]]
        first.write_bytes(was.content)
        first.chmod(was.mode)
        os.utime(first, ns=(PAST_NS, PAST_NS))
        for path in other_paths:
            os.link(first, path)
        stat = os.lstat(first)
        for name in paths:
            traits = (stat.st_ino, stat.st_size, stat.st_mode, stat.st_mtime_ns)
            self._read_files[name] = traits, self.before.files[name]


def _paths_by_node(state: State) -> dict[int, list[str]]:
    """Return the paths of each file."""
    paths_by_node: dict[int, list[str]] = {}
    for path, file in state.files.items():
        paths_by_node.setdefault(file.node, []).append(path)
    return paths_by_node


def _scan(root: Path) -> dict[str, _Traits | None]:
    """Return what tells files apart, by path; None for folders."""
    traits_by_path: dict[str, _Traits | None] = {}
    start = len(str(root)) + 1
    folders = [str(root)]
    while folders:
        with os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    traits_by_path[entry.path[start:]] = None
                    folders.append(entry.path)
                else:
                    stat = entry.stat(follow_symlinks=False)
                    traits_by_path[entry.path[start:]] = (stat.st_ino, stat.st_size, stat.st_mode, stat.st_mtime_ns)
    return traits_by_path


def _lasting(path: str, content: bytes) -> bytes:
    """Return of a file's content what does not differ from run to run: times, processes, seconds do."""
    if path.endswith(".lock"):
        return b""
    if "/records/" in path or "/roots/" in path or "/tmp/" in path:
        return _without(content, "provenance", "written_s", "missing_since_s", "check")
    return content


def _without(content: bytes, *names: str) -> bytes:
    """Return JSON with the values of these names left out; that they are there still counts."""
    try:
        value: Any = json.loads(content)
        return json.dumps(
            {name: name not in names and member for name, member in value.items()}, sort_keys=True
        ).encode()
    except (ValueError, AttributeError):
        return content
