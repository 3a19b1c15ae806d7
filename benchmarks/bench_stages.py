"""Stages that the benchmarks install: two that do next to nothing, and one that writes long recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tacpipe.plugins.stage import RecordingOutput, Trial, stage

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa

    from tacpipe.datasets.dataset import Recording


@dataclass(frozen=True)
class Make:
    """How much to make."""

    trials: int = 1000  # recordings
    rows: int = 200  # rows of each


@stage(version=1)
def make(params: Make, trial: Trial) -> RecordingOutput:
    """Make a small table."""
    import numpy as np
    import pyarrow as pa

    t_ns = np.arange(params.rows, dtype=np.int64) * 10_000_000  # (time,)
    channels = {f"x{i}": ((t_ns // 10_000_000 + trial * i) % 4093).astype(np.uint16) for i in range(8)}
    return RecordingOutput(pa.table({"t_ns": t_ns, **channels}), {"trial": trial})


@dataclass(frozen=True)
class Add:
    """What to add."""

    count: int = 1  # added to the first channel; another value is another result


@stage(version=1)
def add(params: Add, recording: Recording) -> pa.Table:
    """Add a count to the first channel."""
    import pyarrow as pa
    import pyarrow.compute as pc

    table = recording.table()
    raised = pc.add(table["x0"], pa.scalar(params.count, pa.uint16()))
    return table.set_column(table.column_names.index("x0"), "x0", raised)


@dataclass(frozen=True)
class Long:
    """What to make."""

    trials: int = 100  # recordings
    rows: int = 300_000  # rows of each
    kind: str = "moving"  # moving: integers of a skin; float: as after synchronize
    channels: int = 48  # of a skin of 16 taxels


@stage(version=1)
def make_long(params: Long, trial: Trial) -> RecordingOutput:
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
    return (values.astype(np.int64) % 8192 + 28_000).astype(np.uint16)
