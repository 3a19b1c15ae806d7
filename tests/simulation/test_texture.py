"""Surfaces of the simulated materials, the effect of an aperture, and how well their spectra separate them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.simulation import texture
from tacpipe.simulation.slide import SlideRig
from tests.simulation.texture_likelihood import likelihood_accuracy, likelihood_materials, log_likelihoods


def material(seed: int = 0) -> texture.Material:
    return texture.draw_material(np.random.default_rng(seed))


@given(st.integers(0, 10_000))
def test_a_material_keeps_to_the_ranges_that_it_is_drawn_from(seed: int) -> None:
    sample = material(seed)
    assert ((sample.wavelength_m >= 0.0025) & (sample.wavelength_m <= 0.014)).all()
    assert sample.wavelength_m.shape == sample.amplitude_n.shape == (3,)
    assert 0.8 <= sample.exponent <= 1.8
    variance = (sample.amplitude_n**2).sum() / 2 + sample.background_n**2
    assert variance * (1 + 1e-12) >= 0.15**2
    assert variance <= 0.35**2 * (1 + 1e-12)
    assert 0.05 <= sample.background_n**2 / variance <= 0.25


@given(st.floats(0.0005, 0.003), st.floats(0.0025, 0.014), st.floats(0, 6.2))
def test_an_aperture_is_the_convolution_with_a_gaussian(sigma_m: float, wavelength_m: float, phase: float) -> None:
    wave = texture.Waves(np.array([1 / wavelength_m]), np.array([0.3]), np.array([phase]))
    reach = np.linspace(-6, 6, 4001) * sigma_m
    bell = np.exp(-(reach**2) / (2 * sigma_m**2))
    expected = (bell * 0.3 * np.cos(2 * np.pi * (0.05 + reach) / wavelength_m + phase)).sum() / bell.sum()
    assert texture.contact_force(wave, np.array([0.05]), sigma_m)[0] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("sigma_m", [0.0006, 0.0018])
def test_the_power_that_is_felt_over_many_tracks_is_that_of_the_spectrum(sigma_m: float) -> None:
    sample = material(3)
    rng = np.random.default_rng(0)
    at_m = np.arange(0, 0.3, 0.0005)
    power = [np.mean(texture.contact_force(texture.draw_surface(sample, rng), at_m, sigma_m) ** 2) for _ in range(100)]
    _, expected = texture.spectrum(sample, sigma_m)
    worn = np.exp(2 * texture.WEAR**2)  # mean square of what is log-normal
    assert np.mean(power) == pytest.approx(expected[:3].sum() * worn + expected[3:].sum(), rel=0.12)


def test_the_power_of_a_background_falls_with_the_wave_number_to_the_exponent() -> None:
    sample = material(5)
    number, power = texture.spectrum(sample, 0.0)
    width = np.diff(np.geomspace(1 / 0.040, 1 / 0.0015, 401))
    slope = np.polyfit(np.log(number[3:]), np.log(power[3:] / width), 1)[0]
    assert slope == pytest.approx(-sample.exponent, rel=0.001)
    assert power[3:].sum() == pytest.approx(sample.background_n**2)
    np.testing.assert_allclose(power[:3], sample.amplitude_n**2 / 2)


def test_two_tracks_of_a_material_differ_and_the_same_numbers_give_the_same_track() -> None:
    at_m = np.arange(0, 0.1, 0.001)
    rng = np.random.default_rng(7)
    first, second = (texture.contact_force(texture.draw_surface(material(), rng), at_m, 0.0006) for _ in range(2))
    repeat = texture.contact_force(texture.draw_surface(material(), np.random.default_rng(7)), at_m, 0.0006)
    assert np.abs(first - second).mean() > 0.1 * first.std()
    np.testing.assert_array_equal(first, repeat)


@pytest.mark.long
@pytest.mark.parametrize(("sensor", "lowest_accuracy"), [(0, 0.98), (1, 0.9)])
@pytest.mark.parametrize("noise_scale", [0.0, 1.0])
def test_known_spectra_tell_most_materials(sensor: int, lowest_accuracy: float, noise_scale: float) -> None:
    assert likelihood_accuracy(0, range(sensor, 160, 2), SlideRig(noise_scale=noise_scale)) >= lowest_accuracy


def test_noise_makes_materials_harder_to_tell() -> None:
    trials = range(1, 80, 2)
    loud = likelihood_accuracy(0, trials, SlideRig(noise_scale=30.0))
    assert loud < likelihood_accuracy(0, trials, SlideRig()) - 0.2


@pytest.mark.parametrize("sensor", [0, 1])
def test_materials_that_are_identical_cannot_be_told_apart(sensor: int) -> None:
    rig = SlideRig(materials=4, identical_materials=True)
    assert likelihood_accuracy(0, range(sensor, 64, 2), rig) == 0.25  # Of equal likelihoods, the first wins.
    assert not np.ptp(log_likelihoods(0, sensor, rig))
    assert likelihood_materials(0, [sensor, sensor + 2], rig).tolist() == [1, 1]
