"""Third-party stages whose results differ each time, which is not allowed."""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tacpipe.plugins.stage import Result, stage

if TYPE_CHECKING:
    import pyarrow as pa

    from tacpipe.datasets.dataset import Dataset, Recording
    from tacpipe.plugins.stage import Fitted


@dataclass(frozen=True)
class Nothing:
    only: str = ""  # recording that is not as it was; all of them if empty


@stage(version=1)
def chance(params: Nothing, recording: Recording) -> pa.Table:
    """Return the stream with a random column."""
    import pyarrow as pa

    table = recording.table("left")
    drawn = os.urandom(2) if params.only in ("", recording.name) else b"22"
    return pa.table(
        {"x": table["x"], "drawn": pa.array([int.from_bytes(drawn, "little")] * table.num_rows, pa.uint16())}
    )


@stage(version=1)
def moment(params: Nothing, recordings: Dataset) -> Result:
    """Return when it was run."""
    return Result(files={"same.json": b"{}", "when.json": json.dumps(time.time_ns()).encode()})


@stage(version=1)
def unordered(params: Nothing, recordings: Dataset) -> Result:
    """Return the names of a set in its order, which is another in each process."""
    return Result(files={"names.json": json.dumps(list({f"name-{number}" for number in range(50)})).encode()})


@stage(version=1)
def fit(params: Nothing, train: Dataset) -> Result:
    """Return anything."""
    return Result(files={"codec.json": os.urandom(4).hex().encode()})


@stage(version=1)
def fitted(params: Nothing, recording: Recording, codec: Annotated[Fitted, fit]) -> pa.Table:
    """Return the table beside what the fit gave."""
    import pyarrow as pa

    table = recording.table()
    return pa.table({"x": table["x"], "code": pa.array([codec["codec.json"].decode()] * table.num_rows)})
