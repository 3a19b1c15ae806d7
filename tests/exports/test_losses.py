"""Each column of a recording is in its export, or the command and the README name it as not carried."""

import csv
import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import pyarrow.parquet as pq
import pytest
from rosbags.highlevel import AnyReader

from tests.conftest import Lab
from tests.exports import recordings
from tests.fake_recordings import write_dataset

Names = set[tuple[str, str]]  # stream and column


def of_csv(folder: Path) -> Names:
    """Return the columns that the layout reads back."""
    layout = tomllib.loads((folder / "layout.toml").read_text())
    read = set()
    for stream, described in layout["streams"].items():
        skipped = {column["match"] for column in described["columns"] if column.get("skip")}
        with (folder / "a" / f"{stream}.csv").open() as file:
            read |= {(stream, column) for column in next(csv.reader(file)) if column not in skipped}
    return read


def of_mcap(folder: Path) -> Names:
    """Return the fields of each stream's message, and those of its cloud of points."""
    read = set()
    with AnyReader([folder / "a.mcap"]) as reader:
        for connection, _, raw in reader.messages():
            stream = connection.topic[1:]
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.msgtype.endswith("PointCloud2"):
                read |= {(stream, f"{field.name}_m") for field in message.fields}
            elif "/" not in stream:
                read |= {(stream, name.replace("force_x_n", "Force X [N]")) for name in vars(message)}
                read |= {(stream, "t_ns")}
    return read


def of_hdf5(folder: Path) -> Names:
    """Return the datasets of each group."""
    with h5py.File(folder / "a.h5") as file:
        return {(stream, column) for stream in file for column in file[stream]}


def of_card(folder: Path) -> Names:
    """Return the columns of the Parquet files that croissant.json describes."""
    metadata = json.loads((folder / "croissant.json").read_bytes())
    fields = [field["source"]["extract"]["column"] for records in metadata["recordSet"] for field in records["field"]]
    names = {
        (path.parent.name, name) for path in folder.glob("data/*/*.parquet") for name in pq.read_schema(path).names
    }
    return {(stream, name) for stream, name in names if name in fields}


def of_frames(*columns: str) -> Names:
    """Return stream and column of the columns of a synchronized table, and the times of the streams."""
    streams = list(recordings.varied())
    parts = [
        (stream, name.removeprefix(f"{stream}_")) for name in columns for stream in streams if name.startswith(stream)
    ]
    return {*parts, *((stream, "t_ns") for stream in streams)}


def of_lerobot(folder: Path) -> Names:
    """Return the columns of the features."""
    features = json.loads((folder / "meta/tacpipe.json").read_bytes())["features"]
    stored = pq.read_schema(folder / "data/chunk-000/file-000.parquet").names
    return of_frames(*(column for name in stored if name in features for column in features[name]["columns"]))


def of_zarr(folder: Path) -> Names:
    """Return the columns of the arrays."""
    content = [json.loads(path.read_bytes())["columns"] for path in folder.glob("replay.zarr/data/*/.zattrs")]
    return of_frames(*(column for columns in content for column in columns))


def of_robomimic(folder: Path) -> Names:
    """Return the columns of the datasets of the demonstration."""
    columns: list[str] = []
    with h5py.File(folder / "demos.hdf5") as file:
        file["data/demo_0"].visititems(lambda _, item: columns.extend(item.attrs.get("columns", [])))
    return of_frames(*columns)


FORMATS = {
    "csv": of_csv,
    "mcap": of_mcap,
    "hdf5": of_hdf5,
    "card": of_card,
    "lerobot --rate-hz 50": of_lerobot,
    "lerobot --rate-hz 50 --no-originals": of_lerobot,
    "zarr --rate-hz 50": of_zarr,
    "hdf5 --structure robomimic --rate-hz 50": of_robomimic,
}


def named(text: str, streams: dict[str, list[str]]) -> Names:
    """Return the columns that lines of a README or of a command name as not carried."""
    names = set()
    for stream in re.findall(r"(?:carried: |- )stream (\w+): (?!digits)", text):
        names |= {(stream, column) for column in streams[stream]}
    for columns, stream in re.findall(r"(?:carried: |- )columns? (.+) of stream (\w+): ", text):
        names |= {(stream, column) for column in columns.split(", ")}
    return names


@pytest.mark.parametrize(("export", "read"), FORMATS.items(), ids=FORMATS)
def test_a_column_that_an_export_does_not_hold_is_named(lab: Lab, export: str, read: Callable[[Path], Names]) -> None:
    tables = recordings.varied(timeless="--rate-hz" not in export)
    write_dataset(lab.folder / "rec", {"a": (tables, {})})
    err = lab.run(f"export {export} rec -o out").err
    streams = {stream: table.column_names for stream, table in tables.items()}
    missing = {(stream, column) for stream, columns in streams.items() for column in columns} - read(lab.folder / "out")
    assert missing
    assert missing <= named(err, streams)
    assert missing <= named((lab.folder / "out/README.md").read_text(), streams)


def test_streams_that_synchronize_left_out_are_named(lab: Lab) -> None:
    write_dataset(lab.folder / "rec", {"a": (recordings.varied(timeless=False), {})})
    lab.run("synchronize rec -o sync")
    for export in ("zarr", "lerobot", "hdf5 --structure robomimic"):
        err = lab.run(f"export {export} sync -o {export.split()[0]}").err
        assert "not carried: stream cam: it has no value in each frame" in err
        assert "not carried: stream remarks: it has no value in each frame" in err


def test_all_columns_that_not_all_recordings_have_are_named(lab: Lab) -> None:
    tables, attributes = recordings.trial(0)
    few = {"skin": tables["skin"].drop_columns(["taxel01_x", "taxel01_y", "taxel02_x", "taxel02_y"])}
    write_dataset(lab.folder / "rec", {"a": (few, attributes), "b": ({"skin": tables["skin"]}, attributes)})
    err = lab.run("export zarr rec -o out --rate-hz 100 --common").err
    line = next(line for line in err.splitlines() if "not all recordings" in line)
    assert line.endswith("skin_taxel01_x, skin_taxel01_y, skin_taxel02_x, skin_taxel02_y")
