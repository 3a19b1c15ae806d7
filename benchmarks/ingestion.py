"""Measure reading of CSV, HDF5, Zarr and bags next to the libraries that read them, and pandas writing Parquet."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv as pc
import timing
import zarr
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tacpipe.formats.bags import container
from tacpipe.formats.table import layout, reading, rows
from tacpipe.io import parquet
from tacpipe.plugins import registry

DEMOS, ROWS, TAXELS = 20, 1000, 48
LONG_ROWS = 1_000_000
CSV_COLUMNS, CSV_ROWS = 16, 1_000_000  # 0.17 GB, 1,000 s at 1 kHz
CSV_LAYOUT = """
[streams.arm]
files = "{trial}.csv"
time = { column = "time" }
columns = [{ match = "c{channel}", quantity = "force", unit = "N" }]
"""
BAG_S, BAG_RATE_HZ, BAG_START_NS = 60, 1000, 1_700_000_000_000_000_000


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the seconds from files to tables and to Parquet, next to the libraries' own reading."""
    rounds = max(2, rounds // 5)
    return [*_csv(folder, rounds), *_arrays(folder, rounds), *_bags(folder, rounds)]


# ---- CSV


def _csv(folder: Path, rounds: int) -> list[timing.Line]:
    source, layout_path = folder / "tables", folder / "tables.toml"
    source.mkdir()
    _write_csv(source / "a.csv")
    layout_path.write_text(CSV_LAYOUT)
    times = timing.interleaved(
        {
            "pyarrow": partial(_read_with_pyarrow, source / "a.csv"),
            "batches": partial(_read_batches, source / "a.csv"),
            "ingest": partial(_ingest_csv, folder, source, layout_path),
        },
        rounds,
    )
    case = f"a CSV of {CSV_ROWS:,} rows and {CSV_COLUMNS + 1} columns"
    return [
        timing.at_most(f"{case}: read and checked", times, "batches", "pyarrow", 2.0),
        timing.at_most(f"{case}: tacpipe ingest table", times, "ingest", "pyarrow"),
    ]


def _read_with_pyarrow(path: Path) -> None:
    for _ in pc.open_csv(path):
        pass


def _read_batches(path: Path) -> None:
    (stream,) = layout.parse_layout(CSV_LAYOUT).streams
    for _ in reading.stream_batches(rows.open_rows(path, stream), stream):
        pass


def _ingest_csv(folder: Path, source: Path, layout_path: Path) -> None:
    place = folder / "ingested"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    timing.run(["tacpipe", "ingest", "table", str(source), "--layout", str(layout_path), "-o", "recordings"], place)


def _write_csv(path: Path) -> None:
    values = np.random.default_rng(0).normal(size=CSV_ROWS).round(6)
    seconds = [f"{(1_700_000_000_000 + row) / 1000:.3f}" for row in range(CSV_ROWS)]
    channels = {f"c{number}": np.roll(values, number) for number in range(CSV_COLUMNS)}
    pc.write_csv(pa.table({"time": seconds, **channels}), path)


# ---- HDF5 and Zarr


def _arrays(folder: Path, rounds: int) -> list[timing.Line]:
    demos, long, replay = folder / "hdf5", folder / "long", folder / "zarr"
    for place in (demos, long, replay):
        place.mkdir()
    _write_demos(demos / "demos.hdf5")
    _write_long(long / "long.h5")
    _write_replay(replay / "replay.zarr")
    cases = [
        (f"{DEMOS} demonstrations of {ROWS} rows in HDF5", "hdf5", demos, partial(_read_hdf5, demos / "demos.hdf5")),
        (f"{LONG_ROWS:,} rows of {TAXELS} taxels in HDF5", "hdf5", long, partial(_read_hdf5, long / "long.h5")),
        (f"{DEMOS} episodes of {ROWS} rows in Zarr", "zarr", replay, partial(_read_zarr, replay / "replay.zarr")),
    ]
    lines = []
    for case, kind, place, plain in cases:
        library = {"hdf5": "h5py", "zarr": "zarr"}[kind]
        contestants: dict[str, Callable[[], object]] = {
            library: plain,
            "tables": partial(_ingest_arrays, kind, place),
            "Parquet": partial(_ingest_arrays, kind, place, write=True),
            f"{library} and pandas": partial(plain, write=True),
        }
        times = timing.interleaved(contestants, rounds)
        lines.append(timing.at_most(f"{case}: read", times, "tables", library))
        lines.append(timing.at_most(f"{case}: read and written as Parquet", times, "Parquet", f"{library} and pandas"))
    return lines


def _ingest_arrays(kind: str, place: Path, *, write: bool = False) -> None:
    stage = registry.load(f"ingest.{kind}")
    assert stage.source is not None
    params = stage.params()
    for trial in stage.source.discover(params, place).values():
        recording = stage(params, files=trial.files, values=trial.values)  # type: ignore[union-attr]
        for table in recording.streams.values():
            if write:
                parquet.write(table, io.BytesIO())
            elif isinstance(table, pa.RecordBatchReader):  # its batches are read on demand
                for _ in table:
                    pass


def _read_hdf5(path: Path, *, write: bool = False) -> None:
    with h5py.File(path) as file:
        arrays: list[h5py.Dataset] = []
        file.visititems(lambda _, item: arrays.append(item) if isinstance(item, h5py.Dataset) else None)
        for array in arrays:
            _write_with_pandas(array[()], write=write)


def _read_zarr(path: Path, *, write: bool = False) -> None:
    group = zarr.open_group(str(path), mode="r")
    start = 0
    for stop in np.asarray(group["meta/episode_ends"]):
        for name in ("joint_pos", "tactile"):
            _write_with_pandas(np.asarray(group[f"data/{name}"][start:stop]), write=write)  # type: ignore[index]
        start = stop


def _write_with_pandas(values: np.ndarray, *, write: bool) -> None:
    if write:
        pd.DataFrame(values).rename(columns=str).to_parquet(io.BytesIO())


def _write_demos(path: Path) -> None:
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["rate_hz"] = 50
        for number in range(DEMOS):
            demo = file.create_group(f"data/demo_{number}")
            demo["obs/joint_pos"] = rng.normal(size=(ROWS, 7))
            demo["obs/tactile"] = rng.integers(0, 60_000, (ROWS, TAXELS)).astype(np.uint16)


def _write_long(path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 60_000, (LONG_ROWS, TAXELS)).astype(np.uint16)
    with h5py.File(path, "w") as file:
        file.attrs["rate_hz"] = 1000
        file.create_dataset("tactile", data=values, chunks=(10_000, TAXELS), compression="gzip", compression_opts=1)


def _write_replay(path: Path) -> None:
    rng = np.random.default_rng(0)
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    count = DEMOS * ROWS
    group.create_array("data/joint_pos", data=rng.normal(size=(count, 7)), chunks=(ROWS, 7))
    tactile = rng.integers(0, 60_000, (count, TAXELS)).astype(np.uint16)
    group.create_array("data/tactile", data=tactile, chunks=(ROWS, TAXELS))
    group.create_array("meta/episode_ends", data=np.arange(ROWS, count + 1, ROWS))
    group["meta"].attrs["rate_hz"] = 50


# ---- bags


def _bags(folder: Path, rounds: int) -> list[timing.Line]:
    lines = []
    for storage in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
        path = folder / f"bag-{storage.name.lower()}"
        _write_bag(path, storage)
        contestants: dict[str, Callable[[], object]] = {
            "columns": lambda path=path: container.open_bag(path).read(None, None),  # type: ignore[misc]
            "rosbags, raw messages": partial(_read_messages, path),
            "rosbags, deserialized": partial(_deserialize_messages, path),
        }
        times = timing.interleaved(contestants, rounds)
        case = f"a bag of {BAG_S} s, {storage.name.lower()}"
        lines += [timing.at_most(case, times, "columns", peer) for peer in contestants if peer != "columns"]
    return lines


def _read_messages(path: Path) -> None:
    with Reader(path) as reader:
        for _ in reader.messages():
            pass


def _deserialize_messages(path: Path) -> None:
    with AnyReader([path]) as reader:
        for connection, _, content in reader.messages():
            reader.deserialize(content, connection.msgtype)


def _write_bag(path: Path, storage: StoragePlugin) -> None:
    """Write 48 taxels at 100 Hz, seven joints and a wrench at 1 kHz with rosbags' writer."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    classes: dict[str, Any] = types.types
    rng = np.random.default_rng(0)
    skin_type, joint_type = "std_msgs/msg/Float32MultiArray", "sensor_msgs/msg/JointState"
    wrench_type = "geometry_msgs/msg/WrenchStamped"
    names = [f"panda_joint{joint}" for joint in range(1, 8)]
    vector = classes["geometry_msgs/msg/Vector3"]
    dimensions = classes["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    with Writer(path, version=9, storage_plugin=storage) as writer:
        skin, joints, wrench = (
            writer.add_connection(topic, kind, typestore=types)
            for topic, kind in (("/skin", skin_type), ("/joint_states", joint_type), ("/wrench", wrench_type))
        )
        for step in range(BAG_S * BAG_RATE_HZ):
            t_ns = BAG_START_NS + step * (10**9 // BAG_RATE_HZ)
            stamp = classes["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
            header = classes["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
            values = rng.normal(size=27)
            state = classes[joint_type](header, names, values[:7], values[7:14], values[14:21])
            load = classes["geometry_msgs/msg/Wrench"](vector(*values[21:24]), vector(*values[24:27]))
            writer.write(joints, t_ns + 50_000, types.serialize_cdr(state, joint_type))
            writer.write(wrench, t_ns + 60_000, types.serialize_cdr(classes[wrench_type](header, load), wrench_type))
            if step % 10 == 0:
                taxels = classes[skin_type](dimensions, rng.normal(size=TAXELS).astype(np.float32))
                writer.write(skin, t_ns + 70_000, types.serialize_cdr(taxels, skin_type))
