import ast
import errno
import io
import itertools
import re
import tempfile
import weakref
from pathlib import Path
from random import Random
from typing import Any

import duckdb
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tacpipe.errors import DamagedError, StorageError
from tacpipe.io import parquet, parquet_claims, row_groups
from tacpipe.io.columns import Columns
from tacpipe.io.parquet import ParquetTable, from_parquet, owned, to_parquet, with_metadata
from tests.any_table import bits, tables

drawn = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])


@given(tables())
@drawn
def test_a_table_comes_back_to_the_bit_with_its_types_and_what_is_told_of_its_fields(table: pa.Table) -> None:
    assert bits(from_parquet(to_parquet(table))) == bits(table)


class Content(bytearray):
    """Bytes of which it can be seen whether anybody still holds them."""


def test_arrow_holds_no_memory_of_python_s(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread of Arrow's that lets go of it while Python ends aborts the process: rare, and seen, as exit code 134."""
    opened, files = pq.ParquetFile, []

    def keep(source: pa.NativeFile) -> pq.ParquetFile:
        files.append(opened(source))
        return files[-1]

    monkeypatch.setattr(pq, "ParquetFile", keep)
    content = Content(to_parquet(pa.table({"a": list(range(1000))})))
    reference = weakref.ref(content)
    assert from_parquet(content).num_rows == 1000  # type: ignore[arg-type]
    del content
    assert files and reference() is None


def test_whatever_is_read_as_parquet_lies_in_memory_of_arrow_s_own() -> None:
    """Every reader of bytes in the program gets them from `owned`, which the test above is about."""
    readers = {"BufferReader", "input_stream", "BytesIO"}
    calls = 0
    for file in sorted((Path(__file__).parents[1] / "tacpipe").rglob("*.py")):
        text = file.read_text()
        if "pyarrow" not in text:
            continue
        for call in ast.walk(ast.parse(text)):
            name = getattr(getattr(call, "func", None), "attr", "")
            if isinstance(call, ast.Call) and name in readers and call.args:  # A call without bytes is for writing.
                argument = ast.unparse(call.args[0])  # `self._content` is what `ParquetTable` got from `owned`
                assert argument.startswith("owned(") or argument == "self._content", f"{file}:{call.lineno}"
                calls += 1
    assert calls == 4


@given(tables(), st.data())
@drawn
def test_columns_that_are_asked_for_come_alone(table: pa.Table, data: st.DataObject) -> None:
    names = data.draw(st.lists(st.sampled_from(table.column_names), unique=True)) if table.num_columns else []
    assert bits(from_parquet(to_parquet(table), names)) == bits(table.select(names))


@given(tables(), st.lists(st.integers(0, 3000), max_size=4))
@drawn
def test_the_same_values_give_the_same_bytes_however_they_lie_in_memory(table: pa.Table, cuts: list[int]) -> None:
    edges = [0, *sorted(min(cut, table.num_rows) for cut in cuts), table.num_rows]
    pieces = [table.slice(start, stop - start) for start, stop in itertools.pairwise(edges)]
    # begins in the middle of a buffer
    sliced = pa.concat_tables([table.slice(0, 1), table]).slice(min(1, table.num_rows))
    content = to_parquet(table)
    assert to_parquet(pa.concat_tables(pieces)) == content
    assert to_parquet(sliced) == content
    assert to_parquet(pq.read_table(pa.BufferReader(owned(content))).cast(table.schema)) == content


def batches_of(table: pa.Table, rows: int) -> pa.RecordBatchReader:
    return pa.RecordBatchReader.from_batches(table.schema, iter(table.to_batches(max_chunksize=rows)))


def write_parquet(source: pa.Table | pa.RecordBatchReader) -> bytes:
    sink = io.BytesIO()
    assert parquet.write(source, sink) == pq.ParquetFile(io.BytesIO(sink.getvalue())).metadata.num_rows
    return sink.getvalue()


@given(tables(), st.integers(1, 1500))
@drawn
def test_batches_as_they_come_give_the_bytes_of_the_table_that_they_make(table: pa.Table, rows: int) -> None:
    assert write_parquet(batches_of(table, rows)) == to_parquet(table)


@pytest.mark.parametrize("rows", [400, 401, 2000])  # These rows make one group of rows, one more, and many.
def test_groups_of_rows_are_the_same_in_batches(monkeypatch: pytest.MonkeyPatch, rows: int) -> None:
    monkeypatch.setattr(parquet, "ROW_GROUP_ROWS", 400)
    values = np.concatenate([np.repeat(np.arange(100), 4), np.arange(1600)])[:rows]  # still at first, moving later
    table = pa.table({"t_ns": np.arange(rows), "x": pa.array(values, pa.uint16()), "y": np.sqrt(np.arange(rows))})
    content = to_parquet(table)
    assert all(write_parquet(batches_of(table, size)) == content for size in (1, 7, 399, 400, 3000))
    groups = pq.ParquetFile(io.BytesIO(content)).metadata
    assert [groups.row_group(number).num_rows for number in range(groups.num_row_groups)][:-1] == [400] * (
        (rows - 1) // 400
    )
    assert from_parquet(content).equals(table)


@pytest.mark.parametrize("size", [1, 7, 399, 400, 3000])
def test_rows_that_are_put_aside_on_disk_give_the_bytes_of_their_table(
    monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    monkeypatch.setattr(parquet, "ROW_GROUP_ROWS", 400)
    monkeypatch.setattr(row_groups, "IN_MEMORY", 0)
    monkeypatch.setattr(row_groups, "WRITE_BYTES", 5000)
    rows, rng = 1001, np.random.default_rng(0)
    missing = rng.random(rows) < 0.2
    missing[400:800] = False  # a whole group without a null
    table = pa.table(
        {
            "t_ns": np.arange(rows),
            "x": rng.integers(0, 50_000, rows).astype(np.uint16),
            "y": pa.array(rng.normal(size=rows), mask=missing),
            "z": pa.array(rng.integers(-9, 9, rows), pa.int8(), mask=missing),
            "at": pa.array(np.arange(rows), pa.timestamp("us")),
            "on": pa.array(rng.random(rows) < 0.5, mask=missing),
            "text": pa.array([f"row {row}" for row in range(rows)], mask=missing),
        }
    )
    assert write_parquet(batches_of(table, size)) == to_parquet(table)
    sliced = batches_of(pa.concat_tables([table.slice(0, 3), table]).combine_chunks().slice(3), size)
    assert write_parquet(sliced) == to_parquet(table)


def test_a_disk_that_is_full_while_rows_are_put_aside_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row_groups, "IN_MEMORY", 0)

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(row_groups, "write_all", full)
    with pytest.raises(StorageError, match=f"The disk under {tempfile.gettempdir()} is full"):
        write_parquet(batches_of(pa.table({"x": np.arange(100)}), 10))


def test_frames_of_many_sizes_are_grouped_alike_in_a_table_and_in_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parquet, "GROUP_BYTES", 40_000)
    monkeypatch.setattr(parquet, "PAGE_BYTES", 5_000)
    rng = np.random.default_rng(0)
    frames = [rng.bytes(int(size)) for size in rng.integers(0, 2000, 300)]
    table = pa.table({"t_ns": np.arange(300), "jpeg": pa.array(frames, pa.binary())})
    content = to_parquet(table)
    assert pq.ParquetFile(io.BytesIO(content)).metadata.num_row_groups > 3
    cut = pa.concat_tables([table.slice(start, 11) for start in range(0, 300, 11)])
    assert write_parquet(cut) == content
    assert all(write_parquet(batches_of(table, size)) == content for size in (1, 7, 50, 1000))


