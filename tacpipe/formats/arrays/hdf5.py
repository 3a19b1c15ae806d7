"""HDF5 files as trees of arrays.

Nothing is read that lies in another file: external links, external storage and virtual datasets are left out and named,
as their content would be no part of a recording's key.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.errors import TacpipeError
from tacpipe.formats.arrays.tree import Array
from tacpipe.io import memory, regular
from tacpipe.printable import excerpt, plain

BROKEN = (
    OSError,
    KeyError,
    RuntimeError,
    ValueError,
    TypeError,
)  # what h5py raises for bytes that are not as they should
_TRUNCATED = re.compile(r"truncated file: eof = (\d+),.*stored_eof = (\d+)")


class Hdf5Tree:
    """An opened HDF5 file."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path, self._file = path, file

    def members(self, group: str) -> tuple[list[Array], list[str]]:
        """Return the arrays in a group and the paths of the groups in it; a group within itself is left out."""
        arrays, below = [], []
        with _reading(self.path, group or "its root"):
            found = self._file[group or "/"]
            above = self._addresses(group)
            for name in found:
                one = _member(found, name, f"{group}/{name}" if group else name)
                if isinstance(one, Array):
                    arrays.append(one)
                elif one and _address(found[name]) not in above:
                    below.append(one)
        return arrays, below

    def is_group(self, path: str) -> bool:
        """Return whether there is a group of this path."""
        with _reading(self.path, path or "its root"):
            kind = self._file.get(path, getclass=True) if path else h5py.Group
            return kind is not None and issubclass(kind, h5py.Group)

    def attributes(self, group: str) -> Mapping[str, Any]:
        """Return the attributes of a group, but those that cannot be read."""
        with _reading(self.path, group or "its root"):
            return _attributes(self._file[group or "/"])

    def read(self, array: Array, start: int, stop: int) -> AnyArray:
        """Return the rows of an array; text as ``str`` objects. Raises `TacpipeError` where they are damaged."""
        memory.require(array.row_bytes * max(stop - start, 0), f"{self.path}, {plain(array.path, 200)},")
        with _reading(self.path, array.path):
            found = self._file[array.path]
            text = h5py.check_string_dtype(found.dtype) is not None
            given = (found.asstr(errors="replace") if text else found)[() if not array.shape else slice(start, stop)]
            return np.asarray(given)

    def files(self, array: Array, start: int, stop: int) -> None:
        """Return None: all arrays lie in one file."""

    def stated(self, array: Array) -> None:
        """Return nothing, as the file states it."""

    def _addresses(self, group: str) -> set[Any]:
        """Return where a group and those above it lie in the file."""
        parts = group.split("/") if group else []
        return {_address(self._file["/".join(parts[:count]) or "/"]) for count in range(len(parts) + 1)}


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Hdf5Tree]:
    """Open an HDF5 file for reading. Raises `TacpipeError` for one that is cut short or not HDF5."""
    with regular.failing(path), regular.opened(path) as file:  # not a pipe, and what the system answers
        size = file.seek(0, 2)
    try:
        found = h5py.File(path, "r", locking=False)
    except BROKEN as error:
        cut = _TRUNCATED.search(str(error))
        if cut:
            raise TacpipeError(
                f"{path} is cut short: it has {int(cut[1]):,} bytes, and its header states {int(cut[2]):,}. Copy it again."
            ) from error
        if not size:
            raise TacpipeError(f"{path} is empty. Copy it again, or take it away.") from error
        if "already open for write" in str(error):
            raise TacpipeError(
                f"{path} was not closed by the program that wrote it, or is still being written. Close it there, or run "
                f"`h5clear -s {path}` on a copy."
            ) from error
        raise TacpipeError(f"{path} is not an HDF5 file: {plain(str(error), 200)}.") from error
    with found:
        yield Hdf5Tree(path, found)


@contextlib.contextmanager
def _reading(path: Path, what: str) -> Iterator[None]:
    """Raise what h5py raises in the block as a `TacpipeError` that names file and place."""
    try:
        yield
    except BROKEN as error:
        if isinstance(error, OSError) and error.errno is not None:
            with regular.failing(path):
                raise
        raise TacpipeError(
            f"{path}: {plain(what, 200)} cannot be read: {plain(str(error.args[0] if error.args else error), 200)}. Copy "
            f"the file again."
        ) from error


def _member(group: h5py.Group, name: str, path: str) -> Array | str:
    """Return an array, the path of a group, or an empty text for what is neither."""
    link = group.get(name, getlink=True)
    if isinstance(link, h5py.ExternalLink):
        return Array(
            path, (), np.dtype("V"), problem=f"lies in another file ({excerpt(link.filename)}), which is not read"
        )
    if isinstance(link, h5py.SoftLink) and name not in group:
        return Array(path, (), np.dtype("V"), problem="is a link to what is not there")
    found = group[name]
    if isinstance(found, h5py.Group):
        return path
    if not isinstance(found, h5py.Dataset):
        return ""
    problem = ""
    if found.is_virtual or found.external:
        problem = "has its values in another file, which is not read"
    elif found.shape is None:
        problem = "holds nothing"
    return Array(path, found.shape or (), found.dtype, _attributes(found), problem)


def _address(group: h5py.Group) -> Any:
    about = h5py.h5o.get_info(group.id)
    return about.fileno, about.addr


def _attributes(found: Any) -> dict[str, Any]:
    made = {}
    for name in found.attrs:
        with contextlib.suppress(*BROKEN):  # of types that numpy has not
            made[str(name)] = found.attrs[name]
    return made
