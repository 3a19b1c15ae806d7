"""Materials as a sliding finger measures them: three gratings over a fractal background, seen through an aperture.

A surface is one-dimensional, along the way of the slide, and is given in newton: what it adds to the pressure on the
skin. Skin does not measure a point but a Gaussian neighbourhood of it, so that a wave of length lambda keeps the share
``exp(-2 (pi sigma / lambda)^2)`` of its amplitude. As all waves are sines, that is exact.

The same material under two unlike sensors: the spectrum over wave numbers is the same up to the aperture, and speed turns
wave numbers into frequencies. Another trial of a material has other phases and another background of the same spectrum,
and its track is a bit stretched and worn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Floats

GRATINGS = 3
WAVELENGTH_M = (0.0025, 0.014)
BACKGROUND_M = (
    0.0015,
    0.040,
)  # wavelengths of the background; longer ones would be slope, shorter ones nobody measures
ROUGHNESS_N = (0.15, 0.35)  # standard deviation of all that a surface adds
AMPLITUDE = (0.15, 1.0)  # amplitude of one grating relative to the others
EXPONENT = (0.8, 1.8)  # exponent of the background's power over the wave number
BACKGROUND = (0.05, 0.25)  # its fraction of the variance
FRICTION = (0.3, 0.9)
STIFFNESS_N_M = (1000.0, 4000.0)
WEAR = 0.2  # standard deviation of the logarithm of a grating's amplitude from trial to trial
STRETCH = 0.01  # relative stretch of the wavelength
WAVES = 64  # number of waves of a background
GRID_M = 0.00005  # grid at which a surface is computed, linear in between


@dataclass(frozen=True)
class Material:
    """The properties that all trials of a material share."""

    wavelength_m: Floats  # (grating,)
    amplitude_n: Floats  # (grating,)
    background_n: float  # standard deviation
    exponent: float
    friction: float  # mu
    stiffness_n_m: float  # combined stiffness of finger and material


@dataclass(frozen=True)
class Waves:
    """A sum of sines; arrays are (wave,)."""

    number_per_m: Floats  # one over the wavelength
    amplitude_n: Floats
    phase_rad: Floats


def material(rng: np.random.Generator) -> Material:
    """Return a random material."""
    fraction, roughness = rng.uniform(*BACKGROUND), rng.uniform(*ROUGHNESS_N)
    amplitude = rng.uniform(*AMPLITUDE, GRATINGS)
    amplitude *= roughness * np.sqrt((1 - fraction) / (amplitude**2 / 2).sum())
    return Material(
        wavelength_m=rng.uniform(*WAVELENGTH_M, GRATINGS),
        amplitude_n=amplitude,
        background_n=float(roughness * np.sqrt(fraction)),
        exponent=float(rng.uniform(*EXPONENT)),
        friction=float(rng.uniform(*FRICTION)),
        stiffness_n_m=float(rng.uniform(*STIFFNESS_N_M)),
    )


def track(material: Material, rng: np.random.Generator) -> Waves:
    """Return the surface along one trial's way over a material."""
    edges = _edges(WAVES)
    number = rng.uniform(edges[:-1], edges[1:])
    size, phase = rng.rayleigh(1.0, WAVES), rng.uniform(0, 2 * np.pi, GRATINGS + WAVES)
    worn, stretched = rng.normal(0, 1, (2, GRATINGS))
    return Waves(
        np.concatenate([1 / material.wavelength_m * (1 + STRETCH * stretched), number]),
        np.concatenate([material.amplitude_n * np.exp(WEAR * worn), size * np.sqrt(_background(material, edges))]),
        phase,
    )


def passed(number_per_m: Floats, aperture_m: float) -> Floats:
    """Return the fraction of a wave's amplitude that a Gaussian aperture lets through, of the shape of ``number_per_m``.

    >>> passed(np.array([0.0, 125.0, 250.0]), 0.0018).round(3).tolist()
    [1.0, 0.368, 0.018]
    """
    fraction: Floats = np.exp(-2 * (np.pi * aperture_m * number_per_m) ** 2)
    return fraction


def contact_force(surface: Waves, position_m: Floats, aperture_m: float) -> Floats:
    """Return what is measured of a surface at ``position_m`` (any shape), N, of the same shape."""
    low, high = float(position_m.min()), float(position_m.max())
    grid = low + GRID_M * np.arange(int((high - low) / GRID_M) + 2)
    amplitude = surface.amplitude_n * passed(surface.number_per_m, aperture_m)
    significant = amplitude > 1e-6 * amplitude.max()
    angle = np.outer(2 * np.pi * surface.number_per_m[significant], grid) + surface.phase_rad[significant, None]
    value: Floats = np.interp(position_m.ravel(), grid, amplitude[significant] @ np.cos(angle)).reshape(
        position_m.shape
    )
    return value


def spectrum(material: Material, aperture_m: float, parts: int = 400) -> tuple[Floats, Floats]:
    """Return wave numbers, per m, and the expected power at each, N^2, of a material measured through an aperture.

    The gratings come first, then ``parts`` pieces of the background; both arrays are (grating + part,). The powers add
    up to the variance of what is measured.
    """
    edges = _edges(parts)
    number = np.concatenate([1 / material.wavelength_m, np.sqrt(edges[:-1] * edges[1:])])
    power = np.concatenate([material.amplitude_n**2 / 2, _background(material, edges)])
    return number, power * passed(number, aperture_m) ** 2


def _edges(parts: int) -> Floats:
    """Return the wave numbers between which the ``parts`` waves of a background lie, evenly in their logarithm."""
    return np.geomspace(1 / BACKGROUND_M[1], 1 / BACKGROUND_M[0], parts + 1)


def _background(material: Material, edges: Floats) -> Floats:
    """Return the power of the background between each two wave numbers (part,), N^2."""
    if abs(material.exponent - 1) < 1e-9:
        area = np.diff(np.log(edges))
    else:
        area = np.diff(edges ** (1 - material.exponent)) / (1 - material.exponent)
    power: Floats = material.background_n**2 * area / area.sum()
    return power
