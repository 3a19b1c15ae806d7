"""Compare the moments of chunks of rows with those that numpy computes from all rows."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.codecs.codec import INCREMENTS, LEVELS
from tacpipe.codecs.measures import Moments, mean_and_scale
from tacpipe.errors import TacpipeError


def rows(seed: int, count: int = 200) -> np.ndarray:
    """Return rows of five channels: of unlike levels and spreads, two of them alike, and one that never moves."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(count, 5)) * [1, 1000, 1e-3, 30, 0] + [0, 20_000, 5, -300, 7]
    values[:, 3] = values[:, 1] * 2 + rng.normal(size=count)
    return np.asarray(values)


@given(st.integers(0, 2**16), st.sampled_from([LEVELS, INCREMENTS]))
@settings(max_examples=40, deadline=None)
def test_moments_of_pieces_are_those_of_all_rows(seed: int, representation: str) -> None:
    values, rng = rows(seed), np.random.default_rng(seed)
    cuts = [0, *sorted(rng.integers(0, 201, 5).tolist()), 200]
    moments = Moments.from_pieces((values[start:stop] for start, stop in itertools.pairwise(cuts)), 5)

    mean, scale = mean_and_scale(values, representation)
    assert moments.count == 200
    assert moments.varies.tolist() == [True, True, True, True, False]
    for ours, theirs in zip(moments.mean_and_scale(representation), (mean, scale), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-11)
    triangle, scaled = moments.standardised_triangle(representation), (values - mean) / scale
    np.testing.assert_allclose(triangle.T @ triangle, scaled.T @ scaled, rtol=1e-9, atol=1e-9 * len(values))


def test_moments_of_two_parts_are_those_of_both_together() -> None:
    values = rows(1)
    merged = Moments.from_pieces([values[:50]], 5).merge(Moments.from_pieces([values[50:]], 5))
    np.testing.assert_allclose(
        np.abs(merged.centred_triangle), np.abs(Moments.from_pieces([values], 5).centred_triangle), rtol=1e-9, atol=1e-9
    )
    assert merged.merge(Moments(5)).count == 200


def test_rows_of_which_no_channel_moves_have_no_scale() -> None:
    with pytest.raises(TacpipeError, match="None of the 2 tactile channels changes in 3 training rows"):
        Moments.from_pieces([np.full((3, 2), 0.1)], 2).mean_and_scale(LEVELS)
