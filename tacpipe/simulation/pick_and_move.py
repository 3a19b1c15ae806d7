"""Simulate pick-and-move trials: two fingers with uSkin sensors grasp a bottle, lift it and move it.

A trial has these steps:

1. the fingers close (0.6 to 1.2 s), then the grip force increases (0.4 s);
2. the hand lifts the bottle and moves it (`tacpipe.simulation.trajectory`);
3. the bottle sticks, slips or is dropped (`tacpipe.simulation.mechanics`);
4. the contact forces act on the taxels (`tacpipe.simulation.taxels`), and slip also on the proximity sensor;
5. each device logs on its own clock, with the faults of `tacpipe.simulation.faults`.

The grip is intentionally weak, as on the published rig, so that the hand reaches accelerations at which the bottle
slips. Axes of the hand: x and y are horizontal, y points from finger 1 to finger 2, z is up.

The standard deviations of tared counts are close to those of the published recordings: 279, 190 and 1219 counts in x, y
and z.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tacpipe.arrays import AnyArray, Bools, Floats, Times
from tacpipe.channels import schema
from tacpipe.io.spill import Gathered, Spill
from tacpipe.plugins.stage import Attribute, RecordingOutput
from tacpipe.sensors import plan
from tacpipe.simulation import faults, handling, mechanics, taxels, trajectory

# The proximity sensor at the wrist measures the distance to the object's top face, which increases with slip. Rest level,
# slope, noise and saturation are those of the published derived recordings: 737 to 748 counts at rest, a minimum of 544, and
# a robust standard deviation of 0.82 counts around the filtered signal.
PROXIMITY_RATE_HZ = 400.0
REST_COUNT = 740.0
COUNT_MM = 8.0  # decrease of the reading per millimetre of downward slip
NOISE_COUNT = 0.8
FLOOR_COUNT = 544.0  # minimum reading, which is reached at 24.5 mm


def proximity_readings(up_m: Floats, noise_scale: float, rng: np.random.Generator) -> NDArray[np.int16]:
    """Return the counts for an object with the relative displacement ``up_m`` (time,), negative for downward slip."""
    level = REST_COUNT + COUNT_MM * 1000 * up_m + NOISE_COUNT * noise_scale * rng.normal(size=len(up_m))
    return np.rint(level).clip(FLOOR_COUNT, np.iinfo(np.int16).max).astype(np.int16)


START_NS = 1_600_000_000_000_000_000  # UTC time of the first trial; the next ones start minutes later
TRIAL_NS = 120_000_000_000
MASSES_KG = (0.20, 0.28, 0.36, 0.44, 0.52)  # mass of a bottle at five fill levels
GRIP_N = (4.0, 8.0)  # normal force of each finger
FRICTION = (0.35, 0.60)  # mu_s
RESERVE = 1.3  # minimum 2 mu_s N / (m g): slip starts at 0.3 g or more, and kinetic friction still carries the weight
OPEN_M, GRASPED_M = 0.070, 0.040  # distance between the fingers, open and around the bottle
APPROACH_S, RAMP_S, PAUSE_S = (0.6, 1.2), 0.4, (0.2, 0.5)
HANDLING_STREAM, SKIN_STREAM = 3, 10  # parts of the random seed; devices and cameras have other numbers
BLOCK_ROWS = 1 << 16  # rows of a stream that are computed at once
MEMORY_BYTES = 1 << 24  # streams larger than this are spilled to disk
PLAN_S, PLAN_POINT_S = 1.0, 0.02  # length of a plan, and the time between its points
LOSS_S, SLIDE_S = 0.02, 0.04  # duration of a loss of grip, and of the overload after it


@dataclass(frozen=True)
class PickRig:
    """The handling of the bottle and the logging of the streams. The fields are those of the stage's params.

    Control experiments: ``friction_scale=4`` never slips, ``effort=1.15`` slips only because of the planned motion,
    ``effort=0.9, grip_loss_probability=1, grip_loss=0.3`` only because of the grip, and ``still`` has a constant load.
    """

    duration_s: float = 12.0
    protocol: str = "mixed"  # a name in `trajectory.PROTOCOLS`, or mixed for a random one
    effort: float = 0.0  # ratio of the largest planned load to the friction limit; 0: random grip and friction
    friction_scale: float = 1.0
    grip_loss_probability: float = 0.0
    grip_loss: float = 0.2
    lever_m: float = 0.0
    still: bool = False
    handling: str = handling.PLANNED  # one of `handling.HANDLINGS`, or mixed; replaces effort, friction and grip
    tactile_rate_hz: float = 50.0
    robot_rate_hz: float = 1000.0
    hold_probability: float = 0.07
    drop_probability: float = 0.002
    noise_scale: float = 1.0
    tactile_jitter_ms: float = 2.0
    robot_jitter_ms: float = 0.5
    clock_offset_ms: float = 80.0
    clock_skew_ppm: float = 50.0
    plan_rate_hz: float = 0.0
    same_skins: bool = False


@dataclass(frozen=True)
class PickScene:
    """The ground truth of a trial. Arrays have shape (time, …) at 1 kHz."""

    protocol: str
    path: trajectory.Trajectory
    finger_m: Floats  # (time,)
    grasp: mechanics.HeldObject
    contact: mechanics.Contact
    skins: tuple[taxels.Skin, taxels.Skin]
    loss_ns: int | None  # time of a loss of grip
    handling: str = handling.PLANNED
    release_ns: int | None = None  # time at which the gripper begins to open on purpose

    @property
    def has_contact(self) -> Bools:
        """Whether the fingers hold the object (time,); False from the start of a release."""
        contact: Bools = self.contact.normal_n.max(axis=1) > 0
        return contact if self.release_ns is None else contact & (self.path.t_ns < self.release_ns)


def simulate_trial(seed: int, index: int, rig: PickRig = PickRig()) -> RecordingOutput:
    """Simulate trial ``index`` of the rig, with the streams xela1, xela2, robot, proximity and truth.

    With a ``plan_rate_hz``, there is also a stream plan.

    The same seed, index and rig give the same values. Attributes that start with ``gt_`` and the columns of ``truth``, at
    1 kHz, are ground truth. Raises `TacpipeError` if the trial is too short for the lift.
    """
    scene = perform(seed, index, rig)
    start_ns = START_NS + index * TRIAL_NS
    streams: dict[str, pa.Table | pa.RecordBatchReader] = {}
    spill = Spill(MEMORY_BYTES)
    labels: dict[str, Attribute] = {}
    duration_ns = int(scene.path.t_ns[-1])
    devices = {
        "xela1": (rig.tactile_rate_hz, rig.tactile_jitter_ms, rig.clock_offset_ms),
        "xela2": (rig.tactile_rate_hz, rig.tactile_jitter_ms, rig.clock_offset_ms),
        "robot": (rig.robot_rate_hz, rig.robot_jitter_ms, 0.0),
        "proximity": (PROXIMITY_RATE_HZ, rig.robot_jitter_ms, rig.clock_offset_ms),
    }
    for number, (name, (rate_hz, delay_ms, offset_ms)) in enumerate(devices.items()):
        rng = np.random.default_rng([seed, index, 1, number])
        samples = faults.samples(duration_ns, rate_hz, rig.drop_probability, rng)
        offset, skew = rng.uniform(-1, 1, 2)
        clock = faults.DeviceClock(round(offset * offset_ms * 1e6), float(skew * rig.clock_skew_ppm * 1e-6))
        arrived_ns = faults.arrivals(samples.true_ns, delay_ms * 1e6, rng)
        measure, fields = _measurement(name, scene, samples.true_ns, rig, rng)

        def build_rows(block: slice) -> pa.Table:
            clocks = [start_ns + faults.device_stamps(samples.true_ns[block], clock), samples.seq[block]]  # noqa: B023
            columns = [*clocks, *measure(block).T]  # noqa: B023
            return schema.stream(start_ns + arrived_ns[block], columns, [*_clock_fields(), *fields])  # noqa: B023

        streams[name] = _build_in_blocks(len(samples.seq), build_rows, spill)
        labels |= {f"gt_{name}_clock_offset_ns": clock.offset_ns, f"gt_{name}_clock_skew": clock.skew}
    if rig.plan_rate_hz:
        streams["plan"] = plans(scene, start_ns, rig.plan_rate_hz)
    streams["truth"] = _build_in_blocks(len(scene.path.t_ns), _truth(scene, start_ns), spill)
    return RecordingOutput(streams, _attributes(scene, index, start_ns, rig) | labels)


def _build_in_blocks(
    rows: int, build_rows: Callable[[slice], pa.Table], spill: Spill
) -> pa.Table | pa.RecordBatchReader:
    """Return a stream of ``rows`` rows, built in blocks that are spilled to disk."""
    gathered = Gathered(spill, build_rows(slice(0, 0)))
    for first in range(0, rows, BLOCK_ROWS):
        gathered.add(build_rows(slice(first, first + BLOCK_ROWS)))
    return gathered.rows()


def perform(seed: int, index: int, rig: PickRig = PickRig()) -> PickScene:
    """Simulate the scene of trial ``index``. It does not depend on the logging of its streams."""
    rng = np.random.default_rng([seed, index])
    approach_s, pause_s = rng.uniform(*APPROACH_S), rng.uniform(*PAUSE_S)
    random_protocol = trajectory.PROTOCOLS[int(rng.integers(len(trajectory.PROTOCOLS)))]
    protocol = random_protocol if rig.protocol == "mixed" else rig.protocol
    course = None
    if rig.handling != handling.PLANNED:
        handling_rng = np.random.default_rng([seed, index, HANDLING_STREAM])
        course = handling.draw_plan(rig.handling, protocol, rig.duration_s, approach_s + RAMP_S + pause_s, handling_rng)
        path = course.path
    elif rig.still:
        path = trajectory.rest(rig.duration_s)
    else:
        path = trajectory.draw_trajectory(protocol, rig.duration_s, approach_s + RAMP_S + pause_s, rng)
    if rig.still:
        closing, squeeze = np.ones(len(path.t_ns)), np.ones(len(path.t_ns))
    else:
        closing = _ease(path.t_ns / 1e9 / approach_s)
        squeeze = _ease((path.t_ns / 1e9 - approach_s) / RAMP_S)
    mass_kg = float(MASSES_KG[rng.integers(len(MASSES_KG))])
    load_n = np.linalg.norm(
        mechanics.HeldObject(mass_kg, 1.0, squeeze).demand_n(path.hand_acceleration_m_s2)[:, ::2], axis=1
    )
    if course is None:
        grip_n, friction = _draw_grip(mass_kg, float(load_n.max()), rig.effort, rng)
    else:
        friction, grip_n = course.friction, float(load_n.max()) / (2 * course.effort * course.friction)
        opening = course.grip(load_n)
        squeeze = squeeze * opening
        closing = closing * opening if course.release is not None else closing
    grasp = mechanics.HeldObject(mass_kg, friction * rig.friction_scale, grip_n * squeeze, rig.lever_m)
    loss_ns = None
    if rng.random() < rig.grip_loss_probability:
        row = _draw_loss_row(load_n, grasp, path.rise_m, rig.grip_loss, rng)
        loss_ns = int(path.t_ns[row])
        remaining_grip = 1 - rig.grip_loss * _ease((path.t_ns - loss_ns) / 1e9 / LOSS_S)
        grasp = mechanics.HeldObject(mass_kg, grasp.friction, grasp.grip_n * remaining_grip, rig.lever_m)
    rise_m = None if rig.still else path.rise_m
    contact = mechanics.carry(grasp, path.hand_acceleration_m_s2, rise_m, rate_hz=trajectory.RATE_HZ)
    skin_rng = np.random.default_rng([seed, SKIN_STREAM]) if rig.same_skins else rng
    skins = (taxels.draw_skin(skin_rng), taxels.draw_skin(skin_rng))
    finger_m = OPEN_M + (GRASPED_M - OPEN_M) * closing
    scene = PickScene(protocol, path, finger_m, grasp, contact, skins, loss_ns)
    if course is None:
        return scene
    release_ns = None if course.release is None else int(path.t_ns[course.release])
    return replace(scene, handling=course.kind, release_ns=release_ns)


def touch(
    scene: PickScene,
    finger: int,
    true_ns: Times,
    *,
    creep: float = taxels.CREEP,
    places_m: Floats = taxels.PLACES_M,
) -> Floats:
    """Return the force on each taxel of finger 0 or 1 at ``true_ns`` (time, taxel, axis).

    ``places_m`` (taxel, 2) are the taxels' positions along the hand's x and z.
    """
    contact = scene.contact
    rows = np.minimum(np.searchsorted(scene.path.t_ns, true_ns), len(scene.path.t_ns) - 1)
    at = interpolation(scene, true_ns)
    displacement, torque = at(contact.displacement_m), at(contact.torque_nm)
    pressures = [
        at(contact.normal_n[:, j])[:, None] * taxels.fractions(skin, displacement, torque, places_m)
        for j, skin in enumerate(scene.skins)
    ]
    friction = scene.grasp.friction * np.where(contact.slip[rows], mechanics.KINETIC, 1.0)
    # shear forces of both fingers' taxels
    shear = taxels.shear(friction[:, None] * np.hstack(pressures), at(contact.force_n[:, ::2]))
    lagging_n = at(taxels.lag(contact.normal_n[:, finger], trajectory.RATE_HZ))
    fraction = taxels.fractions(scene.skins[finger], displacement, torque, places_m)
    normal = (1 - creep) * pressures[finger] + creep * lagging_n[:, None] * fraction
    columns = slice(finger * len(places_m), (finger + 1) * len(places_m))
    return np.concatenate([shear[:, columns] + taxels.bulge(normal, places_m), normal[:, :, None]], axis=2)


def _measurement(
    name: str, scene: PickScene, true_ns: Times, rig: PickRig, rng: np.random.Generator
) -> tuple[Callable[[slice], AnyArray], list[Any]]:
    """Return a function that returns a block of a device's samples at ``true_ns`` (time, channel), and the fields."""
    if name == "robot":
        return lambda block: arm(scene, true_ns[block]), [
            schema.float_field("finger_m", "m", "finger_width"),
            *schema.pose_fields(),
        ]
    if name == "proximity":
        up_m = interpolation(scene, true_ns)(scene.contact.displacement_m[:, 1])
        field = pa.field("distance", pa.int16(), metadata={"unit": "count", "quantity": "proximity"})
        return proximity_readings(up_m, rig.noise_scale, rng)[:, None].__getitem__, [field]
    finger = ("xela1", "xela2").index(name)
    skin = scene.skins[finger]
    force = touch(scene, finger, true_ns, creep=0.0 if rig.still else taxels.CREEP)
    drift_scale = 0.0 if rig.still else rig.noise_scale
    errors = taxels.draw_errors(true_ns / 1e9, rig.noise_scale, drift_scale, rng)
    counts = taxels.digitise(skin.base_count + taxels.signal(skin, force) + errors)
    return faults.hold(counts, rig.hold_probability, rng)[0].__getitem__, schema.uskin_fields()


