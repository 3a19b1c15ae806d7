"""Export each published set in each format that supports it, and read it back with other tools."""

from pathlib import Path

import duckdb
import h5py
import pyarrow.parquet as pq
import pytest
import zarr
from rosbags.highlevel import AnyReader

import tacpipe
from tests.conftest import Lab, sample_data

SETS = {  # format to the part of the published set that is exported
    "xela-flat": "xela_flat_pick_move",
    "xela-psc": "xela_slip_psc",
    "biotac-slide": "biotac_slide_20_50/mat1",
    "roboskin": "roboskin_slide_20_50",
    "vision2tactile": "vision2tactile/wood",
}
FRAMES = ("xela-flat", "xela-psc", "biotac-slide", "roboskin")  # a grasp of vision2tactile has no course in time
KEPT = 3  # recordings that are exported
pytestmark = pytest.mark.data


def ingest(lab: Lab, name: str) -> list[str]:
    """Ingest a set, leave out all recordings but a few, and return the names of these."""
    if not (sample_data() / SETS[name]).exists():
        pytest.skip("published data lie elsewhere; see data/README.md")
    lab.run(f"ingest {name} {sample_data() / SETS[name]} -o rec --skip-bad")
    items = list(tacpipe.open("rec").recordings)
    if items[KEPT:]:
        lab.run(f"label rec {' '.join(map(repr, items[KEPT:]))} --exclude 'not exported here'")
    return items[:KEPT]


@pytest.mark.parametrize("name", ["xela-psc", pytest.param("xela-flat", marks=pytest.mark.long)])
def test_a_set_comes_back_from_mcap_to_the_bit(lab: Lab, name: str) -> None:
    names = ingest(lab, name)
    lab.run("export mcap rec -o mcap")
    lab.run("ingest mcap mcap -o back")
    provided, back = tacpipe.open("rec"), tacpipe.open("back")
    assert {entry.name: entry.digests for entry in back} == {entry: provided[entry].digests for entry in names}


@pytest.mark.long
@pytest.mark.parametrize("name", SETS)
def test_every_set_is_exported_at_native_rates(lab: Lab, name: str) -> None:
    names = ingest(lab, name)
    provided = tacpipe.open("rec")
    for export in ("csv", "mcap", "hdf5", "card"):
        lab.run(f"export {export} rec -o {export}")
    for entry in (provided[name] for name in names):
        timed = [stream for stream in entry.streams if "t_ns" in entry.table(stream).column_names]
        assert timed
        with h5py.File(f"hdf5/{entry.name}.h5") as file, AnyReader([Path(f"mcap/{entry.name}.mcap")]) as reader:
            assert set(file) == set(entry.streams)
            counts = {connection.topic: connection.msgcount for connection in reader.connections}
            for stream in entry.streams:
                table = entry.table(stream)
                for column in table.column_names:
                    assert len(file[stream][column]) == table.num_rows
                if stream in timed:
                    assert counts[f"/{stream}"] == table.num_rows
                path = f"card/data/{stream}/{entry.name}.parquet"
                answer = duckdb.sql(f"select count(*) from '{path}'")
                assert answer is not None
                assert answer.fetchall() == [(table.num_rows,)]


@pytest.mark.long
@pytest.mark.parametrize("name", FRAMES)
def test_every_set_with_a_course_in_time_is_exported_as_frames(lab: Lab, name: str) -> None:
    names = ingest(lab, name)
    lab.run("export lerobot rec -o lr --rate-hz 50 --common")
    lab.run("export zarr rec -o buffer --rate-hz 50 --common")
    lab.run("export hdf5 rec -o demos --structure robomimic --rate-hz 50 --common")
    frames = pq.read_table("lr/data")
    ends = zarr.open_array("buffer/replay.zarr", path="meta/episode_ends", mode="r")[:]
    assert len(frames) == ends[-1]  # type: ignore[index]
    assert set(frames["episode_index"].to_pylist()) == set(range(len(names)))
    assert any(entry.startswith("observation.tactile.") for entry in frames.column_names)
    with h5py.File("demos/demos.hdf5") as file:
        assert sum(file["data"][entry].attrs["num_samples"] for entry in file["data"]) == len(frames)
