"""Record trials of a simulated rig, with ground truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from tacpipe.stage import Recording, Trial, stage


@dataclass(frozen=True)
class Params:
    """What the simulated pick-and-move rig does, and how badly its streams are logged."""

    trials: int = 24  # recordings
    seed: int = 0  # of all that is random
    duration_s: float = 12.0  # seconds a recording: approach, grasp, lift and move, then further moves
    protocol: str = "mixed"  # how the arm moves: controlled (trapezoids), kinaesthetic (by hand), or mixed
    effort: float = 0.0  # largest load of the plan over what friction holds; above 1 the plan makes it slip; 0: random
    friction_scale: float = 1.0  # times the friction that was drawn; with 4 nothing ever slips
    grip_loss_probability: float = 0.0  # share of trials in which the grip gives way, unannounced
    grip_loss: float = 0.2  # share of the grip force that is lost then
    lever_m: float = 0.0  # metres from the grasp to the centre of mass, sideways; twists the object
    still: bool = False  # hold the lifted object still from first to last row, without drift and creep
    tactile_rate_hz: float = 50.0  # frames a second of each tactile sensor
    robot_rate_hz: float = 1000.0  # states a second of the arm
    hold_probability: float = 0.07  # share of tactile frames that repeat the one before; 0.75 is like the 2021 rig
    drop_probability: float = 0.002  # share of samples that are lost
    noise_scale: float = 1.0  # times the noise and drift of real sensors (uSkin: 1.35, 1.15, 3.4 counts in x, y, z)
    tactile_jitter_ms: float = 2.0  # milliseconds, mean and standard deviation of a tactile frame's way to the host
    robot_jitter_ms: float = 0.5  # milliseconds, the same of an arm state or a proximity reading
    clock_offset_ms: float = 80.0  # milliseconds, largest offset of the sensors' own clocks (t_device_ns)
    clock_skew_ppm: float = 50.0  # parts per million, largest skew of a device's own clock


@stage(version=2)
def forward(params: Params, trial: Trial) -> Recording:
    """Return one grasp-lift-move trial: xela1, xela2, robot, proximity and, with ground truth, truth."""
    from tacpipe.simulation.pick_and_move import Rig, simulate_trial

    values = asdict(params)
    del values["trials"]
    seed = values.pop("seed")
    return simulate_trial(seed, trial, Rig(**values))


@dataclass(frozen=True)
class MaterialParams:
    """What the simulated rig of two unlike sensors slides over, and how well the sensors tell."""

    trials: int = 200  # recordings: a BioTac's and a RoboSkin's by turns, the materials in turn, so 40 are one of each
    seed: int = 0  # of all that is random
    materials: int = 20  # materials
    sessions: int = 1  # sessions a material, over which its trials are shared out by turns
    identical_materials: bool = False  # all classes are one and the same material; only their sessions differ
    spectra: str = "shared"  # shared: both sensors feel the same materials; independent: each has its own twenty
    session_scale: float = 1.0  # times the offsets, gains and drift that the trials of a session have in common
    noise_scale: float = 1.0  # times what differs from reading to reading: noise, drift, each trial's own offsets
    force_n: float = 1.0  # newton, mean force of a slide; it varies by 5 % from trial to trial
    speed_m_s: float = 0.025  # metres a second, of the arm that draws the BioTac
    roboskin_speed_m_s: float = 0.05  # metres a second, mean speed of what slides over RoboSkin; it wanders by 30 %
    pac: bool = True  # whether the BioTac's vibration channels are simulated; they are zero otherwise
    arm_every: int = 20  # every how many-th slide of a BioTac on a material has the arm's streams; 0: none
    jitter_ms: float = 0.1  # milliseconds, mean and standard deviation of a reading's way to the host


@stage(version=1)
def material(params: MaterialParams, trial: Trial) -> Recording:
    """Return one slide of a BioTac or of RoboSkin over a material, and, with ground truth, truth."""
    from tacpipe.simulation.slide import Rig, simulate_trial

    values = asdict(params)
    del values["trials"]
    seed = values.pop("seed")
    return simulate_trial(seed, trial, Rig(**values))


@dataclass(frozen=True)
class TouchParams:
    """What lies on the simulated table, how it is grasped, and how well camera and fingertips tell."""

    trials: int = 360  # recordings, each a grasp; the objects take turns
    seed: int = 0  # of all that is random
    families: str = "all"  # of objects: box, cylinder, sphere, ellipsoid, cone, bow, separated by commas; or all
    objects: int = 5  # named objects of each family
    stiffness: str = "mixed"  # of the objects: rigid, elastic (50 kPa), foam (15 kPa), or mixed, each object its own
    spheres: bool = False  # spheres that differ in size alone, seen from as much nearer, grasped through the centre
    one_pose: bool = False  # each object always lies the same way, and is only shifted and turned about the vertical
    shift: float = 0.5  # largest share of half the cloud's length by which grasps lie off its middle
    effort_spread: float = 0.15  # standard deviation of the logarithm of the closing effort, which nobody sees
    noise_scale: float = 1.0  # times the noise of a real camera (1.5 mm at 1 m) and real sensors (3.5 to 6.4 counts)
    drift_count_day: float = 30.0  # counts a day by which the sensors drift, root mean square
    raw: bool = False  # the camera's whole view and the sensors over time, as before `segment grasps`


@stage(version=2)
def touch(params: TouchParams, trial: Trial) -> Recording:
    """Return one grasp of an object on a table: cloud, grasp, reading and, with ground truth, truth."""
    from tacpipe.simulation.grasp import simulate_trial
    from tacpipe.simulation.grasp_scene import Rig

    values = asdict(params)
    del values["trials"]
    seed = values.pop("seed")
    return simulate_trial(seed, trial, Rig(**values))