def test_what_lies_under_a_null_does_not_count() -> None:
    validity, values = pa.array([True, False, True]), pa.array([1.5, 2.5, 3.5])
    hidden = pa.Array.from_buffers(pa.float64(), 3, [validity.buffers()[1], values.buffers()[1]])
    assert to_parquet(pa.table({"x": hidden})) == to_parquet(pa.table({"x": [1.5, None, 3.5]}))


def test_units_and_layout_come_back_as_field_metadata() -> None:
    metadata = {"taxel01_x": {"unit": "count", "taxel": "1", "axis": "x"}, "t_ns": {"unit": "ns"}}
    table = with_metadata(pa.table({"t_ns": [0, 1], "taxel01_x": [5, 6], "bare": [1.0, 2.0]}), metadata)
    read = from_parquet(to_parquet(table), ["taxel01_x", "bare"])
    assert read.schema.field("taxel01_x").metadata == {b"unit": b"count", b"taxel": b"1", b"axis": b"x"}
    assert read.schema.field("bare").metadata is None


def test_metadata_is_added_to_what_a_field_has_already() -> None:
    table = with_metadata(with_metadata(pa.table({"x": [1]}), {"x": {"unit": "count"}}), {"x": {"rest": "3.5"}})
    assert table.schema.field("x").metadata == {b"unit": b"count", b"rest": b"3.5"}


