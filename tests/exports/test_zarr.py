"""Zarr replay buffers as zarr reads them."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import zarr

import tacpipe
from tests.conftest import Lab
from tests.exports import recordings
from tests.fake_recordings import write_dataset


def opened() -> Any:
    """Return the store that was written."""
    return zarr.open("buffer/replay.zarr", mode="r", zarr_format=2)


def test_zarr_reads_the_frames_of_all_recordings_and_where_each_ends(rig: Lab) -> None:
    rig.run("export zarr rec -o buffer --rate-hz 100 --actions arm")
    rig.run("synchronize rec -o sync --rate-hz 100")
    tables = [entry.table() for entry in tacpipe.open("sync")]
    store = opened()
    assert store["meta/episode_ends"][:].tolist() == np.cumsum([table.num_rows for table in tables]).tolist()
    touch = np.concatenate([table["skin_taxel01_z"].to_numpy() for table in tables])
    np.testing.assert_array_equal(store["data/skin_tactile"][:, 2], touch)
    assert store["data/skin_tactile"].attrs["columns"][2] == "skin_taxel01_z"
    np.testing.assert_array_equal(store["data/t_ns"][:], np.concatenate([table["t_ns"].to_numpy() for table in tables]))
    assert store["data/actions"].shape == (sum(table.num_rows for table in tables), 13)
    assert store["meta"].attrs["labels"]["trial-01"]["object"] == "cup"
    assert store["meta"].attrs["rate_hz"] == 100


@pytest.mark.filterwarnings("error")
def test_the_store_holds_nothing_that_zarr_does_not_know(rig: Lab) -> None:
    rig.run("export zarr rec -o buffer --rate-hz 100")
    assert list(opened().groups())


def test_recordings_of_other_channels_are_refused_by_name(lab: Lab) -> None:
    both = {"skin": recordings.skin(1), "arm": recordings.arm(1)}
    provided: dict[str, Any] = {"a": ({"skin": recordings.skin(1)}, {}), "b": (both, {})}
    write_dataset(lab.folder / "rec", provided)
    ran = lab.call("export zarr rec -o buffer --rate-hz 100")
    assert ran.code == 2
    assert "b" in ran.err.split()
    ran = lab.run("export zarr rec -o buffer --rate-hz 100 --common")
    assert "arm_position_x_m" not in opened()["data/skin_tactile"].attrs["columns"]
    assert any("not carried" in line and "columns" in line for line in ran.err.splitlines())


def test_integers_of_which_one_recording_misses_some_are_floats_in_all(lab: Lab) -> None:
    whole, gaps = recordings.skin(1), recordings.skin(2)
    counts = pa.field("n", pa.int32(), metadata={"unit": "1", "quantity": "state"})
    provided: dict[str, Any] = {
        "a": ({"skin": whole.append_column(counts, pa.array(range(40), pa.int32()))}, {}),
        "b": ({"skin": gaps.append_column(counts, pa.array([None] * 20 + list(range(20)), pa.int32()))}, {}),
    }
    write_dataset(lab.folder / "rec", provided)
    lab.run("synchronize rec -o sync --rate-hz 100 --values hold")
    lab.run("export zarr sync -o buffer")
    tables = [recording.table() for recording in tacpipe.open("sync")]
    assert any(table["skin_n"].null_count for table in tables)
    expected = np.concatenate([table["skin_n"].to_numpy().astype(float) for table in tables])
    np.testing.assert_array_equal(opened()["data/skin_state"][:], expected)
