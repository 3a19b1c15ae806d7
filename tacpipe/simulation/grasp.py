"""Grasps of the simulated table: a camera sees an object, two fingers pinch it, and their sensors read what they measure.

Trial i is of object i mod n. What happens in one:

1. an object comes to rest on the table in a random pose, and `tacpipe.simulation.depth_camera` sees it;
2. `tacpipe.simulation.antipodal` plans where two fingers take it;
3. the fingers, a little off, press as `tacpipe.simulation.pinch` states;
4. `tacpipe.simulation.fingertip_sp` reads that.

Grasps of an object follow one another in sessions, over which the sensors drift.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Floats, Times
from tacpipe.channels import biotac_sp, schema
from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import Attribute, RecordingOutput
from tacpipe.simulation import depth_camera, fingertip_sp, grasp_truth, pinch
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
    bound = grasp_truth.bound(hand, scene, rig, np.random.default_rng([seed, BOUND, index]))
    streams["truth"] = grasp_truth.table(t_ns, scene, readings, bound, moments_ns)
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
