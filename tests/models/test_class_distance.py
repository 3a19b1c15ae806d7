"""The distance to classes: a slide of another texture is further from all than one of a texture that was learned."""

from __future__ import annotations

import numpy as np

from tacpipe.metrics import calibration
from tacpipe.models.minirocket import with_profile
from tacpipe.models.readout import statistics
from tacpipe.tasks.material.sensor_calibration import ClassDistance


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
    far_slides, _ = slides((12,), 20, 2)
    assert calibration.auroc(scores.max(axis=1), fitted.scores(far_slides).max(axis=1)) > 0.95


def test_a_slide_far_from_all_training_slides_scores_lower_than_each_slide_of_a_learned_class() -> None:
    fitted = ClassDistance.fit(*slides((0, 2, 5), 60, 0))
    learned = fitted.scores(slides((0, 2, 5), 20, 1)[0]).max(axis=1)
    for kind in (100, 1000, 10_000):
        assert fitted.scores(slides((kind,), 20, 2)[0]).max() < learned.min()


def test_no_direction_counts_more_in_the_distance_to_all_slides_than_in_the_distance_to_a_class() -> None:
    fitted = ClassDistance.fit(*slides((0, 2, 5), 60, 0))
    assert np.linalg.norm(fitted.overall, 2) <= 1 + 1e-9  # else a slide far enough in that direction scores highest


def test_the_score_of_a_class_compares_distances_to_all_slides_to_its_mean_and_to_its_nearest_slide() -> None:
    learned, labels = slides((0, 2, 5), 60, 0)
    fitted = ClassDistance.fit(learned, labels)

    def components(frames: np.ndarray) -> np.ndarray:
        features = np.hstack([statistics(frames), fitted.patterns.transform(with_profile(frames))])
        return (features - fitted.centre) @ fitted.projection  # (slide, component)

    frames, _ = slides((2,), 1, 1)
    plain_training, (plain,) = components(learned), components(frames)
    training, slide = plain_training * fitted.gain, plain * fitted.gain
    means = np.stack([training[labels == kind].mean(axis=0) for kind in (0, 2, 5)])
    deviations = np.concatenate([training[labels == kind] - mean for kind, mean in zip((0, 2, 5), means, strict=True)])
    assert 0.5 < np.square(deviations).sum(axis=1).mean() / len(slide) < 1.2  # about the number of components
    to_all = slide @ np.linalg.inv(np.eye(len(slide)) + np.cov(means.T)) @ slide
    expected = [
        np.log(to_all * np.linalg.norm(plain))
        - np.log(np.square(slide - mean).sum())
        - np.log(np.square(slide - training[labels == kind]).sum(axis=1).min())
        - np.log(np.square(plain - plain_training[labels == kind]).sum(axis=1).min())
        for kind, mean in zip((0, 2, 5), means, strict=True)
    ]
    np.testing.assert_allclose(fitted.scores(frames)[0], expected, rtol=1e-6)


def test_training_slides_themselves_have_a_finite_score() -> None:
    frames, labels = slides((0, 5), 10, 0)
    assert np.isfinite(ClassDistance.fit(frames, labels).scores(frames)).all()


def test_tensors_give_back_the_distance() -> None:
    frames, labels = slides((0, 5), 10, 0)
    fitted = ClassDistance.fit(frames, labels)
    assert (ClassDistance.from_tensors(fitted.to_tensors()).scores(frames) == fitted.scores(frames)).all()
