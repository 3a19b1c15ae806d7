"""A BioTac on a slide: the fluid's pressure, nineteen electrodes and, 22 times a frame, the quick part of the pressure.

An electrode's impedance changes as skin and fluid move under the load: in proportion to the force, the more the nearer
the electrode is to where the finger touches, with a part that friction drags along the finger. Where the electrodes lie
is published (C.-H. Lin et al., *Estimating point of contact, force and torque in a biomimetic tactile sensor with
deformable skin*, SynTouch 2013, and the drivers that list them). How much each changes is an assumption: of the size of
published slides, 0 to 235 counts, most of them below 60, and a noise of 0.8 counts.

The host takes the readings of the trial's start off and keeps the absolute value, as in the published slides.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import Counts, Floats
from tacpipe.channels import places, schema

PLACES_M = places.BIOTAC_M  # (electrode, axis); x along the finger to its tip, z from the pad into the finger
ALONG_M = PLACES_M[:, 0]  # (electrode,), xi: by which an electrode measures the surface earlier
APERTURE_M = 0.0006
CENTRE_M = 0.001 * np.array([-1.0, 0.0, -5.08])  # position of the contact on the finger
REACH_M = 0.005  # standard deviation of the Gaussian by which electrodes measure what is there
GAIN_COUNT_N = (45.0, 3.0)  # gain of an electrode at the centre, and gain of all electrodes
LEAN = 0.4  # fraction of the force, times friction, that shows more or less at 5 mm before or behind the centre
PRESSURE_COUNT_N = 28.0  # PDC
TRIGGER_COUNT = 40  # PDC above which the slide starts
VIBRATION_COUNT_S_N = 25.0  # PAC, by the derivative of what is measured
NOISE_COUNT, PRESSURE_NOISE_COUNT, VIBRATION_NOISE_COUNT = 0.75, 1.0, 3.0
DRIFT_COUNT = 0.3  # random walk of an electrode, counts after one second
RATE_HZ = 100.0
VIBRATION_RATE_HZ = RATE_HZ * schema.VIBRATIONS
REST_COUNT = (2500.0, 3500.0)  # counts of an electrode without touch
TARE_ROWS = 10  # time at the start whose mean is subtracted
WARMTH_COUNT, WARMING_S = 120.0, 6.0  # TAC: the finger is warmer than the material


def gains() -> Floats:
    """Return the counts that one newton at the centre gives on each electrode (electrode,)."""
    distance2 = ((PLACES_M - CENTRE_M) ** 2).sum(axis=1)
    near, uniform = GAIN_COUNT_N
    gain: Floats = near * np.exp(-distance2 / (2 * REACH_M**2)) + uniform
    return gain


def leans() -> Floats:
    """Return the fraction of the friction that each electrode measures as pressure (electrode,).

    This is the term d; it is positive forward of the centre.
    """
    lean: Floats = LEAN * np.tanh((ALONG_M - CENTRE_M[0]) / 0.005)
    return lean


def read(signal: Floats, noise_scale: float, rng: np.random.Generator) -> Counts:
    """Return electrodes (time, electrode) as they are logged: with rest, noise and drift, rounded, tared and absolute."""
    steps = rng.normal(0, DRIFT_COUNT / np.sqrt(RATE_HZ), signal.shape)
    noise = rng.normal(0, NOISE_COUNT, signal.shape) + np.cumsum(steps, axis=0)
    rest_counts = rng.uniform(*REST_COUNT, signal.shape[1])
    return tared(np.rint(rest_counts + signal + noise_scale * noise))


def pressure(force_n: Floats, noise_count: Floats) -> Counts:
    """Return the fluid's pressure PDC (time,) as it is logged, of a force and noise (time,)."""
    return tared(np.rint(PRESSURE_COUNT_N * force_n + noise_count))


def vibration(contact_n: Floats, noise_scale: float, rng: np.random.Generator) -> Counts:
    """Return PAC (time, reading) of what is measured at `VIBRATION_RATE_HZ` (time * reading,), N."""
    noise = rng.normal(0, VIBRATION_NOISE_COUNT, len(contact_n))
    change = np.diff(contact_n, prepend=contact_n[:1]) * VIBRATION_RATE_HZ
    return counted(VIBRATION_COUNT_S_N * change + noise_scale * noise).reshape(-1, schema.VIBRATIONS)


def warmth(since_s: Floats, noise_scale: float, rng: np.random.Generator) -> tuple[Counts, Counts]:
    """Return TDC and TAC (time,) at ``since_s`` after the finger touched: it cools, fast at first."""
    touching = np.maximum(since_s, 0.0)
    quick = WARMTH_COUNT * (1 - np.exp(-touching / 0.3)) * np.exp(-touching / WARMING_S)
    noise = rng.normal(0, 1.0, (2, len(since_s))) * noise_scale
    return counted(2 * (1 - np.exp(-touching / WARMING_S)) + noise[0]), counted(quick + noise[1])


def tared(counts: Floats) -> Counts:
    """Return by how much counts (time, …) differ from their mean over the first `TARE_ROWS` rows."""
    return counted(counts - np.rint(counts[:TARE_ROWS].mean(axis=0)))


def counted(counts: Floats) -> Counts:
    """Return the absolute values of tared counts, rounded, within 16 bits."""
    rounded: Counts = np.rint(np.abs(counts)).clip(0, 65_535).astype(np.uint16)
    return rounded
