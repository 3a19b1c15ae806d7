"""Predictions that are read of a result are those of the fakes."""

import math
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.channels import biotac_sp
from tacpipe.tasks.touch.report import paper, predictions
from tacpipe.tasks.touch.report.methods import TouchResult, baseline_name
from tacpipe.tasks.touch.report.predictions import GraspPredictions
from tests.report import parts
from tests.tasks.touch.report.touch_fakes import KNOWN, NOVEL, PER_OBJECT, result


def test_grasps_that_the_model_has_seen_are_left_out() -> None:
    read = predictions.read_predictions(result().recordings["predictions"])
    assert len(read.recordings) == len(KNOWN) * PER_OBJECT
    assert "bleach-seen" not in read.recordings
    assert max(values.max() for values in read.true.values()) < 1e5


def test_values_are_device_counts_by_target_with_electrodes_side_by_side() -> None:
    read = predictions.read_predictions(result(off=0.1).recordings["predictions"])
    assert read.targets == biotac_sp.TARGETS
    assert read.true["e_mf"].shape == (24, 24)
    np.testing.assert_allclose(read.true["pdc_th"][:2, 0], [3040, 2860])  # 0.6 and 0.4 of 2500 to 3400
    np.testing.assert_allclose(read.predicted["model"]["pdc_th"][:2, 0], [3130, 2950])  # a tenth more


def test_known_and_novel_objects_are_told_apart() -> None:
    read = predictions.read_predictions(result(novel=NOVEL).recordings["predictions"])
    assert set(read.of(True).objects) == set(KNOWN)
    assert set(read.of(False).objects) == set(NOVEL)
    assert len(read.of(None).recordings) == len(read.recordings)


def test_what_a_model_does_not_foretell_is_no_target_though_its_truth_is_there() -> None:
    fake_result = result(targets=("pdc_th", "e_th"))
    shard = fake_result.recordings["predictions"]
    shard.tables = {**shard.tables, "true": result().recordings["predictions"].tables["true"]}
    assert predictions.read_predictions(shard).targets == ("pdc_th", "e_th")


def test_an_object_without_a_name_is_called_unnamed() -> None:
    shard = result(known=("",)).recordings["predictions"]
    grasps = shard.tables["grasps"]
    assert pa.compute.any(pa.compute.equal(grasps["object"], "")).as_py()
    assert set(predictions.read_predictions(shard).objects) == {"unnamed"}


def runs(*results: Any) -> list[GraspPredictions]:
    return [TouchResult(dataset).predictions for dataset in results]


@pytest.mark.parametrize("target", biotac_sp.TARGETS)
def test_errors_are_shares_of_the_range_and_counts_and_skill_is_over_the_constant(target: str) -> None:
    scored = predictions.score(runs(result(off=0.05)), target, True)
    assert scored is not None
    low, high = biotac_sp.RANGES[target]
    assert scored.rmse == pytest.approx(0.05, abs=1e-6)
    assert scored.counts == pytest.approx(0.05 * (high - low), abs=1e-3)
    assert scored.mae == pytest.approx(0.05, abs=1e-6)
    assert scored.skill.mean == pytest.approx(0.5, abs=1e-4)
    assert scored.r2 == pytest.approx(0.75, abs=1e-3)  # 1 - 0.05² / 0.1²
    assert (scored.grasps, scored.objects, scored.runs) == (24, 3, 1)


def test_runs_on_the_same_grasps_are_pooled_but_claim_no_more_grasps() -> None:
    scored = predictions.score(runs(result(off=0.03, seed=0), result(off=0.05, seed=1)), "pdc_th", True)
    assert scored is not None
    assert scored.rmse == pytest.approx(math.sqrt((0.03**2 + 0.05**2) / 2), abs=1e-6)
    assert scored.each.mean == pytest.approx(0.04, abs=1e-6)
    assert scored.each.sd == pytest.approx(0.02 / math.sqrt(2), abs=1e-6)
    assert (scored.grasps, scored.runs) == (24, 2)


def test_runs_of_other_folds_add_their_grasps() -> None:
    scored = predictions.score(runs(result(), result(first=50)), "pdc_th", True)
    assert scored is not None and scored.grasps == 48


def test_a_batch_mean_is_no_larger_than_the_error_over_all() -> None:
    scored = predictions.score(runs(result(off={"bleach": 0.01, "coffee": 0.05, "spam": 0.2})), "pdc_th", True)
    assert scored is not None
    assert scored.batch_mean < scored.rmse == pytest.approx(math.sqrt((0.01**2 + 0.05**2 + 0.2**2) / 3), abs=1e-6)


def test_objects_are_drawn_where_they_are_novel_and_grasps_where_they_are_known() -> None:
    offs = {"bleach": 0.02, "coffee": 0.02, "spam": 0.02, "drill": 0.01, "shoe": 0.09}
    novel = predictions.score(runs(result(off=offs, novel=NOVEL)), "pdc_th", False)
    known_score = predictions.score(runs(result(off=offs, known=(*KNOWN, *NOVEL))), "pdc_th", True)
    assert novel is not None and known_score is not None
    assert math.isnan(novel.skill.low)  # two objects show nothing of how much objects vary
    assert known_score.skill.high - known_score.skill.low < 0.5
    assert novel.objects == 2


def test_one_novel_object_gives_no_interval() -> None:
    scored = predictions.score(runs(result(novel=("drill",))), "pdc_th", False)
    assert scored is not None and math.isnan(scored.skill.low)


def test_where_nothing_is_said_there_is_no_score() -> None:
    runs_of_one_target = runs(result(targets=("pdc_th",)))
    assert predictions.score(runs_of_one_target, "e_th", True) is None
    assert predictions.score(runs_of_one_target, "pdc_th", False) is None
    assert predictions.score(runs_of_one_target, "pdc_th", True, "nearest_in_time") is None


def test_without_a_constant_there_is_no_skill() -> None:
    without_constant = result()
    del without_constant.recordings["predictions"].tables["constant"]
    scored = predictions.score(runs(without_constant), "pdc_th", True)
    assert scored is not None and math.isnan(scored.skill.mean)
    assert scored.rmse == pytest.approx(0.05, abs=1e-6)


def test_baselines_come_from_the_method_of_most_runs() -> None:
    methods = parts.methods(
        "touch",
        result(off=0.05, baselines={"object_mean": 0.07}),
        result("trees", off=0.04, baselines={"object_mean": 0.08}, seed=0),
        result("trees", off=0.04, baselines={"object_mean": 0.08}, seed=1),
    )
    rows = dict(paper.baseline_rows(methods, "pdc_th", True))
    assert list(rows) == [baseline_name(predictor) for predictor in ("constant", "object_mean", "nearest_in_time")]
    mean = rows[baseline_name("object_mean")]
    assert mean is not None and mean.runs == 2 and mean.rmse == pytest.approx(0.08, abs=1e-6)
    assert rows[baseline_name("nearest_in_time")] is None