def _draw_grip(mass_kg: float, load_n: float, effort: float, rng: np.random.Generator) -> tuple[float, float]:
    """Return a random grip force in N and friction.

    They hold the weight if ``effort`` is 0; otherwise the load ``load_n`` is ``effort`` times the friction limit. The grip
    is outside of `GRIP_N` if effort, mass and plan require it.
    """
    if effort:
        friction_n = load_n / (2 * effort)  # friction force of each finger
        low, high = np.clip([friction_n / GRIP_N[1], friction_n / GRIP_N[0]], *FRICTION)
        friction = float(rng.uniform(low, high))
        return friction_n / friction, friction
    while True:
        grip_n, friction = float(rng.uniform(*GRIP_N)), float(rng.uniform(*FRICTION))
        if 2 * friction * grip_n >= RESERVE * mass_kg * mechanics.GRAVITY_M_S2:
            return grip_n, friction


def _draw_loss_row(
    load_n: Floats, grasp: mechanics.HeldObject, rise_m: Floats, loss: float, rng: np.random.Generator
) -> int:
    """Return a random row for a loss of grip: the hand is lifted, and the load exceeds friction for `SLIDE_S` afterwards.

    If there is no such row, any row with a lifted hand is used.
    """
    is_lifted = rise_m >= rise_m.max() / 2
    start, stop = round(LOSS_S * trajectory.RATE_HZ), round((LOSS_S + SLIDE_S) * trajectory.RATE_HZ)
    # for each row, the number of earlier rows in which the weakened grip still holds
    holding_before = np.cumsum(np.append(0, load_n <= (1 - loss) * grasp.limit_n))
    slides = is_lifted.copy()
    slides[-stop:] = False
    slides[:-stop] &= holding_before[stop:-1] == holding_before[start : start - stop - 1]
    return int(rng.choice(np.flatnonzero(slides if slides.any() else is_lifted)))


