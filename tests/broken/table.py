"""Read the inputs of `tests.broken.cases` with several tools, and write the table of docs/benchmarks/broken-data.md.

``python -m tests.broken.table`` rewrites the table between the marks of the page.
"""

import contextlib
import io
import json
import logging
import os
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import tacpipe
from tests.broken.cases import CASES, Case, build

PAGE = Path(__file__).parents[2] / "docs" / "benchmarks" / "broken-data.md"
TOOLS = ("pandas", "polars", "pyxdf", "rosbags")
BEGIN, END = "<!-- table -->\n", "<!-- end of table -->\n"
SILENT, WARNED, REFUSED, REPAIRED, CRASHED, NONE = "silent", "warned", "refused", "repaired", "crashed", "–"


def of_frames(
    case: Case, data: Path, read: Callable[[Path], Any], concat: Callable[[list[Any]], Any], times: Callable[[Any], Any]
) -> Any:
    """Return what a case asks for from tables that a library reads and joins, in the usual calls of its documentation."""
    if "ticks" in case.fault or "32-bit" in case.fault:
        values, stamps = (np.load(data / f"t1/{name}.npy") for name in ("tactile", "timestamps"))
        return values.reshape(len(values), -1) if "ticks" in case.fault else {"t1": times(stamps)}
    if "LeRobot" in case.fault:
        return [read(path) for path in sorted(data.rglob("file-*.parquet"))]
    frames = {path.parent.name: read(path) for path in sorted(data.glob("*/s.csv"))}
    if "labels" in case.fault:
        import yaml

        return [yaml.safe_load(path.read_text())["material"] for path in sorted(data.glob("*/meta.yaml"))]
    if "order" in case.fault or "missing" in case.fault:
        joined = concat(list(frames.values()))
        return [float(frame["T1"].mean()) for frame in (joined, *frames.values())]
    if "copies" in case.fault:
        return dict.fromkeys(frames, "") | {"t00": "test"}
    return {name: times(frame["time"]) for name, frame in frames.items()}


def read_pandas(case: Case, data: Path) -> Any:
    import pandas as pd

    def times(column: Any) -> Any:
        series = pd.Series(column)
        if series.dtype.kind in "OT" or str(series.dtype).startswith("str"):
            series = pd.to_datetime(series).dt.tz_localize("Europe/Berlin").astype("int64") / 1e9
        return series.to_numpy()

    return of_frames(
        case, data, lambda path: (pd.read_parquet if path.suffix == ".parquet" else pd.read_csv)(path), pd.concat, times
    )


def read_polars(case: Case, data: Path) -> Any:
    import polars as pl

    def times(column: Any) -> Any:
        series = pl.Series(column)
        if series.dtype == pl.String:
            series = series.str.to_datetime().dt.replace_time_zone("Europe/Berlin").dt.epoch("us") / 1e6
        return series.to_numpy()

    return of_frames(
        case, data, lambda path: (pl.read_parquet if path.suffix == ".parquet" else pl.read_csv)(path), pl.concat, times
    )


def read_pyxdf(case: Case, data: Path) -> Any:
    import pyxdf

    streams, _ = pyxdf.load_xdf(data / "s.xdf")
    return {number: stream["time_stamps"] for number, stream in enumerate(streams)}


def read_rosbags(case: Case, data: Path) -> Any:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([data / "bag"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        return [reader.deserialize(content, connection.msgtype) for connection, _, content in reader.messages()]


READERS = {"pandas": read_pandas, "polars": read_polars, "pyxdf": read_pyxdf, "rosbags": read_rosbags}


def classify_tool(case: Case, tool: str, folder: Path) -> str:
    """Return what a tool does with a case."""
    if tool not in case.tools:
        return NONE
    log = io.StringIO()
    handler = logging.StreamHandler(log)
    handler.setLevel(logging.WARNING)
    logging.getLogger().addHandler(handler)
    try:
        with warnings.catch_warnings(record=True) as caught, contextlib.redirect_stderr(log):
            warnings.simplefilter("always")
            value = READERS[tool](case, folder / "data")
    except Exception:  # whichever error the tool has for it
        return REFUSED
    finally:
        logging.getLogger().removeHandler(handler)
    if case.right(value):
        return REPAIRED
    return WARNED if caught or log.getvalue() else SILENT


def read_stored(case: Case) -> Any:
    """Return what a case asks for from the datasets that the commands of tacpipe wrote in the working directory."""
    if "copies" in case.fault:
        return {row["recording"]: row["role"] for row in tacpipe.open("split")["split"].table().to_pylist()}
    recordings = tacpipe.open("rec")
    if "labels" in case.fault:
        return [recording.attributes["material"] for recording in recordings]
    if "ticks" in case.fault:
        (recording,) = recordings
        table = recording.table("s")
        return np.column_stack([table[name].to_numpy() for name in table.column_names if name != "t_ns"])
    if "order" in case.fault:
        return [float(np.mean(recording.table("s")["T1"].to_numpy())) for recording in recordings] + [
            1000.0 if len({tuple(recording.table("s").column_names) for recording in recordings}) == 1 else 0.0
        ]
    if Path("sync").exists():
        return {recording.name: recording.table()["t_ns"].to_numpy() / 1e9 for recording in tacpipe.open("sync")}
    return {
        f"{recording.name} {name}": recording.table(name)["t_ns"].to_numpy() / 1e9
        for recording in recordings
        for name in recording.streams
    }


def run_tacpipe(command: str) -> tuple[int, str, str]:
    ran = subprocess.run(
        [sys.executable, "-m", "tacpipe", *command.split()], capture_output=True, text=True, check=False
    )
    return ran.returncode, ran.stdout, ran.stderr


def classify_tacpipe(case: Case) -> str:
    """Return what the commands of tacpipe do with a case in the working directory."""
    notes = ""
    for command in case.commands:
        code, _, messages = run_tacpipe(command)
        if code:
            return CRASHED if "Traceback" in messages else REFUSED
        notes += messages
    noted = any(re.search(case.words, line) for line in notes.splitlines() if case.words and ":" in line)
    if case.right(read_stored(case)):
        return f"{REPAIRED}, with a note" if noted else REPAIRED
    return WARNED if noted else SILENT


def classify_check() -> str:
    """Return the kinds of findings of `tacpipe check` in the working directory, before ingest."""
    layout = "--layout layout.toml " if Path("layout.toml").exists() else ""
    _, output, messages = run_tacpipe(f"check data {layout}--json")
    if "Traceback" in messages:
        return CRASHED
    found = json.loads(output)
    if "findings" not in found:
        return REFUSED
    return ", ".join(sorted({f"`{finding['kind']}`" for finding in found["findings"]})) or SILENT


def rows() -> list[list[str]]:
    """Return the cells of the table, a row per case."""
    table = []
    here = Path.cwd()
    for case in CASES:
        with tempfile.TemporaryDirectory() as folder:
            build(case, Path(folder))
            cells = [case.fault, *(classify_tool(case, tool, Path(folder)) for tool in TOOLS)]
            os.chdir(folder)
            try:
                table.append([*cells, classify_tacpipe(case), classify_check()])
            finally:
                os.chdir(here)
            print(table[-1], file=sys.stderr, flush=True)
    return table


def to_text(table: list[list[str]]) -> str:
    heads = ["fault", *(f"{tool} {version(tool)}" for tool in TOOLS), "tacpipe", "`tacpipe check`"]
    lines = [heads, ["---"] * len(heads), *table]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    before, _, after = PAGE.read_text().partition(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n{to_text(rows())}\n{END}{after.partition(END)[2]}")
    print(PAGE)
