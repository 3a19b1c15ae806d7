"""Read tables that are not text: Parquet, numpy arrays (NPY, NPZ) and JSON Lines, in blocks of columns."""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.json as pj
import pyarrow.parquet as pq

from tacpipe.errors import TacpipeError
from tacpipe.formats import container
from tacpipe.formats.container import Batched, SourceStream, Time
from tacpipe.formats.faults import explaining
from tacpipe.formats.table import text
from tacpipe.formats.table.columns import RowFile
from tacpipe.formats.table.layout import GZIP
from tacpipe.io import memory, regular
from tacpipe.io.parquet import BROKEN, owned, require_claims
from tacpipe.plugins import failures
from tacpipe.printable import listed, plain
from tacpipe.video.images import PICTURE, array_format, raw_images
from tacpipe.video.stream import VideoFormat

BATCH_ROWS = 1 << 18  # maximum number of rows in a batch of a Parquet file
BLOCK_BYTES = 1 << 24  # size of a block of JSON lines or arrays
READ_BYTES = 1 << 20  # bytes read at once per Parquet column, whatever the size of row groups
MAX_COLUMNS = 1 << 20  # maximum number of columns per array
MAX_PIXELS = 1 << 28  # maximum number of values per decoded image
STREAM_COLUMNS = 4096  # maximum number of values per row of an array that is guessed to be channels
MAX_LINE_BYTES = 1 << 26  # maximum size of a JSON object
_ZIP_ERRORS = (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error, KeyError, RuntimeError)


