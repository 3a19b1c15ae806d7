"""Simulate the BioTac SP fingertips of a hand, middle finger and thumb, under contact.

An electrode's impedance decreases where the skin is pressed towards it and the fluid layer gets thin, and increases
where the fluid moves. The published electrode positions are unrolled: distance along the finger, and distance around the
core. Rest levels and noise are those of untouched sensors of a published rig. The changes of electrodes and pressure
under load are assumptions with the magnitude of readings under published grasps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Counts, Floats, Times
from tacpipe.channels import biotac_sp

CHANNELS = biotac_sp.ELECTRODES + 1  # tactile channels of a finger: the electrodes, then the fluid pressure
GAIN_COUNT = 2600.0  # decrease of an electrode if all fluid is squeezed out
FLUID_M = 0.0006  # indentation at which 1 - 1/e of this decrease is reached
BREADTH = 1.1  # ratio of the pressed region's sigma to the contact radius
BULGE = 0.35  # fraction of the decrease of pressed electrodes by which the others increase
REST_COUNT = (2400.0, 3480.0)  # range of the rest level of an electrode
NOISE_COUNT = (3.5, 6.4)  # range of the standard deviation of an electrode
PRESSURE_NOISE_COUNT = (0.05, 0.25)
PRESSURE_COUNT = (1676.0, 2779.0)  # reading of the untouched finger, by finger
PRESSURE_COUNT_N = 140.0  # slope
FULL_COUNT = {"electrode": (100, 3800), "pdc": (0, 4095)}  # bounds of the readings
DRIFT_DAYS = (2.0, 3.0, 5.0)  # periods of the drift
DAY_NS = 86_400_000_000_000
# ranges of the other channels of the untouched finger, by finger
OTHERS_COUNT = {"pac0": (2037, 2049), "pac1": (2037, 2049), "tac": (2152, 2051), "tdc": (2620, 2449)}
OTHERS_NOISE_COUNT = {"pac0": 8.0, "pac1": 8.0, "tac": 10.0, "tdc": 6.0}
VIBRATION_COUNT_S_N = 3.0  # PAC per rate of change of the force


@dataclass(frozen=True)
class Sensors:
    """The properties of two sensors: rest levels and noise of their channels (finger, channel), and phases of the drift."""

    rest: Floats
    noise: Floats
    phases_rad: Floats  # (period, finger, channel)


def draw_sensors(rng: np.random.Generator) -> Sensors:
    """Return two random sensors."""
    fingers, electrodes = len(biotac_sp.FINGERS), biotac_sp.ELECTRODES
    rest_counts = np.column_stack([rng.uniform(*REST_COUNT, (fingers, electrodes)), PRESSURE_COUNT])
    noise = np.column_stack(
        [
            rng.uniform(*NOISE_COUNT, (fingers, electrodes)),
            rng.uniform(*PRESSURE_NOISE_COUNT, fingers),
        ]
    )
    return Sensors(rest_counts, noise, rng.uniform(0, 2 * np.pi, (len(DRIFT_DAYS), *rest_counts.shape)))


def electrode_change(contact_m: Floats, skin_m: Floats, centre_m: Floats) -> Floats:
    """Return the change of electrodes by a contact (..., electrode) in counts.

    ``contact_m`` is the radius of the contact (...), ``skin_m`` the deformation of the skin (...), ``centre_m`` the
    centre of the contact on the unrolled core (..., axis), all in metres.
    """
    distance2 = ((biotac_sp.unrolled_positions_m() - centre_m[..., None, :]) ** 2).sum(axis=-1)
    sigma2 = np.maximum(BREADTH * contact_m, 1e-9) ** 2
    near = np.exp(-distance2 / (2 * sigma2[..., None]))
    fall = GAIN_COUNT * (1 - np.exp(-skin_m / FLUID_M))[..., None] * near
    distribution = (1 - near) / (1 - near).sum(axis=-1, keepdims=True)
    return np.asarray(BULGE * fall.sum(axis=-1, keepdims=True) * distribution - fall)


def signal(hand: Sensors, force_n: Floats, contact_m: Floats, skin_m: Floats, centre_m: Floats) -> Floats:
    """Return the counts of both sensors without noise and drift (..., finger, channel)."""
    pressure = PRESSURE_COUNT_N * force_n[..., None]
    return np.asarray(hand.rest + np.concatenate([electrode_change(contact_m, skin_m, centre_m), pressure], axis=-1))


def drift(phases_rad: Floats, rate_count_day: float, t_ns: int | Times = 0) -> Floats:
    """Return the drift of channels at ``t_ns`` in counts, from phases (..., period, finger, channel).

    The drift is a sum of three slow waves with a root-mean-square rate of ``rate_count_day`` counts per day.
    """
    rate = 2 * np.pi / np.array(DRIFT_DAYS)[:, None, None]  # rad a day
    size = rate_count_day / rate * np.sqrt(2 / len(DRIFT_DAYS))
    days = np.asarray(t_ns, np.float64)[..., None, None, None] / DAY_NS
    return np.asarray((size * np.sin(rate * days + phases_rad)).sum(axis=-3))


def to_counts(counts: Floats) -> Counts:
    """Return the logged channels (..., channel), rounded and clipped to `FULL_COUNT`."""
    low, high = np.array([FULL_COUNT["electrode"]] * biotac_sp.ELECTRODES + [FULL_COUNT["pdc"]]).T
    return np.rint(counts).clip(low, high).astype(np.uint16)


def rows(counts: Counts, speed_n_s: Floats, noise_scale: float, rng: np.random.Generator) -> list[Floats]:
    """Return the 58 columns (time,) of `biotac_sp.fields` for channels (time, finger, channel).

    ``speed_n_s`` is the rate of change of the force (time, finger), which the vibration readings show.
    """
    blocks = []
    for field in biotac_sp.fields():
        name, channel = field.name.split("_")
        finger = biotac_sp.FINGERS.index(name)
        if channel == "pdc":
            blocks.append(counts[:, finger, -1].astype(np.float64))
        elif channel.startswith("electrode"):
            blocks.append(counts[:, finger, int(channel.removeprefix("electrode")) - 1].astype(np.float64))
        else:
            level = OTHERS_COUNT[channel][finger] + noise_scale * rng.normal(
                0, OTHERS_NOISE_COUNT[channel], len(counts)
            )
            shake = VIBRATION_COUNT_S_N * speed_n_s[:, finger] if channel.startswith("pac") else 0.0
            blocks.append(np.rint(level + shake).clip(0, 4095))
    return blocks
