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
    tactile_rate_hz: float = 50.0  # frames a second of each tactile sensor
    robot_rate_hz: float = 1000.0  # states a second of the arm
    hold_probability: float = 0.07  # share of tactile frames that repeat the one before; 0.75 is like the 2021 rig
    drop_probability: float = 0.002  # share of samples that are lost
    noise_scale: float = 1.0  # times the noise of a real uSkin at rest (1.35, 1.15, 3.4 counts in x, y, z)
    tactile_jitter_ms: float = 2.0  # milliseconds, standard deviation of a tactile frame's stamp
    robot_jitter_ms: float = 0.5  # milliseconds, standard deviation of an arm state's stamp
    clock_offset_ms: float = 0.0  # milliseconds, largest offset of a tactile clock; nothing downstream undoes it
    clock_skew_ppm: float = 50.0  # parts per million, largest skew of a stream's clock


@stage(version=1)
def forward(params: Params, trial: Trial) -> Recording:
    """Return one grasp-lift-move trial: xela1, xela2, robot and, with ground truth, truth."""
    from tacpipe.simulation.pick_and_move import Rig, simulate_trial

    values = asdict(params)
    del values["trials"]
    seed = values.pop("seed")
    return simulate_trial(seed, trial, Rig(**values))
