"""Simulate recordings of a rig, with ground truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

from tacpipe.errors import UsageError
from tacpipe.plugins.constraints import (
    CommaList,
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Range,
    Seed,
    Unit,
)
from tacpipe.plugins.params import added
from tacpipe.plugins.stage import RecordingOutput, Trial, stage

Handling = Literal["planned", "mixed", "jolt", "jolt-held", "fade", "fade-held", "release", "shake", "hold"]
Families = Annotated[
    str, CommaList(Literal["all", "box", "cylinder", "sphere", "ellipsoid", "cone", "bow"], min_items=1)
]


@dataclass(frozen=True)
class Params:
    """Motions of the simulated pick-and-move rig, and the noise and latency of its streams."""

    trials: PositiveInt = 24  # number of recordings
    seed: Seed = 0  # random seed
    # length of a recording: approach, grasp, lift and move, then further moves
    duration_s: Annotated[float, Range(4), Unit("s")] = 12.0
    # how the arm moves: controlled (trapezoids), kinaesthetic (by hand), or mixed
    protocol: Literal["mixed", "controlled", "kinaesthetic"] = "mixed"
    # maximum load of the plan as a fraction of the friction limit; above 1 the object slips; 0: random
    effort: NonNegativeFloat = 0.0
    friction_scale: PositiveFloat = 1.0  # factor of the drawn friction; with 4 nothing slips
    grip_loss_probability: Fraction = 0.0  # fraction of trials in which the grip weakens without warning
    grip_loss: Fraction = 0.2  # fraction of the grip force that is lost when the grip weakens
    # sideways distance from the grasp to the centre of mass; it twists the object
    lever_m: Annotated[NonNegativeFloat, Unit("m")] = 0.0
    still: bool = False  # hold the lifted object still from first to last row, without drift and creep
    tactile_rate_hz: Annotated[PositiveFloat, Unit("Hz")] = 50.0  # frame rate of each tactile sensor
    robot_rate_hz: Annotated[PositiveFloat, Unit("Hz")] = 1000.0  # rate of the arm's states
    # fraction of tactile frames that repeat the previous frame; 0.75 is like the 2021 rig
    hold_probability: Fraction = 0.07
    drop_probability: Fraction = 0.002  # fraction of samples that are lost
    # multiple of the noise and drift of real sensors (uSkin: 1.35, 1.15, 3.4 counts in x, y, z)
    noise_scale: NonNegativeFloat = 1.0
    # mean and standard deviation of a tactile frame's latency
    tactile_jitter_ms: Annotated[NonNegativeFloat, Unit("ms")] = 2.0
    # mean and standard deviation of the latency of an arm state or a proximity reading
    robot_jitter_ms: Annotated[NonNegativeFloat, Unit("ms")] = 0.5
    # maximum offset of the sensors' own clocks (t_device_ns)
    clock_offset_ms: Annotated[NonNegativeFloat, Unit("ms")] = 80.0
    clock_skew_ppm: Annotated[NonNegativeFloat, Unit("ppm")] = 50.0  # maximum skew of a device's own clock
    # plans per second that the arm's controller sends, each for the next second; 0: no stream plan
    plan_rate_hz: Annotated[NonNegativeFloat, Unit("Hz")] = added(0.0)
    # what happens to the object, with friction and mass of 20 objects; replaces effort, grip loss and still.
    # jolt: moves until it slips; jolt-held: nearly slips; fade: the grip weakens until it slips; fade-held: nearly slips;
    # release: the gripper opens on purpose; shake, hold: no event; mixed: all; planned: none of these
    handling: Handling = added("planned")
    same_skins: bool = added(False)  # all trials have the same two tactile sensors, as on one rig

    def check(self) -> None:
        """Raise an error for a handling next to params that it replaces."""
        _check_handling(self)
        if self.handling != "planned" and self.still:
            raise UsageError(f"handling is {self.handling}, and still is set. Leave one of them out.")


def _check_handling(params: Params | GelParams) -> None:
    """Raise `UsageError` if a handling is set next to effort or a loss of grip, which it replaces."""
    if params.handling != "planned" and (params.effort or params.grip_loss_probability):
        name = "effort" if params.effort else "grip_loss_probability"
        raise UsageError(f"handling is {params.handling}, and {name} is set. Leave one of them out.")


def _rig_options(params: Params | MaterialParams | TouchParams | GelParams) -> dict[str, Any]:
    """Return the options of a rig: the params without the number of trials and the seed."""
    return {name: value for name, value in asdict(params).items() if name not in ("trials", "seed")}


@stage(version=2)
def forward(params: Params, trial: Trial) -> RecordingOutput:
    """Simulate grasp-lift-move trials, with ground truth.

    Each recording has the streams xela1, xela2, robot, proximity and, with ground truth, truth. With --plan-rate-hz, it
    also has the stream plan.

    Example: tacpipe simulate forward --trials 12 --duration-s 6 -o data/recordings
    """
    from tacpipe.simulation.pick_and_move import PickRig, simulate_trial

    return simulate_trial(params.seed, trial, PickRig(**_rig_options(params)))


@dataclass(frozen=True)
class MaterialParams:
    """Surfaces over which the simulated rig slides two different sensors, and the noise of the sensors."""

    # number of recordings, alternating between the sensors; 40 cover each of 20 materials with both sensors
    trials: PositiveInt = 200
    seed: Seed = 0  # random seed
    materials: PositiveInt = 20  # number of materials
    sessions: PositiveInt = 1  # number of sessions per material, between which its trials alternate
    identical_materials: bool = False  # all classes are the same material; only their sessions differ
    # shared: both sensors measure the same materials; independent: each has its own twenty
    spectra: Literal["shared", "independent"] = "shared"
    # multiple of the offsets, gains and drift that the trials of a session share
    session_scale: NonNegativeFloat = 1.0
    # multiple of the noise, drift and offsets of each trial
    noise_scale: NonNegativeFloat = 1.0
    force_n: Annotated[PositiveFloat, Unit("N")] = 1.0  # mean force of a slide; it varies by 5 % from trial to trial
    speed_m_s: Annotated[PositiveFloat, Unit("m/s")] = 0.025  # speed of the arm that draws the BioTac
    # mean speed of the material over RoboSkin; it varies by 30 %
    roboskin_speed_m_s: Annotated[PositiveFloat, Unit("m/s")] = 0.05
    pac: bool = True  # simulate the BioTac's vibration channels; they are zero otherwise
    # number of a material's BioTac slides from one with the arm's streams to the next; 0: none
    arm_every: NonNegativeInt = 20
    jitter_ms: Annotated[NonNegativeFloat, Unit("ms")] = 0.1  # mean and standard deviation of a reading's latency


@stage(version=1)
def material(params: MaterialParams, trial: Trial) -> RecordingOutput:
    """Simulate slides of two different sensors over materials.

    Each recording has the stream of its sensor, biotac or roboskin, and, with ground truth, truth.

    Example: tacpipe simulate material --trials 96 --materials 4 -o data/touched
    """
    from tacpipe.simulation.slide import SlideRig, simulate_trial

    return simulate_trial(params.seed, trial, SlideRig(**_rig_options(params)))


@dataclass(frozen=True)
class TouchParams:
    """Objects on the simulated table, their grasps, and the noise of camera and fingertips."""

    trials: PositiveInt = 360  # number of recordings, one per grasp; the objects alternate
    seed: Seed = 0  # random seed
    families: Families = "all"  # families of objects, or all
    objects: PositiveInt = 5  # number of named objects in each family
    # stiffness of the objects: rigid, elastic (50 kPa), foam (15 kPa), or mixed, different for each object
    stiffness: Literal["mixed", "rigid", "elastic", "foam"] = "mixed"
    spheres: bool = False  # spheres of different sizes, seen from proportional distances, grasped through the centre
    one_pose: bool = False  # each object has a single pose, and is only shifted and rotated about the vertical
    shift: Fraction = 0.5  # maximum offset of grasps from the cloud's middle, as a fraction of half its length
    # standard deviation of the logarithm of the closing effort, which no stream shows
    effort_spread: NonNegativeFloat = 0.15
    # multiple of the noise of a real camera (1.5 mm at 1 m) and real sensors (3.5 to 6.4 counts)
    noise_scale: NonNegativeFloat = 1.0
    drift_count_day: Annotated[NonNegativeFloat, Unit("count/day")] = 30.0  # root mean square drift of the sensors
    raw: bool = False  # record the camera's whole view and the sensors over time, for `segment grasps`

    def check(self) -> None:
        """Raise an error for whole views of spheres of different sizes, which have no table."""
        if self.raw and self.spheres:
            raise UsageError("raw and spheres are both set; spheres of all sizes have no table. Leave one of them out.")


@stage(version=2)
def touch(params: TouchParams, trial: Trial) -> RecordingOutput:
    """Simulate grasps of objects seen by a depth camera.

    Each recording has the streams cloud, grasp, reading and, with ground truth, truth.

    Example: tacpipe simulate touch --trials 96 --objects 1 -o data/pinched
    """
    from tacpipe.simulation.grasp import simulate_trial
    from tacpipe.simulation.grasp_scene import GraspRig

    return simulate_trial(params.seed, trial, GraspRig(**_rig_options(params)))


@dataclass(frozen=True)
class GelParams:
    """Trials of the simulated pick-and-move rig with a gel in each finger, and the cameras behind the gels."""

    trials: PositiveInt = 12  # number of recordings
    seed: Seed = 0  # random seed
    # length of a recording: approach, grasp, lift and move, then further moves
    duration_s: Annotated[float, Range(4), Unit("s")] = 6.0
    # maximum load of the plan as a fraction of the friction limit; above 1 the object slips; 0: random
    effort: NonNegativeFloat = 0.0
    friction_scale: PositiveFloat = 1.0  # factor of the drawn friction; with 4 nothing slips
    grip_loss_probability: Fraction = 0.0  # fraction of trials in which the grip weakens without warning
    # what happens to the object, with friction and mass of 20 objects; replaces effort, grip loss and still.
    # jolt: moves until it slips; jolt-held: nearly slips; fade: the grip weakens until it slips; fade-held: nearly slips;
    # release: the gripper opens on purpose; shake, hold: no event; mixed: all; planned: none of these
    handling: Handling = added("planned")
    frame_rate_hz: Annotated[PositiveInt, Unit("Hz")] = 25  # frames per second of each camera
    drop_probability: Fraction = 0.002  # fraction of frames that are lost
    noise_scale: NonNegativeFloat = 1.0  # multiple of the noise of the cameras
    # mean and standard deviation of a frame's latency
    jitter_ms: Annotated[NonNegativeFloat, Unit("ms")] = 2.0

    def check(self) -> None:
        """Raise an error for a handling next to params that it replaces."""
        _check_handling(self)


@stage(version=1)
def gel(params: GelParams, trial: Trial) -> RecordingOutput:
    """Simulate gels with printed markers, seen by cameras.

    Each recording has the videos gel1 and gel2 of 320x240 pixels, robot and, with ground truth, truth, gel1_truth and
    gel2_truth: the displacement of each marker, in pixels.

    Example: tacpipe simulate gel --trials 4 -o data/gels
    """
    from tacpipe.simulation.gel import GelRig, simulate_trial

    return simulate_trial(params.seed, trial, GelRig(**_rig_options(params)))
