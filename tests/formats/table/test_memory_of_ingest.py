"""The memory that `tacpipe ingest` takes, which must not grow with the file."""

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq
import pytest

LAYOUT = """
[streams.arm]
files = "{name}"
%s
time = { column = "time", unit = "s" }
columns = [{ match = "c{channel}" }]
"""
COLUMNS, ROWS, BLOCK = 16, 4_000_000, 100_000  # a CSV of 0.6 GB; as a table 0.54 GB, stored 0.4 GB
MOST_KB = 800_000  # bytes in memory: the program and its libraries, blocks of the file, one group of rows
LONG_LAYOUT = """
[streams.arm]
files = "all.csv"
long = { channel = "sensor", value = "reading" }
time = { column = "time", unit = "s" }
columns = [{ match = "c{channel}" }]
"""
RUN = """
import sys
from tacpipe.cli import main
code = main.answer(sys.argv[1:])
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1], file=sys.stderr)
sys.exit(code)
"""
linux = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read as Linux states it")


def rows(start: int, values: np.ndarray, recordings: int) -> pa.Table:
    """Return rows of a table as a rig's script logs them."""
    seconds = [f"{(1_700_000_000_000 + row) / 1000:.3f}" for row in range(start, start + BLOCK)]
    names = [f"trial{row * recordings // ROWS}" for row in range(start, start + BLOCK)]
    columns = {f"c{number}": pa.array(np.roll(values, number + start // BLOCK)) for number in range(COLUMNS)}
    return pa.table({"time": seconds, **({"trial": names} if recordings > 1 else {}), **columns})


def write_rows(path: Path, recordings: int = 1) -> None:
    values = np.random.default_rng(0).normal(size=BLOCK).round(6)
    output = (rows(start, values, recordings) for start in range(0, ROWS, BLOCK))
    first = next(output)
    if path.suffix == ".parquet":
        with pq.ParquetWriter(path, first.schema) as writer:
            for table in (first, *output):
                writer.write_table(table)
        return
    with path.open("wb") as sink, pc.CSVWriter(sink, first.schema) as writer:
        for table in (first, *output):
            writer.write_table(table)


def ran(folder: Path, command: str) -> str:
    """Run a command, which must succeed in so little memory, and return what it printed."""
    provided = [sys.executable, "-c", RUN, *command.split()]
    output = subprocess.run(provided, cwd=folder, capture_output=True, text=True, check=False)
    assert output.returncode == 0, output.stderr
    assert int(output.stderr.split()[-1]) < MOST_KB
    return output.stdout


@pytest.mark.long
@linux
@pytest.mark.parametrize("name", ["all.csv", "all.parquet"])
def test_a_file_larger_than_memory_is_described_and_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "own").mkdir()
    write_rows(tmp_path / "own" / name)
    (tmp_path / "layout.toml").write_text(LAYOUT % "")
    assert "[streams.all]" in ran(tmp_path, "ingest table own --guess")
    assert f"{ROWS} rows" in ran(tmp_path, "ingest table own --layout layout.toml --dry-run")
    ran(tmp_path, "ingest table own --layout layout.toml -o rec")
    (shard,) = (tmp_path / "rec").rglob("arm.parquet")
    assert pq.ParquetFile(shard).metadata.num_rows == ROWS


@pytest.mark.long
@linux
def test_a_file_of_many_recordings_larger_than_memory_is_read(tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    write_rows(tmp_path / "own" / "all.csv", recordings=4)
    (tmp_path / "layout.toml").write_text(LAYOUT % 'recording = "trial"')
    ran(tmp_path, "ingest table own --layout layout.toml -o rec")
    shards = sorted((tmp_path / "rec").rglob("arm.parquet"))
    assert [pq.ParquetFile(shard).metadata.num_rows for shard in shards] == [ROWS // 4] * 4


@pytest.mark.long
@linux
def test_a_table_in_long_form_whose_channels_follow_one_another_is_read(tmp_path: Path) -> None:
    moments = 5 * BLOCK  # 8 million rows, 0.25 GB, of which a table took 1.2 GB
    (tmp_path / "own").mkdir()
    values = np.random.default_rng(0).normal(size=BLOCK).round(6)
    with (tmp_path / "own" / "all.csv").open("wb") as sink:
        schema = pa.schema([("time", pa.string()), ("sensor", pa.string()), ("reading", pa.float64())])
        with pc.CSVWriter(sink, schema, write_options=pc.WriteOptions(quoting_style="none")) as writer:
            for channel, start in np.ndindex(COLUMNS, moments // BLOCK):
                seconds = rows(start * BLOCK, values, 1).column("time")
                writer.write_table(
                    pa.table([seconds, [f"c{channel}"] * BLOCK, np.roll(values, channel)], schema=schema)
                )
    (tmp_path / "layout.toml").write_text(LONG_LAYOUT)
    ran(tmp_path, "ingest table own --layout layout.toml -o rec")
    (shard,) = (tmp_path / "rec").rglob("arm.parquet")
    result = pq.ParquetFile(shard)
    assert (result.metadata.num_rows, result.metadata.num_columns) == (moments, 1 + COLUMNS)


@pytest.mark.long
@linux
def test_arrays_larger_than_memory_are_read(tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    values = np.random.default_rng(0).normal(size=(BLOCK, COLUMNS))
    with h5py.File(tmp_path / "own" / "run.h5", "w") as file:  # 0.54 GB, of which a table took 1.2 GB
        data = file.create_dataset("skin/data", (ROWS, COLUMNS), "f8", chunks=(8192, COLUMNS))
        stamps = file.create_dataset("skin/time_ns", (ROWS,), "i8", chunks=(8192,))
        for start in range(0, ROWS, BLOCK):
            data[start : start + BLOCK] = values
            stamps[start : start + BLOCK] = np.arange(start, start + BLOCK) * 10**6
    ran(tmp_path, "ingest hdf5 own -o rec")
    (shard,) = (tmp_path / "rec").rglob("*.parquet")
    assert pq.ParquetFile(shard).metadata.num_rows == ROWS
