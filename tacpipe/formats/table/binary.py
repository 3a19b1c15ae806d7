"""Tables that are not text: Parquet, NPZ archives of numpy, and JSON lines; blocks of columns as they hold them."""

from __future__ import annotations

import functools
import gzip
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.json as pj
import pyarrow.parquet as pq

from tacpipe.errors import TacpipeError
from tacpipe.formats.table.layout import GZIP
from tacpipe.io import memory, regular
from tacpipe.io.parquet import BROKEN, owned
from tacpipe.printable import plain

BATCH_ROWS = 1 << 18


@dataclass(frozen=True)
class ParquetFile:
    """A Parquet file, whoever wrote it; nested columns are refused where they are asked for."""

    path: Path

    def names(self) -> list[str]:
        """Return the names of the columns."""
        try:
            with regular.opened(self.path) as file:
                return list(pq.ParquetFile(file).schema_arrow.names)
        except BROKEN as error:
            raise TacpipeError(f"{self.path} is not a Parquet file: {plain(str(error), 200)}.") from error

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield the columns that ``types`` names, some rows at a time, with the types that the file has."""
        try:
            with regular.opened(self.path) as file:
                for batch in pq.ParquetFile(file).iter_batches(BATCH_ROWS, columns=list(types)):
                    yield _flat(self.path, pa.Table.from_batches([batch]))
        except BROKEN as error:
            raise TacpipeError(f"{self.path} cannot be read: {plain(str(error), 200)}. Copy it again.") from error

    def place(self, index: int) -> str:
        """Return how the data row ``index`` (from 0) is named in errors."""
        return f"row {index + 1}"


@dataclass(frozen=True)
class NumpyArchive:
    """An NPZ archive: arrays (time,) are columns, one (time, n, …) is n columns NAME_0, NAME_1, …; pickles are refused."""

    path: Path

    def names(self) -> list[str]:
        """Return the names of the columns."""
        return list(self._columns)

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield all rows of the columns that ``types`` names."""
        columns = self._columns
        yield pa.table({name: pa.array(columns[name]) for name in types})

    def place(self, index: int) -> str:
        """Return how the data row ``index`` (from 0) is named in errors."""
        return f"row {index + 1}"

    @functools.cached_property
    def _columns(self) -> dict[str, np.ndarray]:
        found: dict[str, np.ndarray] = {}
        try:
            with regular.opened(self.path) as file, zipfile.ZipFile(file) as archive:
                memory.require(sum(one.file_size for one in archive.infolist()), str(self.path))
                file.seek(0)
                with np.load(file, allow_pickle=False) as arrays:
                    for name in arrays.files:
                        array = arrays[name]
                        if array.ndim == 0:
                            continue
                        flat = array.reshape(len(array), -1)
                        found |= (
                            {name: array}
                            if array.ndim == 1
                            else {
                                f"{name}_{column}": np.ascontiguousarray(flat[:, column])
                                for column in range(flat.shape[1])
                            }
                        )
        except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError) as error:
            raise TacpipeError(f"{self.path} is not an archive of arrays: {plain(str(error), 200)}.") from error
        lengths = {name: len(array) for name, array in found.items()}
        if len(set(lengths.values())) > 1:
            first, other = next((a, b) for a in lengths for b in lengths if lengths[a] != lengths[b])
            raise TacpipeError(
                f"{self.path}: {plain(first)} has {lengths[first]} rows and {plain(other)} has {lengths[other]}; arrays of "
                f"one stream have one length. Write those of each rate into a file of their own."
            )
        return found


@dataclass(frozen=True)
class JsonLines:
    """A file with one JSON object a line; lists within it are columns NAME_0, NAME_1, …."""

    path: Path

    def names(self) -> list[str]:
        """Return the names of the columns."""
        return list(self._table.column_names)

    def batches(self, types: Mapping[str, pa.DataType]) -> Iterator[pa.Table]:
        """Yield all rows of the columns that ``types`` names."""
        yield _flat(self.path, self._table.select(list(types)))

    def place(self, index: int) -> str:
        """Return how the data row ``index`` (from 0) is named in errors."""
        return f"line {index + 1}"

    @functools.cached_property
    def _table(self) -> pa.Table:
        with regular.failing(self.path):
            content = regular.source(self.path)
            if self.path.suffix.lower() == GZIP:
                content = gzip.decompress(content)
        try:
            table = pj.read_json(pa.BufferReader(owned(content)), pj.ReadOptions(use_threads=False))
        except (pa.ArrowInvalid, OSError) as error:
            raise TacpipeError(f"{self.path} is not JSON lines: {plain(str(error), 200)}.") from error
        return _unfolded(self.path, table.flatten())


def _unfolded(path: Path, table: pa.Table) -> pa.Table:
    """Return a table whose columns of lists of one length are columns of their own."""
    columns: dict[str, pa.ChunkedArray] = {}
    for name in table.column_names:
        column = table.column(name).combine_chunks()
        if not pa.types.is_list(column.type):
            columns[name] = column
            continue
        lengths = set(pa.compute.list_value_length(column).to_pylist())
        if len(lengths) != 1 or None in lengths:
            raise TacpipeError(
                f"{path}: lists of {plain(name)} have {len(lengths)} lengths; a column holds one value a row."
            )
        (width,) = lengths
        for position in range(width):
            columns[f"{name}_{position}"] = pa.compute.list_element(column, position)
    return pa.table(columns)


def _flat(path: Path, table: pa.Table) -> pa.Table:
    for field in table.schema:
        if pa.types.is_nested(field.type):
            raise TacpipeError(
                f"{path}: column {plain(field.name)} holds {field.type}; a column holds one value a row."
            )
    return table


def opened(path: Path, kind: str) -> ParquetFile | NumpyArchive | JsonLines:
    """Return the reader of a file of this kind."""
    readers: dict[str, type[ParquetFile | NumpyArchive | JsonLines]]
    readers = {"parquet": ParquetFile, "npz": NumpyArchive, "jsonl": JsonLines}
    return readers[kind](path)
