"""A dataset gives back to the bit what was put into it, and its files give it to other programs."""

import math
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import tacpipe
from tacpipe.errors import UsageError
from tacpipe.io.hashing import bytes_digest
from tacpipe.io.parquet import to_parquet
from tacpipe.store.store import Store
from tests.any_table import bits, tables
from tests.fake_recordings import publish_dataset

drawn = settings(
    deadline=None, max_examples=25, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
streams = st.dictionaries(st.sampled_from(["left", "right", "robot_state"]), tables(columns=3), min_size=1, max_size=2)


@contextmanager
def publish_temporarily(recordings: Mapping[str, Mapping[str, pa.Table]]) -> Iterator[Path]:
    """Give the directory of a dataset that holds these recordings, stream by stream."""
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder) / ".tacpipe")
        publish_dataset(store, Path(folder) / "data", recordings)
        yield Path(folder) / "data"


@given(st.dictionaries(st.sampled_from(["trial-000", "trial-001"]), streams, min_size=1, max_size=2))
@drawn
def test_every_table_comes_out_of_a_dataset_as_it_went_in_to_the_bit(
    recordings: dict[str, dict[str, pa.Table]],
) -> None:
    with publish_temporarily(recordings) as path:
        dataset = tacpipe.open(path)
        assert set(dataset.recordings) == set(recordings)
        for name, tables in recordings.items():
            assert dataset.recordings[name].streams == tuple(sorted(tables))
            for stream, table in tables.items():
                assert bits(dataset.recordings[name].table(stream)) == bits(table)


@given(tables(columns=4))
@drawn
def test_pandas_and_duckdb_read_the_values_that_were_written(table: pa.Table) -> None:
    if not table.num_columns:
        return  # duckdb knows no table without columns
    with publish_temporarily({"trial-000": {"": table}}) as path:
        file = path / "trial-000.parquet"
        assert file.read_bytes() == to_parquet(table)
        frame = pd.read_parquet(file, dtype_backend="pyarrow")
        assert bits(pa.Table.from_pandas(frame, schema=table.schema)) == bits(table)
        rows = duckdb.execute(f"select * from '{file}'").fetchall()
        values = [plain(column) for column in zip(*rows, strict=True)] or [[]] * table.num_columns
        assert values == [plain(column.to_pylist()) for column in table.columns]


def plain(values: Any) -> list[Any]:
    """Return values so that NaN equals itself and zeros keep their sign."""
    return [repr(value) if isinstance(value, float) else value for value in values]


@given(tables(columns=3), st.integers(0, 1000))
@drawn
def test_all_recordings_in_one_table_are_the_recordings_one_after_another(table: pa.Table, seed: int) -> None:
    first = table.rename_columns([f"c{place}" for place in range(table.num_columns)])
    sizes = np.random.default_rng(seed).integers(0, first.num_rows + 1, 4)
    recordings = {f"trial-{place:03d}": {"": first.slice(0, int(size))} for place, size in enumerate(sizes)}
    with publish_temporarily(recordings) as path:
        joined = tacpipe.open(path).table()
        assert joined["recording"].to_pylist() == [
            name for name, tables in recordings.items() for _ in range(tables[""].num_rows)
        ]
        expected = pa.concat_tables([tables[""] for tables in recordings.values()])
        bare = [(name, kind, values) for name, kind, _, values in bits(expected)]
        assert [(name, kind, values) for name, kind, _, values in bits(joined.drop_columns(["recording"]))] == bare


@given(st.integers(1, 5), st.integers(0, 30), st.integers(0, 1000))
@drawn
def test_arrays_and_tensors_hold_the_columns_that_were_asked_for_in_their_order(
    columns: int, rows: int, seed: int
) -> None:
    values = np.random.default_rng(seed).normal(size=(rows, columns))  # (time, channel)
    table = pa.table({f"c{place}": values[:, place] for place in range(columns)})
    order = [f"c{place}" for place in np.random.default_rng(seed).permutation(columns)]
    with publish_temporarily({"trial-000": {"": table}}) as path:
        dataset = tacpipe.open(path)
        expected = values[:, [int(name[1:]) for name in order]]
        arrays, tensors = dataset.to_numpy(columns=order)["trial-000"], dataset.to_torch(columns=order)["trial-000"]
        assert arrays.columns == tensors.columns == tuple(order)
        assert arrays.values.tobytes() == tensors.values.numpy().tobytes() == expected.tobytes()
        assert arrays.t_ns is None and tensors.t_ns is None
        assert dataset.to_numpy()["trial-000"].values.shape == (rows, columns)


def exactly(array: Any) -> list[Any]:
    """Return the values of an array (time,) or of a frame's column as Python has them, None where one is masked."""
    values = array.tolist()
    if np.ma.isMaskedArray(array):
        values = [None if hidden else value for value, hidden in zip(values, np.ma.getmaskarray(array), strict=True)]
    return [None if value is pd.NA or (isinstance(value, float) and math.isnan(value)) else value for value in values]


def as_stored(column: pa.ChunkedArray) -> list[Any]:
    """Return the values of a column, where neither null nor NaN is a number."""
    return [None if isinstance(value, float) and math.isnan(value) else value for value in column.to_pylist()]


