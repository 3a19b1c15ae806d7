import io
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.errors import DamagedError
from tacpipe.tables import from_parquet, to_parquet, with_metadata

types = [pa.uint8(), pa.uint16(), pa.int16(), pa.int32(), pa.int64(), pa.float32(), pa.float64(), pa.bool_()]


@st.composite
def tables(draw: st.DrawFn) -> pa.Table:
    rows = draw(st.integers(0, 30))
    columns = {}
    for position, kind in enumerate(draw(st.lists(st.sampled_from(types), min_size=1, max_size=6))):
        raw = np.array(draw(st.lists(st.integers(0, 200), min_size=rows, max_size=rows)), dtype=np.int64)
        columns[f"channel{position}"] = (
            pa.array(raw).cast(kind, safe=False) if kind != pa.bool_() else pa.array(raw > 9)
        )
    return pa.table(columns)


@given(tables())
@settings(deadline=None, max_examples=50)
def test_a_table_comes_back_as_it_was_written_with_its_types(table: pa.Table) -> None:
    assert from_parquet(to_parquet(table)).equals(table)


@given(tables())
@settings(deadline=None, max_examples=20)
def test_the_same_table_gives_the_same_bytes(table: pa.Table) -> None:
    assert to_parquet(table) == to_parquet(pa.Table.from_batches(table.to_batches(), table.schema))


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
