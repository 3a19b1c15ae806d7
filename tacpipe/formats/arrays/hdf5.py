"""HDF5 files as trees of arrays.

External links, external storage and virtual datasets are skipped with a note: the content of other files would not be
part of a recording's key. Truncated files are read up to the cut.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.errors import TacpipeError
from tacpipe.formats.arrays.tree import ArrayDescription, StoredAttributes, StoredValue, Tree, with_time_first
from tacpipe.io import memory, regular
from tacpipe.printable import excerpt, plain

# errors that h5py raises for damaged bytes
BROKEN = (OSError, KeyError, RuntimeError, ValueError, TypeError)
ATTRIBUTE_BYTES = 1 << 27  # memory limit for reading an attribute
MAX_COMPRESSION_RATIO = 10_000  # maximum number of bytes that one byte of the file may decompress to
FILTERS = {  # HDF5 numbers of the accepted filters; others may need third-party plug-ins
    *(1, 2, 3, 4, 5, 6),  # built into HDF5: deflate, shuffle, fletcher32, szip, nbit, scale-offset
    *(307, 32000, 32001, 32004, 32008, 32013, 32015, 32026),  # bzip2, lzf, blosc, lz4, bitshuffle, zfp, zstd, blosc2
}
_TRUNCATED = re.compile(r"truncated file: eof = (\d+),.*stored_eof = (\d+)")


class Hdf5Tree(Tree):
    """An open HDF5 file. ``bytes_left`` is the number of bytes present in a truncated file, None for a complete file."""

    def __init__(self, path: Path, file: h5py.File, bytes_left: int | None = None) -> None:
        self.path, self._file, self._available = path, file, bytes_left
        cut = f"{path} is cut short after {bytes_left or 0:,} bytes, and the rest is missing. Copy it again."
        self.notes = [] if bytes_left is None else [cut]
        self._members: dict[str, tuple[list[ArrayDescription], list[str]]] = {}  # members of each listed group
        self._attributes_by_group: dict[str, StoredAttributes] = {}  # attributes of groups

    def members(self, group: str) -> tuple[list[ArrayDescription], list[str]]:
        """Return the arrays in a group, and the paths of the groups in it."""
        if group in self._members:
            return self._members[group]
        arrays, subgroups = [], []
        with self._convert_read_errors(group or "its root"):
            parent = self._file[group or "/"]
            for name in self._names(parent):
                path = f"{group}/{name}" if group else name
                try:
                    member = _member(parent, name, path, self.path)
                except BROKEN:
                    if self._available is None:
                        raise
                    member = path  # a path beyond the cut is listed, and opening it raises an error
                if isinstance(member, ArrayDescription):
                    arrays.append(member)
                elif member:
                    subgroups.append(member)
        self._members[group] = with_time_first(arrays), subgroups
        return self._members[group]

    def is_group(self, path: str) -> bool:
        """Return whether a group has this path."""
        with self._convert_read_errors(path or "its root"):
            kind = self._file.get(path, getclass=True) if path else h5py.Group
            return kind is not None and issubclass(kind, h5py.Group)

    def attributes(self, group: str) -> StoredAttributes:
        """Return the readable attributes of a group."""
        with self._convert_read_errors(group or "its root"):
            if group not in self._attributes_by_group:
                self._attributes_by_group[group] = _read_attributes(self._file[group or "/"], self.path)
            return self._attributes_by_group[group]

    def read(self, array: ArrayDescription, start: int, stop: int) -> AnyArray:
        """Return the rows of an array, text as ``str`` objects. Raises `TacpipeError` if they are damaged."""
        memory.require(array.row_bytes * max(stop - start, 0), f"{self.path}, {plain(array.path, 200)},")
        limit_bytes = memory.MAX_BLOCK_BYTES + array.row_bytes * max(stop - start, 1) * 4
        subject = f"{self.path}, {plain(array.path, 200)},"
        with (
            memory.bounded(limit_bytes, subject) if array.dtype.hasobject else contextlib.nullcontext(),
            self._convert_read_errors(array.path),
        ):
            dataset = self._file[array.path]
            if self._available is not None:
                _expect_within_file(dataset, self._available)
            is_text = h5py.check_string_dtype(dataset.dtype) is not None
            rows = (*(slice(None),) * array.time_axis, slice(start, stop)) if array.shape else ()
            values = (dataset.asstr(errors="replace") if is_text else dataset)[rows]
            return np.moveaxis(np.asarray(values), array.time_axis, 0) if array.shape else np.asarray(values)

    @contextlib.contextmanager
    def _convert_read_errors(self, subject: str) -> Iterator[None]:
        """Convert errors of h5py in the block to a `TacpipeError` with the file and the path in it."""
        try:
            yield
        except BROKEN as error:
            if isinstance(error, OSError) and error.errno is not None:
                with regular.failing(self.path):
                    raise
            if self._available is not None:
                cut = f"{self.path} is cut short after {self._available:,} bytes"
                raise TacpipeError(f"{cut}, and {plain(subject, 200)} lies behind. Copy it again.") from error
            reason = plain(str(error.args[0] if error.args else error), 200)
            raise TacpipeError(
                f"{self.path}: {plain(subject, 200)} cannot be read: {reason}. Copy the file again."
            ) from error

    def _names(self, group: h5py.Group) -> list[str]:
        """Return the names in a group; for a truncated file, those that can be listed."""
        if self._available is None:
            return list(group)
        names: list[bytes] = []
        group_id = group.id  # keeps the group open while its links are listed
        with contextlib.suppress(*BROKEN):
            group_id.links.iterate(names.append)  # iteration continues while the callback returns None
        return [name.decode(errors="surrogateescape") for name in names]

    def identity(self, group: str) -> Any:
        """Return the group's address in the file, which all paths of the group share."""
        try:
            about = h5py.h5o.get_info(self._file[group or "/"].id)
        except BROKEN:
            return group  # the group is beyond the end of a truncated file
        return about.fileno, about.addr


