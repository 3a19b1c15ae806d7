"""Compare classes shared between sensors with normal distributions and the rule of Bayes by another road."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal
from sklearn.covariance import LedoitWolf

from tacpipe.errors import TacpipeError
from tacpipe.models.transfer import BANDS, REGULARISATION, Bands, Gaussians, Labelled, Sampling, Transfer

WIDE, CLASSES = 5, 10
MEANS = 2 * np.random.default_rng(0).normal(size=(CLASSES, WIDE))


def sided(
    classes: object, count: int, gain: float = 1.0, offset: float = 0.0, noise: float = 0.3, seed: int = 1
) -> Labelled:
    """Slides of some classes, as a sensor with this gain and offset in every feature feels them."""
    labels = np.repeat(np.array(classes), count)
    rng = np.random.default_rng(seed)
    return Labelled(offset + gain * MEANS[labels] + noise * rng.normal(size=(len(labels), WIDE)), labels)


def named(transfer: Transfer, gaussians: Gaussians, slides: Labelled) -> float:
    """The share of slides named rightly."""
    return float((transfer.classes[gaussians.scores(slides.features).argmax(axis=1)] == slides.labels).mean())


def test_classes_that_only_another_sensor_was_told_are_named() -> None:
    transfer = Transfer.fit(sided(range(6), 8, 0.5, 3.0), [sided(range(CLASSES), 8, seed=2)])
    new = sided(range(6, CLASSES), 30, 0.5, 3.0, seed=3)
    assert named(transfer, transfer.learned, new) > 0.9
    assert named(transfer, transfer.expected, new) > 0.9
    assert named(transfer, transfer.learned, sided(range(6), 30, 0.5, 3.0, seed=4)) > 0.95


def test_what_is_expected_is_the_other_sensors_mean_by_gain_and_offset() -> None:
    slides, foreign = sided(range(6), 400, -0.5, 3.0, 0.05), sided(range(CLASSES), 400, noise=0.05, seed=2)
    transfer = Transfer.fit(slides, [foreign])
    np.testing.assert_allclose(transfer.learned.mean[6:], 3 - 0.5 * MEANS[6:], atol=0.05)
    np.testing.assert_allclose(transfer.expected.mean, 3 - 0.5 * MEANS, atol=0.05)


def test_sensors_that_have_nothing_in_common_expect_nothing_of_one_another() -> None:
    strange = np.random.default_rng(7).normal(size=(CLASSES, WIDE))
    foreign = sided(range(CLASSES), 8, seed=2)
    right = []
    for seed in range(20):
        shuffled = np.random.default_rng(seed).permutation(strange)
        slides = Labelled(shuffled[np.repeat(np.arange(6), 8)], np.repeat(np.arange(6), 8))
        rng = np.random.default_rng([seed, 1])
        transfer = Transfer.fit(
            Labelled(slides.features + 0.1 * rng.normal(size=slides.features.shape), slides.labels), [foreign]
        )
        right.append(named(transfer, transfer.expected, Labelled(shuffled[6:], np.arange(6, CLASSES))))
    assert np.mean(right) < 0.2  # chance is 0.1


def test_a_few_slides_correct_what_is_expected_by_the_rule_of_bayes() -> None:
    slides, foreign = sided(np.r_[np.repeat(range(5), 6), 5, 5], 1, 0.5, 1.0), sided(range(CLASSES), 8, seed=2)
    transfer = Transfer.fit(slides, [foreign])
    number = 4  # a class of six slides
    residuals = slides.features - np.stack(
        [slides.features[slides.labels == label].mean(axis=0) for label in slides.labels]
    )
    scale = residuals.std(axis=0)
    covariance = LedoitWolf(assume_centered=True).fit(residuals / scale).covariance_ * np.outer(scale, scale) * 32 / 26
    prior = transfer.expected.covariance[number] - covariance
    precise = np.linalg.inv(np.linalg.inv(prior) + 6 * np.linalg.inv(covariance))
    mean = precise @ (
        np.linalg.inv(prior) @ transfer.expected.mean[number]
        + 6 * np.linalg.inv(covariance) @ slides.features[slides.labels == number].mean(axis=0)
    )
    np.testing.assert_allclose(np.diag(np.diag(prior)), prior, atol=1e-12)
    np.testing.assert_allclose(transfer.learned.mean[number], mean, rtol=1e-6)
    np.testing.assert_allclose(transfer.learned.covariance[number], covariance + precise, rtol=1e-6)


def test_many_slides_of_its_own_outweigh_what_others_expect() -> None:
    wrong = sided(range(CLASSES), 8, seed=2)
    wrong = Labelled(np.random.default_rng(3).permutation(wrong.features), wrong.labels)
    slides = sided(range(CLASSES), 500)
    transfer = Transfer.fit(slides, [wrong])
    means = np.stack([slides.features[slides.labels == label].mean(axis=0) for label in range(CLASSES)])
    np.testing.assert_allclose(transfer.learned.mean, means, atol=0.01)


def test_few_slides_are_told_better_with_another_sensor_than_without() -> None:
    new = sided(range(CLASSES), 40, 0.5, 3.0, 1.0, seed=3)
    with_other, without = [], []
    for seed in range(5):
        slides = sided(range(CLASSES), 2, 0.5, 3.0, 1.0, seed=10 + seed)
        transfer = Transfer.fit(slides, [sided(range(CLASSES), 50, noise=0.3, seed=2)])
        with_other.append(named(transfer, transfer.learned, new))
        transfer = Transfer.fit(slides)
        without.append(named(transfer, transfer.learned, new))
    assert np.mean(with_other) > np.mean(without) + 0.05


def test_the_more_exact_of_two_sensors_counts_more() -> None:
    exact, vague = sided(range(CLASSES), 20, noise=0.01, seed=2), sided(range(CLASSES), 20, seed=3)
    rng = np.random.default_rng(4)
    vague = Labelled(vague.features + rng.normal(size=(CLASSES, WIDE))[vague.labels], vague.labels)
    slides = sided(range(6), 20, noise=0.01)
    errors = {
        name: np.abs(Transfer.fit(slides, sensors).learned.mean[6:] - MEANS[6:]).mean()
        for name, sensors in {"exact": [exact], "vague": [vague], "both": [vague, exact]}.items()
    }
    assert errors["both"] < 0.1 * errors["vague"]
    assert errors["both"] < 2 * errors["exact"]


def test_scores_are_logarithms_of_normal_densities() -> None:
    transfer, new = (
        Transfer.fit(sided(range(6), 8), [sided(range(CLASSES), 8, seed=2)]),
        sided(range(CLASSES), 3, seed=5),
    )
    expected = np.array(
        [
            multivariate_normal(mean, cov + REGULARISATION * np.trace(cov) / WIDE * np.eye(WIDE)).logpdf(new.features)
            for mean, cov in zip(transfer.learned.mean, transfer.learned.covariance, strict=True)
        ]
    ).T
    np.testing.assert_allclose(
        transfer.learned.scores(new.features), expected + WIDE / 2 * np.log(2 * np.pi), rtol=1e-5
    )


def test_nothing_is_expected_of_classes_that_no_other_sensor_knows() -> None:
    transfer = Transfer.fit(sided(range(CLASSES), 8), [sided(range(7), 8, seed=2)])
    scores = transfer.expected.scores(MEANS)
    assert np.isfinite(scores[:, :7]).all()
    assert np.isneginf(scores[:, 7:]).all()
    assert named(transfer, transfer.learned, sided(range(CLASSES), 20, seed=3)) > 0.95


def test_tensors_hold_everything() -> None:
    transfer = Transfer.fit(sided(range(6), 8), [sided(range(CLASSES), 8, seed=2)])
    restored = Transfer.from_tensors(transfer.to_tensors())
    for stored, read_back in ((transfer.learned, restored.learned), (transfer.expected, restored.expected)):
        assert np.array_equal(stored.scores(MEANS), read_back.scores(MEANS))
    assert restored.classes.tolist() == list(range(CLASSES))


def test_slides_that_teach_nothing_are_refused() -> None:
    with pytest.raises(TacpipeError, match=" 2 classes in common; a map between them needs 3"):
        Transfer.fit(sided(range(4), 4), [sided(range(2, 8), 4)])
    with pytest.raises(TacpipeError, match="8 slides of 1 classes do not show"):
        Transfer.fit(sided([3], 8))
    with pytest.raises(TacpipeError, match="4 slides of 4 classes do not show"):
        Transfer.fit(sided(range(4), 1))
    with pytest.raises(TacpipeError, match=r"must be \(slide, 5\) and \(slide,\)"):
        Transfer.fit(sided(range(4), 4), [Labelled(np.zeros((4, 3)), np.arange(4))])
    with pytest.raises(TacpipeError, match="not finite"):
        Transfer.fit(Labelled(np.full((8, WIDE), np.nan), np.arange(8) % 4))


FINGER, FOREARM = Sampling(400, 100.0, 0.025), Sampling(75, 50.0, 0.05)
COMMON = Bands.common([FINGER, FOREARM])


def slides(felt: Sampling, surface: dict[float, float], channels: int = 6, count: int = 4, seed: int = 0) -> np.ndarray:
    """Slides (slide, time, channel) over waves of given periods a metre and amplitudes in counts, on 1,000 counts."""
    rng = np.random.default_rng(seed)
    at_m = np.arange(felt.frames)[:, None] / felt.rate_hz * felt.speed_m_s
    frames = np.full((count, felt.frames, channels), 1000.0)
    for per_m, amplitude in surface.items():
        frames += amplitude * np.sin(2 * np.pi * per_m * at_m + rng.uniform(0, 2 * np.pi, (count, 1, channels)))
    return frames


def read(felt: Sampling, frames: np.ndarray, bands: Bands = COMMON) -> np.ndarray:
    return bands.log_power(frames, felt.rate_hz, felt.speed_m_s)


def centres() -> np.ndarray:
    frequencies: np.ndarray = np.sqrt(COMMON.edges_per_m[1:] * COMMON.edges_per_m[:-1])
    return frequencies


def test_bands_are_those_that_every_sensor_can_tell() -> None:
    assert COMMON.distance_m == pytest.approx(0.075)  # the forearm's 75 frames at 50 Hz and 50 mm/s
    assert COMMON.edges_per_m[0] == pytest.approx(3 / 0.075)
    assert COMMON.edges_per_m[-1] == pytest.approx(0.6 * 50 / 2 / 0.05)
    assert len(COMMON.edges_per_m) == BANDS + 1


@settings(max_examples=30, deadline=None)
@given(st.floats(50, 290), st.floats(0.01, 0.05), st.floats(60, 400))
def test_a_wave_of_the_surface_is_in_its_band_at_any_speed_and_rate(
    per_m: float, speed_m_s: float, rate_hz: float
) -> None:
    felt = Sampling(int(0.08 / speed_m_s * rate_hz) + 1, rate_hz, speed_m_s)
    spectra = read(felt, slides(felt, {per_m: 100.0}))[:, :-1]
    if felt.max_per_m > 300:
        nearest = np.abs(np.log(centres()[spectra.argmax(axis=1)] / per_m))
        assert (nearest <= np.log(centres()[1] / centres()[0]) + 1e-9).all()


def test_two_sensors_over_one_surface_have_the_same_spectrum() -> None:
    surface = dict(zip(centres(), 40 + 30 * np.sin(np.arange(BANDS)), strict=True))
    fingertip, forearm = (read(felt, slides(felt, surface, 30, 60)).mean(axis=0) for felt in (FINGER, FOREARM))
    assert np.corrcoef(fingertip[:-1], forearm[:-1])[0, 1] > 0.98
    assert np.abs(fingertip - forearm).max() < 0.3


def test_an_aperture_is_an_offset_of_each_band() -> None:
    sigma_m = 0.001
    surface = dict.fromkeys(np.linspace(30, 330, 90), 20.0)
    narrow = {per_m: size * np.exp(-2 * (np.pi * sigma_m * per_m) ** 2) for per_m, size in surface.items()}
    wide, part = (read(FINGER, slides(FINGER, waves, 20, 40)).mean(axis=0)[:-1] for waves in (surface, narrow))
    offsets = -4 * (np.pi * sigma_m * centres()) ** 2  # offset of the power's logarithm: twice that of the amplitude
    np.testing.assert_allclose((part - wide)[:-2], (offsets - offsets.mean())[:-2], atol=0.25)


@given(st.floats(0.2, 20))
@settings(max_examples=10, deadline=None)
def test_neither_gain_nor_force_counts(gain: float) -> None:
    rough = slides(FINGER, dict.fromkeys(centres(), 30.0))
    np.testing.assert_allclose(read(FINGER, gain * rough), read(FINGER, rough), atol=0.02)


def test_one_channel_out_of_order_does_not_count() -> None:
    channel = slides(FINGER, dict(zip(centres(), np.linspace(60, 5, BANDS), strict=True)), channels=1)
    rough = np.repeat(channel, 30, axis=2)
    broken = rough.copy()
    broken[..., 3] += 500 + 300 * np.random.default_rng(1).normal(size=broken.shape[:2])
    np.testing.assert_allclose(read(FINGER, broken), read(FINGER, rough), atol=1e-4)
    assert np.abs(read(FINGER, broken[..., 3:4]) - read(FINGER, channel)).max() > 3


def test_channels_that_touch_nothing_do_not_count() -> None:
    rough = slides(FINGER, dict(zip(centres(), np.linspace(60, 5, BANDS), strict=True)), channels=6)
    idle = np.zeros((*rough.shape[:2], 14))
    np.testing.assert_allclose(read(FINGER, np.concatenate([idle, rough], axis=2)), read(FINGER, rough), atol=2.0)
    assert np.abs(read(FINGER, idle)[:, :-1]).max() < 1e-6  # nothing but the power of rounding, alike in all bands


def test_white_noise_has_its_variance_in_every_band() -> None:
    noise = 1000 + 10 * np.random.default_rng(2).normal(size=(200, FINGER.frames, 1))
    spectra = read(FINGER, noise)
    strength = spectra[:, -1].mean() + 2 * np.log(1001) - np.log(FINGER.speed_m_s / FINGER.rate_hz)
    assert np.abs(spectra[:, :-1].mean(axis=0)).max() < 0.25
    assert strength == pytest.approx(np.log(100), abs=0.5)  # the mean logarithm of a power lies below its logarithm


def test_slides_are_read_alike_one_by_one_or_many_at_once() -> None:
    rough = slides(FOREARM, {100.0: 20.0, 220.0: 30.0}, count=300)
    np.testing.assert_allclose(read(FOREARM, rough)[[0, 299]], read(FOREARM, rough[[0, 299]]), atol=1e-4)
    assert read(FOREARM, rough[:0]).shape == (0, BANDS + 1)


def test_slides_that_cannot_be_read_are_refused() -> None:
    with pytest.raises(TacpipeError, match=r"shorter than 0\.075 m; give \(slide, time, channel\) with 300 frames"):
        read(FINGER, np.zeros((2, 299, 3)))
    with pytest.raises(TacpipeError, match="not finite"):
        read(FINGER, np.full((2, 400, 3), np.nan))
    with pytest.raises(TacpipeError, match=r"is 0\.075 m long and resolves more than 40 periods per metre"):
        Bands.common([FINGER, FOREARM, Sampling(400, 10.0, 0.1)])
