"""Which recordings a tree of arrays holds: a group each, rows of arrays that hold all of them, or one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacpipe.errors import TacpipeError
from tacpipe.formats.arrays.tree import Array, Tree
from tacpipe.printable import plain

NUMBERED = re.compile(
    r"(demo|episode|ep|traj|trajectory|trial|run|recording|rollout|seq|sequence)s?[_-]?\d+", re.IGNORECASE
)
ENDS = ("meta/episode_ends", "episode_ends")  # arrays with the row behind the last of each recording
RECORDINGS = "recordings"  # attribute of a group whose groups are a recording each, whatever their names


@dataclass(frozen=True)
class Episode:
    """One recording within a tree: its group, and its rows where arrays hold those of several."""

    name: str | None  # None: the tree is one recording
    group: str = ""
    start: int = 0
    stop: int | None = None  # None: to the end of each array

    def inside(self, path: str) -> str:
        """Return the path of a group or an array within the recording's group."""
        return path[len(self.group) :].strip("/")


def found(tree: Tree) -> list[Episode]:
    """Return the recordings of a tree, in order: by number where names have one. Raises `TacpipeError`."""
    ends = _ends(tree)
    if ends is not None:
        return [Episode(_named(number), "", *_rows(ends, number)) for number in range(len(ends))]
    for group in _above(tree):
        below = tree.members(group)[1]
        names = [one.rpartition("/")[2] for one in below]
        marked = tree.attributes(group).get("kind") == RECORDINGS
        chosen = [one for one, name in zip(below, names, strict=True) if marked or NUMBERED.fullmatch(name)]
        if chosen:
            return [Episode(one.rpartition("/")[2], one) for one in sorted(chosen, key=_order)]
    return [Episode(None)]


def named(tree: Tree, name: str | None) -> Episode:
    """Return the recording of this name, without a look at the others. Raises `TacpipeError` where there is none."""
    if name is None:
        return Episode(None)
    ends = _ends(tree)
    if ends is not None:
        number = int(name.rpartition("_")[2]) if re.fullmatch(r"episode_\d+", name) else len(ends)
        if number < len(ends):
            return Episode(name, "", *_rows(ends, number))
    for group in _above(tree) if ends is None else ():
        path = f"{group}/{name}" if group else name
        if tree.is_group(path):
            return Episode(name, path)
    raise TacpipeError(f"{tree.path} holds no recording {plain(name)}.")


def _above(tree: Tree) -> list[str]:
    """Return the groups that the groups of recordings may lie in: the root, and those in it."""
    return ["", *tree.members("")[1]]


def _ends(tree: Tree) -> Sequence[int] | None:
    """Return the row behind the last of each recording, None where the tree does not state them."""
    for path in ENDS:
        group = path.rpartition("/")[0]
        if not tree.is_group(group):
            continue
        array = next((one for one in tree.members(group)[0] if one.path == path), None)
        if array is None:
            continue
        ends = _checked(tree, array)
        return [int(end) for end in ends]
    return None


def _checked(tree: Tree, array: Array) -> np.ndarray:
    if len(array.shape) != 1 or array.dtype.kind not in "iu":
        raise TacpipeError(
            f"{tree.path}: {array.path} must be whole numbers, one a recording; it has the shape {array.shape}."
        )
    ends = np.asarray(tree.read(array, 0, array.shape[0]))
    steps = np.diff(ends.astype(np.int64), prepend=0)
    if (steps < 1).any():
        row = int((steps < 1).argmax())
        raise TacpipeError(
            f"{tree.path}: {array.path} must rise from one recording to the next; row {row + 1} holds {ends[row]}"
            f"{f', the one before {ends[row - 1]}' if row else ''}."
        )
    return ends


def _rows(ends: Sequence[int], number: int) -> tuple[int, int]:
    return (ends[number - 1] if number else 0), ends[number]


def _named(number: int) -> str:
    return f"episode_{number:06d}"  # as LeRobot counts them; a recording that is added changes no other's name


def _order(path: str) -> list[int | str]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path)]
