"""The published arrangement: against its formula, entry by entry, and there and back."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tacpipe.formats.roboskin import is_time, scramble, unscramble
from tests.formats.slide_files import touched

slides = hnp.arrays(np.float32, hnp.array_shapes(min_dims=3, max_dims=5, max_side=7), elements=st.floats(width=32))


@given(slides)
def test_both_ways_undo_each_other_to_the_bit(given_slides: np.ndarray) -> None:
    for forward, backward in ((scramble, unscramble), (unscramble, scramble)):
        assert backward(forward(given_slides)).tobytes() == np.ascontiguousarray(given_slides).tobytes()
        assert forward(given_slides).shape == given_slides.shape


@given(st.integers(1, 7), st.integers(1, 4), st.integers(1, 9))
def test_each_reading_goes_where_the_formula_says(triangles: int, taxels: int, frames: int) -> None:
    readings = np.random.default_rng(0).random((2, triangles, taxels, frames))
    scrambled = scramble(readings)
    for row in range(triangles):
        for place in range(frames):
            turn = frames * row + place
            assert np.array_equal(scrambled[:, row, :, place], readings[:, turn % triangles, :, turn // triangles])


def test_what_is_scrambled_has_no_time_axis_and_what_is_not_has() -> None:
    for slide in touched(20):
        assert is_time(slide, -1)
        assert not is_time(scramble(slide), -1)
        assert is_time(unscramble(scramble(slide)), -1)
