"""Stages of a third party, small enough to compute by hand; found like any plug-in's."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import Discovery, RecordingOutput, Result, stage

if TYPE_CHECKING:
    from pathlib import Path

    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.plugins.stage import Files, Fitted, Trial


@dataclass(frozen=True)
class Make:
    trials: int = 4  # how many recordings
    rows: int = 20  # rows of each
    offset: int = 0  # added to every value


@stage(version=1)
def make(params: Make, trial: Trial) -> RecordingOutput:
    """Return counting numbers, times the number of the trial plus one."""
    import numpy as np
    import pyarrow as pa

    t_ns = np.arange(params.rows) * 10_000_000  # (time,)
    values = (np.arange(params.rows) * (trial + 1) + params.offset).astype(np.uint16)  # (time,)
    left_table = pa.table({"t_ns": t_ns, "x": pa.array(values, pa.uint16())})
    right = pa.table({"t_ns": t_ns, "y": pa.array(values[::-1].copy(), pa.uint16())})
    return RecordingOutput({"left": left_table, "right": right}, {"trial": trial, "material": "cork"})


@dataclass(frozen=True)
class Read:
    pass


def discover(params: Read, source: Path) -> dict[str, dict[str, Path]]:
    """Find one recording a text file."""
    return {file.stem: {file.name: file} for file in sorted(source.glob("*.txt"))}


@stage(version=1, source=Discovery(discover))
def read(params: Read, files: Files) -> RecordingOutput:
    """Return the numbers of a text file, one a line."""
    import pyarrow as pa

    (path,) = files.values()
    try:
        values = [int(line) for line in path.read_text().split()]
    except ValueError as error:
        raise TacpipeError(f"{path} holds {error.args[0].rpartition(':')[2].strip()}, which is not a number.") from None
    return RecordingOutput({"left": pa.table({"x": pa.array(values, pa.uint16())})})


@dataclass(frozen=True)
class Scale:
    factor: int = 2  # every value is multiplied by it
    refuse: int = -1  # a first value that counts as bad
    pause_s: float = 0.0  # how long each recording takes
    gate: str = ""  # a file, without which no recording is done


@stage(version=1)
def scale(params: Scale, recording: Recording) -> pa.Table:
    """Return the left stream, multiplied."""
    import pyarrow as pa
    import pyarrow.compute as pc

    time.sleep(params.pause_s)
    while params.gate and not os.path.exists(params.gate):  # noqa: PTH110
        time.sleep(0.01)
    table = recording.table("left")
    if table.num_rows and table["x"][0].as_py() == params.refuse:
        raise TacpipeError(f"It begins with {params.refuse}, which this stage refuses.")
    return pa.table({"x": pc.multiply(table["x"].cast(pa.int32()), params.factor)})


@stage(version=1, reads=("material",))
def named(params: Read, recording: Recording) -> RecordingOutput:
    """Return the table as it is, with the material as it was read."""
    return RecordingOutput(recording.table("left"), {"seen": recording.attributes["material"]})


@stage(version=1)
def fit(params: Read, train: Dataset) -> Result:
    """Return the mean of the training recordings."""
    import numpy as np

    values = np.concatenate([shard.table()["x"].to_numpy() for shard in train.recordings.values()])
    return Result(files={"codec.json": f"{values.mean():.6f}".encode()})


@stage(version=1)
def centre(params: Read, recording: Recording, codec: Annotated[Fitted, fit]) -> pa.Table:
    """Return the table with the training mean taken off."""
    import pyarrow as pa
    import pyarrow.compute as pc

    table = recording.table()
    return pa.table({"x": pc.subtract(table["x"].cast(pa.float64()), float(codec["codec.json"]))})


@stage(version=1)
def total(params: Read, recordings: Dataset) -> Result:
    """Return the sum of each recording."""
    import json

    sums = {name: sum(shard.table()["x"].to_pylist()) for name, shard in recordings.recordings.items()}
    return Result(files={"metrics.json": json.dumps(sums).encode()})


@stage(version=1)
def halves(params: Read, recordings: Dataset) -> Result:
    """Return a split: the first half trains, the second tests."""
    import pyarrow as pa

    names = sorted(recordings.recordings)
    roles = ["train" if position < len(names) / 2 else "test" for position in range(len(names))]
    fold = pa.array([0] * len(names), pa.int32())
    table = pa.table({"recording": names, "fold": fold, "role": roles})
    return Result(recordings={"split": RecordingOutput(table)})


@stage(version=1)
def page(params: Read, recordings: Dataset) -> Result:
    """Return a page that counts the recordings."""
    return Result(files={"page.html": f"<p>{len(recordings)} recordings</p>".encode()})
