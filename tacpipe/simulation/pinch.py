"""Compute the forces of a pinch with two fingers, and the position and size of each contact.

`Situation` has the values that a camera and a planned grasp determine, `Unseen` the others. Each finger presses with the
force that its joint torque allows, which decreases with the opening, or, on soft objects, with the object's resistance:
F = min(F_max, k s), where k = 2 E R is the stiffness for a flat punch with the width of the tip (K. L. Johnson, *Contact
Mechanics*, Cambridge 1985, section 3.8) and s is the closing distance beyond contact. The two forces may differ, because
table friction and the arm carry the difference, as in published grasps.

Size and depth of a contact follow Hertz, with the equations of chapter 4 of the same book. Arrays may have any shape.
Units are N, m, 1/m and Pa.
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
    """Return the effective radius in metres of a spherical tip in contact with a curved surface.

    ``curvatures_1_m`` are the surface's principal curvatures (..., 2). Each is added to the tip's curvature; the radius
    is the geometric mean of both relative radii, equation (4.25) with R_e = (R' R'')^(1/2). For a sphere of radius R it
    is 1 / (1/tip + 1/R). Raises `ValueError` if the surface is too concave for the tip.
    """
    relative = 1 / tip_m + np.asarray(curvatures_1_m, np.float64)
    if (relative <= 0).any():
        raise ValueError(f"A tip of {tip_m} m does not fit into a hollow of {relative.min() - 1 / tip_m:.4g} 1/m.")
    return np.asarray(1 / np.sqrt(relative.prod(axis=-1)))


def effective_modulus_pa(skin_pa: float, compliance_1_pa: float) -> float:
    """Return E* of a skin on an object in Pa: 1/E* = 1/E_skin + compliance, where a rigid object has compliance 0."""
    return 1 / (1 / skin_pa + compliance_1_pa)


def contact_radius_m(force_n: ArrayLike, radius_m: ArrayLike, modulus_pa: float) -> Floats:
    """Return the contact radius a = (3 F R / 4 E*)^(1/3) in metres, equation (4.22); 0 without force."""
    return np.asarray(np.cbrt(3 * np.asarray(force_n, np.float64) * np.asarray(radius_m) / (4 * modulus_pa)))


def indentation_m(contact_m: ArrayLike, radius_m: ArrayLike) -> Floats:
    """Return the total indentation of both bodies a^2 / R in metres, equation (4.23)."""
    return np.asarray(np.asarray(contact_m, np.float64) ** 2 / np.asarray(radius_m))


TIP_M = 0.0067  # radius of a fingertip, an assumption
SKIN_PA = 1.0e6  # modulus of its skin, an assumption
FORCE_N = ((3.2, 1.3), (2.6, 1.0))  # force of the joints at the smallest and the widest opening, by finger
OPENING_M = (0.02, 0.12)
SQUEEZE_M = (0.008, 0.012)  # range of the closing distance beyond contact
COMMON = 0.8  # common fraction of the variance of both fingers' log effort
# position of a level contact along and around the finger, without the thumb's side offset
CENTRE_M = ((0.0038, 0.0), (-0.0013, 0.0))
SIDE_M = (0.003, 0.005)  # range of the side offset of the thumb's contact
BEND_RAD = 0.3  # angle of the last joint at the smallest opening; it is straight at the widest
SHIFT_M, TILT_RAD = 0.002, np.deg2rad(5.0)  # maximum errors of a fingertip's pose


@dataclass(frozen=True)
class Situation:
    """The geometry of a grasp. Fingers are middle finger and thumb; axes are along and around the finger."""

    opening_m: float
    curvatures_1_m: Floats  # (finger, 2), principal curvatures of the object at the contact
    bending_1_m: Floats  # (finger, axis), normal curvatures of the object along the axes of the pad
    lean_rad: Floats  # (finger, axis), tilt of the contact normal from the pad's normal
    compliance_1_pa: float  # compliance of the object in 1/Pa


@dataclass(frozen=True)
class Unseen:
    """Random draws of the unobserved values of grasps."""

    effort: Floats  # (draw, finger), factor of the torque limit
    squeeze_m: Floats  # (draw,), closing distance beyond contact
    shift_m: Floats  # (draw, finger, axis), position error of the fingertip across the normal
    tilt_rad: Floats  # (draw, finger, axis), orientation error of the fingertip
    side_m: Floats  # (draw,), side offset of the thumb's contact


@dataclass(frozen=True)
class Touch:
    """Force, radius and position of a contact, and the deformation of the skin."""

    force_n: Floats  # (draw, finger)
    contact_m: Floats  # (draw, finger)
    skin_m: Floats  # (draw, finger)
    centre_m: Floats  # (draw, finger, axis), position of the contact on the unrolled core


def situation(placed: Placed, grasp: Grasp, compliance_1_pa: float) -> Situation:
    """Return the geometry of a grasp with a wrist. The middle finger is at ``g1``, the thumb at ``g2``."""
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


def draw_unseen(rng: np.random.Generator, draws: int, effort_spread: float) -> Unseen:
    """Return ``draws`` draws of the unobserved values. ``effort_spread`` is the standard deviation of the log effort."""
    common, individual = rng.normal(size=(draws, 1)), rng.normal(size=(draws, 2))
    return Unseen(
        np.exp(effort_spread * (np.sqrt(COMMON) * common + np.sqrt(1 - COMMON) * individual)),
        rng.uniform(*SQUEEZE_M, draws),
        rng.uniform(-SHIFT_M, SHIFT_M, (draws, 2, 2)),
        rng.uniform(-TILT_RAD, TILT_RAD, (draws, 2, 2)),
        rng.uniform(*SIDE_M, draws),
    )


def limits_n(opening_m: float) -> Floats:
    """Return the largest force of each finger (finger,) in N, which decreases with the opening."""
    fraction = (opening_m - OPENING_M[0]) / (OPENING_M[1] - OPENING_M[0])
    return np.array([narrow + fraction * (wide - narrow) for narrow, wide in FORCE_N])


def touch(situation: Situation, hidden: Unseen) -> Touch:
    """Return the contacts for a situation and each draw of the unobserved values."""
    force = hidden.effort * limits_n(situation.opening_m)
    if situation.compliance_1_pa:
        resisted = 2 / situation.compliance_1_pa * TIP_M * hidden.squeeze_m
        force = np.minimum(force, resisted[:, None])
    return Touch(force, *deformation(situation, force), centre(situation, hidden))


def deformation(situation: Situation, force_n: Floats) -> tuple[Floats, Floats]:
    """Return the contact radius and the deformation of the skin in metres under forces (..., finger).

    The skin's part of the total indentation is E* / E_skin, because both bodies deform in proportion to their compliance.
    """
    radius = effective_radius_m(TIP_M, situation.curvatures_1_m)
    modulus = effective_modulus_pa(SKIN_PA, situation.compliance_1_pa)
    contact = contact_radius_m(force_n, radius, modulus)
    return contact, indentation_m(contact, radius) * modulus / SKIN_PA


def centre(situation: Situation, hidden: Unseen) -> Floats:
    """Return the centre of the contact on the unrolled core (draw, finger, axis) in metres.

    The contact of a round tip is where its normal equals the object's. For a tip shifted by e on a surface of curvature
    k, the normal tilts by e k / (1 + k R).
    """
    fraction = (situation.opening_m - OPENING_M[0]) / (OPENING_M[1] - OPENING_M[0])
    lean = situation.lean_rad + np.array([BEND_RAD * (2 * fraction - 1), 0.0]) + hidden.tilt_rad
    lean = lean + hidden.shift_m * situation.bending_1_m / (1 + situation.bending_1_m * TIP_M)
    at = np.array(CENTRE_M) + TIP_M * lean
    at[:, 1, 1] += hidden.side_m
    return np.asarray(at)


RATE_HZ = 100.0  # rate of readings
FREE_S, CLOSING_S, HELD_S, RELEASE_S, AFTER_S = (0.8, 1.4), (0.3, 0.6), (0.8, 1.4), 0.2, 0.5
JITTER_NS = 100_000.0  # mean and standard deviation of the delay of a reading


@dataclass(frozen=True)
class PinchCourse:
    """The arrival times of readings (time,), and the fraction of the full force at these times (time,)."""

    t_ns: Times
    fraction: Floats
    moments_ns: dict[str, int]  # contact: first touch; hold: full force; release: start of its decrease


def draw_course(start_ns: int, rng: np.random.Generator) -> PinchCourse:
    """Return a course that starts at ``start_ns`` and whose phases have random durations."""
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
