"""Simulate grasps on a table: a camera sees an object, two fingers pinch it, and their sensors read what they measure.

Trial i is of object i mod n. What happens in one:

1. an object comes to rest on the table in a random pose, and `tacpipe.simulation.depth_camera` sees it;
2. `tacpipe.simulation.grasp_scene` plans where two fingers take it;
3. the fingers, a little off, press as `tacpipe.simulation.pinch` states;
4. `tacpipe.simulation.fingertip_sp` reads that.

Grasps of an object follow one another in sessions, over which the sensors drift.

The effort of the hand, the errors of the fingertips' poses, drift and noise do not show in a cloud and a planned grasp. The
mean over them, E[y | geometry], has the least root-mean-square error of all predictions from these. Sensors drift alike in
grasps that are near in time: a model fitted on some of them may fall below this error unless nothing drifts.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Counts, Floats, Times
from tacpipe.channels import biotac_sp, schema
from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import Attribute, RecordingOutput
from tacpipe.simulation import depth_camera, fingertip_sp, pinch
from tacpipe.simulation.grasp_scene import (
    GraspRig,
    GraspScene,
    Readings,
    draw_thing,
    families,
    perform,
    read_sensors,
    sensors,
)

DRAWS = 256


def draw_readings(
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


def error_bound(
    hand: fingertip_sp.Sensors, scene: GraspScene, rig: GraspRig, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return mean and variance of what the sensors may read, given the geometry alone, each (finger, channel)."""
    possible = draw_readings(
        scene.situation,
        hand,
        rng,
        effort_spread=rig.effort_spread,
        noise_scale=rig.noise_scale,
        drift_count_day=rig.drift_count_day,
    )
    return mean_and_variance(possible)


def truth_table(
    t_ns: int, scene: GraspScene, sensed: Readings, estimate: tuple[Floats, Floats], moments_ns: Mapping[str, int]
) -> pa.Table:
    """Return the stream ``truth``: of each finger, gt_mf_… and gt_th_…, then of the object.

    ``gt_expected_…`` is the mean and ``gt_variance_…`` the variance of a reading given the geometry, counts and counts
    squared; ``moments_ns`` are when fingers touch, hold and let go, in nanoseconds, each a column ``gt_…_ns``.
    """
    columns = [column for finger in range(len(biotac_sp.FINGERS)) for column in _finger(finger, scene, sensed)]
    columns += [(f"gt_position_{axis}_m", "m", "position", scene.placed.origin_m[i]) for i, axis in enumerate("xyz")]
    columns += [
        (f"gt_rotation_{axis}_{part}", "1", "orientation", scene.placed.rotation[i, j])
        for j, axis in enumerate("xyz")
        for i, part in enumerate("xyz")
    ]
    columns += [(f"gt_up_{axis}", "1", "orientation", scene.up[i]) for i, axis in enumerate("xyz")]
    columns.append(("gt_compliance_1_pa", "1/Pa", "compliance", scene.thing.compliance_1_pa))
    for name, unit, estimates in zip(("expected", "variance"), ("count", "count^2"), estimate, strict=True):
        columns += [
            (f"gt_{name}_{column}", unit, "tactile", estimates[finger, channel])
            for finger, short in enumerate(biotac_sp.FINGERS)
            for channel, column in enumerate(biotac_sp.columns(f"e_{short}") + biotac_sp.columns(f"pdc_{short}"))
        ]
    fields = [schema.float_field(name, unit, quantity) for name, unit, quantity, _ in columns]
    moments = [
        pa.field(f"gt_{name}_ns", pa.int64(), metadata={"unit": "ns", "quantity": "time"}) for name in moments_ns
    ]
    values = [*([value] for *_, value in columns), *([at] for at in moments_ns.values())]
    return schema.stream(np.array([t_ns]), values, [*fields, *moments])


def _finger(finger: int, scene: GraspScene, sensed: Readings) -> list[tuple[str, str, str, float]]:
    """Return name, unit, quantity and value of what is true of a finger."""
    touch, situation = sensed.touch, scene.situation
    columns = [
        ("force_n", "N", "force", touch.force_n[0, finger]),
        ("effort", "1", "share", scene.hidden.effort[0, finger]),
        ("radius_m", "m", "length", touch.contact_m[0, finger]),
        ("indentation_m", "m", "length", touch.skin_m[0, finger]),
        ("centre_along_m", "m", "position", touch.centre_m[0, finger, 0]),
        ("centre_around_m", "m", "position", touch.centre_m[0, finger, 1]),
        ("curvature1_1_m", "1/m", "curvature", situation.curvatures_1_m[finger, 0]),
        ("curvature2_1_m", "1/m", "curvature", situation.curvatures_1_m[finger, 1]),
        ("lean_along_rad", "rad", "angle", situation.lean_rad[finger, 0]),
        ("lean_around_rad", "rad", "angle", situation.lean_rad[finger, 1]),
        ("pdc_drift_count", "count", "static_pressure", sensed.drift[finger, -1]),
    ]
    return [(f"gt_{biotac_sp.FINGERS[finger]}_{name}", unit, kind, float(value)) for name, unit, kind, value in columns]


