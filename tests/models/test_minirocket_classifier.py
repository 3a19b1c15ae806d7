"""The strong classifier tells textures apart that have the same level, and levels where these tell."""

from __future__ import annotations

import numpy as np
import pytest
from safetensors.numpy import load, save

from tacpipe.errors import TacpipeError
from tacpipe.models.minirocket import MinirocketClassifier
from tacpipe.models.readout import Level

PATTERNS = 84 * 6


def textured(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return slides over ridges 6, 9 or 14 frames apart, at a pressure that says nothing, and labels 3, 4 and 20."""
    rng = np.random.default_rng(seed)
    index = np.arange(count) % 3
    period = np.array([6.0, 9.0, 14.0])[index]
    phase = 2 * np.pi * (np.arange(60)[None, :] / period[:, None] + rng.random((count, 1)))
    gains = rng.uniform(2, 6, (count, 1, 5))
    x = rng.uniform(20, 60, (count, 1, 5)) + gains * np.sin(phase)[..., None] + rng.normal(size=(count, 60, 5))
    return x.astype(np.float32), np.array([3, 4, 20])[index]


def press(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return slides of noise alone whose pressure on five channels tells the class."""
    rng = np.random.default_rng(seed)
    labels = np.arange(count) % 4
    contact = np.array([[1, 1, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 1, 1, 0], [0, 0, 0, 1, 1]])[labels]
    root = 5 + 3 * contact[:, None] + rng.normal(size=(count, 1, 5)) + 3 * rng.normal(size=(count, 60, 5))
    x = np.square(root)
    return x.astype(np.float32), labels


def test_textures_are_told_apart_where_levels_say_nothing() -> None:
    x, labels = textured(60)
    new, truth = textured(90, seed=1)
    fitted = MinirocketClassifier.fit(x, labels, features=PATTERNS)
    assert fitted.classes.tolist() == [3, 4, 20]
    assert fitted.scores(new).shape == (90, 3)
    assert np.mean(fitted.predict(new) == truth) > 0.9
    assert np.mean(Level.fit(x, labels).predict(new) == truth) < 0.6


def test_strength_counts_where_it_tells_the_class() -> None:
    x, labels = press(80)
    new, truth = press(200, seed=1)
    fitted = MinirocketClassifier.fit(x, labels, features=PATTERNS)
    assert fitted.share == 1
    assert np.mean(fitted.predict(new) == truth) > 0.8


def test_shuffled_labels_are_learned_from_the_same_patterns_and_tell_nothing() -> None:
    x, labels = textured(60)
    new, truth = textured(300, seed=1)
    shuffled = np.random.default_rng(0).permutation(labels)
    fitted = MinirocketClassifier.fit(x, labels, features=PATTERNS)
    relabelled = fitted.with_labels(x, shuffled)
    assert np.mean(relabelled.predict(new) == truth) < 0.6
    fitted_alone = MinirocketClassifier.fit(x, shuffled, features=PATTERNS)
    assert np.array_equal(relabelled.scores(new), fitted_alone.scores(new))


def test_the_seed_decides_and_tensors_hold_everything() -> None:
    x, labels = textured(30)
    first, same, reseeded = (MinirocketClassifier.fit(x, labels, features=PATTERNS, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.scores(x), same.scores(x))
    assert not np.array_equal(first.scores(x), reseeded.scores(x))
    restored = MinirocketClassifier.from_tensors(load(save(first.to_tensors())))
    assert np.array_equal(restored.scores(x), first.scores(x))
    assert restored.share == first.share


def test_readings_below_zero_and_other_slides_are_handled() -> None:
    x, labels = textured(30)
    fitted = MinirocketClassifier.fit(x - 60, labels, features=PATTERNS)
    assert np.isfinite(fitted.scores(x - 60)).all()
    with pytest.raises(TacpipeError, match="do not fit the transform"):
        fitted.scores(x[:, :50])
