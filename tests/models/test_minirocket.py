"""MiniRocket, against loops written from the paper: kernels, padding, dilations, biases and shares."""

import itertools

import numpy as np
import pytest
from safetensors.numpy import load, save

from tacpipe.errors import TacpipeError
from tacpipe.models import minirocket
from tacpipe.models.minirocket import MinirocketClassifier, Rocket
from tacpipe.models.readout import Level

FRAMES, CHANNELS = 41, 3


def slides(count: int, frames: int = FRAMES, channels: int = CHANNELS, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    walk = rng.normal(size=(count, frames, channels)).cumsum(axis=1)
    return (10 * walk).round().astype(np.float32)  # whole numbers: sums are exact in any order


@pytest.fixture(scope="module")
def fitted() -> Rocket:
    return Rocket.fit(slides(12), features=84 * 12, seed=3)


def weights(kernel: int) -> list[int]:
    """Return the nine weights of a kernel: 2 at three places, in the order of combinations, and -1 elsewhere."""
    heavy = list(itertools.combinations(range(9), 3))[kernel]
    return [2 if place in heavy else -1 for place in range(9)]


def answer(slide: np.ndarray, rocket: Rocket, index: int, kernel: int) -> list[float]:
    """Return what a kernel answers at each position of one slide (time, channel), with loops."""
    dilation = int(rocket.dilations[index])
    channels = [c for c in range(slide.shape[1]) if rocket.channels[index, kernel, c]]
    padded = (index + kernel) % 2 == 0
    answers = []
    for middle in range(len(slide)):
        places = [middle + (place - 4) * dilation for place in range(9)]
        inside = [0 <= place < len(slide) for place in places]
        if not padded and not all(inside):
            continue
        total = 0.0
        for weight, place, is_inside in zip(weights(kernel), places, inside, strict=True):
            total += weight * sum(float(slide[place, c]) for c in channels) if is_inside else 0.0
        answers.append(total)
    return answers


def test_features_are_the_shares_of_answers_above_each_bias(fitted: Rocket) -> None:
    x = slides(4, seed=9)
    features = fitted.transform(x)
    assert features.shape == (4, 84 * 12)
    assert features.dtype == np.float32
    expected, at = np.zeros(features.shape), 0
    for index, count in enumerate(fitted.counts):
        for kernel in range(84):
            answers = [answer(slide, fitted, index, kernel) for slide in x]
            for _ in range(count):
                expected[:, at] = [
                    np.mean([value > fitted.biases[at] for value in answer_values]) for answer_values in answers
                ]
                at += 1
    assert at == features.shape[1]
    np.testing.assert_allclose(features, expected, atol=1e-6)


def test_dilations_are_powers_of_two_evenly_up_to_the_slide_and_share_the_features(fitted: Rocket) -> None:
    longest = np.log2((FRAMES - 1) / 8)
    powers = [int(2 ** (longest * step / 11)) for step in range(12)]
    assert fitted.dilations.tolist() == sorted(set(powers))
    assert fitted.counts.tolist() == [powers.count(dilation) for dilation in sorted(set(powers))]
    large = Rocket.fit(slides(3, 400), features=10_000)
    assert 8 * large.dilations[-1] <= 399
    assert large.counts.sum() == 10_000 // 84
    assert len(large.biases) == 84 * large.counts.sum()


def test_biases_are_quantiles_of_one_training_slides_answers_at_multiples_of_the_golden_ratio() -> None:
    x = slides(1, seed=5)  # a single slide, so that biases can be of it alone
    rocket = Rocket.fit(x, features=84 * 4, seed=1)
    at = 0
    for index, count in enumerate(rocket.counts):
        for kernel in range(84):
            quantiles = [(n * (1 + 5**0.5) / 2) % 1 for n in range(at + 1, at + 1 + int(count))]
            expected = np.quantile(answer(x[0], rocket, index, kernel), quantiles)
            np.testing.assert_allclose(rocket.biases[at : at + count], expected, rtol=1e-5, atol=1e-3)
            at += int(count)


def test_every_kernel_sums_one_to_nine_channels_and_small_sums_are_the_most_frequent() -> None:
    rocket = Rocket.fit(slides(2, channels=20), features=84 * 32)
    counts = np.bincount(rocket.channels.sum(axis=-1).ravel(), minlength=10)
    assert counts[0] == 0
    assert len(counts) == 10
    assert counts[1] > counts[4] > 0
    assert rocket.channels.any(axis=(0, 1)).all()


def test_slides_are_transformed_alike_alone_and_among_others(fitted: Rocket) -> None:
    x = slides(40)
    count = minirocket.BLOCK_BYTES // x[0, :, :1].nbytes  # slides of a block
    many = np.resize(x, (2 * count + 3, *x.shape[1:]))
    batched, alone = fitted.transform(many), fitted.transform(x)
    assert np.array_equal(alone, batched[:40])
    assert np.array_equal(np.resize(alone, batched.shape), batched)
    assert np.array_equal(fitted.transform(x[7:8]), batched[7:8])


def test_positions_beyond_what_a_byte_counts_are_counted() -> None:
    x = slides(2, frames=600)
    rocket = Rocket.fit(x, features=84)
    always = Rocket(rocket.frames, rocket.dilations, rocket.counts, rocket.channels, np.full(84, -1e9, np.float32))
    assert (always.transform(x) == 1).all()


def test_the_seed_decides_and_tensors_hold_everything(fitted: Rocket) -> None:
    x = slides(12)
    repeated, reseeded = Rocket.fit(x, features=84 * 12, seed=3), Rocket.fit(x, features=84 * 12, seed=4)
    assert np.array_equal(repeated.transform(x), fitted.transform(x))
    assert not np.array_equal(reseeded.transform(x), fitted.transform(x))
    assert np.array_equal(Rocket.from_tensors(fitted.to_tensors()).transform(x), fitted.transform(x))


def test_slides_that_cannot_be_transformed_say_why(fitted: Rocket) -> None:
    with pytest.raises(TacpipeError, match="with 9 frames or more"):
        Rocket.fit(slides(3, frames=8))
    with pytest.raises(TacpipeError, match="83 features are too few for 84 kernels"):
        Rocket.fit(slides(3), features=83)
    with pytest.raises(TacpipeError, match=r"\(slide, 41, 3\) was fitted"):
        fitted.transform(slides(2, channels=4))
    broken = slides(2)
    broken[1, 3, 0] = np.nan
    with pytest.raises(TacpipeError, match="not finite"):
        fitted.transform(broken)


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


def test_shuffled_labels_tell_nothing() -> None:
    x, labels = textured(60)
    new, truth = textured(300, seed=1)
    shuffled = np.random.default_rng(0).permutation(labels)
    assert np.mean(MinirocketClassifier.fit(x, shuffled, features=PATTERNS).predict(new) == truth) < 0.6


def test_the_seed_decides_a_classifier_and_tensors_hold_it() -> None:
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
