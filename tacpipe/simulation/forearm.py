"""Simulate a patch of iCub RoboSkin on a slide: six triangular modules of ten taxels, some of which the object presses.

The compensated readings of the iCub are floats, 0 without pressure and clipped at 255. The contact patch moves over the
triangles as the curved forearm rolls on the object. A dead zone hides the noise of taxels outside of the patch. In the
published slides, 51 % of the readings are zero.

The layout is that of `tacpipe.channels.places.roboskin_m`.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import Float32s, Floats
from tacpipe.channels import places, schema

TAXELS = schema.TRIANGLES * schema.TRIANGLE_TAXELS
APERTURE_M = 0.0018
SIGMA_M = 0.0085  # standard deviation of the patch's Gaussian pressure
GAIN_COUNT_N = 170.0  # gain of a taxel at the centre of the patch
LEAN = 0.3  # value one sigma before or after the centre, as for the fingertip
NOISE_COUNT = 2.25  # noise of a taxel, three times that of the fingertip
DEAD_COUNT = 6.0  # dead band: subtracted from readings; smaller readings become 0
DRIFT_COUNT = 0.9  # random walk: standard deviation after one second
MAX_COUNT = 255.0
RATE_HZ, FRAMES = 50.0, 75
START_M = ((-0.018, -0.010), (-0.003, 0.003))  # start of the patch's centre along and across the strip
ROLL_M = ((0.012, 0.022), (-0.003, 0.003))  # displacement of the centre during a slide


PLACES_M = places.roboskin_m()  # (taxel, axis): along the strip and across it, around its centre
ALONG_M = PLACES_M[:, 0]  # (taxel,), xi: distance by which a taxel measures the surface earlier


def fractions(patch_m: Floats) -> Floats:
    """Return the fraction of the patch's pressure that each taxel measures (time, taxel).

    It is 1 at the patch's centre ``patch_m`` (time, axis).
    """
    distance2 = ((PLACES_M - patch_m[:, None]) ** 2).sum(axis=2)
    fraction: Floats = np.exp(-distance2 / (2 * SIGMA_M**2))
    return fraction


def leans(patch_m: Floats) -> Floats:
    """Return the fraction d of the friction that each taxel measures as pressure (time, taxel).

    It is positive in front of the patch.
    """
    return LEAN * np.tanh((ALONG_M - patch_m[:, :1]) / SIGMA_M)


def simulate_taxels(signal: Floats, noise_scale: float, rng: np.random.Generator) -> Float32s:
    """Return the logged taxels (time, taxel) for a signal: with noise and drift, less the dead zone, and clipped."""
    steps = rng.normal(0, DRIFT_COUNT / np.sqrt(RATE_HZ), signal.shape)
    noise = rng.normal(0, NOISE_COUNT, signal.shape) + np.cumsum(steps, axis=0)
    return (signal + noise_scale * noise - DEAD_COUNT).clip(0, MAX_COUNT).astype(np.float32)
