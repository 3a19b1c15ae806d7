"""A lab's folder, written by pandas and numpy as a lab's own scripts write it."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from tacpipe.formats.table import layout, reading
from tacpipe.formats.table import rows as table_rows
from tacpipe.formats.table.layout import Layout, StreamLayout

START_S = 1_700_000_000


def frame(rows: int = 50, rate_hz: float = 100.0, seed: int = 0) -> pd.DataFrame:
    """Return stamps in Unix seconds, four taxels as whole numbers and a force."""
    rng = np.random.default_rng(seed)
    result: dict[str, Any] = {"time": START_S + np.arange(rows) / rate_hz}
    result |= {f"taxel{taxel}": rng.integers(0, 4096, rows) for taxel in range(1, 5)}
    result["fx"] = rng.normal(size=rows).round(6)
    return pd.DataFrame(result)


def write(folder: Path, trials: int = 3, **options: Any) -> list[pd.DataFrame]:
    """Write ``trials`` folders with a ``skin.csv`` each and return what they hold."""
    output = []
    for trial in range(trials):
        place = folder / f"trial_{trial}"
        place.mkdir(parents=True)
        output.append(frame(seed=trial))
        output[-1].to_csv(place / "skin.csv", index=False, **options)
    return output


def read_stream_table(path: Path, stream: StreamLayout, recording: str | None = None) -> pa.Table:
    """Return the rows of a file as a stream, read at once."""
    return reading.stream_batches(table_rows.open_rows(path, stream), stream, recording).read_all()


def stream(extra: str = "", columns: str = "", files: str = "trial_{trial}/skin.csv") -> StreamLayout:
    """Return the stream of a layout with some entries of its own."""
    return skin_layout(extra, columns, files).streams[0]


def skin_layout(
    extra: str = "", columns: str = "", files: str = "trial_{trial}/skin.csv", more_toml: str = ""
) -> Layout:
    """Return a layout of one stream, ``skin``."""
    columns = columns or (
        '{ match = "taxel{taxel}", quantity = "tactile", unit = "count", type = "uint16" }, '
        '{ match = "fx", name = "force_x_n", quantity = "force", unit = "N", component = "x" }'
    )
    time = "" if "time =" in extra else 'time = { column = "time" }'
    return layout.parse_layout(
        f'[streams.skin]\nfiles = "{files}"\n{time}\n{extra}\ncolumns = [{columns}]\n{more_toml}'
    )
