"""Generate the scene of a simulated grasp: an object, its cloud, and the grasp with two fingers.

The scene also contains unobserved values, such as the hand's effort, so that it determines the readings of a trial.

As in the published protocol, the line between the fingers passes through a point that is shifted along the first principal
axis of the visible points, at half the depth of the body. Of the nearly horizontal lines through it, one is chosen for which
both fingers are within a friction cone around the normals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tacpipe.arrays import Bools, Floats
from tacpipe.clouds.cloud import Cloud
from tacpipe.clouds.grasp import Grasp
from tacpipe.errors import TacpipeError
from tacpipe.simulation import depth_camera, fingertip_sp, pinch
from tacpipe.simulation.bodies import Bow, Box, Ellipsoid, Frustum, Shape
from tacpipe.simulation.depth_camera import Placed

FAMILIES = ("box", "cylinder", "sphere", "ellipsoid", "cone", "bow")
MODULI_PA = {"rigid": np.inf, "elastic": 50_000.0, "foam": 15_000.0}
SHARES = (0.6, 0.2, 0.2)  # fractions of the objects by entry of MODULI_PA
# range of the slope of cones, within friction, and smallest ratio of the radii of top and bottom
TAPER, NARROW = (0.08, 0.22), 0.4
REFERENCE_M = 0.04  # radius of the sphere that represents spheres of all sizes
SPHERES_M = (0.012, 0.058)  # range of the radii of spheres


@dataclass(frozen=True)
class Thing:
    """A named object with its shape and stiffness class."""

    name: str
    family: str
    shape: Shape
    stiffness: str

    @property
    def compliance_1_pa(self) -> float:
        """The inverse of Young's modulus in 1/Pa; 0 if rigid."""
        return 1 / MODULI_PA[self.stiffness]


def draw_household_object(rng: np.random.Generator, family: str, number: int, stiffness: str = "mixed") -> Thing:
    """Return a random object of a family, named by the family and ``number``, such as "cone-03".

    ``stiffness`` is one of `MODULI_PA`, or mixed.
    """
    random_stiffness = str(rng.choice(list(MODULI_PA), p=SHARES))
    shape = _draw_shape(family, rng)
    return Thing(f"{family}-{number:02d}", family, shape, random_stiffness if stiffness == "mixed" else stiffness)


def _draw_shape(family: str, rng: np.random.Generator) -> Shape:
    """Return a random body of a family with widths between about 20 and 120 mm."""

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


OPENING_M = (0.02, 0.12)  # range of the distance between the fingers
CONE_RAD = np.deg2rad(15.0)  # maximum angle between the closing direction and a normal
MARGIN_M = 0.004  # smallest distance of a contact from an edge
DIRECTIONS = 36  # number of candidate closing lines
LEAN_RAD = np.deg2rad(4.0)  # standard deviation of the angle between a closing line and the table
PITCH_RAD = np.deg2rad(20.0)  # maximum angle between approach and vertical, around the closing axis
FAR_M = 0.2  # distance from which the fingers approach


def antipodal_grasps(
    placed: Placed, seen_m: Floats, up: Floats, shift: float, rng: np.random.Generator, *, central: bool = False
) -> Grasp | None:
    """Return a random grasp of a body with visible points (point, xyz) in metres, or None if no line is suitable.

    ``shift`` is the largest shift of the point as a fraction of half the cloud's length. With ``central``, the body's origin
    is used instead. Finger 1, at ``g1``, is on the camera's left, as on the published rig.
    """
    through = placed.origin_m if central else _inside(placed, _shift_along_axis(seen_m, shift, rng))
    if through is None:
        return None
    directions = _level_directions(up, rng)
    start, stop = (through - FAR_M * side * directions for side in (1, -1))
    first = start + placed.hit(start, directions)[:, None] * directions
    second = stop - placed.hit(stop, -directions)[:, None] * directions
    suitable = np.flatnonzero(_suitable(placed, first, second))
    if not len(suitable):
        return None
    chosen = int(rng.choice(suitable))
    closing, pitch = directions[chosen], rng.uniform(-PITCH_RAD, PITCH_RAD)
    down = -up + (up @ closing) * closing
    down /= np.linalg.norm(down)
    approach = np.cos(pitch) * down + np.sin(pitch) * np.cross(closing, down)
    return Grasp(first[chosen], second[chosen], np.column_stack([approach, closing, np.cross(approach, closing)]))


