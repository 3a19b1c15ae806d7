"""The scene of a grasp on the simulated table: an object, what a camera sees of it, and how two fingers take it.

What nobody sees of it, such as the effort of the hand, is part of the scene too: it is all that a trial needs for what
the fingers then measure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tacpipe.arrays import Floats
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError
from tacpipe.simulation import antipodal, depth_camera, fingertip_sp, household, pinch
from tacpipe.simulation.bodies import Ellipsoid
from tacpipe.simulation.depth_camera import Placed
from tacpipe.simulation.household import Thing

CAMERA_M = (0.9, 1.2)  # height above the table
TILT_RAD = np.deg2rad(8.0)  # largest tilt of the camera
SEEN_AT_M, SPREAD_M = (-0.05, -0.15), 0.03  # mean and standard deviation of object positions in the camera's view
LEAST_POINTS = 800  # smallest size of a cloud, as in the published set
TRIES = 100  # poses until one is seen and grasped
SENSORS, THINGS, TRIAL = 1, 2, 3  # streams of random numbers


@dataclass(frozen=True)
class GraspRig:
    """The objects and the quality of the sensors. The fields are those of the stage's params.

    Controls: ``spheres`` makes all objects alike but for their size, ``one_pose`` leaves the cloud only the object to
    state, ``effort_spread=0`` makes the force one of the geometry alone.
    """

    families: str = "all"
    objects: int = 5
    stiffness: str = "mixed"
    spheres: bool = False
    one_pose: bool = False
    shift: float = 0.5
    effort_spread: float = 0.15
    noise_scale: float = 1.0
    drift_count_day: float = 30.0
    raw: bool = False


@dataclass(frozen=True)
class GraspScene:
    """The true course of a trial."""

    thing: Thing
    placed: Placed
    up: Floats  # the table's normal in the camera's frame (xyz)
    camera_m: float  # distance from the camera to the table along the optical axis
    cloud: Cloud
    grasp: Grasp
    situation: pinch.Situation
    hidden: pinch.Unseen


@dataclass(frozen=True)
class Readings:
    """The readings of both sensors at contact: the true touch, and the counts (finger, channel) without noise."""

    touch: pinch.Touch
    drift: Floats
    signal: Floats


def families(rig: GraspRig) -> tuple[str, ...]:
    """Return the families that a rig grasps, raising `TacpipeError` for an unknown one."""
    names = household.FAMILIES if rig.families == "all" else tuple(name.strip() for name in rig.families.split(","))
    unknown = [name for name in names if name not in household.FAMILIES]
    if unknown:
        raise TacpipeError(
            f"There is no family {unknown[0]!r}; known are {', '.join(household.FAMILIES)}, or all for all of them."
        )
    return ("sphere",) if rig.spheres else names


def draw_thing(seed: int, index: int, rig: GraspRig = GraspRig()) -> Thing:
    """Return what trial ``index`` grasps: the same object whichever others there are, but for spheres of all sizes."""
    if rig.spheres:
        stiffness = "rigid" if rig.stiffness == "mixed" else rig.stiffness
        drawn = household.draw_thing(np.random.default_rng([seed, THINGS]), "sphere", 1, stiffness)
        return replace(drawn, name="spheres", shape=Ellipsoid(np.full(3, household.REFERENCE_M)))
    names = families(rig)
    number, kind = divmod(index % (len(names) * rig.objects), len(names))
    rng = np.random.default_rng([seed, THINGS, household.FAMILIES.index(names[kind]), number])
    return household.draw_thing(rng, names[kind], number + 1, rig.stiffness)


def sensors(seed: int) -> fingertip_sp.Sensors:
    """Return the two sensors of a rig."""
    return fingertip_sp.sensors(np.random.default_rng([seed, SENSORS]))


def perform(seed: int, index: int, rig: GraspRig = GraspRig()) -> GraspScene:
    """Return what truly happens in trial ``index``; raises `TacpipeError` if in `TRIES` poses nothing could be grasped."""
    thing = draw_thing(seed, index, rig)
    rng = np.random.default_rng([seed, TRIAL, index])
    rests = thing.shape.rests()
    scale = float(rng.uniform(*household.SPHERES_M)) / household.REFERENCE_M if rig.spheres else 1.0
    for _ in range(TRIES):
        up, height_m = depth_camera.camera(rng, CAMERA_M, TILT_RAD)
        pose = rests[0 if rig.one_pose else int(rng.integers(len(rests)))]
        at_m = (float(rng.normal(SEEN_AT_M[0], SPREAD_M)), float(rng.normal(SEEN_AT_M[1], SPREAD_M)))
        placed = depth_camera.place_shape(thing.shape, pose, float(rng.uniform(0, 2 * np.pi)), at_m, up, height_m)
        direction, depth_m = depth_camera.depths(placed)
        if len(depth_m) < LEAST_POINTS:
            continue
        points = depth_camera.measured(direction, depth_m, rig.noise_scale, rng)
        grasp = antipodal.grasped(placed, points.astype(np.float64), up, rig.shift, rng, central=rig.spheres)
        if grasp is None:
            continue
        colours = depth_camera.painted(placed.inward(direction * depth_m[:, None]), rng)
        situation = pinch.situation(placed, grasp, thing.compliance_1_pa)
        hidden = pinch.unseen(rng, 1, rig.effort_spread)
        scene = GraspScene(thing, placed, up, height_m, Cloud(points, colours), grasp, situation, hidden)
        return scene if scale == 1 else _scaled(scene, scale)
    raise TacpipeError(f"The object {thing.name} could not be seen and grasped in {TRIES} poses; take another seed.")


def read_sensors(hand: fingertip_sp.Sensors, scene: GraspScene, t_ns: int, rig: GraspRig = GraspRig()) -> Readings:
    """Return what both sensors measure of a scene at ``t_ns``; where the camera is does not matter."""
    touch = pinch.touch(scene.situation, scene.hidden)
    off = fingertip_sp.drift(hand.phases_rad, rig.drift_count_day, t_ns)
    signal = fingertip_sp.signal(hand, touch.force_n, touch.contact_m, touch.skin_m, touch.centre_m)[0]
    return Readings(touch, off, signal + off)


def _scaled(scene: GraspScene, scale: float) -> GraspScene:
    """Return a scene with all lengths times ``scale``: the camera sees the same, only nearer and smaller or the reverse."""
    thing = replace(scene.thing, shape=Ellipsoid(np.full(3, household.REFERENCE_M * scale)))
    placed = Placed(thing.shape, scene.placed.rotation, scene.placed.origin_m * scale)
    grasp = Grasp(scene.grasp.g1_m * scale, scene.grasp.g2_m * scale, scene.grasp.wrist)
    cloud = Cloud((scene.cloud.points_m * scale).astype(np.float32), scene.cloud.colours)
    situation = pinch.situation(placed, grasp, thing.compliance_1_pa)
    return replace(scene, thing=thing, placed=placed, cloud=cloud, grasp=grasp, situation=situation)
