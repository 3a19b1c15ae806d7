"""Counters that ran over their end."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tacpipe.signals.repairs import unwrap

steps = hnp.arrays(np.int32, st.integers(1, 60), elements=st.integers(-32_767, 32_767))


@given(st.integers(0, 65_535), steps)
def test_a_walk_that_was_cut_to_16_bits_comes_back(first: int, moved: np.ndarray) -> None:
    walk = first + np.cumsum(moved) - moved[0]
    restored = unwrap(walk.astype(np.uint16))
    assert restored.tolist() == walk.tolist()
    np.testing.assert_array_equal(restored, np.unwrap((walk % 65_536).astype(np.int64), period=65_536))
    signed = unwrap((walk - 32_768).astype(np.int16))
    np.testing.assert_array_equal(signed, walk - 32_768)


@pytest.mark.parametrize("kind", ["uint16", "int16"])
def test_what_never_wraps_is_the_same_array(kind: str) -> None:
    values: np.ndarray = np.array([100, 30_000, 12, 32_767], dtype=kind)
    assert unwrap(values) is values
    assert unwrap(values[:0]).dtype == kind


def test_a_wide_range_without_a_jump_is_no_wrap() -> None:
    values = np.arange(0, 65_536, 16_384, dtype=np.uint16)
    assert unwrap(values) is values
