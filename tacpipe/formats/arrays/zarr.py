"""Zarr stores as trees of arrays: folders and zip files, formats 2 and 3.

Metadata are read as JSON, values by the library zarr. By the specification a missing chunk contains only fill values,
so zarr silently reads a lost file as zeros. Here a missing chunk is an error unless it was allowed.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import itertools
import json
import math
import multiprocessing
import os
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np

from tacpipe.arrays import AnyArray
from tacpipe.errors import TacpipeError
from tacpipe.formats.arrays.tree import ArrayDescription, StoredAttributes, Tree
from tacpipe.formats.faults import explaining
from tacpipe.io import files as file_system
from tacpipe.io import memory, regular
from tacpipe.printable import excerpt, listed, plain

MARKS = (".zgroup", ".zarray", "zarr.json")  # files that mark a folder as a group or an array
MAX_CHUNKS = 1 << 20  # maximum number of chunks per array
UNPACKED_BYTES = 1 << 27  # memory limit for reading chunks, in addition to their values
MAX_METADATA_BYTES = 1 << 26  # maximum size of a metadata file
BROKEN_ZIP = (zipfile.BadZipFile, zlib.error, EOFError, KeyError, ValueError, RuntimeError, NotImplementedError)
BROKEN = (  # errors that zarr and its codecs raise for damaged bytes
    *(*BROKEN_ZIP, OSError, LookupError, TypeError, AttributeError, ArithmeticError, AssertionError, ImportError),
    SystemError,  # raised by blosc
)
CODECS = {  # accepted codecs of numcodecs and zarr; unlike pickle, none runs stored code
    *("adler32", "astype", "bitround", "blosc", "bytes", "bz2", "crc32", "crc32c", "delta", "fixedscaleoffset"),
    *("fletcher32", "gzip", "jenkins_lookup3", "lz4", "lzma", "packbits", "quantize", "sharding_indexed", "shuffle"),
    *("transpose", "vlen-utf8", "zlib", "zstd"),
}
_filled: ContextVar[bool] = ContextVar("filled", default=False)  # whether missing chunks are read as fill values
_KINDS = re.compile(r"bool|u?int(8|16|32|64)|float(16|32|64)")


class ZarrMetadata(TypedDict, total=False):
    """The metadata of an array or a group, which may be damaged."""

    zarr_format: int
    shape: list[int]
    attributes: StoredAttributes  # format 3
    dtype: Any  # format 2: a name, or a list of fields
    chunks: list[int]
    compressor: Any
    filters: list[Any] | None
    dimension_separator: str
    data_type: str  # format 3
    codecs: list[Any]
    chunk_grid: Any
    chunk_key_encoding: Any


class ZarrNode(NamedTuple):
    """An array or a group."""

    metadata: ZarrMetadata
    attributes: StoredAttributes


@dataclass(frozen=True)
class ZarrTree(Tree):
    """A Zarr store. ``path`` is a folder or a zip file; ``names`` are the members of a zip file, None for a folder."""

    path: Path
    names: frozenset[str] | None
    _nodes: dict[str, ZarrNode | None] = field(default_factory=dict)  # metadata by path

    def members(self, group: str) -> tuple[list[ArrayDescription], list[str]]:
        """Return the arrays in a group and the paths of the groups in it, sorted."""
        arrays, below = [], []
        for name in self._below(group):
            path = f"{group}/{name}" if group else name
            node = self._node(path)
            if node is not None and "shape" in node.metadata:
                arrays.append(_parse_array(path, *node))
            elif node is not None:
                below.append(path)
        return arrays, below

    def is_group(self, path: str) -> bool:
        """Return whether a group has this path."""
        node = self._node(path)
        return node is not None and "shape" not in node.metadata

    def attributes(self, group: str) -> StoredAttributes:
        """Return the attributes of a group."""
        node = self._node(group)
        return node.attributes if node is not None else {}

    def read(self, array: ArrayDescription, start: int, stop: int) -> AnyArray:
        """Return the rows of an array. Raises `TacpipeError` for damaged and for missing chunks."""
        zarr = _library()
        end = min(stop, array.shape[0]) if array.shape else 1
        memory.require(array.row_bytes * max(end - start, 0), f"{self.path}, {plain(array.path, 200)},")
        chunks = self.chunks(array, start, end)
        lost = [name for name in chunks if not self._has(name)]
        for name in chunks if self.names is None else ():
            if name not in lost:
                path = regular.inside(self.path, name)
                with regular.failing(path):
                    regular.require(path, path.stat().st_mode)  # zarr would block on a named pipe
        if lost and not _filled.get():
            raise TacpipeError(
                f"{self.path} lacks {listed(lost, 2)}, which hold{'s' * (len(lost) == 1)} rows of {plain(array.path, 200)}. "
                f"Copy the store again; if the program that wrote it leaves out chunks of fill values alone, as zarr 3 "
                f"does, give --fill-missing-chunks."
            )
        subject = f"{self.path}: {plain(array.path, 200)}, rows {start + 1} to {end}, cannot be read: "
        with (
            explaining(BROKEN, subject, ". Copy the store again.", path=self.path),
            contextlib.ExitStack() as stack,
            self._store() as store,
        ):
            zarr_array = zarr.open_array(store, path=array.path, mode="r")
            chunk_bytes = math.prod(zarr_array.chunks) * max(array.dtype.itemsize, 1)
            limit_bytes = UNPACKED_BYTES + array.row_bytes * max(end - start, 1) + 4 * chunk_bytes
            stack.enter_context(memory.bounded(limit_bytes, f"{self.path}, {plain(array.path, 200)},"))
            return np.asarray(zarr_array[() if not array.shape else slice(start, end)])

    def chunks(self, array: ArrayDescription, start: int, stop: int) -> list[str]:
        """Return the names of the files in the store that contain rows of an array.

        Raises `TacpipeError` if there are too many.
        """
        node = self._node(array.path)
        assert node is not None
        shape, key = _chunk_grid(node[0])
        if math.prod(array.shape) == 0 or stop <= start:
            return []
        spans = [range(math.ceil(size / step)) for size, step in zip(array.shape, shape, strict=True)]
        if spans:
            spans[0] = range(start // shape[0], math.ceil(stop / shape[0]))
        if (count := math.prod(map(len, spans))) > MAX_CHUNKS:
            raise TacpipeError(
                f"{self.path}: {plain(array.path, 200)} declares {count:,} chunks, and {MAX_CHUNKS:,} are read at most. "
                f"Write larger chunks; if its source is untrusted, do not use it."
            )
        return [f"{array.path}/{key(at)}" for at in itertools.product(*spans)]

    def files(self, array: ArrayDescription, start: int, stop: int) -> Mapping[str, Path] | None:
        """Return the files that contain rows of an array, or None for a zip file."""
        if self.names is not None:
            return None
        return {name: self.path / name for name in self.chunks(array, start, stop) if self._has(name)}

    def encoding_metadata(self, array: ArrayDescription) -> Any:
        """Return the metadata of an array except its shape, which grows with each added recording."""
        node = self._node(array.path)
        return {key: value for key, value in node[0].items() if key != "shape"} if node is not None else None

    def _has(self, name: str) -> bool:
        if self.names is not None:
            return name in self.names
        with regular.failing(self.path):
            return file_system.present(self.path / name)

    def _below(self, group: str) -> list[str]:
        """Return the names of the folders in a group."""
        if self.names is None:
            with regular.failing(self.path), os.scandir(self.path / group) as entries:
                return sorted(entry.name for entry in entries if entry.is_dir(follow_symlinks=False))
        start = f"{group}/" if group else ""
        return sorted(
            {
                name[len(start) :].partition("/")[0]
                for name in self.names
                if name.startswith(start) and "/" in name[len(start) :]
            }
        )

    def _node(self, path: str) -> ZarrNode | None:
        """Return metadata and attributes of a group or an array, or None if there is neither."""
        if path not in self._nodes:
            self._nodes[path] = self._read_node(path)
        return self._nodes[path]

    def _read_node(self, path: str) -> ZarrNode | None:
        """Return the metadata and attributes of an array or group, or None if the path is neither."""
        for mark in MARKS:
            name = f"{path}/{mark}" if path else mark
            if self._has(name):
                about = self._read_json(name)
                if mark == MARKS[-1]:
                    attributes = about.get("attributes", {})
                else:
                    attributes_name = f"{path}/.zattrs" if path else ".zattrs"
                    attributes = self._read_json(attributes_name) if self._has(attributes_name) else {}
                return ZarrNode(about, attributes if isinstance(attributes, dict) else {})
        return None

    def _read_json(self, name: str) -> Any:
        """Return the JSON object in a file of the store. Raises `TacpipeError` if it is none."""
        with explaining((*BROKEN_ZIP, RecursionError), f"{self.path}: {plain(name, 200)} cannot be read: "):
            content = json.loads(self._read_metadata(name))
        if not isinstance(content, dict):
            raise TacpipeError(f"{self.path}: {plain(name, 200)} holds {excerpt(content)}; it must be a JSON object.")
        return content

    def _read_metadata(self, name: str) -> bytes:
        """Return the content of a metadata file. Raises `TacpipeError` if it is too large."""
        if self.names is None:
            path = regular.inside(self.path, name)
            with regular.failing(path):
                return regular.content(path, MAX_METADATA_BYTES)
        with _archive(self.path) as archive:
            if archive.getinfo(name).file_size > MAX_METADATA_BYTES:
                raise TacpipeError(f"{self.path}: {plain(name, 200)} has more than {MAX_METADATA_BYTES:,} bytes.")
            return archive.read(name)

    @contextlib.contextmanager
    def _store(self) -> Iterator[Any]:
        """Open the store with the library zarr in the block."""
        storage = _library().storage
        if self.names is None:
            yield storage.LocalStore(self.path, read_only=True)
            return
        store = storage.ZipStore(self.path, mode="r")
        try:
            yield store
        finally:
            store.close()


@contextlib.contextmanager
def allow_missing_chunks(*, filled: bool) -> Iterator[None]:
    """Read missing chunks as fill values within the ``with`` block if ``filled``, otherwise raise an error for them."""
    before = _filled.set(filled)
    try:
        yield
    finally:
        _filled.reset(before)


@contextlib.contextmanager
def open_zarr(path: Path) -> Iterator[ZarrTree]:
    """Open a Zarr store, folder or zip file. Raises `TacpipeError` if it is neither."""
    names = None
    if not path.is_dir():
        advice = ". Its table of contents lies at its end: copy the file again."
        with explaining(BROKEN_ZIP, f"{path} is not a whole zip file: ", advice), _archive(path) as archive:
            names = frozenset(archive.namelist())
    tree = ZarrTree(path, names)
    if not tree.is_group(""):
        raise TacpipeError(f"{path} is not a Zarr group: it has no .zgroup or zarr.json of one at its top.")
    yield tree


@functools.cache
def _library() -> Any:
    """Return the library zarr, with its lock created for forked processes.

    The lock of its codecs would otherwise have a name in the system. Workers end without cleanup, so the name would
    remain and Python would warn about it.
    """
    import zarr
    import zarr.storage
    from numcodecs import blosc

    zarr.config.set(
        {"threading.max_workers": 1}
    )  # each command already uses one process per core, and reads keep their order
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method("fork", force=True)
    try:
        blosc.get_mutex()
    finally:
        multiprocessing.set_start_method(before, force=True)
    return zarr


@contextlib.contextmanager
def _archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a zip file in the block. Raises `zipfile.BadZipFile` if it is damaged."""
    with regular.failing(path):
        file = regular.opened(path)
    with file:
        try:
            with zipfile.ZipFile(file) as archive:
                yield archive
        except OSError as error:
            if error.errno != errno.EINVAL:  # EINVAL: a damaged table has an offset before the start of the file
                with regular.failing(path):
                    raise
            raise zipfile.BadZipFile("its table of contents leads out of the file") from error