def _shift_along_axis(seen_m: Floats, shift: float, rng: np.random.Generator) -> Floats:
    """Return the visible point (xyz) in metres that is closest to a random point on the first principal axis."""
    centre = seen_m.mean(axis=0)
    axis = np.linalg.eigh(np.cov(seen_m.T))[1][:, -1]
    half = np.ptp(seen_m @ axis) / 2
    target = centre + shift * half * rng.uniform(-1, 1) * axis
    return np.asarray(seen_m[np.argmin(((seen_m - target) ** 2).sum(axis=1))])


def _inside(placed: Placed, seen_m: Floats) -> Floats | None:
    """Return the point (xyz) in metres halfway through the body on the camera's ray to ``seen_m``, or None if it misses."""
    ray = seen_m / np.linalg.norm(seen_m)
    near = float(placed.hit(np.zeros((1, 3)), ray[None])[0])
    back = near + 2 * placed.shape.bound_m + FAR_M
    far = back - float(placed.hit((back * ray)[None], -ray[None])[0])
    if not np.isfinite(near):
        return None
    misses = far - near > 2 * placed.shape.bound_m
    return None if misses else np.asarray((near + far) / 2 * ray)


def _level_directions(up: Floats, rng: np.random.Generator) -> Floats:
    """Return nearly horizontal unit vectors (direction, xyz), all towards positive x."""
    side = np.cross(up, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    angle = np.pi * (np.arange(DIRECTIONS) + rng.random()) / DIRECTIONS - np.pi / 2
    lean = rng.normal(0, LEAN_RAD, DIRECTIONS)
    level = np.outer(np.cos(angle), side) + np.outer(np.sin(angle), np.cross(up, side))
    directions = np.cos(lean)[:, None] * level + np.outer(np.sin(lean), up)
    return np.asarray(directions * np.where(directions[:, :1] < 0, -1.0, 1.0))


def _suitable(placed: Placed, first_m: Floats, second_m: Floats) -> Bools:
    """Return a mask (pair,) of the pairs of contacts (pair, xyz) that the fingers can grasp."""
    with np.errstate(invalid="ignore"):
        gap = second_m - first_m
        opening = np.linalg.norm(gap, axis=1)
        closing = gap / opening[:, None]
    suitable = np.isfinite(opening) & (opening >= OPENING_M[0]) & (opening <= OPENING_M[1])
    for at_m, sign in ((first_m, -1), (second_m, 1)):
        candidates = np.flatnonzero(suitable)
        along = sign * (placed.normal(at_m[candidates]) * closing[candidates]).sum(axis=1)
        suitable[candidates] &= (along >= np.cos(CONE_RAD)) & (
            placed.shape.margin_m(placed.to_body_frame(at_m[candidates])) >= MARGIN_M
        )
    return np.asarray(suitable)


CAMERA_M = (0.9, 1.2)  # height above the table
TILT_RAD = np.deg2rad(8.0)  # maximum tilt of the camera
SEEN_AT_M, SPREAD_M = (-0.05, -0.15), 0.03  # mean and standard deviation of object positions in the camera's view
MIN_POINTS = 800  # minimum number of points of a cloud, as in the published set
MAX_POSES = 100  # maximum number of poses of an object that are tried
SENSORS, THINGS, TRIAL = 1, 2, 3  # parts of the random seeds of sensors, objects and trials


@dataclass(frozen=True)
class GraspRig:
    """The objects and the quality of the sensors. The fields are those of the stage's params.

    Control experiments: with ``spheres``, objects differ only in size; with ``one_pose``, the cloud depends only on the
    object; with ``effort_spread=0``, the force depends only on the geometry.
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
    """The ground truth of a trial."""

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
    """The true contact, and the drift and the noise-free counts (finger, channel) of both sensors."""

    touch: pinch.Touch
    drift: Floats
    signal: Floats


def families(rig: GraspRig) -> tuple[str, ...]:
    """Return the families of objects of a rig."""
    names = FAMILIES if rig.families == "all" else tuple(name.strip() for name in rig.families.split(","))
    return ("sphere",) if rig.spheres else names


def draw_object(seed: int, index: int, rig: GraspRig = GraspRig()) -> Thing:
    """Return the object of trial ``index``. With ``rig.spheres``, all trials have the same object."""
    if rig.spheres:
        stiffness = "rigid" if rig.stiffness == "mixed" else rig.stiffness
        sphere = draw_household_object(np.random.default_rng([seed, THINGS]), "sphere", 1, stiffness)
        return replace(sphere, name="spheres", shape=Ellipsoid(np.full(3, REFERENCE_M)))
    names = families(rig)
    number, kind = divmod(index % (len(names) * rig.objects), len(names))
    rng = np.random.default_rng([seed, THINGS, FAMILIES.index(names[kind]), number])
    return draw_household_object(rng, names[kind], number + 1, rig.stiffness)


def sensors(seed: int) -> fingertip_sp.Sensors:
    """Return the two sensors of the rig with this seed."""
    return fingertip_sp.draw_sensors(np.random.default_rng([seed, SENSORS]))


def perform(seed: int, index: int, rig: GraspRig = GraspRig()) -> GraspScene:
    """Simulate the scene of trial ``index``. Raises `TacpipeError` if no grasp is possible in `MAX_POSES` poses."""
    thing = draw_object(seed, index, rig)
    rng = np.random.default_rng([seed, TRIAL, index])
    rests = thing.shape.rests()
    scale = float(rng.uniform(*SPHERES_M)) / REFERENCE_M if rig.spheres else 1.0
    for _ in range(MAX_POSES):
        up, height_m = depth_camera.sample_camera(rng, CAMERA_M, TILT_RAD)
        pose = rests[0 if rig.one_pose else int(rng.integers(len(rests)))]
        at_m = (float(rng.normal(SEEN_AT_M[0], SPREAD_M)), float(rng.normal(SEEN_AT_M[1], SPREAD_M)))
        placed = depth_camera.place_shape(thing.shape, pose, float(rng.uniform(0, 2 * np.pi)), at_m, up, height_m)
        direction, depth_m = depth_camera.visible_rays(placed)
        if len(depth_m) < MIN_POINTS:
            continue
        points = depth_camera.noisy_points(direction, depth_m, rig.noise_scale, rng)
        grasp = antipodal_grasps(placed, points.astype(np.float64), up, rig.shift, rng, central=rig.spheres)
        if grasp is None:
            continue
        colours = depth_camera.random_colours(placed.to_body_frame(direction * depth_m[:, None]), rng)
        situation = pinch.situation(placed, grasp, thing.compliance_1_pa)
        hidden = pinch.draw_unseen(rng, 1, rig.effort_spread)
        scene = GraspScene(thing, placed, up, height_m, Cloud(points, colours), grasp, situation, hidden)
        return scene if scale == 1 else _scale_scene(scene, scale)
    raise TacpipeError(f"The object {thing.name} could not be grasped in {MAX_POSES} poses; use another seed.")


def read_sensors(hand: fingertip_sp.Sensors, scene: GraspScene, t_ns: int, rig: GraspRig = GraspRig()) -> Readings:
    """Return the readings of both sensors for a scene at ``t_ns``. The camera's position does not matter."""
    touch = pinch.touch(scene.situation, scene.hidden)
    drift = fingertip_sp.drift(hand.phases_rad, rig.drift_count_day, t_ns)
    signal = fingertip_sp.signal(hand, touch.force_n, touch.contact_m, touch.skin_m, touch.centre_m)[0]
    return Readings(touch, drift, signal + drift)


def _scale_scene(scene: GraspScene, scale: float) -> GraspScene:
    """Return a scene with all lengths multiplied by ``scale``. The camera's image does not change."""
    thing = replace(scene.thing, shape=Ellipsoid(np.full(3, REFERENCE_M * scale)))
    placed = Placed(thing.shape, scene.placed.rotation, scene.placed.origin_m * scale)
    grasp = Grasp(scene.grasp.g1_m * scale, scene.grasp.g2_m * scale, scene.grasp.wrist)
    cloud = Cloud((scene.cloud.points_m * scale).astype(np.float32), scene.cloud.colours)
    situation = pinch.situation(placed, grasp, thing.compliance_1_pa)
    return replace(scene, thing=thing, placed=placed, cloud=cloud, grasp=grasp, situation=situation)
