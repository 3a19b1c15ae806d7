"""Spikes: against the identifier written out for one reading, and what must not be touched."""

from __future__ import annotations

import statistics

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tacpipe.signals.repairs import hampel


def spike(values: list[int], row: int, deviations: float, floor: float) -> bool:
    """Return whether the row, which is far from both ends, is a spike among seven rows by definition."""
    window = values[row - 3 : row + 4]
    middle = statistics.median(window)
    spread = 1.4826 * statistics.median([abs(value - middle) for value in window])
    return abs(values[row] - middle) > max(deviations * spread, floor)


@given(hnp.arrays(np.uint16, st.integers(7, 30), elements=st.integers(0, 40)), st.floats(0, 20), st.floats(0.5, 5))
def test_a_spike_is_one_by_the_book(values: np.ndarray, floor: float, deviations: float) -> None:
    flagged, repaired = hampel(values[:, None], 7, deviations, floor)
    for row in range(3, len(values) - 3):
        assert flagged[row, 0] == spike(values.tolist(), row, deviations, floor)
        expected = statistics.median(values[row - 3 : row + 4].tolist()) if flagged[row, 0] else values[row]
        assert repaired[row, 0] == expected


@pytest.mark.parametrize("row", [0, 1, 15, 29])
def test_a_glitch_is_mended_wherever_it_stands_and_its_type_stays(row: int) -> None:
    values = np.random.default_rng(0).integers(10, 30, (30, 4)).astype(np.uint16)
    broken = values.copy()
    broken[row, 2] = 3425
    flagged, repaired = hampel(broken, 7, 5.0, 255.0)
    assert np.argwhere(flagged).tolist() == [[row, 2]]
    assert 10 <= repaired[row, 2] < 30
    assert repaired.dtype == np.uint16
    assert np.array_equal(np.delete(repaired.ravel(), row * 4 + 2), np.delete(values.ravel(), row * 4 + 2))
    assert broken[row, 2] == 3425  # The input is not changed


def test_steps_of_a_flat_signal_are_none() -> None:
    values = np.zeros((40, 1), dtype=np.uint16)
    values[20] = 1  # the deviations of its neighbours are 0
    assert hampel(values, 7, 5.0, 0.0)[0].sum() == 1
    assert not hampel(values, 7, 5.0, 1.0)[0].any()


def test_an_edge_of_a_step_is_no_spike() -> None:
    values = np.r_[np.zeros(20), np.full(20, 900.0)][:, None]
    assert not hampel(values, 7, 5.0, 255.0)[0].any()


@pytest.mark.parametrize(("rows", "length"), [(1, 10), (7, 3), (7, 1), (7, 0)])
def test_without_neighbours_there_is_nothing_to_compare_with(rows: int, length: int) -> None:
    values = np.arange(length, dtype=np.float64)[:, None] * 1000
    flagged, repaired = hampel(values, rows, 5.0, 0.0)
    assert not flagged.any()
    assert np.array_equal(repaired, values)


def test_spikes_are_the_same_in_blocks_of_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(1).integers(0, 2000, (211, 3)).astype(np.int32)
    whole = hampel(values, 7, 1.0, 50.0)
    monkeypatch.setattr("tacpipe.signals.repairs.BLOCK_VALUES", 5)
    for expected, in_blocks in zip(whole, hampel(values, 7, 1.0, 50.0), strict=True):
        np.testing.assert_array_equal(in_blocks, expected)
    assert whole[0].any()
