"""Simulate the texture of materials under a sliding finger: three gratings and a fractal background, with an aperture.

A surface is one-dimensional, along the slide, and in N: the force that it adds to the pressure on the skin. The skin
averages over a Gaussian aperture, so the amplitude of a wave with wavelength lambda is multiplied by ``exp(-2 (pi sigma
/ lambda)^2)``. This is exact, because all waves are sines.

For two different sensors, the spectrum of a material over wave numbers differs only by the aperture, and speed converts wave
numbers to frequencies. Trials of a material differ in phases and background, with the same spectrum, and the gratings are
slightly stretched and worn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Floats

GRATINGS = 3
WAVELENGTH_M = (0.0025, 0.014)
# wavelengths of the background; longer ones would act as a slope, and shorter ones are not measured
BACKGROUND_M = (0.0015, 0.040)
ROUGHNESS_N = (0.15, 0.35)  # range of the standard deviation of a surface
AMPLITUDE = (0.15, 1.0)  # range of the relative amplitudes of gratings
EXPONENT = (0.8, 1.8)  # range of the exponent of the background's power spectrum
BACKGROUND = (0.05, 0.25)  # range of the background's fraction of the variance
FRICTION = (0.3, 0.9)
STIFFNESS_N_M = (1000.0, 4000.0)
WEAR = 0.2  # standard deviation of a grating's log amplitude between trials
STRETCH = 0.01  # standard deviation of the relative stretch of a grating
WAVES = 64  # number of waves of a background
GRID_M = 0.00005  # grid of computed points, with linear interpolation between them


@dataclass(frozen=True)
class Material:
    """The properties of a material that are common to all trials."""

    wavelength_m: Floats  # (grating,)
    amplitude_n: Floats  # (grating,)
    background_n: float  # standard deviation of the background in N
    exponent: float
    friction: float  # mu
    stiffness_n_m: float  # combined stiffness of finger and material


@dataclass(frozen=True)
class Waves:
    """A sum of sines. Arrays have shape (wave,)."""

    number_per_m: Floats  # waves per metre: one over the wavelength
    amplitude_n: Floats
    phase_rad: Floats


def draw_material(rng: np.random.Generator) -> Material:
    """Return a random material."""
    background_fraction, roughness_n = rng.uniform(*BACKGROUND), rng.uniform(*ROUGHNESS_N)
    amplitude = rng.uniform(*AMPLITUDE, GRATINGS)
    # scaled so that the gratings have the variance that the background leaves of the whole
    amplitude *= roughness_n * np.sqrt((1 - background_fraction) / (amplitude**2 / 2).sum())
    return Material(
        wavelength_m=rng.uniform(*WAVELENGTH_M, GRATINGS),
        amplitude_n=amplitude,
        background_n=float(roughness_n * np.sqrt(background_fraction)),
        exponent=float(rng.uniform(*EXPONENT)),
        friction=float(rng.uniform(*FRICTION)),
        stiffness_n_m=float(rng.uniform(*STIFFNESS_N_M)),
    )


def draw_surface(material: Material, rng: np.random.Generator) -> Waves:
    """Return the surface of one trial on a material: its worn and stretched gratings, and a random background."""
    edges = _edges(WAVES)
    number = rng.uniform(edges[:-1], edges[1:])
    size, phase = rng.rayleigh(1.0, WAVES), rng.uniform(0, 2 * np.pi, GRATINGS + WAVES)
    worn, stretched = rng.normal(0, 1, (2, GRATINGS))
    return Waves(
        np.concatenate([1 / material.wavelength_m * (1 + STRETCH * stretched), number]),
        np.concatenate([material.amplitude_n * np.exp(WEAR * worn), size * np.sqrt(_background(material, edges))]),
        phase,
    )


def transmission(number_per_m: Floats, aperture_m: float) -> Floats:
    """Return the fraction of a wave's amplitude after a Gaussian aperture, with the shape of ``number_per_m``.

    >>> transmission(np.array([0.0, 125.0, 250.0]), 0.0018).round(3).tolist()
    [1.0, 0.368, 0.018]
    """
    return np.exp(-2 * (np.pi * aperture_m * number_per_m) ** 2)


def contact_force(surface: Waves, position_m: Floats, aperture_m: float) -> Floats:
    """Return the measured force of a surface in N at ``position_m``, with the same shape."""
    low, high = float(position_m.min()), float(position_m.max())
    grid = low + GRID_M * np.arange(int((high - low) / GRID_M) + 2)
    amplitude = surface.amplitude_n * transmission(surface.number_per_m, aperture_m)
    significant = amplitude > 1e-6 * amplitude.max()
    angle = np.outer(2 * np.pi * surface.number_per_m[significant], grid) + surface.phase_rad[significant, None]
    value: Floats = np.interp(position_m.ravel(), grid, amplitude[significant] @ np.cos(angle)).reshape(
        position_m.shape
    )
    return value


def spectrum(material: Material, aperture_m: float, parts: int = 400) -> tuple[Floats, Floats]:
    """Return wave numbers in 1/m and the expected power at each in N², for a material measured with an aperture.

    The gratings are first, then ``parts`` bands of the background. Both arrays have shape (grating + band,). The powers
    add up to the variance of the measured force.
    """
    edges = _edges(parts)
    number = np.concatenate([1 / material.wavelength_m, np.sqrt(edges[:-1] * edges[1:])])
    power = np.concatenate([material.amplitude_n**2 / 2, _background(material, edges)])
    return number, power * transmission(number, aperture_m) ** 2


def _edges(parts: int) -> Floats:
    """Return the limits (parts + 1,) of ``parts`` logarithmically spaced wave number bands of a background."""
    return np.geomspace(1 / BACKGROUND_M[1], 1 / BACKGROUND_M[0], parts + 1)


def _background(material: Material, edges: Floats) -> Floats:
    """Return the power of the background in each band (band,) in N²."""
    if abs(material.exponent - 1) < 1e-9:
        area = np.diff(np.log(edges))
    else:
        area = np.diff(edges ** (1 - material.exponent)) / (1 - material.exponent)
    power: Floats = material.background_n**2 * area / area.sum()
    return power