@dataclass(frozen=True)
class ParquetFile(RowFile):
    """A Parquet file from any source; reading a nested column raises an error."""

    path: Path

    def names(self) -> list[str]:
        """Return the names of the columns. Raises `TacpipeError` if the file is not Parquet."""
        with explaining(BROKEN, f"{self.path} is not a Parquet file: "), regular.opened(self.path) as file:
            return list(pq.ParquetFile(file).schema_arrow.names)

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield the columns in ``types`` in blocks of rows, with the types of the file.

        Raises `TacpipeError` if it is damaged.
        """
        rows = min(BATCH_ROWS, BLOCK_BYTES // max(1, len(types)))
        with failures.naming_source([self.path]):
            require_claims(self.path, list(types), rows=rows)
            with regular.opened(self.path) as file:
                opened = pq.ParquetFile(file, buffer_size=READ_BYTES, pre_buffer=False, page_checksum_verification=True)
                for batch in opened.iter_batches(rows, columns=list(types)):
                    yield _refuse_nested(self.path, pa.Table.from_batches([batch]))


@dataclass(frozen=True)
class NumpyArchive(RowFile):
    """An NPZ archive: arrays (time,) are columns; an array (time, n, …) is n columns NAME_0, NAME_1, …."""

    path: Path
    time_axis: int = 0  # axis of the rows in each array

    def names(self) -> list[str]:
        """Return the names of the columns."""
        return list(self._column_sources)

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield the columns in ``types`` in blocks of rows."""
        array_names = {self._column_sources[name][0] for name in types}
        arrays = {name: array for name, array in self._arrays.items() if name in array_names}
        rows = max(1, BLOCK_BYTES // max(1, sum(array.row_bytes for array in arrays.values())))
        self._expect_same_length(arrays)
        for blocks in self._blocks(arrays, rows):
            yield pa.table({name: _column(blocks, *self._column_sources[name]) for name in types})

    @functools.cached_property
    def _column_sources(self) -> dict[str, tuple[str, int | None]]:
        """The array of each column, and the column's position in a row of it; None for an array with one value per row."""
        sources: list[tuple[str, tuple[str, int | None]]] = []
        for name, array in self._arrays.items():
            if array.width is None:
                sources.append((name, (name, None)))
            else:
                sources += [(f"{name}_{position}", (name, position)) for position in range(array.width)]
        return container.parts_by_name(sources, self.path, "column")

    def arrays(self) -> Mapping[str, ArrayMember]:
        """Return the arrays with rows by name."""
        return self._arrays

    def frames(self, array: str, clock: str) -> SourceStream:
        """Return a stream of the images in ``array`` as raw pixels, with the timestamps in the array ``clock``, if any.

        Raises `TacpipeError` if the file lacks an array, or ``array`` does not contain images.
        """
        names = [array, *([clock] if clock else [])]
        missing = [name for name in names if name not in self._arrays]
        if missing:
            raise TacpipeError(
                f"{self.path} has no array {plain(missing[0])}; it has {listed(self._arrays, 6)}. Correct the layout."
            )
        arrays = {name: self._arrays[name] for name in names}
        images = arrays[array]
        video_format = images.video_format
        if video_format is None:
            shape = " x ".join(map(str, images.shape))
            raise TacpipeError(
                f"{self.path}: {plain(array)} has the shape {shape} and the type {images.dtype}. Images must be uint8 "
                f"(frame, row, column, rgb), or uint8 or uint16 (frame, row, column)."
            )
        self._expect_same_length(arrays)
        clocks = [] if not clock else [pa.field(clock, pa.from_numpy_dtype(arrays[clock].dtype.newbyteorder("=")))]
        schema = pa.schema([*clocks, pa.field(PICTURE, pa.binary(), metadata=video_format.to_metadata())])
        rows = max(1, BLOCK_BYTES // max(1, images.row_bytes))

        def read() -> Iterator[pa.Table]:
            for blocks in self._blocks(arrays, rows):
                pixels = raw_images(blocks[array].reshape(-1, *images.row_shape))
                stamps = [_column(blocks, clock, None)] if clock else []
                yield pa.table([*stamps, pa.array(pixels, pa.binary())], schema)

        return SourceStream(array, array, Time(column=clock), Batched(schema, images.rows, read), images.rows)

    @functools.cached_property
    def _arrays(self) -> dict[str, ArrayMember]:
        """The arrays of the file by name. Raises `TacpipeError` if two have the same name."""
        with self._convert_errors(), self._archive() as archive:
            members = [
                ArrayMember.from_archive(archive, info, self.time_axis)
                for info in archive.infolist()
                if info.filename.endswith(".npy")
            ]
        return container.parts_by_name(((array.name, array) for array in members if array.shape), self.path, "array")

    def _blocks(self, arrays: Mapping[str, ArrayMember], rows: int) -> Iterator[dict[str, np.ndarray]]:
        """Yield up to ``rows`` rows of arrays of one length at a time; an empty block if there is no row."""
        with contextlib.ExitStack() as stack, self._convert_errors():
            archive = stack.enter_context(self._archive())
            readers = {name: stack.enter_context(array.reading(archive)) for name, array in arrays.items()}
            count = next((array.rows for array in arrays.values()), 0)
            for start in range(0, count, rows) if count else (0,):
                yield {name: read(min(rows, count - start)) for name, read in readers.items()}

    @contextlib.contextmanager
    def _archive(self) -> Iterator[Archive]:
        with regular.opened(self.path) as file, zipfile.ZipFile(file) as archive:
            yield archive

    def _expect_same_length(self, arrays: Mapping[str, ArrayMember]) -> None:
        """Raise `TacpipeError` if arrays of one stream have different numbers of rows."""
        lengths = {name: array.rows for name, array in arrays.items()}
        if len(set(lengths.values())) > 1:
            first = next(iter(lengths))
            second = next(name for name in lengths if lengths[name] != lengths[first])
            raise TacpipeError(
                f"{self.path}: {plain(first)} has {lengths[first]} rows and {plain(second)} has {lengths[second]}; arrays "
                f"of one stream have one length. Skip those of another rate, and read them as a stream of their own."
            )

    def _convert_errors(self) -> contextlib.AbstractContextManager[None]:
        return explaining(_ZIP_ERRORS, f"{self.path} is not an archive of arrays: ")


class NumpyFile(NumpyArchive):
    """An .npy file, treated as an archive with one array that has the file's name."""

    @contextlib.contextmanager
    def _archive(self) -> Iterator[Archive]:
        yield _LoneArray(self.path)


class Archive(Protocol):
    """An opened archive of arrays."""

    def infolist(self) -> list[zipfile.ZipInfo]:
        """Return the names of the files in the archive."""

    def open(self, name: str, /) -> contextlib.AbstractContextManager[IO[bytes]]:
        """Open a file of the archive for reading."""


@dataclass(frozen=True)
class _LoneArray:
    path: Path

    def infolist(self) -> list[zipfile.ZipInfo]:
        info = zipfile.ZipInfo(f"{self.path.name.partition('.')[0]}.npy")
        is_packed = self.path.suffix.lower() == GZIP
        info.file_size = sys.maxsize if is_packed else self.path.stat().st_size
        return [info]

    def open(self, name: str, /) -> contextlib.AbstractContextManager[IO[bytes]]:
        return text.open_text(self.path)


@dataclass(frozen=True)
class ArrayMember:
    """An array in an archive, as declared by its header."""

    name: str
    member: str  # name of the file in the archive
    shape: tuple[int, ...]
    columnwise: bool  # Fortran order: rows are not contiguous
    dtype: np.dtype[Any]
    time_axis: int = 0

    @classmethod
    def from_archive(cls, archive: Archive, member: zipfile.ZipInfo, time_axis: int = 0) -> ArrayMember:
        """Return the array declared by a header. Raises `ValueError` if it is not an array, or contains Python objects."""
        with archive.open(member.filename) as file:
            shape, columnwise, dtype = _read_header(file)
        if dtype.hasobject:
            raise ValueError(f"{member.filename} holds Python objects, which are not read: they can run programs")
        if max(1, math.prod(shape)) * dtype.itemsize > member.file_size:
            raise ValueError(f"{member.filename} declares more values than it has bytes for")
        if shape and time_axis >= len(shape):
            raise ValueError(f"{member.filename} has the shape {shape}, without a dimension {time_axis} (time_axis)")
        width = math.prod(size for axis, size in enumerate(shape) if axis != time_axis)
        row_shape = (*shape[:time_axis], *shape[time_axis + 1 :])
        limit = MAX_COLUMNS if array_format((1, *row_shape), dtype) is None else MAX_PIXELS
        if width > limit:
            raise ValueError(f"{member.filename} has {width:,} values a row, {limit:,} are allowed")
        name = member.filename.removesuffix(".npy")
        return cls(name, member.filename, shape, columnwise and len(shape) > 1, dtype, time_axis)

    @property
    def rows(self) -> int:
        """The number of rows."""
        return self.shape[self.time_axis]

    @property
    def row_shape(self) -> tuple[int, ...]:
        """The shape of one row."""
        return self.shape[: self.time_axis] + self.shape[self.time_axis + 1 :]

    @property
    def width(self) -> int | None:
        """The number of values per row, or None if a row is a scalar."""
        return math.prod(self.row_shape) if self.row_shape else None

    @property
    def row_bytes(self) -> int:
        """The size of a row in bytes."""
        return math.prod(self.row_shape) * self.dtype.itemsize

    @property
    def video_format(self) -> VideoFormat | None:
        """The format of decoded images, or None if the array cannot be images."""
        return array_format((self.rows, *self.row_shape), self.dtype)

    @property
    def is_pictures(self) -> bool:
        """Whether the array is images with more values than a table has columns."""
        return self.video_format is not None and self.is_wide

    @property
    def is_wide(self) -> bool:
        """Whether a row has more values than a table has columns."""
        return (self.width or 0) > STREAM_COLUMNS

    def describe_wide(self) -> str:
        """Return a phrase about an array whose rows have too many values for columns."""
        shape = " x ".join(map(str, self.row_shape))
        return (
            f"{plain(self.name)} of {shape} values ({self.dtype}) per row, which are no channels; images must be uint8"
        )

    @contextlib.contextmanager
    def reading(self, archive: Archive) -> Iterator[Callable[[int], np.ndarray]]:
        """Yield a function that returns the next ``rows`` rows (time, value); it raises `ValueError` if there are fewer."""
        with archive.open(self.member) as file:
            _read_header(file)
            if self.columnwise or self.time_axis:
                memory.require(self.rows * self.row_bytes, f"{self.member}, whose rows are not one after another,")
                order: Literal["F", "C"] = "F" if self.columnwise else "C"
                full = np.frombuffer(self._exactly(file, self.rows), self.dtype).reshape(self.shape, order=order)
                flat, ends = np.moveaxis(full, self.time_axis, 0).reshape(self.rows, -1), itertools.count()
                yield lambda rows: flat[[next(ends) for _ in range(rows)]]
            else:
                yield lambda rows: np.frombuffer(self._exactly(file, rows), self.dtype).reshape(rows, -1)

    def _exactly(self, file: IO[bytes], rows: int) -> bytes:
        content = file.read(rows * self.row_bytes)
        if len(content) < rows * self.row_bytes:
            raise ValueError(f"{self.member} ends before its last row")
        return content


def _read_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Return the shape of an array, whether it is in Fortran order, and its type, from its header.

    Raises `ValueError` for an unknown format.
    """
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"an array of format {version} is not known")
    shape, is_fortran, dtype = readers[version](file)
    return tuple(map(int, shape)), bool(is_fortran), dtype


def _column(blocks: Mapping[str, np.ndarray], array: str, position: int | None) -> pa.Array:
    values = blocks[array][:, position or 0]
    return pa.array(np.ascontiguousarray(values, values.dtype.newbyteorder("=")))


@dataclass(frozen=True)
class JsonLines(RowFile):
    """A file with one JSON object per line; lists in it become columns NAME_0, NAME_1, …."""

    path: Path

    def names(self) -> list[str]:
        """Return the names of the columns in any line."""
        return list(self._kinds)

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield the columns in ``types`` in blocks of lines, with the same types in each block."""
        for block in map(self._split_lists, self._blocks()):
            columns = {
                name: block.column(name).cast(self._kinds[name], safe=False)  # includes integers in a column of floats
                if name in block.column_names
                else pa.nulls(block.num_rows, self._kinds[name])
                for name in types
            }
            yield _refuse_nested(self.path, pa.table(columns))

    def head(self) -> pa.Table:
        """Return the first lines."""
        return self._split_lists(next(self._blocks(), pa.table({})))

    def place(self, index: int) -> str:
        """Return the name of the data row ``index`` (from 0) in errors."""
        return f"line {index + 1}"

    @functools.cached_property
    def _kinds(self) -> dict[str, pa.DataType]:
        """The type of each column that represents the values of all lines, in order of first appearance.

        Raises `TacpipeError` if there is no such type.
        """
        schemas: list[pa.Schema] = []
        widths: dict[str, int] = {}
        for block in self._blocks():
            self._add_widths(block, widths)
            schemas.append(self._split_lists(block.slice(0, 1)).schema)
        with explaining(pa.ArrowException, f"{self.path} is not JSON lines: "):
            full_schema = pa.unify_schemas(schemas, promote_options="permissive") if schemas else pa.schema([])
        return {field.name: field.type for field in full_schema}

    def _blocks(self) -> Iterator[pa.Table]:
        """Yield the lines as tables. Raises `TacpipeError` if a line is too long or not a JSON object."""
        too_long = TacpipeError(f"{self.path} is not JSON lines: a line has over {MAX_LINE_BYTES} bytes.")
        with text.open_text(self.path) as file:
            for pieces in text.whole_lines(file, BLOCK_BYTES, MAX_LINE_BYTES, too_long):
                with explaining((pa.ArrowInvalid, OSError, UnicodeDecodeError), f"{self.path} is not JSON lines: "):
                    buffer = pa.BufferReader(owned(*pieces))
                    table = pj.read_json(buffer, pj.ReadOptions(use_threads=False)).flatten()
                    table.column_names  # noqa: B018  (names that are not UTF-8 are found here)
                yield table

    def _add_widths(self, block: pa.Table, widths: dict[str, int]) -> None:
        """Add the length of the lists in each column to ``widths``.

        Raises `TacpipeError` if lengths differ within a column.
        """
        for field in block.schema:
            if pa.types.is_list(field.type):
                lengths = set(pc.list_value_length(block.column(field.name)).to_pylist())
                lengths |= {widths[field.name]} if field.name in widths else set()
                if len(lengths) != 1 or None in lengths:
                    raise TacpipeError(
                        f"{self.path}: lists of {plain(field.name)} have {len(lengths)} lengths; a column holds one value a "
                        f"row."
                    )
                (widths[field.name],) = lengths

    def _split_lists(self, block: pa.Table) -> pa.Table:
        """Return a table whose list columns of constant length are split into columns."""
        columns: list[tuple[str, pa.ChunkedArray]] = []
        widths: dict[str, int] = {}
        self._add_widths(block, widths)
        for name, column in zip(block.column_names, block.columns, strict=True):
            if name in widths:
                columns += [(f"{name}_{at}", pc.list_element(column, at)) for at in range(widths[name])]
            else:
                columns.append((name, column))
        return pa.table(container.parts_by_name(columns, self.path, "column"))


def _refuse_nested(path: Path, table: pa.Table) -> pa.Table:
    """Return ``table``. Raises `TacpipeError` if a column is nested."""
    for field in table.schema:
        if pa.types.is_nested(field.type):
            raise TacpipeError(
                f"{path}: column {plain(field.name)} holds {field.type}; a column holds one value a row."
            )
    return table


def open_table(path: Path, kind: str, time_axis: int = 0) -> ParquetFile | NumpyArchive | JsonLines:
    """Return the reader of a file of this kind; ``time_axis`` is that of arrays."""
    if kind in ("npz", "npy"):
        return (NumpyArchive if kind == "npz" else NumpyFile)(path, time_axis)
    return ParquetFile(path) if kind == "parquet" else JsonLines(path)