@contextlib.contextmanager
def open_hdf5(path: Path) -> Iterator[Hdf5Tree]:
    """Open an HDF5 file, which may be truncated, for reading. Raises `TacpipeError` if it is not HDF5."""
    with (
        regular.failing(path),
        regular.opened(path) as file,
    ):  # raises an error if it is a pipe, or the system cannot read it
        size = file.seek(0, io.SEEK_END)
    try:
        file_h5 = h5py.File(path, "r", locking=False)
    except BROKEN as error:
        cut = _TRUNCATED.search(str(error))
        if cut:
            with _open_truncated(path, int(cut[1]), int(cut[2])) as tree:
                yield tree
            return
        if not size:
            raise TacpipeError(f"{path} is empty. Copy it again, or remove it.") from error
        if "already open for write" in str(error):
            raise TacpipeError(
                f"{path} was not closed by the program that wrote it, or is still being written. Close it there, or run "
                f"`h5clear -s {path}` on a copy."
            ) from error
        raise TacpipeError(f"{path} is not an HDF5 file: {plain(str(error), 200)}.") from error
    with file_h5:
        yield Hdf5Tree(path, file_h5)


@contextlib.contextmanager
def _open_truncated(path: Path, available: int, size: int) -> Iterator[Hdf5Tree]:
    """Open a file with ``available`` of ``size`` bytes. Raises `TacpipeError` if these are too few."""
    with regular.failing(path), regular.opened(path) as file:
        try:
            file_h5 = h5py.File(_PaddedFile(file, available, size), "r")
            with file_h5:
                tree = Hdf5Tree(path, file_h5, available)
                tree.members("")
                yield tree
        except BROKEN as error:
            if isinstance(error, OSError) and error.errno is not None:
                raise
            raise TacpipeError(
                f"{path} is cut short: it has {available:,} bytes, and its header states {size:,}. Copy it again."
            ) from error


