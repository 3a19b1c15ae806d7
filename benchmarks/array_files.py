"""HDF5 and Zarr files as recordings, beside h5py and zarr reading the same arrays, and pandas writing them as Parquet."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import timing
import zarr

from tacpipe.io import parquet
from tacpipe.plugins import registry

DEMOS, ROWS, TAXELS = 20, 1000, 48
LONG = 1_000_000  # rows of one recording


def measure(folder: Path, rounds: int) -> list[timing.Line]:
    """Return the seconds from files to tables and to Parquet, beside the libraries' own reading."""
    hdf5, long, store = folder / "hdf5", folder / "long", folder / "zarr"
    for place in (hdf5, long, store):
        place.mkdir()
    _demos(hdf5 / "demos.hdf5")
    _long(long / "long.h5")
    _replay(store / "replay.zarr")
    cases = [
        (f"{DEMOS} demonstrations of {ROWS} rows in HDF5", "hdf5", hdf5, "h5py", partial(_h5py, hdf5 / "demos.hdf5")),
        (f"{LONG:,} rows of {TAXELS} taxels in HDF5", "hdf5", long, "h5py", partial(_h5py, long / "long.h5")),
        (f"{DEMOS} episodes of {ROWS} rows in Zarr", "zarr", store, "zarr", partial(_zarr, store / "replay.zarr")),
    ]
    lines = []
    for what, kind, place, library, plain in cases:
        ours = partial(_ours, kind, place)
        both: dict[str, Callable[[], object]] = {library: plain, "tables": ours}
        both |= {"Parquet": partial(ours, write=True), f"{library} and pandas": partial(plain, write=True)}
        times = timing.interleaved(both, max(2, rounds // 5))
        lines.append(timing.at_most(f"{what}: read", times, "tables", library))
        lines.append(timing.at_most(f"{what}: read and written as Parquet", times, "Parquet", f"{library} and pandas"))
    return lines


def _ours(kind: str, place: Path, *, write: bool = False) -> None:
    stage = registry.load(f"ingest.{kind}")
    assert stage.discover is not None
    params = stage.params()
    for one in stage.discover(params, place).values():
        made = stage(params, files=one.files, values=one.values)  # type: ignore[union-attr]
        for table in made.streams.values():
            if write:
                parquet.write(table, io.BytesIO())
            elif isinstance(table, pa.RecordBatchReader):  # batches are read when they are asked for
                for _ in table:
                    pass


def _h5py(path: Path, *, write: bool = False) -> None:
    with h5py.File(path) as file:
        arrays: list[h5py.Dataset] = []
        file.visititems(lambda _, one: arrays.append(one) if isinstance(one, h5py.Dataset) else None)
        for array in arrays:
            _written(array[()], write=write)


def _zarr(path: Path, *, write: bool = False) -> None:
    group = zarr.open_group(str(path), mode="r")
    start = 0
    for stop in np.asarray(group["meta/episode_ends"]):
        for name in ("joint_pos", "tactile"):
            _written(np.asarray(group[f"data/{name}"][start:stop]), write=write)  # type: ignore[index]
        start = stop


def _written(values: np.ndarray, *, write: bool) -> None:
    if write:
        pd.DataFrame(values).rename(columns=str).to_parquet(io.BytesIO())


def _demos(path: Path) -> None:
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["rate_hz"] = 50
        for number in range(DEMOS):
            demo = file.create_group(f"data/demo_{number}")
            demo["obs/joint_pos"] = rng.normal(size=(ROWS, 7))
            demo["obs/tactile"] = rng.integers(0, 60_000, (ROWS, TAXELS)).astype(np.uint16)


def _long(path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 60_000, (LONG, TAXELS)).astype(np.uint16)
    with h5py.File(path, "w") as file:
        file.attrs["rate_hz"] = 1000
        file.create_dataset("tactile", data=values, chunks=(10_000, TAXELS), compression="gzip", compression_opts=1)


def _replay(path: Path) -> None:
    rng = np.random.default_rng(0)
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    rows = DEMOS * ROWS
    group.create_array("data/joint_pos", data=rng.normal(size=(rows, 7)), chunks=(ROWS, 7))
    tactile = rng.integers(0, 60_000, (rows, TAXELS)).astype(np.uint16)
    group.create_array("data/tactile", data=tactile, chunks=(ROWS, TAXELS))
    group.create_array("meta/episode_ends", data=np.arange(ROWS, rows + 1, ROWS))
    group["meta"].attrs["rate_hz"] = 50