START_NS = 1_620_000_000_000_000_000  # UTC stamp of the first grasp
GRASP_NS = 180_000_000_000  # time between two grasps of a session
SESSION = 20  # grasps
READ_NS = 5_000_000_000  # time between the plan and the reading
NOISE, BOUND = 4, 5  # streams of random numbers


def simulate_trial(seed: int, index: int, rig: GraspRig) -> RecordingOutput:
    """Return trial ``index`` of the rig: cloud, grasp, reading, truth; or raw: scene, grasp, biotac_sp, scene_truth, truth.

    The same seed, index and rig give the same values. Columns of ``truth`` and ``scene_truth`` are ground truth. Raises
    `TacpipeError` for a rig that cannot be.
    """
    _check(rig)
    scene = perform(seed, index, rig)
    t_ns = stamp_ns(index, rig)
    hand = sensors(seed)
    readings = read_sensors(hand, scene, t_ns, rig)
    rng = np.random.default_rng([seed, NOISE, index])
    streams = {"grasp": scene.grasp.table(t_ns)}
    moments_ns: dict[str, int] = {}
    if rig.raw:
        course = pinch.course(t_ns, rng)
        neighbour = draw_thing(seed, index + 1 + int(rng.integers(1_000)), rig)
        view = depth_camera.view(scene.placed, neighbour.shape, scene.up, scene.camera_m, rig.noise_scale, rng)
        streams |= depth_camera.tables(view)
        streams["biotac_sp"] = _readings_over_time(hand, scene, readings, course, rig, rng)
        moments_ns = course.moments_ns
    else:
        streams["cloud"] = scene.cloud.table()
        no_drift = np.zeros((1, len(biotac_sp.FINGERS)))
        streams["reading"] = _logged(np.array([t_ns + READ_NS]), hand, readings.signal[None], no_drift, rig, rng)
    bound = error_bound(hand, scene, rig, np.random.default_rng([seed, BOUND, index]))
    streams["truth"] = truth_table(t_ns, scene, readings, bound, moments_ns)
    return RecordingOutput(streams, _attributes(scene, session(index, rig)))


def stamp_ns(index: int, rig: GraspRig) -> int:
    """Return when trial ``index`` takes place, UTC nanoseconds: objects take turns session by session."""
    turn, number = divmod(_number(index, rig), SESSION)
    return START_NS + ((turn * _objects(rig) + index % _objects(rig)) * SESSION + number) * GRASP_NS


def session(index: int, rig: GraspRig) -> int:
    """Return in which session of its object trial ``index`` is, from 1."""
    return _number(index, rig) // SESSION + 1


def _objects(rig: GraspRig) -> int:
    return 1 if rig.spheres else len(families(rig)) * rig.objects


def _number(index: int, rig: GraspRig) -> int:
    """Return which of the grasps of its object a trial is, from 0."""
    return index // _objects(rig)


def _readings_over_time(
    hand: fingertip_sp.Sensors,
    scene: GraspScene,
    readings: Readings,
    course: pinch.PinchCourse,
    rig: GraspRig,
    rng: np.random.Generator,
) -> pa.Table:
    """Return the stream of both sensors while fingers close, hold and let go."""
    force = course.fraction[:, None] * readings.touch.force_n  # (time, finger)
    contact, skin = pinch.pressed(scene.situation, force)
    centre = np.broadcast_to(readings.touch.centre_m, (len(force), *readings.touch.centre_m.shape[1:]))
    counts = fingertip_sp.signal(hand, force, contact, skin, centre) + readings.drift
    speed = np.gradient(force, course.t_ns / 1e9, axis=0)
    return _logged(course.t_ns, hand, counts, speed, rig, rng)


def _logged(
    t_ns: Times,
    hand: fingertip_sp.Sensors,
    signal: Floats,
    speed_n_s: Floats,
    rig: GraspRig,
    rng: np.random.Generator,
) -> pa.Table:
    """Return a stream of readings of what sensors show (time, finger, channel), with noise."""
    counts = fingertip_sp.counted(signal + rig.noise_scale * hand.noise * rng.normal(size=signal.shape))
    return schema.stream(t_ns, fingertip_sp.rows(counts, speed_n_s, rig.noise_scale, rng), biotac_sp.fields())


def _attributes(scene: GraspScene, session: int) -> dict[str, Attribute]:
    return {
        "sensor": "biotac-sp",
        "simulated": True,
        "object": scene.thing.name,
        "family": scene.thing.family,
        "session": f"{scene.thing.name}-s{session:02d}",
    }


def _check(rig: GraspRig) -> None:
    """Refuse a rig that cannot be."""
    if rig.objects < 1:
        raise TacpipeError(f"objects is {rig.objects}; a family needs 1 or more.")
    for name in ("effort_spread", "noise_scale", "drift_count_day"):
        if getattr(rig, name) < 0:
            raise TacpipeError(f"{name} is {getattr(rig, name)}; it must be 0 or more.")
    if not 0 <= rig.shift <= 1:
        raise TacpipeError(f"shift is {rig.shift}; it is a fraction of half the cloud's length, 0 to 1.")
    if rig.raw and rig.spheres:
        raise TacpipeError("raw and spheres are both set; spheres of all sizes have no table. Leave one of them out.")