class _PaddedFile(io.RawIOBase):
    """A truncated file, padded with zeros to its full size."""

    def __init__(self, file: io.BufferedReader, available: int, size: int) -> None:
        self._file, self._available, self._size, self._at = file, available, size, 0

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Read into ``buffer``; bytes beyond the end of the truncated file read as zeros. Return the number of bytes."""
        count = max(0, min(len(buffer), self._size - self._at))
        self._file.seek(min(self._at, self._available))
        content = self._file.read(count)
        buffer[: len(content)] = content
        buffer[len(content) : count] = bytes(count - len(content))
        self._at += count
        return count


def _expect_within_file(dataset: h5py.Dataset, available: int) -> None:
    """Raise `OSError` if bytes of an array are beyond the end of a truncated file, because they would read as zeros."""
    if dataset.chunks is None:
        offset = dataset.id.get_offset()
        ends = [offset + dataset.id.get_storage_size()] if offset is not None else []
    else:
        chunks = (dataset.id.get_chunk_info(number) for number in range(dataset.id.get_num_chunks()))
        ends = [chunk.byte_offset + chunk.size for chunk in chunks]
        if not ends and dataset.size:
            raise OSError("its chunks are not listed")
    if max(ends, default=0) > available:
        raise OSError("its values lie behind the end")


def _member(group: h5py.Group, name: str, path: str, file: Path) -> ArrayDescription | str:
    """Return the description of an array, the path of a group, or "" for any other member of ``group``.

    If an array cannot be read, ``problem`` of its description is the reason.
    """
    link = group.get(name, getlink=True)
    if isinstance(link, h5py.ExternalLink):
        return ArrayDescription(
            path, (), np.dtype("V"), problem=f"lies in another file ({excerpt(link.filename)}), which is not read"
        )
    if isinstance(link, h5py.SoftLink) and name not in group:
        return ArrayDescription(path, (), np.dtype("V"), problem="is a link to what is not there")
    member = group[name]
    if isinstance(member, h5py.Group):
        return path
    if not isinstance(member, h5py.Dataset):
        return ""
    problem = ""
    if member.is_virtual or member.external:
        problem = "has its values in another file, which is not read"
    elif member.shape is None:
        problem = "holds nothing"
    elif unknown := [number for number in _filters(member) if number not in FILTERS]:
        problem = f"is stored with the filter {unknown[0]}, which is not read"
    elif (
        member.chunks and (chunk_bytes := int(np.prod(member.chunks)) * member.dtype.itemsize) > memory.MAX_BLOCK_BYTES
    ):
        problem = f"has chunks of {memory.readable_size(chunk_bytes)}, which are not read"
    elif member.nbytes > max(memory.MAX_BLOCK_BYTES, MAX_COMPRESSION_RATIO * member.id.get_storage_size()):
        stored = memory.readable_size(member.id.get_storage_size())
        problem = f"declares {memory.readable_size(member.nbytes)} of values and holds {stored}"
    chunk_rows = member.chunks[0] if member.chunks else 0
    return ArrayDescription(path, member.shape or (), member.dtype, _read_attributes(member, file), chunk_rows, problem)


def _filters(dataset: h5py.Dataset) -> Iterator[int]:
    """Yield the numbers of the filters that the chunks of an array passed through."""
    about = dataset.id.get_create_plist()
    for index in range(about.get_nfilters()):
        yield about.get_filter(index)[0]


def _read_attributes(owner: Any, file: Path) -> StoredAttributes:
    """Return the attributes of a group or array; those that numpy cannot represent are left out."""
    attributes: dict[str, StoredValue] = {}
    for name in owner.attrs:
        subject = f"{file}, the attribute {plain(name)},"
        with contextlib.suppress(*BROKEN), memory.bounded(ATTRIBUTE_BYTES, subject):  # numpy lacks some types
            attributes[str(name)] = owner.attrs[name]
    return attributes
