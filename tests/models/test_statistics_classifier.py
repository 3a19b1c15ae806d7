"""Compare the statistics of slides with numpy's, and test their classifier."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from safetensors.numpy import load, save

from tacpipe.errors import TacpipeError
from tacpipe.models.readout import CHUNK, VIEWS, StatisticsClassifier, View, statistics, view_features

ACROSS = 6  # channels that describe all others at one moment


def rippled(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return slides of one level that ripple by little or by much, and labels 4 and 9."""
    rng = np.random.default_rng(seed)
    labels = np.array([4, 9])[np.arange(count) % 2]
    x = 50 + rng.normal(size=(count, 30, 3)) * np.where(labels == 4, 1, 6)[:, None, None]
    return (x - x.mean(axis=1, keepdims=True) + 50).astype(np.float32), labels


def press(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return slides that ripple alike at two levels, and labels 4 and 9."""
    rng = np.random.default_rng(seed)
    labels = np.array([4, 9])[np.arange(count) % 2]
    return (rng.normal(size=(count, 30, 3)) + np.where(labels == 4, 50, 80)[:, None, None]).astype(np.float32), labels


def test_every_statistic_of_a_channel_is_that_of_its_root() -> None:
    x = np.array([[[0, 1], [4, 1], [9, 1], [-16, 1], [0, 1], [25, 1]]], np.float32)  # (slide, time, channel)
    root = np.array([0, 2, 3, -4, 0, 5.0])
    steps = np.array([2, 1, 7, 4, 5])  # steps between successive roots, without their sign
    turns = np.array([1, 8, 11, 1])  # +2 +1 -7 +4 +5: changes of the step, without their sign
    expected = [
        root.mean(),
        np.sqrt(np.mean((root - root.mean()) ** 2)),
        steps.mean(),
        -2.0,  # quantile of the sorted -4 0 0 2 3 5, half-way from the first to the second: 0.1 of five steps
        0.0,
        1.0,
        2.75,
        4.0,
        -4.0,
        5.0,
        turns.mean() / steps.mean(),
        2 / 6,
        1.0,
        -0.5,
        2.5,
    ]
    values = statistics(x)[0].reshape(len(expected), 2 + ACROSS)
    np.testing.assert_allclose(values[:, 0], expected, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(values[:, 1], [1, 0, 0, 1, 1, 1, 1, 1, 1, 1, 0, 0, 1, 1, 1], atol=1e-7)


def test_six_channels_describe_all_others_at_each_moment() -> None:
    x = np.tile(np.array([[1.0, 4.0, 9.0, 16.0]], np.float32), (1, 5, 1))  # roots 1, 2, 3 and 4 at each moment
    means = statistics(x)[0, : 4 + ACROSS]
    np.testing.assert_allclose(means, [1, 2, 3, 4, 2.5, np.sqrt(1.25), 2.5, 3.25, 3.7, 4], rtol=1e-6)


def test_a_slide_has_the_same_statistics_however_many_are_read_at_once() -> None:
    x = np.random.default_rng(0).normal(size=(CHUNK + 3, 9, 2)).astype(np.float32)
    np.testing.assert_array_equal(statistics(x)[-2:], statistics(x[-2:]))


def test_a_slide_without_its_level_reads_alike_wherever_it_is_pressed() -> None:
    x = np.random.default_rng(0).normal(size=(2, 9, 3))
    lifted = x + np.array([0.0, 30.0, 500.0])
    np.testing.assert_allclose(view_features(lifted, "level_removed"), view_features(x, "level_removed"), atol=1e-5)
    assert np.abs(view_features(lifted, "level") - view_features(x, "level")).max() > 1


@pytest.mark.parametrize(("slides", "views"), [(rippled, ("all", "level_removed")), (press, ("all", "level"))])
def test_what_differs_in_level_or_in_ripple_is_classified_by_the_views_that_hold_it(
    slides: Callable[..., tuple[np.ndarray, np.ndarray]], views: tuple[View, ...]
) -> None:
    x, labels = slides(24)
    new, truth = slides(100, seed=1)
    for view in views:
        assert np.mean(StatisticsClassifier.fit(x, labels, view=view).predict(new) == truth) > 0.95


def test_what_differs_in_level_alone_is_not_classified_once_the_level_is_removed() -> None:
    x, labels = press(40)
    new, truth = press(200, seed=1)
    assert np.mean(StatisticsClassifier.fit(x, labels, view="level_removed").predict(new) == truth) < 0.65


@pytest.mark.parametrize("view", VIEWS)
def test_a_stored_classifier_gives_the_same_scores(view: View) -> None:
    x, labels = rippled(20)
    fitted = StatisticsClassifier.fit(x, labels, view=view)
    opened = StatisticsClassifier.from_tensors(load(save(fitted.to_tensors())))
    assert opened.view == view
    assert opened.classes.tolist() == [4, 9]
    np.testing.assert_array_equal(opened.scores(x), fitted.scores(x))


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("x", [np.zeros((4, 2, 3)), np.zeros((4, 9, 0)), np.full((4, 9, 3), np.nan), np.zeros((4, 9))])
def test_slides_without_statistics_are_refused(x: np.ndarray, view: View) -> None:
    with pytest.raises(TacpipeError):
        StatisticsClassifier.fit(x, np.array([1, 1, 2, 2]), view=view)
