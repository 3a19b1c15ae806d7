"""Simulate the skin of a finger: a 4x4 grid of taxels under pressure and shear, and its counts.

The pressure has a Gaussian distribution around the contact, which the object's displacement and a torque shift. Shear is
elastic: the object displaces the skins of both fingers equally, and each taxel resists in proportion, up to mu times its
pressure. Taxels below this limit carry the remaining load. Slip therefore starts at the rim, where the pressure is
smallest, and is complete when the object slips. The history of partial slip (Cattaneo and Mindlin) is not modelled.
Pressure also pushes the skin outwards, with forces that add up to zero.

A count is ``base + C (f + q |f| f)`` plus cross-talk of neighbours, drift and noise, rounded. A fraction of the pressure
in f is delayed (creep). C (axis, axis) is a matrix per taxel. Without drift and noise, `forces` returns f.

Axes: a taxel's x is the hand's x, its y the hand's z, its z the pressure. Taxels are numbered row by row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Counts, Floats
from tacpipe.channels import places, schema

PITCH_M = places.USKIN_PITCH_M  # pitch of the taxels
PAD_M = 2 * PITCH_M  # half the width of a pad, the limit of the centre of pressure
PLACES_M = places.uskin_m()  # (taxel, axis)
SIGMA_M = (0.004, 0.006)  # standard deviation of the Gaussian that distributes the pressure
CENTRE_M = 0.003  # maximum distance between the centres of the pressure and of the pad, along each axis
TWIST_M_NM = 0.02  # shift of the centre of pressure per torque
# x, y, z; chosen with `BULGE` for the standard deviations of the published recordings
GAIN_COUNT_N = (1500.0, 1500.0, 3250.0)
OFF_AXIS = 0.05  # fraction of a force that acts on the other axes
QUADRATIC_N = 0.03  # q as a fraction of the gain, at one newton
CROSSTALK = 0.08  # fraction of a taxel's signal in its four neighbours
CREEP, CREEP_S = 0.03, 0.5  # fraction of the pressure that is delayed, and time constant of the delay
BULGE = 0.4  # outward fraction of a taxel's pressure, per pitch of distance from the centre
BASE_COUNT = (16_000.0, 16_500.0, 38_000.0)  # rest levels in the published recordings
BASE_SPREAD_COUNT = 300.0
DRIFT_COUNT = 2.0  # random walk: standard deviation after one second
NOISE_COUNT = (1.35, 1.15, 3.4)  # x, y, z; standard deviation of second differences / sqrt(6), quiet xela-psc frames


@dataclass(frozen=True)
class Skin:
    """The taxels of a finger, and the position of the contact."""

    centre_m: Floats  # (2,), initial position of the contact
    sigma_m: float
    gain_count_n: Floats  # C (taxel, axis, axis)
    base_count: Floats  # (taxel, axis)


def draw_skin(rng: np.random.Generator) -> Skin:
    """Return a random skin."""
    mixing = np.eye(3) + OFF_AXIS * rng.uniform(-1, 1, (schema.TAXELS, 3, 3))
    base = np.array(BASE_COUNT) + rng.uniform(-BASE_SPREAD_COUNT, BASE_SPREAD_COUNT, (schema.TAXELS, 3))
    centre = rng.uniform(-CENTRE_M, CENTRE_M, 2)
    return Skin(centre, float(rng.uniform(*SIGMA_M)), mixing * np.array(GAIN_COUNT_N)[:, None], base)


def fractions(skin: Skin, displacement_m: Floats, torque_nm: Floats, places_m: Floats = PLACES_M) -> Floats:
    """Return the fraction of the normal force on each taxel (time, taxel). The fractions add up to 1.

    ``displacement_m`` (time, 2) is that of the object along x and z, ``torque_nm`` (time,) the torque on it, and
    ``places_m`` (taxel, axis) are the positions of the taxels.
    """
    moved = skin.centre_m + displacement_m + np.outer(torque_nm, [TWIST_M_NM, 0.0])
    centre = PAD_M * np.tanh(moved / PAD_M)
    distance2 = ((places_m - centre[:, None]) ** 2).sum(axis=2)
    fraction = np.exp((distance2.min(axis=1, keepdims=True) - distance2) / (2 * skin.sigma_m**2))
    normalised: Floats = fraction / fraction.sum(axis=1, keepdims=True)
    return normalised


def shear(cap_n: Floats, load_n: Floats) -> Floats:
    """Return the shear force of each taxel (time, taxel, 2), which together carry ``load_n`` (time, 2).

    All taxels carry the same load up to their caps (time, taxel). If all are capped, the load is distributed in
    proportion to the caps.
    """
    total = np.linalg.norm(load_n, axis=1)
    ordered = np.sort(cap_n, axis=1)
    taxels = cap_n.shape[1]
    below = np.cumsum(ordered, axis=1) - ordered  # load of the taxels with smaller caps, if they are capped
    # load of each remaining taxel if this one is not capped
    level = (total[:, None] - below) / (taxels - np.arange(taxels))
    fits = level <= ordered  # the first taxel for which this is True and those after it are not capped
    borne = np.minimum(cap_n, np.take_along_axis(level, fits.argmax(axis=1)[:, None], axis=1))
    full = ~fits.any(axis=1)
    borne[full] = cap_n[full]
    borne[full] *= (total / np.maximum(cap_n.sum(axis=1), 1e-12))[full, None]
    direction = load_n / np.maximum(total, 1e-12)[:, None]
    pulled: Floats = borne[:, :, None] * direction[:, None]
    return pulled


def bulge(pressed_n: Floats, places_m: Floats = PLACES_M) -> Floats:
    """Return the outward forces of taxels (time, taxel, 2) by pressure (time, taxel). Their sum is zero."""
    total = np.maximum(pressed_n.sum(axis=1, keepdims=True), 1e-12)
    outwards = places_m - (pressed_n @ places_m / total)[:, None]
    pushed: Floats = BULGE * pressed_n[:, :, None] * outwards / PITCH_M
    return pushed


def signal(skin: Skin, force_n: Floats) -> Floats:
    """Return the counts above base (time, taxel, axis) for forces on taxels (time, taxel, axis) in N."""
    bent = force_n + QUADRATIC_N * np.abs(force_n) * force_n
    counts: Floats = np.einsum("mn,tna->tma", crosstalk(), np.einsum("tna,nba->tnb", bent, skin.gain_count_n))
    return counts


def forces(skin: Skin, counts: Floats) -> Floats:
    """Return the forces on taxels (time, taxel, axis) in N that cause these counts without drift and noise."""
    above = np.einsum("mn,tna->tma", np.linalg.inv(crosstalk()), counts.reshape(-1, schema.TAXELS, 3) - skin.base_count)
    bent = np.einsum("tna,nba->tnb", above, np.linalg.inv(skin.gain_count_n))
    size = (np.sqrt(1 + 4 * QUADRATIC_N * np.abs(bent)) - 1) / (2 * QUADRATIC_N)
    force: Floats = np.sign(bent) * size
    return force


def crosstalk() -> Floats:
    """Return the cross-talk matrix (taxel, taxel)."""
    row, column = np.divmod(np.arange(schema.TAXELS), 4)
    distance = np.abs(row[:, None] - row) + np.abs(column[:, None] - column)
    matrix: Floats = np.eye(schema.TAXELS) + CROSSTALK * (distance == 1)
    return matrix


def lag(values: Floats, rate_hz: float) -> Floats:
    """Apply a first-order lag of `CREEP_S` to ``values`` (time,). The initial state is their first value."""
    steps = np.arange(round(12 * CREEP_S * rate_hz))
    kernel = np.exp(-steps / (CREEP_S * rate_hz))
    kernel /= kernel.sum()
    size = 1 << int(np.ceil(np.log2(len(values) + len(kernel))))
    above = values - values[0]
    late: Floats = values[0] + np.fft.irfft(np.fft.rfft(above, size) * np.fft.rfft(kernel, size), size)[: len(values)]
    return late


def draw_errors(at_s: Floats, noise_scale: float, drift_scale: float, rng: np.random.Generator) -> Floats:
    """Return noise plus drift in counts (time, taxel, axis) for samples at ``at_s`` (time,)."""
    shape = (len(at_s), schema.TAXELS, 3)
    steps_s = np.diff(at_s, prepend=at_s[:1])
    drift = np.cumsum(rng.normal(0, 1.0, shape) * np.sqrt(steps_s)[:, None, None], axis=0) * DRIFT_COUNT
    noise = rng.normal(0, 1.0, shape) * NOISE_COUNT
    return noise * noise_scale + drift * drift_scale


def digitise(counts: Floats) -> Counts:
    """Return the device's counts (time, channel) for counts (time, taxel, axis): rounded, clipped to 16 bits."""
    return np.rint(counts).clip(0, 65_535).reshape(len(counts), -1).astype(np.uint16)