def _parse_array(path: str, metadata: ZarrMetadata, attributes: StoredAttributes) -> ArrayDescription:
    """Return the description of an array from its metadata. If the array cannot be read, ``problem`` is the reason."""
    problem = ""
    shape = metadata.get("shape")
    if not isinstance(shape, list) or not all(isinstance(size, int) and size >= 0 for size in shape):
        return ArrayDescription(path, (), np.dtype("V"), problem=f"has the shape {excerpt(shape)}, which is none")
    try:
        dtype = _parse_dtype(metadata)
    except (TypeError, ValueError, LookupError, AttributeError):
        dtype, problem = np.dtype("V"), f"has the type {excerpt(metadata.get('dtype', metadata.get('data_type')))}"
    try:
        steps, _ = _chunk_grid(metadata)
    except (TypeError, ValueError, LookupError, AttributeError):
        steps = []
    if len(steps) != len(shape) or not all(isinstance(step, int) and step > 0 for step in steps):
        problem, steps = "has chunks of no known shape", []
    try:
        codecs = {str(codec) for codec in _codec_names(metadata)}
    except (TypeError, AttributeError):
        codecs = {"unnamed"}
    if math.prod(steps) * dtype.itemsize > memory.MAX_BLOCK_BYTES and "sharding_indexed" not in codecs:
        problem = f"has chunks of {memory.readable_size(math.prod(steps) * dtype.itemsize)}"
    if unknown := sorted(codecs - CODECS):
        problem = f"is stored with the codec {excerpt(unknown[0])}"
    elif dtype.hasobject and dtype.metadata is None:
        problem = "holds Python objects"
    reason = f"{problem}, which is not read" if problem else ""
    return ArrayDescription(path, tuple(shape), dtype, attributes, steps[0] if steps else 0, reason)


