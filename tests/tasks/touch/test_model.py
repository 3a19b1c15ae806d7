"""Quantiles of predicted readings: calibrated on validation grasps, predicted, and evaluated next to the constant's."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.tasks.task import CalibrationRequest
from tacpipe.tasks.touch import grasps as grasps_of
from tacpipe.tasks.touch import model as touch_model
from tacpipe.tasks.touch import model as touch_prediction
from tacpipe.tasks.touch.model import TouchModel
from tests.tasks.touch.handmade import cloud, dataset, evaluated, recording, recordings, trained

PERCENTS = (10, 50, 90)
FAST = {"architecture": "trees", "inputs": "xyz"}
ASKED = CalibrationRequest(PERCENTS, False, 0.05, 0)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return trained(tmp_path_factory.mktemp("model"), **FAST)


@pytest.fixture(scope="module")
def watched() -> Any:
    return recordings(50, 8)


@pytest.fixture(scope="module")
def model(plain: dict[str, bytes], watched: Any) -> dict[str, bytes]:
    return touch_model.calibrate(plain, ASKED, recordings(), watched)


def test_a_calibrated_model_predicts_the_same_and_adds_its_quantiles(
    plain: dict[str, bytes], model: dict[str, bytes]
) -> None:
    requested = recordings(80, 2)
    before, after = (
        touch_prediction.predict(files, requested).recordings["predictions"].streams[""] for files in (plain, model)
    )
    assert before.equals(after)
    with_quantiles = touch_prediction.predict(model, requested, (), [10, 90]).recordings["predictions"].streams[""]
    assert with_quantiles.select(before.column_names).equals(before)
    assert with_quantiles.column_names[1:4] == ["pdc_th", "pdc_th_q10", "pdc_th_q90"]
    assert (with_quantiles["e_mf_07_q10"].to_numpy() < with_quantiles["e_mf_07_q90"].to_numpy()).all()
    assert TouchModel.load(model).quantiles.percents == PERCENTS  # type: ignore[union-attr]


def test_as_many_values_of_calibration_grasps_lie_below_a_quantile_as_its_level_states(
    model: dict[str, bytes], watched: Any
) -> None:
    loaded = TouchModel.load(model)
    assert loaded.quantiles is not None
    grasps = grasps_of.read(watched)
    for target, bands in loaded.quantiles.quantiles(loaded.predict_grasps(grasps)).items():
        below = (grasps.readings[target][..., None] <= bands + 1e-9).mean(axis=(0, 1))
        assert (below >= np.array(PERCENTS) / 100 - 1e-9).all()
        assert (below <= np.array(PERCENTS) / 100 + 1.5 / len(grasps)).all()


def test_evaluation_reports_quantiles_of_known_and_novel_objects(model: dict[str, bytes]) -> None:
    shards = [
        *recordings(80, 3).recordings.values(),
        *(recording(n, kind) for kind in ("egg", "shoe") for n in (30, 31)),
    ]
    tree, result = evaluated(model, dataset(*shards))
    reported = tree["quantiles"]
    rows = pq.read_table(io.BytesIO(result.files["coverage.parquet"])).to_pandas()
    assert len(rows) == 3 * 50 * (reported["known"]["n"] + reported["novel"]["n"])  # a predictor, value and grasp
    for (is_known, predictor, target), group in rows.groupby(["known", "predictor", "target"]):
        measured = reported["known" if is_known else "novel"][predictor]
        for name, column in (("coverage", "covered"), ("width", "width"), ("pinball", "pinball")):
            assert group[column].mean() == pytest.approx(measured[name][target], rel=1e-5)
    assert reported["levels"] == [10, 50, 90] and set(reported["known"]) >= {"model", "constant", "object_mean"}
    for part in ("known", "novel"):
        for predictor in ("model", "constant", "object_mean"):
            by_measure = reported[part][predictor]
            assert set(by_measure["coverage"]) == {"pdc_th", "pdc_mf", "e_th", "e_mf"}
            assert all(0 <= value <= 1 for value in by_measure["coverage"].values())
        assert list(reported[part]["constant"]["pinball_skill"].values()) == pytest.approx([0] * 4)
    assert reported["novel"]["n"] == 4


def test_a_model_without_quantiles_is_evaluated_as_before_and_has_none_to_give(plain: dict[str, bytes]) -> None:
    tree, result = evaluated(plain, recordings(80, 2))
    assert "quantiles" not in tree and "coverage.parquet" not in result.files
    with pytest.raises(TacpipeError, match="tacpipe calibrate"):
        touch_prediction.predict(plain, recordings(80, 1), (), [10])


def test_grasps_that_the_model_learned_from_are_refused(tmp_path: Path, watched: Any) -> None:
    files = trained(tmp_path, recordings(), watched, **FAST)
    with pytest.raises(TacpipeError, match="--no-use-validation"):
        touch_model.calibrate(files, ASKED, recordings(), watched)


def test_too_few_grasps_cannot_promise_the_band(plain: dict[str, bytes]) -> None:
    request = CalibrationRequest(PERCENTS, True, 0.05, 0)
    with pytest.raises(TacpipeError, match="3 calibration grasps can guarantee a band with a coverage of 75 %"):
        touch_model.calibrate(plain, request, recordings(), dataset(*(recording(n) for n in (60, 61, 62))))


FEW_TREES = {"architecture": "trees", "targets": "pdc_th,e_mf"}


def test_grasps_without_reading_are_told_what_evaluate_tells(tmp_path: Path) -> None:
    files = trained(tmp_path, **FEW_TREES)
    table = touch_prediction.predict(files, recordings(6, 2, felt=False)).recordings["predictions"].streams[""]
    assert table.column_names == ["recording", "pdc_th", *(f"e_mf_{n:02d}" for n in range(1, 25))]
    assert table.column("recording").to_pylist() == ["ball-006", "ball-007", "melon-006", "melon-007"]
    evaluated_table = evaluated(files, recordings(6, 2))[1].recordings["predictions"].streams["model"]
    assert table.drop_columns(["recording"]).equals(evaluated_table)


def test_what_is_not_what_the_model_reads_is_refused(tmp_path: Path) -> None:
    files = trained(tmp_path, **FEW_TREES)
    with pytest.raises(TacpipeError, match="no grasp to predict"):
        touch_prediction.predict(files, dataset())
    with pytest.raises(TacpipeError, match="melon-003 has a cloud without colours"):
        touch_prediction.predict(files, dataset(recording(3, "melon", cloud=cloud(3, 0.05, coloured=False))))
