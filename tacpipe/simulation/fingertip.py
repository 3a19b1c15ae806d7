"""Simulate a BioTac on a slide: fluid pressure, nineteen electrodes, and 22 vibration readings per frame.

An electrode's impedance changes with the load: in proportion to the force, more the closer the electrode is to the
contact, with a part that friction shifts along the finger. The positions of the electrodes are published (C.-H. Lin et
al., *Estimating point of contact, force and torque in a biomimetic tactile sensor with deformable skin*, SynTouch 2013,
and in drivers). Their gains are assumptions with the magnitude of published slides: 0 to 235 counts, mostly below 60,
with a noise of 0.8 counts.

The host subtracts the readings at the start of the trial and stores absolute values, as in the published slides.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import Counts, Floats
from tacpipe.channels import places, schema

PLACES_M = places.BIOTAC_M  # (electrode, axis); x along the finger to its tip, z from the pad into the finger
ALONG_M = PLACES_M[:, 0]  # (electrode,), xi: distance by which an electrode measures the surface earlier
APERTURE_M = 0.0006
CENTRE_M = 0.001 * np.array([-1.0, 0.0, -5.08])  # position of the contact on the finger
REACH_M = 0.005  # standard deviation of the Gaussian sensitivity of electrodes
GAIN_COUNT_N = (45.0, 3.0)  # gain of an electrode at the centre, and additional gain of all electrodes
LEAN = 0.4  # fraction of the friction force that is added to, or subtracted from, the force 5 mm before or after the centre
PRESSURE_COUNT_N = 28.0  # PDC
TRIGGER_COUNT = 40  # PDC above which the slide starts
VIBRATION_COUNT_S_N = 25.0  # PAC per derivative of the contact force
NOISE_COUNT, PRESSURE_NOISE_COUNT, VIBRATION_NOISE_COUNT = 0.75, 1.0, 3.0
DRIFT_COUNT = 0.3  # random walk of an electrode: standard deviation after one second
RATE_HZ = 100.0
VIBRATION_RATE_HZ = RATE_HZ * schema.VIBRATIONS
REST_COUNT = (2500.0, 3500.0)  # range of counts of an untouched electrode
TARE_ROWS = 10  # rows at the start whose mean is subtracted
WARMTH_COUNT, WARMING_S = 120.0, 6.0  # TAC: the finger is warmer than the material


def gains() -> Floats:
    """Return the counts per newton at the centre of each electrode (electrode,)."""
    distance2 = ((PLACES_M - CENTRE_M) ** 2).sum(axis=1)
    near, uniform = GAIN_COUNT_N
    gain: Floats = near * np.exp(-distance2 / (2 * REACH_M**2)) + uniform
    return gain


def leans() -> Floats:
    """Return the fraction d of the friction that each electrode measures as pressure (electrode,).

    It is positive in front of the centre.
    """
    lean: Floats = LEAN * np.tanh((ALONG_M - CENTRE_M[0]) / 0.005)
    return lean


def simulate_counts(signal: Floats, noise_scale: float, rng: np.random.Generator) -> Counts:
    """Return the logged counts (time, electrode) for a signal: with rest level, noise and drift, rounded and tared."""
    steps = rng.normal(0, DRIFT_COUNT / np.sqrt(RATE_HZ), signal.shape)
    noise = rng.normal(0, NOISE_COUNT, signal.shape) + np.cumsum(steps, axis=0)
    rest_counts = rng.uniform(*REST_COUNT, signal.shape[1])
    return tare(np.rint(rest_counts + signal + noise_scale * noise))


def pressure(force_n: Floats, noise_count: Floats) -> Counts:
    """Return the logged fluid pressure PDC (time,) for a force and noise (time,)."""
    return tare(np.rint(PRESSURE_COUNT_N * force_n + noise_count))


def vibration(contact_n: Floats, noise_scale: float, rng: np.random.Generator) -> Counts:
    """Return PAC (time, reading) for a contact force (time × reading,) in N at `VIBRATION_RATE_HZ`."""
    noise = rng.normal(0, VIBRATION_NOISE_COUNT, len(contact_n))
    change = np.diff(contact_n, prepend=contact_n[:1]) * VIBRATION_RATE_HZ
    return to_counts(VIBRATION_COUNT_S_N * change + noise_scale * noise).reshape(-1, schema.VIBRATIONS)


def warmth(since_s: Floats, noise_scale: float, rng: np.random.Generator) -> tuple[Counts, Counts]:
    """Return TDC and TAC (time,) at ``since_s`` after the contact: the finger cools, fast at first."""
    touching = np.maximum(since_s, 0.0)
    quick = WARMTH_COUNT * (1 - np.exp(-touching / 0.3)) * np.exp(-touching / WARMING_S)
    noise = rng.normal(0, 1.0, (2, len(since_s))) * noise_scale
    return to_counts(2 * (1 - np.exp(-touching / WARMING_S)) + noise[0]), to_counts(quick + noise[1])


def tare(counts: Floats) -> Counts:
    """Return the absolute differences of counts (time, …) from their mean over the first `TARE_ROWS` rows."""
    return to_counts(counts - np.rint(counts[:TARE_ROWS].mean(axis=0)))


def to_counts(counts: Floats) -> Counts:
    """Convert tared counts to the values that the sensor sends: absolute, rounded, within 16 bits."""
    return np.rint(np.abs(counts)).clip(0, 65_535).astype(np.uint16)
