"""Simulate a pad of taxels other than uSkin: the contact force is distributed over a grid of any number of taxels."""

from __future__ import annotations

import math

import numpy as np

from tacpipe.arrays import Floats, Times
from tacpipe.simulation.emulation.world import World

WIDTH_M = 0.03  # width of a pad along both axes
SIGMA_M = 0.005  # standard deviation of the Gaussian that distributes the pressure


def places(taxels: int) -> Floats:
    """Return where taxels lie on the pad (taxel, 2), m from its centre: row by row of a grid as square as can be.

    >>> places(2).tolist()
    [[0.0, -0.0075], [0.0, 0.0075]]
    """
    rows = next(count for count in range(math.isqrt(taxels), 0, -1) if taxels % count == 0)
    columns = taxels // rows
    row, column = np.divmod(np.arange(taxels), columns)
    return WIDTH_M * np.column_stack([(row + 0.5) / rows - 0.5, (column + 0.5) / columns - 0.5])


def pressed(world: World, finger: int, t_ns: Times, taxels: int) -> Floats:
    """Return the force on each taxel (time, taxel, axis), N: shear along x and y, pressure along z."""
    normal_n = world.contact(t_ns, lambda scene: scene.contact.normal_n[:, finger])
    moved_m = world.contact(t_ns, lambda scene: scene.contact.displacement_m)
    load_n = world.contact(t_ns, lambda scene: scene.contact.force_n[:, ::2]) / 2
    centre_m = world.skins[finger].centre_m + np.clip(moved_m, -WIDTH_M / 2, WIDTH_M / 2)
    distance2 = ((places(taxels) - centre_m[:, None]) ** 2).sum(axis=2)  # (time, taxel)
    fraction = np.exp((distance2.min(axis=1, keepdims=True) - distance2) / (2 * SIGMA_M**2))
    fraction /= fraction.sum(axis=1, keepdims=True)
    force: Floats = fraction[:, :, None] * np.column_stack([load_n, normal_n])[:, None]
    return force


def peak_fraction(taxels: int) -> float:
    """Return the fraction of the force that the taxel under its centre bears, of so many."""
    distance2 = (places(taxels) ** 2).sum(axis=1)
    weight = np.exp((distance2.min() - distance2) / (2 * SIGMA_M**2))
    return float(weight.max() / weight.sum())
