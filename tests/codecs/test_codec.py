from __future__ import annotations

import numpy as np

from tacpipe.codecs import codec, pca
from tacpipe.codecs.measures import Moments

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
