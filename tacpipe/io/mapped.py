"""Keep arrays in temporary files that are mapped into memory, whose pages are released and read again when needed."""

from __future__ import annotations

import mmap
import os
import tempfile
from typing import TYPE_CHECKING, Any

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.io.files import sentence

if TYPE_CHECKING:
    import pyarrow as pa

SEGMENT_BYTES = 1 << 28  # size of a file; few are opened, since each takes a descriptor
MOST_READ = 1 << 26  # bytes read before their pages are released


class MappedArrays:
    """Arrays that take no memory for long. The first ``in_memory`` bytes of them are ordinary ones.

    Files lie where ``TMPDIR`` states, have no name, and are gone with the arrays.
    """

    def __init__(self, in_memory: int) -> None:
        self._in_memory = in_memory
        self._segments: list[mmap.mmap] = []
        self._used = 0  # bytes of the last one
        self._read = 0  # bytes since they were let go of

    def kept(self, values: AnyArray) -> AnyArray:
        """Return the same values. Raises `StorageError` as `empty` does."""
        if values.nbytes <= self._in_memory:
            self._in_memory -= values.nbytes
            return values
        mapped_copy = self.empty(values.shape, values.dtype)
        mapped_copy[...] = values
        self.release()
        return mapped_copy

    def put_aside(self, column: AnyArray | pa.Array) -> AnyArray | pa.Array:
        """Return a column of the same values; one of texts, or with nulls, stays in memory. Raises as `empty`."""
        if isinstance(column, np.ndarray):
            return self.kept(column)
        import pyarrow.types as kinds

        number = kinds.is_integer(column.type) or kinds.is_floating(column.type)
        return self.kept(column.to_numpy()) if number and not column.null_count else column

    @property
    def in_memory(self) -> bool:
        """Return whether no array lies in a file."""
        return not self._segments

    def empty(self, shape: tuple[int, ...], dtype: Any) -> AnyArray:
        """Return an array to be filled. Raises `StorageError` where the disk is full."""
        kind = np.dtype(dtype)
        size = int(np.prod(shape)) * kind.itemsize
        if size <= self._in_memory:
            self._in_memory -= size
            return np.empty(shape, kind)
        place = -(-self._used // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
        if not self._segments or place + size > len(self._segments[-1]):
            self._segments.append(_map_temporary_file(max(size, SEGMENT_BYTES)))
            place = 0
        self._used = place + size
        return np.frombuffer(self._segments[-1], kind, int(np.prod(shape)), place).reshape(shape)

    def read(self, size: int) -> None:
        """Note that about so many bytes were read; beyond `MOST_READ` they are let go of."""
        self._read += size
        if self._read > MOST_READ:
            self.release()

    def release(self) -> None:
        """Let go of what was read and written so far."""
        self._read = 0
        for segment in self._segments:
            segment.madvise(mmap.MADV_DONTNEED)


def _map_temporary_file(size: int) -> mmap.mmap:
    """Return a temporary file of this size, mapped; all of it has its place on the disk."""
    try:
        with tempfile.TemporaryFile() as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a hole that a full disk cannot fill kills its writer
            else:
                file.truncate(size)
            return mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise sentence(tempfile.gettempdir(), error) from error