def interpolation(scene: PickScene, true_ns: Times) -> Any:
    """Return a function that interpolates values at 1 kHz (time,) or (time, axis) to ``true_ns``."""
    rows = np.clip(np.searchsorted(scene.path.t_ns, true_ns, side="right"), 1, len(scene.path.t_ns) - 1)
    before_ns = scene.path.t_ns[rows - 1]
    fraction = (true_ns - before_ns) / (scene.path.t_ns[rows] - before_ns)

    def at(values: Floats) -> Floats:
        weight = fraction if values.ndim == 1 else fraction[:, None]
        return values[rows - 1] * (1 - weight) + values[rows] * weight

    return at


def arm(scene: PickScene, true_ns: Times) -> Floats:
    """Return finger width, position and quaternion (time, 8) at ``true_ns``. The gripper points down and yaws."""
    at = interpolation(scene, true_ns)
    half = at(scene.path.yaw_rad) / 2
    zero = np.zeros_like(half)
    return np.column_stack([at(scene.finger_m), at(scene.path.position_m), np.cos(half), np.sin(half), zero, zero])


def plans(scene: PickScene, start_ns: int, rate_hz: float) -> pa.Table:
    """Return the plans that a controller sends at ``rate_hz``. Each covers the next `PLAN_S`, up to the end of the trial."""
    sent_ns = np.arange(0, int(scene.path.t_ns[-1]), round(1e9 / rate_hz), dtype=np.int64)
    target_ns = sent_ns[:, None] + plan_points_ns()
    exists = target_ns <= scene.path.t_ns[-1]
    arrived_ns, target_ns = np.broadcast_to(sent_ns[:, None], exists.shape)[exists], target_ns[exists]
    columns = [start_ns + target_ns, *arm(scene, target_ns)[:, 1:].T]
    return schema.stream(start_ns + arrived_ns, columns, plan.Plan().fields())


