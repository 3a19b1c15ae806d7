import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.codecs import codec, pca
from tacpipe.codecs.measures import Moments
from tacpipe.errors import TacpipeError

CHANNELS = [f"c{index}" for index in range(6)]
WALKS = np.cumsum(np.random.default_rng(2).normal(size=(4, 30, 6)), axis=1) * 20  # (window, time, channel)


def latents_and_codec(representation: str) -> tuple[np.ndarray, codec.Codec]:
    levels = np.concatenate(WALKS)
    rows = np.concatenate(np.diff(WALKS, axis=1)) if representation == "increments" else levels
    fitted = pca.fit(Moments.from_pieces([rows], 6), CHANNELS, [], components=6, representation=representation)
    return np.stack([fitted.encode(walk, CHANNELS) for walk in WALKS]), fitted


def test_latents_of_increments_are_added_up_onto_the_last_frame() -> None:
    latents, fitted = latents_and_codec("increments")
    decoded = codec.decode_ahead(fitted, latents[:, 20:], WALKS[:, 19])
    assert np.allclose(decoded, WALKS[:, 20:], atol=1e-2)


def test_latents_of_levels_are_counts_whatever_the_last_frame_was() -> None:
    latents, fitted = latents_and_codec("levels")
    decoded = codec.decode_ahead(fitted, latents[:, 20:], np.full((4, 6), 1e6))
    assert np.allclose(decoded, WALKS[:, 20:], atol=1e-2)


def test_channels_themselves_are_levels_and_stay() -> None:
    raw = codec.Raw(tuple(CHANNELS), ())
    assert raw.representation == "levels"
    assert np.array_equal(raw.encode(WALKS[0], CHANNELS, np.ones(30, dtype=bool)), WALKS[0].astype(np.float32))
    assert np.array_equal(codec.decode_ahead(raw, WALKS, WALKS[:, 0]), WALKS)


def test_only_finite_rows_are_projected() -> None:
    projected = []

    def project(rows: np.ndarray) -> np.ndarray:
        projected.append(rows)
        return rows[:, :1]

    latents = codec.encode_finite(project, np.array([[1.0, 2.0], [np.nan, 3.0], [4.0, np.inf], [5.0, 6.0]]), 1)
    assert np.array_equal(latents, np.array([[1.0], [np.nan], [np.nan], [5.0]]), equal_nan=True)
    assert np.array_equal(projected[0], [[1.0, 2.0], [5.0, 6.0]])


def by_hand(values: np.ndarray, begins: np.ndarray, representation: str, frames: int) -> np.ndarray:
    """Walk row by row with what a live reader would remember."""
    inputs = []
    frames_kept: list[np.ndarray] = []
    before = values[0]
    for row, begin in zip(values, begins, strict=True):
        if begin:
            frames_kept, before = [], row
        now = row - before if representation == "increments" else row
        frames_kept = [*(frames_kept or [now] * frames), now][-frames:]
        before = row
        inputs.append(np.concatenate(frames_kept))
    return np.array(inputs)


@given(st.integers(0, 2**16), st.sampled_from(["levels", "increments"]), st.integers(1, 3))
@settings(max_examples=40, deadline=None)
def test_inputs_are_those_of_a_reader_that_walks_row_by_row(seed: int, representation: str, frames: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(12, 2))
    begins = rng.random(12) < 0.3
    begins[0] = True
    assert np.allclose(
        codec.codec_inputs(values, begins, representation, frames), by_hand(values, begins, representation, frames)
    )


@given(st.integers(0, 2**16), st.sampled_from(["levels", "increments"]), st.integers(1, 3))
@settings(max_examples=40, deadline=None)
def test_rows_in_pieces_give_the_inputs_of_the_whole(seed: int, representation: str, frames: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(12, 2))
    values[rng.random((12, 2)) < 0.1] = np.nan
    begins = rng.random(12) < 0.3
    cuts = [0, *sorted(rng.integers(0, 13, 4).tolist()), 12]
    stacking = codec.Stacking(representation, frames)
    pieces = [stacking.next(values[start:stop], begins[start:stop]) for start, stop in itertools.pairwise(cuts)]
    expected = codec.codec_inputs(values, begins, representation, frames)
    assert np.array_equal(np.concatenate(pieces), expected, equal_nan=True)


def test_later_rows_change_nothing_before_them() -> None:
    values = np.random.default_rng(0).normal(size=(10, 3))
    changed = values.copy()
    changed[6:] += 100
    for representation in ("levels", "increments"):
        for frames in (1, 2, 3):
            first_inputs, second_inputs = (
                codec.codec_inputs(counts, None, representation, frames) for counts in (values, changed)
            )
            assert np.array_equal(first_inputs[:6], second_inputs[:6])
            assert not np.array_equal(first_inputs[6:], second_inputs[6:])


def test_a_stretch_begins_after_a_step_of_more_than_one_and_a_half_times_the_median() -> None:
    t_ns = np.cumsum([0, 20, 20, 29, 20, 31, 20]).astype(np.int64) * 1_000_000
    assert codec.run_starts(t_ns).nonzero()[0].tolist() == [0, 5]
    assert codec.run_starts(t_ns[:1]).tolist() == [True]
    assert codec.run_starts(t_ns[:0]).tolist() == []


def test_no_rows_give_no_inputs_of_the_right_width() -> None:
    assert codec.codec_inputs(np.zeros((0, 4)), None, "increments", 3).shape == (0, 12)


def test_another_kind_of_value_is_refused() -> None:
    with pytest.raises(TacpipeError, match="representation is 'speed'"):
        codec.codec_inputs(np.zeros((2, 1)), None, "speed", 1)
