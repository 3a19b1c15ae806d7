"""Plan what happens to the object of a trial: a slip, a close call that holds, a release, shaking, or nothing.

The kinds of `HANDLINGS` are:

- *jolt*: a motion of `tacpipe.simulation.trajectory` whose largest load exceeds the friction limit, so the object slips;
- *jolt-held*: such a motion whose largest load stays just below the limit;
- *fade*: the lifted hand is at rest, and the grip force decreases until friction no longer carries the object, as with
  a gripper that loses pressure or torque. The slip starts when 2 mu_s N falls below the load;
- *fade-held*: the same decrease ends just above the load, so the touch is nearly the same, and nothing slips;
- *release*: the gripper opens on purpose, in half of the trials after the hand has put the object down. In the air, the
  object slides out of the fingers, which is no slip but the intended end of the grasp;
- *shake*: a person or a program shakes the lifted object in bouts below the friction limit. Cyclic movements with an
  object in the hand load the grip in the same way (Flanagan and Wing, Exp Brain Res 105, 1995);
- *hold*: the lifted hand is at rest.

A soft pad is compressed by a few millimetres, and the fingers of a Franka hand open with up to 0.1 m/s (manufacturer's
manual), so the force of a release decreases to zero within `RELEASE_S`. Friction and mass have a few values each, which
are the objects, so that models can be tested on objects that they have not seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.errors import TacpipeError
from tacpipe.simulation.trajectory import (
    PEAK_M_S2,
    RATE_HZ,
    TREMOR_HZ,
    TREMOR_M,
    Trajectory,
    draw_trajectory,
    minimum_jerk,
    path_from_start,
)

PLANNED, MIXED = "planned", "mixed"  # no handling; equal chances of all kinds
HANDLINGS = ("jolt", "jolt-held", "fade", "fade-held", "release", "shake", "hold")
FRICTIONS = (0.35, 0.43, 0.51, 0.60)  # friction coefficients mu_s of the surfaces
SLIPPING, HELD = (1.05, 1.25), (0.85, 0.97)  # ranges of the largest load as a fraction of the friction limit
FIRM = (0.45, 0.75)  # range of the largest load for a firm grasp
SHAKEN = (0.60, 0.90)  # range of the largest load for an object that is shaken
LIFT_M, LIFT_S = (0.10, 0.25), (0.6, 1.0)  # ranges of height and duration of the lift
FADE_S = (0.4, 1.5)  # range of the duration of a decrease of the grip
RELEASE_S = (0.05, 0.30)  # range of the duration of the opening
SHAKE_HZ, BOUT_S, REST_S = (1.5, 4.0), (1.0, 2.0), (0.4, 1.5)  # ranges: frequency, duration of bouts and of pauses
AFTER_LIFT_S, BEFORE_END_S = 0.8, 1.5  # time without an event after the lift, and before the end
MIN_DURATION_S = 7.0


@dataclass(frozen=True)
class HandlingPlan:
    """The motion of the hand and the course of the grip."""

    kind: str
    path: Trajectory
    friction: float  # mu_s
    effort: float  # largest load as a fraction of the friction limit, before the grip changes
    start: int | None = None  # row in which the grip begins to decrease
    rows: int = 0  # duration of the decrease
    final_effort: float = np.inf  # largest load after the decrease as a fraction of the limit; infinite for a release

    @property
    def release(self) -> int | None:
        """The row in which the gripper begins to open on purpose, or None."""
        return self.start if np.isinf(self.final_effort) else None

    def grip(self, load_n: Floats) -> Floats:
        """Return the grip as a fraction of its first value (time,), for the planned load (time,)."""
        if self.start is None:
            return np.ones(len(load_n))
        progress = minimum_jerk(np.clip((np.arange(len(load_n)) - self.start) / self.rows, 0.0, 1.0))
        limit_n = float(load_n.max()) / self.effort
        final = min(float(load_n[self.start :].max()) / self.final_effort / limit_n, 1.0)
        return 1 - (1 - final) * progress


def draw_plan(
    handling: str, protocol: str, duration_s: float, first_s: float, rng: np.random.Generator
) -> HandlingPlan:
    """Return the random plan of a trial whose lift starts at ``first_s``.

    ``handling`` is one of `HANDLINGS` or `MIXED`. Raises `TacpipeError` for a trial that is too short.
    """
    if duration_s < MIN_DURATION_S:
        raise TacpipeError(
            f"A trial of {duration_s} s is too short for a handling; duration_s must be {MIN_DURATION_S:g} s or more."
        )
    kind = HANDLINGS[int(rng.integers(len(HANDLINGS)))] if handling == MIXED else handling
    friction = float(FRICTIONS[rng.integers(len(FRICTIONS))])
    if kind in ("jolt", "jolt-held"):
        effort = rng.uniform(*(SLIPPING if kind == "jolt" else HELD))
        return HandlingPlan(kind, draw_trajectory(protocol, duration_s, first_s, rng), friction, float(effort))
    lift_s, height_m = rng.uniform(*LIFT_S), rng.uniform(*LIFT_M)
    at_s = np.arange(round(duration_s * RATE_HZ) + 1) / RATE_HZ
    moved = np.zeros((len(at_s), 3))
    moved[:, 2] = height_m * minimum_jerk(np.clip((at_s - first_s) / lift_s, 0.0, 1.0))
    if protocol == "kinaesthetic":
        phases = 2 * np.pi * (TREMOR_HZ * at_s[:, None] + rng.random(3))
        moved += rng.uniform(*TREMOR_M, 3) * minimum_jerk(np.clip(at_s - first_s, 0.0, 1.0))[:, None] * np.sin(phases)
    earliest_s, latest_s = first_s + lift_s + AFTER_LIFT_S, duration_s - BEFORE_END_S
    if kind == "hold":
        return HandlingPlan(kind, path_from_start(moved), friction, float(rng.uniform(*FIRM)))
    if kind == "shake":
        moved += _shaking(at_s, earliest_s, rng)
        return HandlingPlan(kind, path_from_start(moved), friction, float(rng.uniform(*SHAKEN)))
    length_s = rng.uniform(*(RELEASE_S if kind == "release" else FADE_S))
    start_s = rng.uniform(earliest_s, max(latest_s - length_s, earliest_s))
    if kind == "release":
        final_effort = np.inf
        if rng.random() < 0.5:  # the hand puts the object down before it opens
            lowered = minimum_jerk(np.clip((at_s - start_s + lift_s) / lift_s, 0.0, 1.0))
            moved *= 1 - lowered[:, None]
    else:
        final_effort = rng.uniform(*(SLIPPING if kind == "fade" else HELD))
    effort, rows = float(rng.uniform(*FIRM)), max(round(length_s * RATE_HZ), 1)
    return HandlingPlan(
        kind, path_from_start(moved), friction, effort, round(start_s * RATE_HZ), rows, float(final_effort)
    )


def _shaking(at_s: Floats, first_s: float, rng: np.random.Generator) -> Floats:
    """Return the displacement by shaking (time, axis) in bouts along random directions, in metres."""
    moved = np.zeros((len(at_s), 3))
    begin_s = first_s
    while begin_s < at_s[-1]:
        length_s, frequency_hz = rng.uniform(*BOUT_S), rng.uniform(*SHAKE_HZ)
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        size_m = rng.uniform(*PEAK_M_S2) / (2 * np.pi * frequency_hz) ** 2
        since_s = at_s - begin_s
        envelope = np.where((since_s > 0) & (since_s < length_s), np.sin(np.pi * since_s / length_s) ** 2, 0.0)
        moved += (size_m * envelope * np.sin(2 * np.pi * frequency_hz * since_s))[:, None] * direction
        begin_s += length_s + rng.uniform(*REST_S)
    return moved
