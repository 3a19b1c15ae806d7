"""Which recordings a tree of arrays holds: a group each, rows of arrays that hold all of them, or one."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.errors import TacpipeError
from tacpipe.formats.arrays.tree import Array, Tree
from tacpipe.io import memory
from tacpipe.printable import plain

NUMBERED = re.compile(
    r"(demo|episode|ep|traj|trajectory|trial|run|recording|rollout|seq|sequence)s?[_-]?\d+", re.IGNORECASE
)
ENDS = ("meta/episode_ends", "episode_ends")  # arrays with the row behind the last of each recording
NAMES, LABELS = "recordings", "labels"  # attributes of their group: the name of each, and its labels by name


@dataclass(frozen=True)
class Episode:
    """One recording within a tree: its group, or its rows where arrays hold those of several."""

    name: str | None  # None: the tree is one recording
    group: str = ""
    start: int = 0
    stop: int | None = None  # None: to the end of each array
    number: int = 0  # among those that share arrays, of which there are ``count``
    count: int = 0
    total: int = 0  # rows of all of them
    beside: str | None = None  # the group of the array that states where they end
    labels: Mapping[str, Any] = field(default_factory=dict)
    stated: bool = False  # whether its name is one that the file states

    def inside(self, path: str) -> str:
        """Return the path of a group or an array within the recording's group."""
        return path[len(self.group) :].strip("/")


def found(tree: Tree) -> list[Episode]:
    """Return the recordings of a tree, in order: by number where names have one. Raises `TacpipeError`."""
    cut = _cut(tree)
    if cut:
        return cut
    groups: list[str] = []
    for group in tree.members("")[1]:  # the groups of recordings lie here, or one level below
        groups += [group] if _is_numbered(group) else filter(_is_numbered, tree.members(group)[1])
    names = Counter(group.rpartition("/")[2] for group in groups)
    return [Episode(_name(group, names), group) for group in sorted(groups, key=_order)] or [Episode(None)]


def _is_numbered(group: str) -> bool:
    return NUMBERED.fullmatch(group.rpartition("/")[2]) is not None


def _name(group: str, names: Mapping[str, int]) -> str:
    """Return the name of a recording's group, with the group above where two have the same last part."""
    last = group.rpartition("/")[2]
    return last if names[last] == 1 else group


def named(tree: Tree, name: str | None) -> Episode:
    """Return the recording of this name, without a look at the others. Raises `TacpipeError` where there is none."""
    if name is None:
        (*several, one) = found(tree)
        if several or one.name is not None:
            raise TacpipeError(f"{tree.path} holds {len(several) + 1} recordings. Name one of them.")
        return one
    cut = _cut(tree)
    for one in cut:
        if one.name == name:
            return one
    for group in ["", *(tree.members("")[1] if "/" not in name else ())] if not cut else ():
        path = f"{group}/{name}" if group else name
        if tree.is_group(path):
            return Episode(name, path)
    raise TacpipeError(f"{tree.path} holds no recording {plain(name)}.")


def _cut(tree: Tree) -> list[Episode]:
    """Return the recordings that an array cuts all others into; none where there is no such array."""
    for path in ENDS:
        group = path.rpartition("/")[0]
        array = (
            next((one for one in tree.members(group)[0] if one.path == path), None) if tree.is_group(group) else None
        )
        if array is not None:
            ends = [int(end) for end in _checked(tree, array)]
            about = tree.attributes(group)
            names, stated = about.get(NAMES), True
            if not isinstance(names, list) or len({str(one) for one in names}) != len(ends):
                names = [f"episode_{number:06d}" for number in range(len(ends))]  # as LeRobot counts them
                stated = False
            labels = about.get(LABELS)
            return [
                Episode(str(name), "", start, stop, number, len(ends), ends[-1], group, _of(labels, str(name)), stated)
                for number, (name, start, stop) in enumerate(zip(names, [0, *ends], ends, strict=False))
            ]
    return []


def _of(labels: Any, name: str) -> Mapping[str, Any]:
    own = labels.get(name) if isinstance(labels, dict) else None
    return own if isinstance(own, dict) else {}


def _checked(tree: Tree, array: Array) -> AnyArray:
    if array.problem:
        raise TacpipeError(f"{tree.path}: {array.path} {array.problem}.")
    if len(array.shape) != 1 or array.dtype.kind not in "iu":
        raise TacpipeError(
            f"{tree.path}: {array.path} must be whole numbers, one a recording; it has the shape {array.shape}."
        )
    memory.require_block(array.row_bytes * array.shape[0], f"{tree.path}: {array.path}")
    ends = np.asarray(tree.read(array, 0, array.shape[0]))
    steps = np.diff(ends.astype(np.int64), prepend=0)
    if (steps < 1).any():
        row = int((steps < 1).argmax())
        raise TacpipeError(
            f"{tree.path}: {array.path} must rise from one recording to the next; row {row + 1} holds {ends[row]}"
            f"{f', the one before {ends[row - 1]}' if row else ''}."
        )
    return ends


def _order(path: str) -> list[int | str]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path)]