def plan_points_ns() -> Times:
    """Return the times of the points of a plan after it is sent (point,)."""
    return np.arange(0, round(PLAN_S * 1e9) + 1, round(PLAN_POINT_S * 1e9), dtype=np.int64)


def _clock_fields() -> list[Any]:
    device = pa.field("t_device_ns", pa.int64(), metadata={"unit": "ns", "quantity": "time"})
    return [device, pa.field("seq", pa.int64(), metadata={"unit": "1", "quantity": "sequence"})]


def _truth(scene: PickScene, start_ns: int) -> Callable[[slice], pa.Table]:
    """Return a function that returns a block of rows of the stream ``truth`` at 1 kHz."""
    contact, acceleration_m_s2 = scene.contact, scene.path.acceleration_m_s2
    # an object that slides out of opening fingers is released
    slip = contact.slip if scene.release_ns is None else contact.slip & scene.has_contact

    def build_rows(block: slice) -> pa.Table:
        columns: list[tuple[Any, Any]] = [
            (schema.float_field(f"gt_finger{j + 1}_normal_n", "N", "force"), contact.normal_n[block, j]) for j in (0, 1)
        ]
        columns += _vector("gt_force_{}_n", "N", "force", contact.force_n[block])
        columns += _vector("gt_acceleration_{}_m_s2", "m/s^2", "acceleration", acceleration_m_s2[block])
        displacement_m, velocity_m_s = contact.displacement_m[block], contact.velocity_m_s[block]
        distance_m, speed_m_s = np.linalg.norm(displacement_m, axis=1), np.linalg.norm(velocity_m_s, axis=1)
        columns += _vector("gt_displacement_{}_m", "m", "position", displacement_m, "xz")
        columns.append((schema.float_field("gt_displacement_m", "m", "position"), distance_m))
        columns += _vector("gt_velocity_{}_m_s", "m/s", "velocity", velocity_m_s, "xz")
        columns.append((schema.float_field("gt_velocity_m_s", "m/s", "velocity"), speed_m_s))
        columns.append((schema.float_field("gt_torque_y_nm", "N m", "torque"), contact.torque_nm[block]))
        columns.append((schema.float_field("gt_rotation_y_rad", "rad", "angle"), contact.rotation_rad[block]))
        mass_kg = np.full(len(displacement_m), scene.grasp.mass_kg)
        columns.append((schema.float_field("gt_mass_kg", "kg", "mass"), mass_kg))
        columns.append((schema.label_field("gt_slip"), slip[block]))
        columns.append((schema.label_field("gt_dropped"), contact.dropped[block]))
        if scene.handling != handling.PLANNED:
            contact_label = np.where(scene.has_contact[block], 0, -1).astype(np.int8)
            columns.append((schema.label_field("gt_contact"), contact_label))
        fields, values = zip(*columns, strict=True)
        return schema.stream(start_ns + scene.path.t_ns[block], values, fields)

    return build_rows


