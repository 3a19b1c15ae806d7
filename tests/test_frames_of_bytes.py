"""Columns of bytes, as a camera's encoded frames, in the store's Parquet files."""

from __future__ import annotations

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tacpipe.io import parquet
from tacpipe.io.columns import Columns
from tacpipe.io.parquet import from_parquet, to_parquet


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
