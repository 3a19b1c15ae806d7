"""A pinch: how hard two fingers press on what lies between them, and where and how widely each touches it.

What a camera and a planned grasp state is the `Situation`; what they do not is `Unseen`. Each finger presses as hard as
the torque of its joints allows, the less the wider the hand is open, or, on soft objects, as the object resists:
F = min(F_max, k s), with k = 2 E R of a flat punch as wide as the tip (K. L. Johnson, *Contact Mechanics*, Cambridge
1985, section 3.8) and s by how much fingers close beyond touch. The two forces differ by what the table's friction and
the arm hold, as in published grasps, where the pressures of the two fingers go their own ways.

The width and depth of a contact follow Hertz, with the equations of chapter 4 of the same book. Arrays of any shape are
taken together; forces are in newton, lengths in metres, curvatures in 1/m, moduli in pascal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tacpipe.arrays import Floats, Times
from tacpipe.clouds.grasp import Grasp
from tacpipe.simulation import faults
from tacpipe.simulation.bodies import principal_curvatures
from tacpipe.simulation.depth_camera import Placed


def effective_radius_m(tip_m: float, curvatures_1_m: ArrayLike) -> Floats:
    """Return the radius of the sphere that touches a plane as a spherical tip does a surface, metres.

    ``curvatures_1_m`` are the surface's two principal curvatures (..., 2). Each adds to the tip's own; the radius is
    the geometric mean of both relative ones, equation (4.25) with R_e = (R' R'')^(1/2). For a sphere of radius R it is
    1 / (1/tip + 1/R). Raises `ValueError` if the surface is hollowed out so much that the tip does not reach its
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
    """Return a = (3 F R / 4 E*)^(1/3), metres, equation (4.22), or 0 if there is no force."""
    return np.asarray(np.cbrt(3 * np.asarray(force_n, np.float64) * np.asarray(radius_m) / (4 * modulus_pa)))


def indentation_m(contact_m: ArrayLike, radius_m: ArrayLike) -> Floats:
    """Return by how much both bodies together give way, a^2 / R, metres, equation (4.23)."""
    return np.asarray(np.asarray(contact_m, np.float64) ** 2 / np.asarray(radius_m))


TIP_M = 0.0067  # radius of a fingertip, an assumption
SKIN_PA = 1.0e6  # modulus of its skin, an assumption
FORCE_N = ((3.2, 1.3), (2.6, 1.0))  # force of the joints at the smallest and the widest opening, by finger
OPENING_M = (0.02, 0.12)
SQUEEZE_M = (0.008, 0.012)  # distance that fingers close beyond the touch
COMMON = 0.8  # fraction of the logarithm of the effort that both fingers have in common
CENTRE_M = (
    (0.0038, 0.0),
    (-0.0013, 0.0),
)  # along and around the finger, where a level contact is, but for the thumb's side
SIDE_M = (0.003, 0.005)  # offset of the thumb's contact to its side
BEND_RAD = 0.3  # angle of the last joint at the smallest opening; it is straight at the widest
SHIFT_M, TILT_RAD = 0.002, np.deg2rad(5.0)  # largest errors of a fingertip's pose


@dataclass(frozen=True)
class Situation:
    """The geometry of a grasp. Fingers are middle finger and thumb, axes are along and around the finger."""

    opening_m: float
    curvatures_1_m: Floats  # (finger, 2), principal ones of the object at the contact
    bending_1_m: Floats  # (finger, axis), its normal curvatures along the axes of the pad
    lean_rad: Floats  # (finger, axis), of the normal from the pad's own
    compliance_1_pa: float  # compliance of the object


@dataclass(frozen=True)
class Unseen:
    """The unobserved values of grasps, drawn any number of times."""

    effort: Floats  # (draw, finger), by which the torque limit is multiplied
    squeeze_m: Floats  # (draw,)
    shift_m: Floats  # (draw, finger, axis), of the fingertip across the normal
    tilt_rad: Floats  # (draw, finger, axis)
    side_m: Floats  # (draw,), of the thumb


@dataclass(frozen=True)
class Touch:
    """The resulting touch: force, radius of the contact, deformation of the skin, and position of the contact."""

    force_n: Floats  # (draw, finger)
    contact_m: Floats  # (draw, finger)
    skin_m: Floats  # (draw, finger)
    centre_m: Floats  # (draw, finger, axis), on the unrolled core


def situation(placed: Placed, grasp: Grasp, compliance_1_pa: float) -> Situation:
    """Return what geometry reports on a grasp whose wrist is known; the middle finger is at ``g1``, the thumb at ``g2``."""
    assert grasp.wrist is not None
    at_m = np.stack([grasp.g1_m, grasp.g2_m])
    normal, bending = placed.normal(at_m), placed.bending(at_m)
    approach = grasp.wrist[:, 0]
    lean, along = np.empty((2, 2)), np.empty((2, 2))
    for finger, pad in enumerate((grasp.closing, -grasp.closing)):
        axes = np.stack([approach, np.cross(pad, approach)])
        inward = -normal[finger]
        lean[finger] = np.arctan2(axes @ inward, pad @ inward)
        along[finger] = np.einsum("ij,jk,ik->i", axes, bending[finger], axes)
    return Situation(grasp.opening_m, principal_curvatures(bending, normal), along, lean, compliance_1_pa)


def unseen(rng: np.random.Generator, draws: int, effort_spread: float) -> Unseen:
    """Return ``draws`` draws of what nobody sees; ``effort_spread`` is the standard deviation of the effort's logarithm."""
    common, individual = rng.normal(size=(draws, 1)), rng.normal(size=(draws, 2))
    return Unseen(
        np.exp(effort_spread * (np.sqrt(COMMON) * common + np.sqrt(1 - COMMON) * individual)),
        rng.uniform(*SQUEEZE_M, draws),
        rng.uniform(-SHIFT_M, SHIFT_M, (draws, 2, 2)),
        rng.uniform(-TILT_RAD, TILT_RAD, (draws, 2, 2)),
        rng.uniform(*SIDE_M, draws),
    )


def limits_n(opening_m: float) -> Floats:
    """Return the force that the joints' torque allows each finger (finger,), N: it falls with the opening."""
    fraction = (opening_m - OPENING_M[0]) / (OPENING_M[1] - OPENING_M[0])
    return np.array([narrow + fraction * (wide - narrow) for narrow, wide in FORCE_N])


def touch(situation: Situation, hidden: Unseen) -> Touch:
    """Return what comes of a situation and each draw of what nobody sees."""
    force = hidden.effort * limits_n(situation.opening_m)
    if situation.compliance_1_pa:
        resisted = 2 / situation.compliance_1_pa * TIP_M * hidden.squeeze_m
        force = np.minimum(force, resisted[:, None])
    return Touch(force, *pressed(situation, force), centre(situation, hidden))


def pressed(situation: Situation, force_n: Floats) -> tuple[Floats, Floats]:
    """Return the contact's radius and by how much the skin gives way, metres, under forces (..., finger).

    Of the whole indentation the skin takes the share E* / E_skin: both bodies give way in proportion to compliance.
    """
    radius = effective_radius_m(TIP_M, situation.curvatures_1_m)
    modulus = effective_modulus_pa(SKIN_PA, situation.compliance_1_pa)
    contact = contact_radius_m(force_n, radius, modulus)
    return contact, indentation_m(contact, radius) * modulus / SKIN_PA


def centre(situation: Situation, hidden: Unseen) -> Floats:
    """Return the middle of the contact on the unrolled core (draw, finger, axis), metres.

    A round tip touches where its normal is the object's. Tips that are shifted by e over a surface of curvature k roll
    to where the normal leans by e k / (1 + k R).
    """
    fraction = (situation.opening_m - OPENING_M[0]) / (OPENING_M[1] - OPENING_M[0])
    lean = situation.lean_rad + np.array([BEND_RAD * (2 * fraction - 1), 0.0]) + hidden.tilt_rad
    lean = lean + hidden.shift_m * situation.bending_1_m / (1 + situation.bending_1_m * TIP_M)
    at = np.array(CENTRE_M) + TIP_M * lean
    at[:, 1, 1] += hidden.side_m
    return np.asarray(at)


RATE_HZ = 100.0  # rate of readings
FREE_S, CLOSING_S, HELD_S, RELEASE_S, AFTER_S = (0.8, 1.4), (0.3, 0.6), (0.8, 1.4), 0.2, 0.5
JITTER_NS = 100_000.0  # mean and standard deviation of a reading's way to the host


@dataclass(frozen=True)
class PinchCourse:
    """When readings arrive (time,), and which fraction of the full force fingers press with then (time,)."""

    t_ns: Times
    fraction: Floats
    moments_ns: dict[str, int]  # contact: first touch; hold: the force is reached; release: it begins to fall


def course(start_ns: int, rng: np.random.Generator) -> PinchCourse:
    """Return a course that starts at ``start_ns``; how long each part lasts is random."""
    free_s, closing_s, held_s = (float(rng.uniform(*limits)) for limits in (FREE_S, CLOSING_S, HELD_S))
    knots_s = np.cumsum([free_s, closing_s, held_s, RELEASE_S])
    true_s = np.arange(round((knots_s[-1] + AFTER_S) * RATE_HZ)) / RATE_HZ
    fraction = np.interp(true_s, knots_s, (0.0, 1.0, 1.0, 0.0))
    true_ns = np.rint(true_s * 1e9).astype(np.int64)
    moments = zip(("contact", "hold", "release"), knots_s, strict=False)
    return PinchCourse(
        start_ns + faults.arrivals(true_ns, JITTER_NS, rng),
        fraction**2 * (3 - 2 * fraction),  # smooth start and stop
        {name: start_ns + round(1e9 * float(at_s)) for name, at_s in moments},
    )