def test_duckdb_pandas_and_pyarrow_open_a_shard_as_it_is(tmp_path: Path) -> None:
    table = pa.table({"t_ns": pa.array([1, 2, 3]), "taxel01_x": pa.array([7, 7, 8], pa.uint16())})
    path = tmp_path / "shard.parquet"
    path.write_bytes(to_parquet(table))
    assert duckdb.execute(f"select sum(taxel01_x) from '{path}'").fetchall() == [(22,)]
    assert pd.read_parquet(path)["taxel01_x"].dtype == np.uint16
    assert pq.read_table(path).equals(table)


def test_held_frames_are_stored_plain_and_smooth_ones_delta_packed_and_both_with_page_checksums() -> None:
    smooth = np.arange(400, dtype=np.uint16)
    for values, encoding in ((smooth, "DELTA_BINARY_PACKED"), (np.repeat(smooth[:100], 4), "PLAIN")):
        content = to_parquet(pa.table({"t_ns": np.arange(400), "x": pa.array(values)}))
        columns = pq.ParquetFile(io.BytesIO(content)).metadata.row_group(0)
        assert encoding in columns.column(1).encodings
        assert "DELTA_BINARY_PACKED" in columns.column(0).encodings
        damaged = bytearray(content)
        damaged[columns.column(1).data_page_offset + 40] ^= 1
        with pytest.raises(OSError, match="CRC"):
            pq.read_table(io.BytesIO(bytes(damaged)), page_checksum_verification=True)


def test_bytes_that_are_no_parquet_file_are_named_so() -> None:
    with pytest.raises(DamagedError, match="no Parquet file"):
        from_parquet(b"PAR1 but not really")


@given(tables())
@drawn
def test_a_footer_declares_the_same_whether_its_usual_forms_are_matched_or_each_field_is_read(table: pa.Table) -> None:
    content = to_parquet(table)
    schema = pq.ParquetFile(io.BytesIO(content)).schema
    matched = parquet_claims.Claims(schema, content).count(content)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parquet_claims, "_read_common_form", lambda *_: None)
        patch.setattr(parquet_claims, "_USUAL", re.compile(rb"(?!)"))
        assert parquet_claims.Claims(schema, content).count(content) == matched


@given(tables(), st.data())
@drawn
def test_a_table_that_is_read_from_its_file_is_the_one_of_its_bytes(table: pa.Table, data: st.DataObject) -> None:
    names = data.draw(st.lists(st.sampled_from(table.column_names), unique=True)) if table.num_columns else []
    with tempfile.NamedTemporaryFile() as file:
        file.write(to_parquet(table))
        file.flush()
        stored = ParquetTable(Path(file.name))
        assert bits(stored.read(names)) == bits(table.select(names))
        assert bits(pa.concat_tables([table.slice(0, 0), *stored.batches(rows=7)])) == bits(table)


