"""Load and contact intervals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tacpipe.errors import TacpipeError
from tacpipe.signals.contact import axis_mean_level, contact_intervals, load, rest_level

MS = 1_000_000
loads = hnp.arrays(np.float64, st.integers(1, 80), elements=st.floats(0, 10))


def intervals(values: list[float], **params: float) -> list[list[int]]:
    given = {"on": 5.0, "off": 3.0, "min_s": 0.0, "merge_s": 0.0, "pad_s": 0.0} | params
    t_ns = np.arange(len(values)) * 10 * MS
    found: list[list[int]] = contact_intervals(np.array(values, dtype=np.float64), t_ns, **given).tolist()
    return found


def test_one_bad_frame_does_not_shift_the_rest_level() -> None:
    values = np.array([[100, 7], [9000, 7], [101, 7], [5000, 0]])
    assert rest_level(values, np.arange(4) * 100 * MS, rest_s=0.2).tolist() == [101.0, 7.0]
    assert rest_level(values, np.arange(4) * 100 * MS, rest_s=0.0).tolist() == [100.0, 7.0]


def test_the_load_is_the_mean_length_of_the_taxels_vectors() -> None:
    values = np.array([[3, 4, 0, 1, 2, 2]], dtype=np.uint16)
    assert load(values, np.zeros(6)).tolist() == [4.0]
    assert load(values, np.zeros(6), axes=1).tolist() == [2.0]


def test_channels_that_are_no_whole_taxels_are_refused() -> None:
    with pytest.raises(TacpipeError, match="4 tactile channels are not whole taxels of 3 axes"):
        load(np.zeros((1, 4)), np.zeros(4))


def test_by_the_axis_mean_all_taxels_begin_at_its_whole_part() -> None:
    values = np.random.default_rng(0).integers(14_000, 51_000, (5, 48)).astype(np.uint16)
    tared = values - axis_mean_level(values)
    means = values[0].reshape(16, 3).mean(axis=0)
    assert tared[0].reshape(16, 3).tolist() == [[int(mean) for mean in means]] * 16
    np.testing.assert_array_equal(np.diff(tared, axis=0), np.diff(values.astype(float), axis=0))
    with pytest.raises(TacpipeError, match="not whole taxels of 5 axes"):
        axis_mean_level(values, axes=5)
    with pytest.raises(TacpipeError, match="without rows"):
        axis_mean_level(values[:0])


def test_between_off_and_on_the_state_stays() -> None:
    assert intervals([4, 5, 4, 3, 2.9, 4, 5, 2]) == [[1, 4], [6, 7]]


def test_contact_that_never_ends_ends_with_the_recording() -> None:
    assert intervals([0, 9, 9]) == [[1, 3]]
    assert intervals([0, 0]) == []


def test_contacts_that_are_near_are_one_and_short_ones_go() -> None:
    assert intervals([9, 9, 0, 9, 9, 0, 0, 0, 9], merge_s=0.02, min_s=0.02) == [[0, 5]]


def test_padding_stops_at_the_ends_and_midway_to_the_next_contact() -> None:
    assert intervals([0, 9, 0, 0, 0, 9, 0], pad_s=10.0) == [[0, 3], [3, 7]]
    assert intervals([0, 0, 9, 0, 0], pad_s=0.01) == [[1, 4]]


def test_thresholds_the_wrong_way_round_are_refused() -> None:
    with pytest.raises(TacpipeError, match="off must lie between 0 and on"):
        intervals([0], on=1.0, off=2.0)


@given(loads, st.floats(0, 0.2), st.floats(0, 0.2))
def test_intervals_are_sorted_disjoint_and_hold_every_row_at_or_above_on(
    values: np.ndarray, merge_s: float, pad_s: float
) -> None:
    t_ns = np.arange(len(values)) * 10 * MS
    found = contact_intervals(values, t_ns, 5.0, 3.0, 0.0, merge_s, pad_s)
    flat = found.ravel()
    assert (np.diff(flat) >= 0).all()
    assert (found[:, 1] > found[:, 0]).all()
    inside = np.zeros(len(values), dtype=bool)
    for start, stop in found:
        inside[start:stop] = True
    assert inside[values >= 5.0].all()
