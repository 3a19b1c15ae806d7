"""Test that stored tactile channels give the same bits above rest as arrays, in half the memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.codecs import tactile
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.tracks import Levels

ROWS, REST = 50, (16000.3, 0.1)


def table(kind: pa.DataType) -> pa.Table:
    values = np.random.default_rng(0).integers(0, 200, (2, ROWS))
    fields = [
        pa.field(f"x{number}", kind, metadata={"quantity": "tactile", "rest": str(level)})
        for number, level in enumerate(REST)
    ]
    return pa.Table.from_arrays(
        [pa.array(values_of_channel).cast(kind) for values_of_channel in values], schema=pa.schema(fields)
    )


@pytest.mark.parametrize(
    ("kind", "bytes_each"), [(pa.float32(), 4), (pa.uint16(), 4), (pa.int32(), 8), (pa.float64(), 8)]
)
def test_every_index_gives_the_bits_that_an_array_gives(kind: pa.DataType, bytes_each: int) -> None:
    columns = table(kind)
    lazy, expected = tracks.above_rest(columns, ["x0", "x1"]), tactile.above_rest(columns, ["x0", "x1"])
    assert lazy.stored.nbytes == ROWS * 2 * bytes_each
    windows = np.arange(6)[:, None] + np.arange(4)
    for at in (slice(None), slice(3, 9), windows, np.arange(ROWS) > 7, (slice(None), [1, 0]), (windows[:, 0], 1)):
        assert np.array_equal(lazy[at], expected[at]) and lazy[at].dtype == np.float64
        assert np.array_equal(lazy.astype(np.float32)[at], expected[at].astype(np.float32))
    assert np.array_equal(lazy.rows_between(4, 20)[windows], expected[4:20][windows])
    assert np.array_equal(np.asarray(lazy), expected) and lazy.shape == expected.shape


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_row_with_a_level_that_is_not_finite_is_known_in_every_block(
    monkeypatch: pytest.MonkeyPatch, value: float
) -> None:
    monkeypatch.setattr(tracks, "BLOCK_ROWS", 7)
    stored: np.ndarray[Any, Any] = np.zeros((20, 3), np.float32)
    stored[[0, 6, 7, 19], [0, 1, 2, 0]] = value
    assert np.flatnonzero(~Levels(stored, np.zeros(3)).finite()).tolist() == [0, 6, 7, 19]
