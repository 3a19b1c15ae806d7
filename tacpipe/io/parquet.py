"""Write and read tables as Parquet, with encodings chosen by measurement, and units and layout as field metadata."""

from __future__ import annotations

import io
import itertools
import json
import mmap
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from tacpipe.arrays import from_arrow
from tacpipe.errors import DamagedError, ShortageError, TacpipeError
from tacpipe.io import memory, regular, row_groups
from tacpipe.io.parquet_claims import Claims
from tacpipe.printable import plain

ROW_GROUP_ROWS = 1 << 20
# fraction of repeated rows above which zstd beats delta packing; see docs/reference/recordings.md
REPEATED_SHARE = 0.25
LARGE_BYTES = 1 << 25  # size of a table in memory above which it is written to a growing buffer
BATCH_ROWS = 1024  # rows per batch: Arrow's default
PAGE_BYTES = 1 << 20  # encoded frames per page; a batch of 1024 rows could exceed the 2 GiB limit of a page
GROUP_BYTES = 1 << 28  # encoded frames per row group
TRIED_BYTES = 1 << 20  # encoded frames that are compressed as a trial
WORTH = 0.95  # maximum ratio of compressed to original size for which compression is used
THREADED_BYTES = 1 << 22  # size in memory above which columns are decoded by several threads; starting them takes time
SOME_ROWS = 1 << 14  # rows decoded at once when a file is read in batches
ZSTD_LEVEL = 3
ZSTD_LEVEL_REPEATED = 9  # long runs of equal values justify the slower search
_CLOCKS = ("t_ns", "t_device_ns", "seq")
_KEY = b"tacpipe"
BROKEN = (  # errors of pyarrow for damaged files, and of Python for their metadata
    *(pa.ArrowException, OSError, ValueError, RuntimeError, MemoryError, OverflowError),
    *(LookupError, TypeError, AttributeError),
)


def to_parquet(table: pa.Table) -> bytes:
    """Return ``table`` as the bytes of a Parquet file; equal tables give equal bytes.

    >>> table = pa.table({"t_ns": pa.array([0, 1], pa.int64())})
    >>> from_parquet(to_parquet(table)).equals(table)
    True
    """
    # Arrow's stream is faster, but doubles its buffer when it grows and copies it at the end, which triples a large
    # table's memory
    sink = io.BytesIO() if table.nbytes > LARGE_BYTES else pa.BufferOutputStream()
    write(table, sink)
    return sink.getvalue() if isinstance(sink, io.BytesIO) else sink.getvalue().to_pybytes()


