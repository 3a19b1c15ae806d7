"""The distance to classes: a slide of another texture is further from all than one of a texture that was learned."""

from __future__ import annotations

import numpy as np

from tacpipe.metrics import calibration
from tacpipe.models.class_distance import NAMES, ClassDistance
from tacpipe.models.minirocket_classifier import with_profile
from tacpipe.models.statistics_classifier import statistics


def slides(kinds: tuple[int, ...], count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Slides (slide, time, channel) whose spread differs by kind, and their kinds (slide,)."""
    rng = np.random.default_rng(seed)
    labels = np.repeat(kinds, count)
    frames = rng.normal(20, 1, (len(labels), 30, 4)) + labels[:, None, None] * rng.normal(0, 1, (len(labels), 30, 4))
    return frames.astype(np.float32), labels


def test_the_nearest_class_is_the_slides_own_and_other_textures_are_far() -> None:
    fitted = ClassDistance.fit(*slides((0, 2, 5), 30, 0))
    frames, labels = slides((0, 2, 5), 20, 1)
    scores = fitted.scores(frames)
    assert (fitted.classes[scores.argmax(axis=1)] == labels).mean() > 0.95
    others, _ = slides((12,), 20, 2)
    assert calibration.auroc(scores.max(axis=1), fitted.scores(others).max(axis=1)) > 0.95


def test_the_distance_is_that_to_a_class_less_that_to_all_slides() -> None:
    frames, labels = slides((0, 2, 5), 60, 0)
    fitted = ClassDistance.fit(frames, labels)
    assert fitted.patterns is not None
    features = np.hstack([statistics(frames), fitted.patterns.transform(with_profile(frames))])
    placed = (features - fitted.centre) @ fitted.projection  # (slide, component), whitened within classes
    apart = placed - placed.mean(axis=0)
    overall = np.einsum("ij,jk,ik->i", apart, np.linalg.inv(np.cov(placed.T)), apart)
    own = np.square(placed - fitted.means[np.searchsorted(fitted.classes, labels)]).sum(axis=1)
    assert 0.5 < own.mean() / placed.shape[1] < 1.2  # about as much as there are components
    found = fitted.scores(frames)[np.arange(len(labels)), np.searchsorted(fitted.classes, labels)]
    np.testing.assert_allclose(found, (overall - own) / 2, rtol=1e-3, atol=1e-3)


def test_tensors_give_back_the_distance() -> None:
    frames, labels = slides((0, 5), 10, 0)
    fitted = ClassDistance.fit(frames, labels)
    assert (ClassDistance.from_tensors(fitted.to_tensors()).scores(frames) == fitted.scores(frames)).all()


def test_tensors_without_patterns_are_of_models_that_read_only_statistics() -> None:
    frames, labels = slides((0, 5), 10, 0)
    fitted = ClassDistance.fit(frames, labels)
    count = statistics(frames).shape[1]
    tensors = {name: tensor for name, tensor in fitted.to_tensors().items() if name in NAMES}
    tensors |= {"centre": fitted.centre[:count], "projection": fitted.projection[:count]}
    older = ClassDistance.from_tensors(tensors)
    placed = (statistics(frames) - older.centre) @ older.projection
    apart = np.square(placed[:, None] - older.means[None]).sum(axis=2)
    away = np.square((placed - older.middle) @ older.overall).sum(axis=1)[:, None]
    np.testing.assert_allclose(older.scores(frames), (away - apart) / 2, rtol=1e-6)
