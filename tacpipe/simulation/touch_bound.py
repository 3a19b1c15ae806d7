"""Compute the expected reading of a touch from its geometry, and the smallest error that a model can have.

The effort of the hand, the errors of the fingertips' poses, drift and noise of the sensors do not show in a cloud and a
planned grasp. The mean over them, E[y | geometry], has the least root-mean-square error of all predictions from these.

Sensors drift alike in grasps that are near in time, so that a model fitted on some of them knows part of the drift of the
others and may fall below this error. To hold a model against it, let nothing drift.
"""

from __future__ import annotations

import numpy as np

from tacpipe.arrays import Counts, Floats
from tacpipe.simulation import fingertip_sp, pinch

DRAWS = 256


def readings(
    situation: pinch.Situation,
    hand: fingertip_sp.Sensors,
    rng: np.random.Generator,
    *,
    draws: int = DRAWS,
    effort_spread: float = 0.15,
    noise_scale: float = 1.0,
    drift_count_day: float = 30.0,
) -> Counts:
    """Return what the sensors may read of one situation (draw, finger, channel), whatever is unseen drawn anew each time.

    Channels are the electrodes, then the pressure; times of drift are drawn too.
    """
    contact = pinch.touch(situation, pinch.unseen(rng, draws, effort_spread))
    counts = fingertip_sp.signal(hand, contact.force_n, contact.contact_m, contact.skin_m, contact.centre_m)
    phases = rng.uniform(0, 2 * np.pi, (draws, *hand.phases_rad.shape))
    off = fingertip_sp.drift(phases, drift_count_day) + noise_scale * hand.noise * rng.normal(size=counts.shape)
    return fingertip_sp.counted(counts + off)


def mean_and_variance(possible: Counts) -> tuple[Floats, Floats]:
    """Return mean and variance of readings (draw, finger, channel), each (finger, channel), counts and counts squared."""
    return possible.mean(axis=0), possible.var(axis=0, ddof=1)


def irreducible_rmse(variances: Floats) -> dict[str, float]:
    """Return the least root-mean-square error of each target, counts, over situations (situation, finger, channel).

    It is the root of the mean of the variances given the geometry: C. M. Bishop, *Pattern Recognition and Machine
    Learning*, 2006, equation (1.90).
    """
    mf, th = np.sqrt(variances[:, :, -1].mean(axis=0))
    e_mf, e_th = np.sqrt(variances[:, :, :-1].mean(axis=(0, 2)))
    return {"pdc_th": float(th), "pdc_mf": float(mf), "e_th": float(e_th), "e_mf": float(e_mf)}
