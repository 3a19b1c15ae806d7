"""The chain of `steps` as stages of tacpipe."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tacpipe.plugins.stage import Discovery, Files, Result, stage
from tests.promises.trust import steps

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording


@dataclass(frozen=True)
class Nothing:
    """No params."""


@dataclass(frozen=True)
class Factor:
    """Params of the stage that scales."""

    factor: int = 2  # Every number is multiplied by this.


def discover(params: Nothing, source: Path) -> dict[str, dict[str, Path]]:
    """Find one recording a text file."""
    return {path.stem: {path.name: path} for path in sorted(source.glob("*.txt"))}


@stage(version=1, source=Discovery(discover))
def load(params: Nothing, files: Files) -> pa.Table:
    """Turn a text into a table."""
    import pyarrow as pa

    (path,) = files.values()
    steps.note_begin("load", path.stem)
    return pa.table({"x": steps.parse_numbers(path.stem, path.read_text())})


@stage(version=1)
def scale(params: Factor, recording: Recording) -> pa.Table:
    """Scale a table."""
    import pyarrow as pa

    steps.note_begin("scale", recording.name)
    values = recording.table()["x"].to_numpy()
    return pa.table({"x": steps.multiply(recording.name, values, params.factor)})


@stage(version=1)
def total(params: Nothing, recordings: Dataset) -> Result:
    """Sum tables."""
    steps.note_begin("total", "all")
    sums = {name: int(shard.table()["x"].to_numpy().sum()) for name, shard in recordings.recordings.items()}
    return Result(files={"total.json": json.dumps(sums).encode()})


def values(directory: str) -> dict[str, list[int]]:
    """Return what tacpipe serves of a dataset, by recording."""
    import tacpipe

    return {name: shard.table()["x"].to_pylist() for name, shard in tacpipe.open(directory).recordings.items()}


if __name__ == "__main__":
    import sys

    print(json.dumps(values(sys.argv[1])))
