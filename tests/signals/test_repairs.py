"""Held frames and what rate is left without them."""

import statistics

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tacpipe.signals.repairs import (
    BLOCK_VALUES,
    RANGE,
    count_wraps,
    hampel,
    mean_rate_hz,
    new_frame_rate_hz,
    repeated_rows,
)


def test_a_frame_is_held_only_if_every_channel_repeats() -> None:
    values = np.array([[1, 1], [1, 1], [1, 2], [1, 2], [2, 2]], dtype=np.uint16)
    assert repeated_rows(values).tolist() == [False, True, False, True, False]


def test_a_recording_of_one_frame_or_none_has_no_held_one() -> None:
    assert repeated_rows(np.zeros((1, 3))).tolist() == [False]
    assert repeated_rows(np.zeros((0, 3))).tolist() == []


def test_nan_is_never_held() -> None:
    assert not repeated_rows(np.full((3, 1), np.nan)).any()


def test_four_frames_at_40_hz_of_which_three_repeat_are_10_hz() -> None:
    t_ns = np.arange(41) * 25_000_000
    repeats = np.arange(41) % 4 != 0
    assert mean_rate_hz(t_ns) == pytest.approx(40.0)
    assert new_frame_rate_hz(t_ns, repeats) == pytest.approx(10.0)


@pytest.mark.parametrize("t_ns", [[], [5], [5, 5]])
def test_a_rate_needs_two_moments(t_ns: list[int]) -> None:
    assert mean_rate_hz(np.array(t_ns, dtype=np.int64)) == 0.0


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


def test_spikes_are_the_same_in_blocks_of_any_size() -> None:
    values = np.random.default_rng(1).integers(0, 2000, (BLOCK_VALUES // 2, 3)).astype(np.int32)
    in_blocks = hampel(values, 7, 1.0, 50.0)
    for row in (0, *range(997, len(values), len(values) // 9)):
        part = hampel(values[max(0, row - 50) : row + 50], 7, 1.0, 50.0)
        inner = slice(0 if row == 0 else 7, -7)
        for expected, values_in_blocks in zip(part, in_blocks, strict=True):
            np.testing.assert_array_equal(values_in_blocks[max(0, row - 50) : row + 50][inner], expected[inner])
    assert in_blocks[0].any()


steps = hnp.arrays(np.int32, st.integers(1, 60), elements=st.integers(-32_767, 32_767))


def unwrap(values: np.ndarray) -> np.ndarray:
    wide = values.astype(np.int32)
    wide[1:] += RANGE * np.cumsum(count_wraps(wide), dtype=np.int32)
    return wide


@given(st.integers(0, 65_535), steps)
def test_a_walk_that_was_cut_to_16_bits_comes_back(first: int, moved: np.ndarray) -> None:
    walk = first + np.cumsum(moved) - moved[0]
    restored = unwrap(walk.astype(np.uint16))
    assert restored.tolist() == walk.tolist()
    np.testing.assert_array_equal(restored, np.unwrap((walk % 65_536).astype(np.int64), period=65_536))
    signed = unwrap((walk - 32_768).astype(np.int16))
    np.testing.assert_array_equal(signed, walk - 32_768)


@pytest.mark.parametrize("kind", ["uint16", "int16"])
def test_what_never_wraps_has_no_wraps(kind: str) -> None:
    values: np.ndarray = np.array([100, 30_000, 12, 32_767], dtype=kind)
    assert not count_wraps(values.astype(np.int32)).any()


def test_a_wide_range_without_a_jump_is_no_wrap() -> None:
    values = np.arange(0, 65_536, 16_384, dtype=np.uint16)
    assert not count_wraps(values.astype(np.int32)).any()
