"""Columns of a stream that are decoded some at a time are those of its table."""

from __future__ import annotations

from random import Random

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import DamagedError
from tacpipe.io.columns import Columns
from tacpipe.io.parquet import from_parquet, to_parquet
from tests.any_table import bits, tables


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