@given(tables(), st.sampled_from([1, 100, 10_000, 1 << 26]), st.randoms(use_true_random=False))
def test_each_column_is_that_of_the_table_whatever_the_order_and_the_size_of_a_block(
    table: pa.Table, block_bytes: int, chance: Random
) -> None:
    content = to_parquet(table)
    expected, columns = from_parquet(content), Columns(content, block_bytes)
    assert columns.schema.equals(expected.schema, check_metadata=True)
    assert (columns.num_rows, columns.column_names) == (expected.num_rows, expected.column_names)
    names = chance.choices(expected.column_names, k=2 * expected.num_columns) if expected.num_columns else []
    for name in names:
        assert bits(pa.table({name: columns.column(name)})) == bits(pa.table({name: expected.column(name)}))


def test_a_stream_that_is_larger_than_a_block_is_never_decoded_whole() -> None:
    rows, names = 1000, [f"x{number}" for number in range(40)]
    content = to_parquet(pa.table({name: pa.array(range(rows), pa.int32()) for name in names}))
    columns = Columns(content, block_bytes=3 * 4 * rows)
    before = pa.total_allocated_bytes()
    for name in names:
        assert columns.column(name).to_pylist() == list(range(rows))
        assert pa.total_allocated_bytes() - before < 5 * 4 * rows


def test_a_column_that_is_not_there_is_a_key_error() -> None:
    with pytest.raises(KeyError):
        Columns(to_parquet(pa.table({"x": pa.array([1], pa.int8())}))).column("y")


def test_bytes_that_are_no_parquet_file_are_damage() -> None:
    with pytest.raises(DamagedError):
        Columns(b"PAR1 nothing of the kind PAR1")


def table(frames: list[bytes]) -> pa.Table:
    half = len(frames) // 2
    data = pa.chunked_array([pa.array(frames[:half], pa.binary()), pa.array(frames[half:], pa.binary())])
    return pa.table({"t_ns": pa.array(range(len(frames)), pa.int64()), "data": data})


def noise(count: int, size: int) -> list[bytes]:
    rng = np.random.default_rng(1)
    return [rng.bytes(size + number) for number in range(count)]


def compression(content: bytes) -> str:
    return str(pq.ParquetFile(io.BytesIO(content)).metadata.row_group(0).column(1).compression)


def test_frames_come_back_to_the_byte() -> None:
    sent = table([b"", *noise(40, 3000), b"\0" * 7])
    assert from_parquet(to_parquet(sent)).equals(sent)
    assert to_parquet(sent) == to_parquet(sent)


def test_what_is_compressed_already_is_not_compressed_again() -> None:
    assert compression(to_parquet(table(noise(40, 3000)))) == "UNCOMPRESSED"
    assert compression(to_parquet(table([bytes(5000)] * 40))) == "ZSTD"


def test_pages_and_groups_of_rows_stay_small_whatever_a_frame_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parquet, "PAGE_BYTES", 10_000)
    monkeypatch.setattr(parquet, "GROUP_BYTES", 100_000)
    content = to_parquet(table(noise(60, 5000)))
    metadata = pq.ParquetFile(io.BytesIO(content)).metadata
    sizes = [metadata.row_group(number).column(1).total_uncompressed_size for number in range(metadata.num_row_groups)]
    assert max(sizes) < 120_000
    assert from_parquet(content).num_rows == 60


def test_another_column_is_read_without_the_frames() -> None:
    columns = Columns(to_parquet(table(noise(40, 3000))))
    assert columns.column("t_ns").to_pylist() == list(range(40))
    assert "data" not in columns._decoded.column_names
