"""Contact of two elastic bodies after Hertz: how wide it grows under a force, and how deep each body gives way.

Equations are those of K. L. Johnson, *Contact Mechanics*, Cambridge 1985, chapter 4. Arrays of any shape are taken
together; forces are in newton, lengths in metres, curvatures in 1/m, moduli in pascal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tacpipe.arrays import Floats


def effective_radius_m(tip_m: float, curvatures_1_m: ArrayLike) -> Floats:
    """Return the radius of the sphere that touches a plane as a spherical tip does a surface, metres.

    ``curvatures_1_m`` are the surface's two principal curvatures (..., 2). Each adds to the tip's own; the radius is
    the geometric mean of both relative ones, equation (4.25) with R_e = (R' R'')^(1/2). For a sphere of radius R it is
    1 / (1/tip + 1/R). Raises `ValueError` where the surface is hollowed out so much that the tip does not reach its
    ground.
    """
    relative = 1 / tip_m + np.asarray(curvatures_1_m, np.float64)
    if (relative <= 0).any():
        raise ValueError(f"A tip of {tip_m} m does not fit into a hollow of {relative.min() - 1 / tip_m:.4g} 1/m.")
    return np.asarray(1 / np.sqrt(relative.prod(axis=-1)))


def effective_modulus_pa(skin_pa: float, compliance_1_pa: float) -> float:
    """Return E* of a skin on an object, pascal: 1/E* = 1/E_skin + compliance, which is 0 for a rigid object."""
    return 1 / (1 / skin_pa + compliance_1_pa)


def contact_radius_m(force_n: ArrayLike, radius_m: ArrayLike, modulus_pa: float) -> Floats:
    """Return a = (3 F R / 4 E*)^(1/3), metres, equation (4.22); 0 where there is no force."""
    return np.asarray(np.cbrt(3 * np.asarray(force_n, np.float64) * np.asarray(radius_m) / (4 * modulus_pa)))


def indentation_m(contact_m: ArrayLike, radius_m: ArrayLike) -> Floats:
    """Return by how much both bodies together give way, a^2 / R, metres, equation (4.23)."""
    return np.asarray(np.asarray(contact_m, np.float64) ** 2 / np.asarray(radius_m))
