"""Simulate grasps on a table: a camera records an object, two fingers pinch it, and their sensors are read.

Trial i is a grasp of object i mod n:

1. an object lies on the table in a random pose, and `tacpipe.simulation.depth_camera` records it;
2. `tacpipe.simulation.grasp_scene` plans a grasp with two fingers;
3. the fingers press with small position errors (`tacpipe.simulation.pinch`);
4. `tacpipe.simulation.fingertip_sp` computes the readings.

Grasps of an object are grouped in sessions, during which the sensors drift.

A cloud and a planned grasp do not show the hand's effort, the pose errors of the fingertips, drift and noise. The mean over
them, E[y | geometry], has the smallest root-mean-square error of all predictions from cloud and grasp. Grasps that are close
in time have similar drift, so a model trained on some of them may have a smaller error unless drift is off.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Counts, Floats, Times
from tacpipe.channels import biotac_sp, schema
from tacpipe.plugins.stage import Attribute, RecordingOutput
from tacpipe.simulation import depth_camera, fingertip_sp, pinch
from tacpipe.simulation.grasp_scene import (
    GraspRig,
    GraspScene,
    Readings,
    draw_object,
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
    rig: GraspRig,
    draws: int = DRAWS,
) -> Counts:
    """Return possible readings of one situation (draw, finger, channel), with random unobserved values for each draw.

    Channels are the electrodes, then the pressure. The times of the drift are random, too.
    """
    contact = pinch.touch(situation, pinch.draw_unseen(rng, draws, rig.effort_spread))
    counts = fingertip_sp.signal(hand, contact.force_n, contact.contact_m, contact.skin_m, contact.centre_m)
    phases = rng.uniform(0, 2 * np.pi, (draws, *hand.phases_rad.shape))
    error = fingertip_sp.drift(phases, rig.drift_count_day) + rig.noise_scale * hand.noise * rng.normal(
        size=counts.shape
    )
    return fingertip_sp.to_counts(counts + error)


def mean_and_variance(possible: Counts) -> tuple[Floats, Floats]:
    """Return mean in counts and variance in counts² (finger, channel) of readings (draw, finger, channel)."""
    return possible.mean(axis=0), possible.var(axis=0, ddof=1)


def truth_table(
    t_ns: int, scene: GraspScene, sensed: Readings, estimate: tuple[Floats, Floats], moments_ns: Mapping[str, int]
) -> pa.Table:
    """Return the stream ``truth``: columns of the fingers (gt_mf_… and gt_th_…), then those of the object.

    ``estimate`` is the mean in counts and the variance in counts² of a reading given the geometry, the columns
    ``gt_expected_…`` and ``gt_variance_…``. ``moments_ns`` are the times of contact, hold and release, each a column
    ``gt_…_ns``.
    """
    columns = [column for finger in range(len(biotac_sp.FINGERS)) for column in _finger(finger, scene, sensed)]
    columns += [(f"gt_position_{axis}_m", "m", "position", scene.placed.origin_m[i]) for i, axis in enumerate("xyz")]
    for j, axis in enumerate("xyz"):
        rotated = scene.placed.rotation[:, j]
        columns += [(f"gt_rotation_{axis}_{part}", "1", "orientation", rotated[i]) for i, part in enumerate("xyz")]
    columns += [(f"gt_up_{axis}", "1", "orientation", scene.up[i]) for i, axis in enumerate("xyz")]
    columns.append(("gt_compliance_1_pa", "1/Pa", "compliance", scene.thing.compliance_1_pa))
    for name, unit, estimates in zip(("expected", "variance"), ("count", "count^2"), estimate, strict=True):
        for finger, short in enumerate(biotac_sp.FINGERS):
            channels = biotac_sp.columns(f"e_{short}") + biotac_sp.columns(f"pdc_{short}")
            columns += [
                (f"gt_{name}_{column}", unit, "tactile", estimates[finger, channel])
                for channel, column in enumerate(channels)
            ]
    fields = [schema.float_field(name, unit, quantity) for name, unit, quantity, _ in columns]
    moments = [
        pa.field(f"gt_{name}_ns", pa.int64(), metadata={"unit": "ns", "quantity": "time"}) for name in moments_ns
    ]
    values = [*([value] for *_, value in columns), *([at] for at in moments_ns.values())]
    return schema.stream(np.array([t_ns]), values, [*fields, *moments])


def _finger(finger: int, scene: GraspScene, sensed: Readings) -> list[tuple[str, str, str, float]]:
    """Return (name, unit, quantity, value) of the ground truth of a finger."""
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


START_NS = 1_620_000_000_000_000_000  # UTC time of the first grasp
GRASP_NS = 180_000_000_000  # time between grasps of a session
SESSION = 20  # grasps
READ_NS = 5_000_000_000  # time between the plan and the reading
NOISE, BOUND = 4, 5  # parts of the random seeds of noise and of the error bound


def simulate_trial(seed: int, index: int, rig: GraspRig) -> RecordingOutput:
    """Simulate trial ``index`` of the rig.

    The streams are cloud, grasp, reading and truth; with ``raw``, scene, grasp, biotac_sp, scene_truth and truth. The
    same seed, index and rig give the same values. Columns of ``truth`` and ``scene_truth`` are ground truth.
    """
    scene = perform(seed, index, rig)
    t_ns = stamp_ns(index, rig)
    hand = sensors(seed)
    readings = read_sensors(hand, scene, t_ns, rig)
    rng = np.random.default_rng([seed, NOISE, index])
    streams = {"grasp": scene.grasp.table(t_ns)}
    moments_ns: dict[str, int] = {}
    if rig.raw:
        course = pinch.draw_course(t_ns, rng)
        neighbour = draw_object(seed, index + 1 + int(rng.integers(1_000)), rig)
        view = depth_camera.view(scene.placed, neighbour.shape, scene.up, scene.camera_m, rig.noise_scale, rng)
        streams |= depth_camera.tables(view)
        streams["biotac_sp"] = _readings_over_time(hand, scene, readings, course, rig, rng)
        moments_ns = course.moments_ns
    else:
        streams["cloud"] = scene.cloud.table()
        no_drift = np.zeros((1, len(biotac_sp.FINGERS)))
        streams["reading"] = _noisy_stream(np.array([t_ns + READ_NS]), hand, readings.signal[None], no_drift, rig, rng)
    possible = draw_readings(scene.situation, hand, np.random.default_rng([seed, BOUND, index]), rig)
    streams["truth"] = truth_table(t_ns, scene, readings, mean_and_variance(possible), moments_ns)
    return RecordingOutput(streams, _attributes(scene, session(index, rig)))


def stamp_ns(index: int, rig: GraspRig) -> int:
    """Return the time of trial ``index`` in UTC ns. Objects alternate by session."""
    turn, number = divmod(_number(index, rig), SESSION)
    return START_NS + ((turn * _objects(rig) + index % _objects(rig)) * SESSION + number) * GRASP_NS


def session(index: int, rig: GraspRig) -> int:
    """Return the session of trial ``index`` for its object, from 1."""
    return _number(index, rig) // SESSION + 1


def _objects(rig: GraspRig) -> int:
    return 1 if rig.spheres else len(families(rig)) * rig.objects


def _number(index: int, rig: GraspRig) -> int:
    """Return the number of a trial among the grasps of its object, from 0."""
    return index // _objects(rig)


def _readings_over_time(
    hand: fingertip_sp.Sensors,
    scene: GraspScene,
    readings: Readings,
    course: pinch.PinchCourse,
    rig: GraspRig,
    rng: np.random.Generator,
) -> pa.Table:
    """Return the readings of both sensors while the fingers close, hold and release."""
    force = course.fraction[:, None] * readings.touch.force_n  # (time, finger)
    contact, skin = pinch.deformation(scene.situation, force)
    centre = np.broadcast_to(readings.touch.centre_m, (len(force), *readings.touch.centre_m.shape[1:]))
    counts = fingertip_sp.signal(hand, force, contact, skin, centre) + readings.drift
    speed = np.gradient(force, course.t_ns / 1e9, axis=0)
    return _noisy_stream(course.t_ns, hand, counts, speed, rig, rng)


def _noisy_stream(
    t_ns: Times,
    hand: fingertip_sp.Sensors,
    signal: Floats,
    speed_n_s: Floats,
    rig: GraspRig,
    rng: np.random.Generator,
) -> pa.Table:
    """Return a stream of readings with noise, from the noise-free signal (time, finger, channel)."""
    counts = fingertip_sp.to_counts(signal + rig.noise_scale * hand.noise * rng.normal(size=signal.shape))
    return schema.stream(t_ns, fingertip_sp.rows(counts, speed_n_s, rig.noise_scale, rng), biotac_sp.fields())


def _attributes(scene: GraspScene, session: int) -> dict[str, Attribute]:
    """Return the attributes of a grasp: sensor, object, family and the session, which has this number."""
    return {
        "sensor": "biotac-sp",
        "simulated": True,
        "object": scene.thing.name,
        "family": scene.thing.family,
        "session": f"{scene.thing.name}-s{session:02d}",
    }