def write(source: pa.Table | pa.RecordBatchReader, sink: Any) -> int:
    """Write a table, or batches as they arrive, to the file ``sink`` as Parquet; return the number of rows.

    Equal rows give equal bytes, as one table or in batches of any size, because the first row group determines how
    columns are stored. One row group of batches is spilled to disk (`tacpipe.io.row_groups`), or kept in memory if
    there are encoded frames.
    """
    row_groups_source = row_groups.rows_in_groups(source, ROW_GROUP_ROWS, GROUP_BYTES)
    first_rows = row_groups_source.head()
    many_repeats = _repeated_share(first_rows, row_groups_source.release) > REPEATED_SHARE
    encoding, compression_level = {}, {}
    compression = dict.fromkeys(source.schema.names, "zstd")
    value_bytes = max(
        [_mean_bytes(first_rows.column(field.name)) for field in source.schema if row_groups.holds_bytes(field)],
        default=0,
    )
    for field in source.schema:
        if row_groups.holds_bytes(field) and _is_incompressible(first_rows.column(field.name)):
            compression[field.name] = "none"
        is_delta = pa.types.is_integer(field.type) and (field.name in _CLOCKS or not many_repeats)
        compression_level[field.name] = ZSTD_LEVEL if is_delta or not many_repeats else ZSTD_LEVEL_REPEATED
        if pa.types.is_floating(field.type):
            encoding[field.name] = "BYTE_STREAM_SPLIT"
        elif is_delta:
            encoding[field.name] = "DELTA_BINARY_PACKED"
        elif not pa.types.is_boolean(field.type):
            encoding[field.name] = "PLAIN"
    bare_schema = pa.schema([pa.field(field.name, field.type) for field in source.schema])
    del first_rows
    with pq.ParquetWriter(
        row_groups_source.releasing(sink),
        bare_schema,
        use_dictionary=False,
        column_encoding=encoding,
        compression=compression,
        compression_level={name: level for name, level in compression_level.items() if compression[name] == "zstd"},
        write_batch_size=max(1, min(BATCH_ROWS, PAGE_BYTES // max(value_bytes, 1))),  # a page contains whole batches
        write_statistics=False,
        write_page_checksum=True,
        store_schema=False,
    ) as writer:
        count = 0
        for group in row_groups_source.groups(max(1, min(ROW_GROUP_ROWS, GROUP_BYTES // max(value_bytes, 1)))):
            writer.write_table(_combine_chunks(group).cast(bare_schema), row_group_size=max(1, group.num_rows))
            count += group.num_rows
        writer.add_key_value_metadata({_KEY: _fields_to_json(source.schema)})
    return count


def from_parquet(content: bytes | Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Return the table in a Parquet file, given as bytes or path, with field metadata; only ``columns`` if given.

    Raises `DamagedError` if the bytes are not a Parquet file or do not match their metadata, and `ShortageError` if the
    table, which may be valid, does not fit in the available memory.
    """
    return ParquetTable(content).read(columns)


def require_claims(
    path: Path,
    columns: Collection[str] | None,
    *,
    share: float = 1.0,
    max_bytes: int | None = None,
    rows: int | None = None,
) -> None:
    """Raise `TacpipeError` if columns of an untrusted file declare more than may be read at once, or than exists.

    The limit is ``max_bytes``, by default the available memory, for the fraction ``share`` that is read at once, or
    `memory.MAX_BLOCK_BYTES` if only ``rows`` rows are read at once. Each text counts, also if several share a
    dictionary entry.
    """
    with regular.failing(path), regular.opened(path) as file:
        try:
            schema = pq.ParquetFile(file).schema
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped, memoryview(mapped) as content:
                claims = Claims(schema, content)
                encoded, largest, _ = claims.count(content, columns, shared=True)
                total, _, _ = claims.count(content, columns)
        except BROKEN as error:
            raise TacpipeError(
                f"{path} is not a whole Parquet file: {plain(' '.join(str(error).split()), 200)}. Copy it again."
            ) from error
        memory.require_block(largest, f"A page of {path}")
        limit = memory.MAX_BLOCK_BYTES if rows is not None else max_bytes
        if rows is None:
            _require_size(path, int(encoded * share), limit)
        if total * share > min(limit or total, memory.MAX_BLOCK_BYTES):
            texts = _text_bytes(file, schema, columns, rows or BATCH_ROWS)
            _require_size(
                path, max(texts, default=0) if rows is not None else int((encoded + sum(texts)) * share), limit
            )


def _require_size(path: Path, size: int, max_bytes: int | None) -> None:
    """Raise `TacpipeError` if a file declares more than ``max_bytes``, by default the available memory."""
    if max_bytes is None:
        memory.require(size, str(path))
    elif size > max_bytes:
        raise TacpipeError(
            f"{path} declares {memory.readable_size(size)} that would be read at once, and "
            f"{memory.readable_size(max_bytes)} are allowed. Write it with shorter texts; if its source is untrusted, do "
            f"not use it."
        )


def _text_bytes(file: Any, schema: Any, columns: Collection[str] | None, rows: int) -> Iterator[int]:
    """Yield the size in bytes of the texts in this number of rows; each dictionary entry is read once."""
    leaves = [schema.column(index) for index in range(len(schema))]
    for path in (leaf.path for leaf in leaves if leaf.physical_type == "BYTE_ARRAY"):
        if columns is None or path in columns or path.partition(".")[0] in columns:
            file.seek(0)
            for batch in pq.ParquetFile(file, read_dictionary=[path]).iter_batches(rows, columns=[path]):
                values = batch.column(0)
                while pa.types.is_nested(values.type):
                    values = values.field(0) if pa.types.is_struct(values.type) else values.flatten()
                if pa.types.is_dictionary(values.type):
                    lengths = pc.binary_length(values.dictionary).take(values.indices)
                else:
                    lengths = pc.binary_length(values)
                yield pc.sum(lengths).as_py() or 0


class ParquetTable:
    """The table in a Parquet file, whose columns are decoded on demand. Raises the errors of `from_parquet`.

    The file is given as bytes, or as the path of a file that does not change; only decoded parts of it are in memory.
    Arrow buffers are read directly, Python bytes are copied.
    """

    def __init__(self, content: bytes | pa.Buffer | Path) -> None:
        if isinstance(content, Path):
            self._source: pa.NativeFile = pa.OSFile(str(content))
            with content.open("rb") as file:
                self._content: Any = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        else:
            self._content = content if isinstance(content, pa.Buffer) else owned(content)
            self._source = pa.BufferReader(self._content)
        self._size = self._source.size()
        self._claims: Claims | None = None
        try:
            self._file = self._open_file()
            stored = (self._file.metadata.metadata or {}).get(_KEY)
            self._fields = None if stored is None else json.loads(stored)["fields"]
            self.schema = self._with_fields(self._file.schema_arrow)
        except BROKEN as error:
            raise _read_error(self._size, error) from error

    def _open_file(self) -> pq.ParquetFile:
        """Return a reader of the file that verifies page checksums if the file is not in memory."""
        if isinstance(self._content, pa.Buffer):
            return pq.ParquetFile(self._source)
        return pq.ParquetFile(self._source, buffer_size=1 << 16, page_checksum_verification=True)

    def _count(self, columns: Sequence[str] | None) -> tuple[int, int, int]:
        """Return total size, size of the largest page and number of ``columns``, as `Claims.count` does.

        Raises `DamagedError` if the file is damaged.
        """
        content = memoryview(self._content).cast("B") if isinstance(self._content, pa.Buffer) else self._content
        try:
            if self._claims is None:
                self._claims = Claims(self._file.schema, content)
            return self._claims.count(content, columns)
        except BROKEN as error:
            raise _read_error(self._size, error) from error

    @property
    def num_rows(self) -> int:
        """The number of rows that the file declares."""
        return int(self._file.metadata.num_rows)

    def read(self, columns: Sequence[str] | None = None) -> pa.Table:
        """Return the table, or only ``columns`` of it, with field metadata.

        Raises `DamagedError` if the file is damaged, and `ShortageError` if the table does not fit in memory.
        """
        total, largest, _ = self._count(columns)
        memory.require(total + largest, f"A Parquet file of {self._size} bytes", error=ShortageError)
        try:
            names = list(columns) if columns is not None else None
            return self._attach_metadata(self._file.read(columns=names, use_threads=total > THREADED_BYTES))
        except BROKEN as error:
            raise _read_error(self._size, error) from error

    def batches(self, columns: Sequence[str] | None = None, rows: int = SOME_ROWS) -> Iterator[pa.Table]:
        """Yield tables of up to ``rows`` rows with field metadata, decoded on demand. Raises the errors of `read`."""
        total, page, count = self._count(columns)
        batch_bytes = total * min(rows, self.num_rows) // max(1, self.num_rows)
        memory.require(batch_bytes + page * count, f"A Parquet file of {self._size} bytes", error=ShortageError)
        names = list(columns) if columns is not None else None
        try:
            yield from map(self._attach_metadata, batches_of_file(self._open_file(), rows, names))
        except BROKEN as error:
            raise _read_error(self._size, error) from error

    def _attach_metadata(self, table: pa.Table) -> pa.Table:
        """Return a table of some columns with their field metadata."""
        if self._fields is None:
            return table
        if not table.num_columns:  # the number of rows would be lost without columns
            return table.replace_schema_metadata(None)
        schema = self.schema
        if table.column_names != schema.names:
            schema = pa.schema([schema.field(name) for name in table.column_names])
        return pa.Table.from_arrays(table.columns, schema=schema)

    def _with_fields(self, schema: pa.Schema) -> pa.Schema:
        return schema if self._fields is None else _with_fields(schema, self._file.schema_arrow.names, self._fields)


def column_names(path: str) -> list[str]:
    """Return the names of the columns of a stored table, which is read from its end only."""
    return list(pq.read_schema(path).names)


def stored_batches(path: str, rows: int = SOME_ROWS) -> pa.RecordBatchReader:
    """Return the rows of a Parquet file on disk as batches of up to ``rows`` rows, decoded on demand.

    For files that this program wrote, because their metadata are not checked first. Raises `DamagedError` as
    `from_parquet` does, also while batches are read.
    """
    size = os.stat(path).st_size  # noqa: PTH116

    def read_batches() -> Iterator[pa.RecordBatch]:
        try:
            for table in batches_of_file(file, rows):
                yield from table.combine_chunks().to_batches()
        except BROKEN as error:
            raise _read_error(size, error) from error

    try:
        file = pq.ParquetFile(path, buffer_size=1 << 16, pre_buffer=False)
        return pa.RecordBatchReader.from_batches(file.schema_arrow, read_batches())
    except BROKEN as error:
        raise _read_error(size, error) from error


def batches_of_file(file: pq.ParquetFile, rows: int, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
    """Yield tables of ``rows`` rows, the last with the remainder.

    Each row group has a reader of its own: pyarrow's reader of a whole file keeps memory for each row group that it passed.
    """
    remainder: pa.Table | None = None
    for group in range(file.metadata.num_row_groups):
        for batch in file.iter_batches(rows, row_groups=[group], columns=columns, use_threads=False):
            table = pa.Table.from_batches([batch])
            if remainder is not None:
                table = pa.concat_tables([remainder, table]).combine_chunks()
            if table.num_rows >= rows:
                yield table.slice(0, rows)
                table = table.slice(rows)
            remainder = table if table.num_rows else None
    if remainder is not None:
        yield remainder


def owned(*pieces: bytes | memoryview) -> pa.Buffer:
    """Return the concatenated bytes in memory owned by Arrow.

    Arrow's threads may release a buffer after the table was read. They cannot release one owned by Python while Python
    shuts down, which would abort the process.
    """
    buffer = pa.allocate_buffer(sum(map(len, pieces)))
    with pa.FixedSizeBufferWriter(buffer) as sink:
        for piece in pieces:
            sink.write(piece)
    return buffer


def _read_error(size: int, error: Exception) -> TacpipeError:
    """Return the error for unreadable bytes: they are damaged, or there is too little memory to find out."""
    if memory.scarce() and (short := memory.shortage(error)) is not None:
        return short
    return DamagedError(f"These {size} bytes are no Parquet file: {plain(' '.join(str(error).split()), 200)}.")


def _combine_chunks(group: pa.Table) -> pa.Table:
    """Return rows with texts and bytes in single chunks, because pages would otherwise end at chunk boundaries."""
    columns = [
        column.combine_chunks() if column.num_chunks > 1 and not pa.types.is_primitive(column.type) else column
        for column in group.columns
    ]
    return pa.Table.from_arrays(columns, schema=group.schema) if columns else group


def _mean_bytes(column: pa.ChunkedArray) -> int:
    """Return the mean size of a value in memory in bytes, however the column is chunked."""
    count = len(column)
    offsets = (count + 1) * (8 if pa.types.is_large_binary(column.type) else 4)
    nulls = -(-count // 8) if column.null_count else 0
    return int(((pc.sum(pc.binary_length(column)).as_py() or 0) + offsets + nulls) / max(count, 1))


def _is_incompressible(column: pa.ChunkedArray) -> bool:
    """Return whether zstd would hardly compress the bytes, as for JPEG images."""
    content = bytearray()
    for value in itertools.chain.from_iterable(column.chunks):
        content += (value.as_py() or b"")[: TRIED_BYTES - len(content)]
        if len(content) >= TRIED_BYTES:
            break
    return len(content) > 0 and len(pa.Codec("zstd", 1).compress(bytes(content), asbytes=True)) > WORTH * len(content)


def _repeated_share(table: pa.Table, release: Callable[[], None]) -> float:
    """Return the fraction of rows whose integer channels all equal those of the previous row.

    ``release`` frees each channel before the next one is read.
    """
    channels = [
        column
        for name, column in zip(table.column_names, table.columns, strict=True)
        if pa.types.is_integer(column.type) and name not in _CLOCKS and not column.null_count
    ]
    if not channels or table.num_rows < 2:
        return 0.0
    same = np.ones(table.num_rows - 1, dtype=bool)  # (time,)
    for column in channels:
        channel = from_arrow(column)
        same &= channel[1:] == channel[:-1]
        release()
    return float(same.mean())


def _fields_to_json(schema: pa.Schema) -> bytes:
    """Return all field metadata as JSON: column positions by value, by key."""
    carriers: dict[tuple[bytes, bytes], list[int]] = {}
    for position, field in enumerate(schema):
        for pair in (field.metadata or {}).items():
            carriers.setdefault(pair, []).append(position)
    fields: dict[str, dict[str, list[int]]] = {}
    for (key, value), positions in carriers.items():
        if not key.startswith(b"PARQUET:"):
            fields.setdefault(key.decode(), {})[value.decode()] = positions
    return json.dumps({"fields": fields}, sort_keys=True, separators=(",", ":")).encode()


def _with_fields(schema: pa.Schema, names: Sequence[str], fields: dict[str, dict[str, list[int]]]) -> pa.Schema:
    """Return a schema with the field metadata that `_fields_to_json` encoded; ``names`` are those of all columns."""
    metadata: dict[str, dict[str, str]] = {}
    for key, values in fields.items():
        for value, positions in values.items():
            for position in positions:
                metadata.setdefault(names[position], {})[key] = value
    return pa.schema([pa.field(field.name, field.type, metadata=metadata.get(field.name)) for field in schema])


def with_metadata(table: pa.Table, metadata: dict[str, dict[str, str]]) -> pa.Table:
    """Return ``table`` with ``metadata`` (text by key, by column) added to its field metadata."""
    fields = []
    for field in table.schema:
        existing = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
        merged = {**existing, **metadata.get(field.name, {})}
        fields.append(pa.field(field.name, field.type, metadata=merged or None))
    return table.cast(pa.schema(fields))


def one_after_another(tables: Mapping[str, pa.Table]) -> pa.Table:
    """Concatenate the tables of recordings, after a first column ``recording`` with their names, without metadata.

    A table that already has this column, such as a split or predictions, keeps its own. At least one table is required.
    """
    tables_with_names = []
    for name, table in tables.items():
        columns, column_names = table.columns, table.column_names
        if "recording" not in column_names:
            names = pa.DictionaryArray.from_arrays(pa.array([0] * table.num_rows, pa.int32()), pa.array([name]))
            columns, column_names = [names, *columns], ["recording", *column_names]
        tables_with_names.append(pa.Table.from_arrays(columns, names=column_names))
    return pa.concat_tables(tables_with_names, promote_options="default").unify_dictionaries()