def _vector(name: str, unit: str, quantity: str, values: Floats, axes: Sequence[str] = schema.AXES) -> list[Any]:
    return [
        (schema.float_field(name.format(axis), unit, quantity), column)
        for axis, column in zip(axes, values.T, strict=True)
    ]


def _attributes(scene: PickScene, index: int, start_ns: int, rig: PickRig) -> dict[str, Attribute]:
    """Return the attributes of trial ``index``, which starts at ``start_ns``; times that do not exist are None."""
    contact, grasp = scene.contact, scene.grasp
    is_released = scene.release_ns is not None
    onset = None if is_released else contact.onset
    onset_ns = None if onset is None else start_ns + int(scene.path.t_ns[onset])
    attributes: dict[str, Attribute] = {
        "sensor": "xela-uskin",
        "simulated": True,
        "object": f"bottle-{round(grasp.mass_kg * 1000)}g",
        "object_class": "bottle",
        "protocol": "still" if rig.still else scene.protocol,
        "dropped": bool(contact.dropped.any()) and not is_released,
        "rate_hz": rig.tactile_rate_hz,
        "trial": f"trial-{index:04d}",
        "gt_mass_kg": grasp.mass_kg,
        "gt_grip_n": float(grasp.grip_n.max()),
        "gt_friction": grasp.friction,
        "gt_slip_onset_ns": onset_ns,
        "gt_grip_loss_ns": None if scene.loss_ns is None else start_ns + scene.loss_ns,
    }
    if scene.handling == handling.PLANNED:
        return attributes
    return attributes | {
        "object": f"{attributes['object']}-friction-{grasp.friction:.2f}",
        "handling": scene.handling,
        "gt_release_ns": None if scene.release_ns is None else start_ns + scene.release_ns,
    }


def _ease(progress: Floats) -> Floats:
    """Return a smooth ramp from 0 to 1 as ``progress`` goes from 0 to 1."""
    clipped = np.clip(progress, 0.0, 1.0)
    return clipped**2 * (3 - 2 * clipped)
