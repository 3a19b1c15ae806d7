"""HDF5 files as h5py reads them: values to the bit, units, labels, and robomimic's structure."""

from __future__ import annotations

import json

import h5py
import numpy as np

import tacpipe
from tests.conftest import Lab
from tests.exports import recordings


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
                wanted = table[name].to_numpy(zero_copy_only=False)
                if wanted.dtype == object:
                    assert values.asstr()[:].tolist() == wanted.tolist()
                else:
                    assert (values.dtype, values[:].tobytes()) == (wanted.dtype, wanted.tobytes())
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


def test_options_of_robomimic_are_refused_for_streams(rig: Lab) -> None:
    assert rig.call("export hdf5 rec -o h5 --rate-hz 50").code == 2
    assert not (rig.folder / "h5").exists()