@given(tables(columns=5))
@drawn
def test_no_value_that_is_read_differs_from_that_of_the_file(table: pa.Table) -> None:
    with publish_temporarily({"trial-000": {"": table}}) as path:
        dataset, expected = tacpipe.open(path), {name: as_stored(table[name]) for name in table.column_names}
        frame, arrays = dataset.to_pandas(), dataset.to_numpy()["trial-000"]
        assert {name: exactly(frame[name]) for name in expected} == expected
        assert {name: exactly(array) for name, array in arrays.by_column.items()} == expected
        for name, array in arrays.by_column.items():
            assert (
                pa.types.is_string(table.schema.field(name).type)
                or array.dtype == table.schema.field(name).type.to_pandas_dtype()
            ), name
        assert not {"t_ns", "t_device_ns", "seq"} & set(arrays.columns)
        try:
            values = arrays.values
        except UsageError:
            wide = [value for name in arrays.columns if arrays[name].dtype.kind in "iu" for value in expected[name]]
            assert any(abs(value) > 2**53 for value in wide if value is not None)
            return
        assert {name: exactly(values[:, at]) for at, name in enumerate(arrays.columns)} == {
            name: expected[name] for name in arrays.columns
        }


def test_a_signalling_nan_is_nan_in_the_type_that_all_channels_share() -> None:
    signalling = np.array([0x7F800001], "<u4").view(np.float32)
    table = pa.table({"x": pa.array([7], pa.int32()), "y": pa.array(signalling)})
    with publish_temporarily({"trial-000": {"": table}}) as path:
        values = tacpipe.open(path).to_numpy()["trial-000"].values
    assert values.dtype == np.float64 and values[0, 0] == 7 and np.isnan(values[0, 1])


def test_times_stay_whole_nanoseconds_beside_channels_of_floats() -> None:
    t_ns = 1_763_782_179_000_000_000 + 20_000_001 * np.arange(5)  # (time,)
    table = pa.table(
        {"t_ns": t_ns, "x": pa.array(np.linspace(0, 1, 5), pa.float32()), "y": np.arange(5, dtype=np.uint16)}
    )
    assert (t_ns.astype(np.float64).astype(np.int64) != t_ns).any()  # A matrix with the times in it would hold these.
    with publish_temporarily({"trial-000": {"": table}}) as path:
        arrays, tensors = (read()["trial-000"] for read in (tacpipe.open(path).to_numpy, tacpipe.open(path).to_torch))
        assert arrays.t_ns is not None and tensors.t_ns is not None
        assert arrays.t_ns.dtype == np.int64 and arrays.t_ns.tolist() == tensors.t_ns.tolist() == t_ns.tolist()
        assert arrays.columns == ("x", "y") and arrays.values.dtype == np.float32
        assert arrays["y"].dtype == np.uint16


def test_masks_labels_and_counters_are_read_by_name_and_are_no_channels() -> None:
    label = pa.field("contact", pa.int32(), metadata={"quantity": "label"})
    unread = [pa.field("x_gap", pa.bool_()), pa.field("seq", pa.int64()), pa.field("gt_force_n", pa.float64())]
    fields = pa.schema([pa.field("x", pa.int16()), label, *unread])
    table = pa.table([[1, 2], [-1, 0], [True, False], [2**62, 2**62 + 1], [0.5, 1.5]], schema=fields)
    with publish_temporarily({"trial-000": {"": table}}) as path:
        arrays = tacpipe.open(path).to_numpy()["trial-000"]
        assert arrays.columns == ("x",) and arrays.values.tolist() == [[1], [2]] and arrays.values.dtype == np.int16
        assert arrays["contact"].tolist() == [-1, 0] and arrays["x_gap"].tolist() == [True, False]
        assert arrays["seq"].tolist() == [2**62, 2**62 + 1]


def test_an_integer_channel_that_a_matrix_of_floats_would_round_is_refused_there_and_read_alone() -> None:
    table = pa.table({"wide": [2**53 + 1, 0], "x": [0.5, 1.0]})
    with publish_temporarily({"trial-000": {"": table}}) as path:
        arrays = tacpipe.open(path).to_numpy()["trial-000"]
        with pytest.raises(UsageError, match=r"wide \(int64\) holds integers beyond 2\^53.*arrays\['wide'\]"):
            _ = arrays.values
        assert arrays["wide"].tolist() == [2**53 + 1, 0]
        assert tacpipe.open(path).to_numpy(columns=["wide"])["trial-000"].values.tolist() == [[2**53 + 1], [0]]


def test_integers_that_some_recordings_lack_stay_integers_in_one_frame() -> None:
    table = pa.table({"t_ns": [1], "t_device_ns": [2**60 + 1]})
    with publish_temporarily({"trial-000": {"": table}, "trial-001": {"": table.select(["t_ns"])}}) as path:
        frame = tacpipe.open(path).to_pandas()
        assert frame["t_device_ns"].tolist() == [2**60 + 1, pd.NA]


@pytest.mark.parametrize("rows", [(1 << 20) - 1, 1 << 20, (1 << 20) + 1])
def test_more_rows_than_a_group_holds_come_back(rows: int) -> None:
    table = pa.table({"t_ns": np.arange(rows), "x": pa.array(np.arange(rows) % 251, pa.uint8())})
    cut = pa.concat_tables([table.slice(0, 700_001), table.slice(700_001)])
    with publish_temporarily({"trial-000": {"": table}}) as path:
        assert tacpipe.open(path).recordings["trial-000"].table().equals(table)
        groups = pq.ParquetFile(path / "trial-000.parquet").metadata.num_row_groups
        assert groups == math.ceil(rows / (1 << 20))
        (name,) = tacpipe.open(path).recordings["trial-000"].digests.values()
    assert bytes_digest(to_parquet(cut)) == name
