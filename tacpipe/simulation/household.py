"""The objects that are grasped on the simulated table: named ones of six families, each of a size and a stiffness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.errors import TacpipeError
from tacpipe.simulation.bodies import Bow, Box, Ellipsoid, Frustum, Shape

FAMILIES = ("box", "cylinder", "sphere", "ellipsoid", "cone", "bow")
MODULI_PA = {"rigid": np.inf, "elastic": 50_000.0, "foam": 15_000.0}
SHARES = (0.6, 0.2, 0.2)  # fraction of the objects per entry of MODULI_PA
TAPER, NARROW = (
    (0.08, 0.22),
    0.4,
)  # slope of cones within friction, and smallest fraction of the radius at the top
REFERENCE_M = 0.04  # radius of the sphere that represents spheres of all sizes
SPHERES_M = (0.012, 0.058)  # radii of those


@dataclass(frozen=True)
class Thing:
    """A named object, its surface, and how readily it gives way: one over Young's modulus, 1/Pa."""

    name: str
    family: str
    shape: Shape
    stiffness: str

    @property
    def compliance_1_pa(self) -> float:
        """One over Young's modulus, 1/Pa; 0 if rigid."""
        return 1 / MODULI_PA[self.stiffness]


def draw_thing(rng: np.random.Generator, family: str, number: int, stiffness: str = "mixed") -> Thing:
    """Return an object of a family as ``rng`` draws it, named by the family and its ``number``, as in "cone-03".

    ``stiffness`` is one of `MODULI_PA`, or mixed. Raises `TacpipeError` for an unknown family or stiffness.
    """
    if family not in FAMILIES:
        raise TacpipeError(f"There is no family {family!r}; known are {', '.join(FAMILIES)}.")
    if stiffness not in (*MODULI_PA, "mixed"):
        raise TacpipeError(f"There is no stiffness {stiffness!r}; known are mixed, {', '.join(MODULI_PA)}.")
    drawn = str(rng.choice(list(MODULI_PA), p=SHARES))
    shape = _shape(family, rng)
    return Thing(f"{family}-{number:02d}", family, shape, drawn if stiffness == "mixed" else stiffness)


def _shape(family: str, rng: np.random.Generator) -> Shape:
    """Return a body whose least width is some 20 mm and whose greatest 120 mm."""

    def between(*limits_mm: tuple[float, float]) -> list[float]:
        return [0.001 * float(rng.uniform(*limits)) for limits in limits_mm]

    if family == "box":
        return Box(np.array(between((15, 35), (22, 50), (35, 60))))
    if family == "cylinder":
        radius, half = between((20, 45), (25, 60))
        return Frustum(radius, radius, half)
    if family == "sphere":
        return Ellipsoid(np.repeat(between((27, 58)), 3))
    if family == "ellipsoid":
        return Ellipsoid(np.array(between((18, 32), (26, 45), (38, 60))))
    if family == "cone":
        bottom, half = between((28, 50), (25, 60))
        return Frustum(bottom, max(NARROW * bottom, bottom - 2 * half * float(rng.uniform(*TAPER))), half)
    tube, arc = between((11, 19), (36, 44))
    return Bow(arc, tube, float(rng.uniform(1.2, 2.6)))
