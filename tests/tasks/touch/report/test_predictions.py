"""Predictions that are read of a result are those of the fakes."""

import numpy as np
import pyarrow as pa

from tacpipe.channels import biotac_sp
from tacpipe.tasks.touch.predictions import read_predictions
from tests.tasks.touch.report.touch_fakes import KNOWN, PER_OBJECT, result


def test_grasps_that_the_model_has_seen_are_left_out() -> None:
    read = read_predictions(result().recordings["predictions"])
    assert len(read.recordings) == len(KNOWN) * PER_OBJECT
    assert "bleach-seen" not in read.recordings
    assert max(values.max() for values in read.true.values()) < 1e5


def test_values_are_device_counts_by_target_with_electrodes_side_by_side() -> None:
    read = read_predictions(result(off=0.1).recordings["predictions"])
    assert read.targets == biotac_sp.TARGETS
    assert read.true["e_mf"].shape == (24, 24)
    np.testing.assert_allclose(read.true["pdc_th"][:2, 0], [3040, 2860])  # 0.6 and 0.4 of 2500 to 3400
    np.testing.assert_allclose(read.predicted["model"]["pdc_th"][:2, 0], [3130, 2950])  # a tenth more


def test_what_a_model_does_not_foretell_is_no_target_though_its_truth_is_there() -> None:
    fake_result = result(targets=("pdc_th", "e_th"))
    shard = fake_result.recordings["predictions"]
    shard.tables = {**shard.tables, "true": result().recordings["predictions"].tables["true"]}
    assert read_predictions(shard).targets == ("pdc_th", "e_th")


def test_an_object_without_a_name_is_called_unnamed() -> None:
    shard = result(known=("",)).recordings["predictions"]
    grasps = shard.tables["grasps"]
    assert pa.compute.any(pa.compute.equal(grasps["object"], "")).as_py()
    assert set(read_predictions(shard).objects) == {"unnamed"}
