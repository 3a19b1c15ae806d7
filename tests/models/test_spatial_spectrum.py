"""Test that spectra over spatial frequency depend on the surface, not on the sensor."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tacpipe.errors import TacpipeError
from tacpipe.models.transfer import BANDS, Bands, Sampling

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