def _parse_dtype(metadata: ZarrMetadata) -> np.dtype[Any]:
    """Return the numpy type of an array. Raises `TypeError` or another error of lookup if there is none."""
    if metadata.get("zarr_format") == 3:
        type_name = metadata["data_type"]
        if type_name in ("string", "variable_length_utf8"):
            return np.dtype("O", metadata={"vlen": str})
        if not _KINDS.fullmatch(type_name):
            raise TypeError(type_name)
        return np.dtype(str(type_name))
    kind: Any = metadata["dtype"]
    if kind == "|O":
        filter_names = [entry.get("id") for entry in metadata.get("filters") or ()]
        return np.dtype("O", metadata={"vlen": str} if "vlen-utf8" in filter_names else {})
    return np.dtype([tuple(entry) for entry in kind] if isinstance(kind, list) else kind)


def _codec_names(metadata: ZarrMetadata) -> Iterator[Any]:
    """Yield the codec names of an array, without the prefix of codecs from numcodecs."""
    if metadata.get("zarr_format") != 3:
        yield from (
            _entry(codec, "id") for codec in (metadata.get("compressor"), *(metadata.get("filters") or ())) if codec
        )
        return
    pending = list(metadata.get("codecs") or ())
    while pending:
        codec = pending.pop()
        name = _entry(codec, "name")
        yield str(name).removeprefix("numcodecs.")
        inner = codec.get("configuration") if isinstance(codec, dict) else None
        for key in ("codecs", "index_codecs"):
            pending += (inner.get(key) or ()) if isinstance(inner, dict) else ()


def _entry(codec: Any, key: str) -> Any:
    return codec.get(key) if isinstance(codec, dict) else codec


def _chunk_grid(metadata: ZarrMetadata) -> tuple[Sequence[int], Any]:
    """Return the shape of a chunk, and a function from its position in the grid to its name in the array."""
    if metadata.get("zarr_format") == 3:
        encoding: Any = metadata.get("chunk_key_encoding", {"name": "default"})
        separator = encoding.get("configuration", {}).get("separator", "/" if encoding["name"] == "default" else ".")
        prefix = ["c"] if encoding["name"] == "default" else []
        shape = metadata["chunk_grid"]["configuration"]["chunk_shape"]
        return list(shape), lambda at: separator.join([*prefix, *map(str, at)]) or "0"
    separator = metadata.get("dimension_separator") or "."
    return list(metadata["chunks"]), lambda at: separator.join(map(str, at)) or "0"
