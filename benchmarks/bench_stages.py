"""Stages that the benchmarks install: two that do next to nothing, and two that write long recordings."""

from __future__ import annotations

from collections.abc import Iterator
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
    """Params of the stage that adds a count."""

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
    """Params of the simulation of long recordings."""

    trials: int = 100  # recordings
    rows: int = 300_000  # rows of each
    kind: str = "moving"  # moving: integers of a skin; float: as after synchronize
    channels: int = 48  # a skin of 16 taxels has 48


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


@dataclass(frozen=True)
class Repeat:
    """How often a recording is repeated."""

    times: int = 5  # copies, one after the other


@stage(version=1)
def repeat(params: Repeat, recording: Recording) -> RecordingOutput:
    """Repeat a recording on one time axis, so that a long one has the contacts and the noise of a short one."""
    import pyarrow as pa

    tables = {name: recording.table(name) for name in recording.streams}
    span_ns = max(table["t_ns"][-1].as_py() - table["t_ns"][0].as_py() for table in tables.values()) + 1_000_000

    def batches(table: pa.Table) -> Iterator[pa.RecordBatch]:
        for copy in range(params.times):
            later = table
            for name, step in (("t_ns", span_ns), ("t_device_ns", span_ns), ("seq", table.num_rows)):
                if name in table.column_names:
                    place = table.schema.get_field_index(name)
                    shifted = table[name].to_numpy() + table[name].type.to_pandas_dtype()(copy * step)
                    later = later.set_column(place, table.schema.field(name), pa.array(shifted))
            yield from later.combine_chunks().to_batches(1 << 16)

    return RecordingOutput(
        {name: pa.RecordBatchReader.from_batches(table.schema, batches(table)) for name, table in tables.items()}
    )
