"""A lab's own recordings as CSV and YAML files: a 4x4 array of one axis is pressed on textured plates and drawn over them.

The load follows from how deep the arm presses, so that a planned motion states what comes; materials differ in the
period of their texture alone, so that how hard was pressed states nothing.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from tacpipe.arrays import AnyFloats

SIDE = 4  # taxels
PITCH_M = 4e-3
SKIN_HZ, ARM_HZ = 100, 500
PERIODS_M = {"cork": 2.2e-3, "foam": 9e-3, "felt": 1.2e-3, "rubber": 4.5e-3}
STIFFNESS = 2.4e7  # counts of a depth in metres to the power of Hertz
LAG_S = 0.03  # The skin lags behind the load.


def write(folder: Path, count: int = 20, seconds: float = 8.0, seed: int = 0) -> None:
    """Write ``count`` recordings, each a folder with ``skin.csv``, ``arm.csv`` and ``labels.yaml``."""
    rng = np.random.default_rng(seed)
    gains, offsets = rng.normal(1, 0.08, SIDE * SIDE), 200 + rng.normal(0, 6, SIDE * SIDE)
    for trial in range(count):
        material = list(PERIODS_M)[trial % len(PERIODS_M)]
        place = folder / f"trial_{trial + 1:02d}"
        place.mkdir(parents=True)
        start_s = 1_730_000_000 + 60 * trial
        time_s, position_m, tilt_rad = move_arm(rng, seconds + rng.uniform(-0.5, 0.5))
        skin_s = np.arange(0.004, time_s[-1] - 0.01, 1 / SKIN_HZ)
        skin_s += rng.normal(0, 2e-4, len(skin_s))
        counts = offsets + gains * press_taxels(rng, PERIODS_M[material], skin_s, time_s, position_m, tilt_rad)
        counts = np.rint(np.clip(counts + rng.normal(0, 1.5, counts.shape), 0, 65535)).astype(int)
        names = [f"t{row}{column}" for row in range(SIDE) for column in range(SIDE)]
        skin = pd.DataFrame(counts, columns=names)
        skin.insert(0, "time", [f"{start_s + t_s:.6f}" for t_s in skin_s])
        skin.to_csv(place / "skin.csv", index=False)
        arm = pd.DataFrame(position_m, columns=["x", "y", "z"]).assign(
            qx=np.sin(tilt_rad / 2), qy=0.0, qz=0.0, qw=np.cos(tilt_rad / 2)
        )
        arm.insert(0, "time", [f"{start_s + t_s:.6f}" for t_s in time_s])
        arm.to_csv(place / "arm.csv", index=False, float_format="%.8f")
        (place / "labels.yaml").write_text(f"material: {material}\nobject: plate_{trial % 5 + 1}\n")


def move_arm(rng: np.random.Generator, seconds: float) -> tuple[AnyFloats, AnyFloats, AnyFloats]:
    """Return times (time,), the arm's positions (time, 3) in m and its tilt (time,) in rad: down, along, up."""
    time_s = np.arange(int(seconds * ARM_HZ)) / ARM_HZ
    down, up, press_m = 0.7 + rng.uniform(0, 0.2), seconds - 0.8, rng.uniform(0.6, 1.8) * 1e-3
    height = np.interp(
        time_s, [0, down, down + 0.3, up, up + 0.25, seconds], [0.01, 0.004, -press_m, -press_m, 0.01, 0.01]
    )
    sliding = np.clip((time_s - down - 0.3) / 0.3, 0, 1) * np.clip((up - 0.1 - time_s) / 0.3, 0, 1)
    waves = zip(rng.uniform(0.1, 0.3, 3), rng.uniform(0.4, 1.8, 3), rng.uniform(0, 2 * np.pi, 3), strict=True)
    height += sliding * sum(press_m * size * np.sin(2 * np.pi * hz * time_s + phase) for size, hz, phase in waves)
    speed = 0.02 * np.clip((time_s - down - 0.4) / 0.1, 0, 1) * np.clip((up - 0.1 - time_s) / 0.1, 0, 1)
    along = 0.3 + np.cumsum(speed) / ARM_HZ + rng.uniform(-0.01, 0.01)
    tilt_rad = 0.02 * np.sin(2 * np.pi * 0.2 * time_s + rng.uniform(0, 2 * np.pi))
    return time_s, np.column_stack([along, np.full(len(time_s), 0.1), height]), tilt_rad


def press_taxels(
    rng: np.random.Generator,
    period_m: float,
    skin_s: AnyFloats,
    time_s: AnyFloats,
    position_m: AnyFloats,
    tilt_rad: AnyFloats,
) -> AnyFloats:
    """Return the load of each taxel (time, taxel) in counts."""
    along, height, tilt = (
        np.interp(skin_s, time_s, values) for values in (position_m[:, 0], position_m[:, 2], tilt_rad)
    )
    place = np.tile(np.arange(SIDE) * PITCH_M, SIDE)  # (taxel,), along the slide
    texture = sum(
        np.sin(2 * np.pi * order * (along[:, None] + place) / period_m + rng.uniform(0, 2 * np.pi)) / order
        for order in (1, 2, 3)
    )
    depth_m = np.clip(tilt[:, None] * (place - place.mean()) / 2 - height[:, None], 0, None)
    load: AnyFloats = STIFFNESS * depth_m**1.5 * (1 + 0.12 * texture)
    decay = np.exp(-1 / SKIN_HZ / LAG_S)
    lagged: AnyFloats = np.zeros_like(load)
    for row in range(1, len(load)):
        lagged[row] = decay * lagged[row - 1] + (1 - decay) * load[row]
    return lagged
