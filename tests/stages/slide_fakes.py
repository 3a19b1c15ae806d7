"""Build recordings of a BioTac that an iiwa draws over a material."""

import numpy as np
import pyarrow as pa

from tacpipe.arrays import AnyArray
from tacpipe.channels import schema
from tacpipe.signals import kinematics
from tacpipe.signals.kinematics import IIWA14

START_NS = 1_581_072_654_000_000_000
LIMIT_M_S = 0.025


def finger(pressure: AnyArray, seed: int = 0) -> pa.Table:
    """Return a BioTac's stream at 100 Hz: electrodes from 10 to 60 counts, and this pressure."""
    rng = np.random.default_rng(seed)
    rows = len(pressure)
    counts = rng.integers(10, 60, (44, rows))
    counts[2] = pressure
    return schema.stream(START_NS + np.arange(rows) * 10_000_000, list(counts), schema.biotac_fields())


def pressed(rows: int = 800, reached: int = 0) -> AnyArray:
    """Return a pressure that reaches 40 counts in the row ``reached``, and falls below for most of what follows."""
    pressure = np.full(rows, 25)
    pressure[:reached] = np.minimum(np.arange(reached), 39)
    pressure[reached : reached + 20] = 40
    return pressure


def drawn(rows: int, moves: slice, speed_m_s: float = LIMIT_M_S, rate_hz: float = 150.0) -> dict[str, pa.Table]:
    """Return an arm's streams while the finger's has ``rows`` at 100 Hz: it turns about its base in these rows alone."""
    count = int(rows / 100 * rate_hz)
    time_s = np.arange(count) / rate_hz
    moving = (time_s >= moves.start / 100) & (time_s < moves.stop / 100)
    joint_rad = np.tile([0.0, 0.5, 0.2, -1.2, 0.5, 0.6, -0.6], (count, 1))
    reach_m = float(np.linalg.norm(kinematics.joint_frames(IIWA14, joint_rad[:1])[0, -1, :2, 3]))
    turning = np.zeros((count, 7))
    turning[moving, 0] = speed_m_s / reach_m
    joint_rad[:, 0] = np.cumsum(turning[:, 0]) / rate_hz
    flange_m = kinematics.joint_frames(IIWA14, joint_rad)[:, -1, :3, 3]
    t_ns = START_NS + np.rint(time_s * 1e9).astype(np.int64)
    upright = np.tile([0.0, 1.0, 0.0, 0.0], (count, 1))
    angles, speeds = schema.joint_fields()
    velocity = kinematics.hand_velocity(IIWA14, joint_rad, turning, flange_m)
    load = np.tile([0.5, -0.5, 2.0, 0.0, 0.0, 0.0], (count, 1))
    return {
        "joint_position": schema.stream(t_ns, joint_rad.T, angles),
        "joint_velocity": schema.stream(t_ns + 1_000_000, turning.T, speeds),
        "pose": schema.stream(t_ns + 2_000_000, np.column_stack([flange_m, upright]).T, schema.pose_fields()),
        "twist": schema.stream(t_ns + 3_000_000, velocity.T, schema.twist_fields()),
        "wrench": schema.stream(t_ns + 4_000_000, load.T, schema.wrench_fields()),
    }


def replaced(table: pa.Table, name: str, row: int, value: float) -> pa.Table:
    """Return a table with another value in one place."""
    column = table.column(name).to_numpy().copy()
    column[row] = value
    field = table.schema.field(name)
    return table.set_column(table.column_names.index(name), field, pa.array(column, field.type))
