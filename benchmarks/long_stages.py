"""Stages that make long recordings, so that what remains is the cost of reading their bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.plugins.stage import RecordingOutput, Trial, stage

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class Long:
    """What to make."""

    trials: int = 100  # recordings
    rows: int = 300_000  # rows of each
    kind: str = "moving"  # moving: integers of a skin; held: each comes four times; float: as after synchronize
    channels: int = 48  # of a skin of 16 taxels


@stage(version=1)
def make(params: Long, trial: Trial) -> RecordingOutput:
    """Make a recording in which every channel drifts under noise, as that of a magnetic skin."""
    import numpy as np
    import pyarrow as pa

    draw = np.random.default_rng(trial)
    t_ns = np.arange(params.rows, dtype=np.int64) * 10_000_000  # (time,)
    channels = {f"c{number:02d}": _channel(params, draw) for number in range(params.channels)}
    return RecordingOutput(pa.table({"t_ns": t_ns, **channels}), {"trial": trial})


def _channel(params: Long, draw: np.random.Generator) -> np.ndarray:
    """Return one channel (time,)."""
    import numpy as np

    drift = np.cumsum(draw.standard_normal(params.rows, dtype=np.float32) * 3)
    values = drift + draw.standard_normal(params.rows, dtype=np.float32) * 2
    if params.kind == "float":
        return np.asarray(values + 30_000, dtype=np.float32)
    counts = (values.astype(np.int64) % 8192 + 28_000).astype(np.uint16)
    return counts[np.arange(params.rows) // 4 * 4] if params.kind == "held" else counts
