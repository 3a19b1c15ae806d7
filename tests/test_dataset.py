"""A dataset gives back to the bit what was put into it, and its files give it to other programs."""

from __future__ import annotations

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
from tacpipe import directory
from tacpipe.hashing import bytes_digest
from tacpipe.manifest import Manifest
from tacpipe.store import Store
from tacpipe.tables import to_parquet
from tests.any_table import bits, tables

drawn = settings(
    deadline=None, max_examples=25, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
streams = st.dictionaries(st.sampled_from(["left", "right", "robot_state"]), tables(columns=3), min_size=1, max_size=2)


@contextmanager
def published(recordings: Mapping[str, Mapping[str, pa.Table]]) -> Iterator[Path]:
    """Give the directory of a dataset that holds these recordings, stream by stream."""
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder) / ".tacpipe")
        store.prepare()
        entries = {
            name: {
                "attributes": {},
                "shards": {
                    stream: {**vars(store.put(to_parquet(table))), "rows": table.num_rows}
                    for stream, table in several.items()
                },
            }
            for name, several in recordings.items()
        }
        manifest = Manifest("scale", 1, recordings=entries)
        store.put(manifest.content)
        directory.publish(store, manifest, Path(folder) / "data")
        yield Path(folder) / "data"


@given(st.dictionaries(st.sampled_from(["trial-000", "trial-001"]), streams, min_size=1, max_size=2))
@drawn
def test_every_table_comes_out_of_a_dataset_as_it_went_in_to_the_bit(
    recordings: dict[str, dict[str, pa.Table]],
) -> None:
    with published(recordings) as path:
        dataset = tacpipe.open(path)
        assert set(dataset.shards) == set(recordings)
        for name, several in recordings.items():
            assert dataset.shards[name].streams == tuple(sorted(several))
            for stream, table in several.items():
                assert bits(dataset.shards[name].table(stream)) == bits(table)


@given(tables(columns=4))
@drawn
def test_pandas_and_duckdb_read_the_values_that_were_written(table: pa.Table) -> None:
    if not table.num_columns:
        return  # duckdb knows no table without columns
    with published({"trial-000": {"": table}}) as path:
        file = path / "trial-000.parquet"
        assert file.read_bytes() == to_parquet(table)
        frame = pd.read_parquet(file, dtype_backend="pyarrow")
        assert bits(pa.Table.from_pandas(frame, schema=table.schema)) == bits(table)
        rows = duckdb.execute(f"select * from '{file}'").fetchall()
        found = [plain(column) for column in zip(*rows, strict=True)] or [[]] * table.num_columns
        assert found == [plain(column.to_pylist()) for column in table.columns]


def plain(values: Any) -> list[Any]:
    """Return values so that NaN equals itself and zeros keep their sign."""
    return [repr(value) if isinstance(value, float) else value for value in values]


@given(tables(columns=3), st.integers(0, 1000))
@drawn
def test_all_recordings_in_one_table_are_the_recordings_one_after_another(table: pa.Table, seed: int) -> None:
    first = table.rename_columns([f"c{place}" for place in range(table.num_columns)])
    sizes = np.random.default_rng(seed).integers(0, first.num_rows + 1, 4)
    recordings = {f"trial-{place:03d}": {"": first.slice(0, int(size))} for place, size in enumerate(sizes)}
    with published(recordings) as path:
        found = tacpipe.open(path).table()
        assert found["recording"].to_pylist() == [
            name for name, one in recordings.items() for _ in range(one[""].num_rows)
        ]
        wanted = pa.concat_tables([one[""] for one in recordings.values()])
        bare = [(name, kind, values) for name, kind, _, values in bits(wanted)]
        assert [(name, kind, values) for name, kind, _, values in bits(found.drop_columns(["recording"]))] == bare


@given(st.integers(1, 5), st.integers(0, 30), st.integers(0, 1000))
@drawn
def test_arrays_and_tensors_hold_the_columns_that_were_asked_for_in_their_order(
    columns: int, rows: int, seed: int
) -> None:
    values = np.random.default_rng(seed).normal(size=(rows, columns))  # (time, channel)
    table = pa.table({f"c{place}": values[:, place] for place in range(columns)})
    order = [f"c{place}" for place in np.random.default_rng(seed).permutation(columns)]
    with published({"trial-000": {"": table}}) as path:
        dataset = tacpipe.open(path)
        wanted = values[:, [int(name[1:]) for name in order]]
        assert dataset.to_numpy(columns=order)["trial-000"].tobytes() == wanted.tobytes()
        assert dataset.to_torch(columns=order)["trial-000"].numpy().tobytes() == wanted.tobytes()
        assert dataset.to_numpy()["trial-000"].shape == (rows, columns)


@pytest.mark.parametrize("rows", [(1 << 20) - 1, 1 << 20, (1 << 20) + 1])
def test_more_rows_than_a_group_holds_come_back(rows: int) -> None:
    table = pa.table({"t_ns": np.arange(rows), "x": pa.array(np.arange(rows) % 251, pa.uint8())})
    cut = pa.concat_tables([table.slice(0, 700_001), table.slice(700_001)])
    with published({"trial-000": {"": table}}) as path:
        assert tacpipe.open(path).shards["trial-000"].table().equals(table)
        groups = pq.ParquetFile(path / "trial-000.parquet").metadata.num_row_groups
        assert groups == math.ceil(rows / (1 << 20))
        (name,) = tacpipe.open(path).shards["trial-000"].digests.values()
    assert bytes_digest(to_parquet(cut)) == name
