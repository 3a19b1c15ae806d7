"""HDF5 files as h5py reads them: values to the bit, units, labels, and robomimic's structure."""

import json
import subprocess
import sys

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import tacpipe
from tests.conftest import Lab
from tests.exports import recordings
from tests.fake_recordings import write_dataset


def test_h5py_reads_each_column_to_the_bit_with_unit_and_quantity(rig: Lab) -> None:
    rig.run("export hdf5 rec -o h5")
    tables, attributes = recordings.trial(1)
    with h5py.File("h5/trial-01.h5") as file:
        assert dict(file.attrs.items()) == attributes
        assert set(file) == set(tables)
        for stream, table in tables.items():
            assert list(file[stream]) == table.column_names
            for name in table.column_names:
                values = file[stream][name]
                expected = table[name].to_numpy(zero_copy_only=False)
                if expected.dtype == object:
                    assert values.asstr()[:].tolist() == expected.tolist()
                else:
                    assert (values.dtype, values[:].tobytes()) == (expected.dtype, expected.tobytes())
        assert dict(file["skin/taxel01_y"].attrs) == {"unit": "count", "quantity": "tactile", "taxel": "1", "axis": "y"}


def test_robomimic_finds_demonstrations_with_observations_and_actions(rig: Lab) -> None:
    rig.run("synchronize rec -o sync --rate-hz 100")
    rig.run("export hdf5 sync -o demos --structure robomimic --actions arm")
    table = tacpipe.open("sync")["trial-01"].table()
    with h5py.File("demos/demos.hdf5") as file:
        assert json.loads(file["data"].attrs["env_args"])["env_kwargs"]["control_freq"] == 100
        demo = file["data/demo_1"]
        assert demo.attrs["num_samples"] == table.num_rows == len(demo["actions"])
        assert (demo.attrs["recording"], demo.attrs["object"]) == ("trial-01", "cup")
        touch = demo["obs/skin_tactile"]
        np.testing.assert_array_equal(touch[:, 3], table["skin_taxel02_x"].to_numpy())
        assert list(touch.attrs["columns"])[3] == "skin_taxel02_x"
        position = table["arm_position_x_m"].to_numpy().astype(np.float32)
        np.testing.assert_array_equal(demo["actions"][:-1, 0], position[1:])


def test_observations_hold_neither_clocks_nor_masks_nor_ground_truth(lab: Lab) -> None:
    truth = pa.table({"t_ns": recordings.skin(1)["t_ns"], "gt_slip": np.arange(40.0)})
    write_dataset(lab.folder / "rec", {"a": ({"skin": recordings.skin(1), "truth": truth}, {})})
    lab.run("export hdf5 rec -o demos --structure robomimic --rate-hz 100")
    with h5py.File("demos/demos.hdf5") as file:
        demo = file["data/demo_0"]
        assert set(demo["obs"]) == {"skin_tactile"}
        assert {"truth", "skin_seq", "skin_gap"} <= set(demo["tacpipe"])
        assert list(demo["tacpipe/truth"].attrs["columns"]) == ["gt_slip"]


def test_masks_list_the_demonstrations_of_each_role_of_the_split(lab: Lab) -> None:
    write_dataset(lab.folder / "rec", recordings.trials(6))
    lab.run("split rec -o split --test 0.34 --val 0.25 --repeats 2")
    roles = {
        row["recording"]: row["role"] for row in pq.read_table("split/split.parquet").to_pylist() if row["fold"] == 1
    }
    lab.run("export hdf5 rec -o demos --structure robomimic --rate-hz 100 --split split --fold 1")
    with h5py.File("demos/demos.hdf5") as file:
        masks = {name: [demo.decode() for demo in file["mask"][name]] for name in file["mask"]}
        listed = {name: {file["data"][demo].attrs["recording"] for demo in demos} for name, demos in masks.items()}
    assert set(listed) == {"train", "valid", "test"}
    for mask, role in (("train", "train"), ("valid", "val"), ("test", "test")):
        assert listed[mask] == {name for name in roles if roles[name] == role}
    assert masks["train"][0].startswith("demo_")


@pytest.mark.parametrize("options", ["--split split", "--structure robomimic --rate-hz 100 --fold 1"])
def test_a_split_that_no_mask_follows_from_is_refused(rig: Lab, options: str) -> None:
    rig.run("split rec -o split --test 0.5 --val 0")
    assert rig.call(f"export hdf5 rec -o out {options}").code == 2
    assert not (rig.folder / "out").exists()


@pytest.mark.parametrize("options", ["", " --structure robomimic --rate-hz 100"])
def test_a_full_disk_for_temporary_files_is_one_sentence_and_no_crash(rig: Lab, options: str) -> None:
    code = (
        "import sys, tempfile; from tacpipe.cli import main;"
        "tempfile.TemporaryFile = lambda *_, **__: open('/dev/full', 'r+b', buffering=0);"
        f"sys.exit(main.answer('export hdf5 rec -o out --jobs 1{options}'.split()))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=rig.folder, capture_output=True, text=True)
    assert done.returncode == 1, done
    assert "temporary files" in done.stderr
    assert "TMPDIR" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (rig.folder / "out").exists()
    rig.run(f"export hdf5 rec -o out{options}")


def test_options_of_robomimic_are_refused_for_streams(rig: Lab) -> None:
    assert rig.call("export hdf5 rec -o h5 --rate-hz 50").code == 2
    assert not (rig.folder / "h5").exists()
