"""Measures of a model against scikit-learn's on the predictions that are written, and who counts as seen and known."""

import csv
import dataclasses
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from sklearn.metrics import mean_absolute_error, r2_score, root_mean_squared_error

from tacpipe.channels import biotac_sp
from tacpipe.errors import TacpipeError
from tacpipe.plugins.stage import Result
from tacpipe.scores import regression
from tacpipe.tasks.touch import evaluation as touch_evaluation
from tests.tasks.touch.handmade import dataset, evaluated, recording, recordings, trained

PREDICTORS = ("model", "constant", "object_mean", "nearest_in_time")
FAST = {"architecture": "trees", "inputs": "xyz"}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return trained(tmp_path_factory.mktemp("model"), **FAST)


@pytest.fixture(scope="module")
def asked() -> Any:
    """Two seen grasps, six unseen of a known object, four of two novel ones, one of no named object."""
    shards: list[Any] = [recording(n) for n in (0, 1)] + [recording(n, "melon") for n in range(20, 26)]
    shards += [recording(n, kind) for kind in ("egg", "shoe") for n in (30, 31)]
    return dataset(*shards, recording(40, object=None))


@pytest.fixture(scope="module")
def result(model: dict[str, bytes], asked: Any) -> Result:
    return evaluated(model, asked)[1]


@pytest.fixture(scope="module")
def metrics(result: Result) -> dict[str, Any]:
    tree: dict[str, Any] = json.loads(result.files["metrics.json"])
    return tree


def columns(target: str) -> list[str]:
    return [target] if target.startswith("pdc") else [f"{target}_{n:02d}" for n in range(1, 25)]


def rows(table: pa.Table, target: str) -> np.ndarray:
    """Return the values of a stream for a target (grasp, value), counts."""
    return np.column_stack([table.column(name).to_numpy() for name in columns(target)]).astype(float)


def masks(result: Result) -> dict[str, np.ndarray]:
    about = result.recordings["predictions"].streams["grasps"].to_pydict()
    in_training, is_known = np.array(about["seen"]), np.array(about["known"])
    return {"": ~in_training, "seen": in_training, "known": is_known & ~in_training, "novel": ~is_known & ~in_training}


@pytest.mark.parametrize("part", ["", "seen", "known", "novel"])
@pytest.mark.parametrize("target", biotac_sp.TARGETS)
def test_measures_are_scikit_learns_on_the_predictions_written(
    part: str, target: str, result: Result, metrics: dict[str, Any]
) -> None:
    streams, mask = result.recordings["predictions"].streams, masks(result)[part]
    tree = metrics[part] if part else metrics
    true = rows(streams["true"], target)[mask]
    low, high = biotac_sp.RANGES[target]
    for name in PREDICTORS:
        predicted = rows(streams[name], target)[mask]
        measured = tree[name]
        rmse = root_mean_squared_error(true.ravel(), predicted.ravel())
        assert measured["n"] == mask.sum()
        assert measured["rmse_counts"][target] == pytest.approx(rmse, rel=1e-5)
        assert measured["rmse"][target] == pytest.approx(rmse / (high - low), rel=1e-5)
        mae = mean_absolute_error(true.ravel(), predicted.ravel()) / (high - low)
        assert measured["mae"][target] == pytest.approx(mae, rel=1e-4)
        r2 = r2_score(true, predicted, multioutput="variance_weighted")
        assert measured["r2"][target] == pytest.approx(r2, rel=1e-3, abs=1e-4)
        constant = root_mean_squared_error(true.ravel(), rows(streams["constant"], target)[mask].ravel())
        assert measured["skill"][target] == pytest.approx(1 - rmse / constant, abs=1e-5)
        if mask.sum() <= 10:  # one batch
            assert measured["rmse_batch_mean"][target] == pytest.approx(measured["rmse"][target])


def test_the_letters_figure_is_no_larger_than_the_error_over_all(model: dict[str, bytes]) -> None:
    tree, result = evaluated(model, recordings(10, 20))  # four batches of ten
    true, predicted = (result.recordings["predictions"].streams[name] for name in ("true", "model"))
    for target in biotac_sp.TARGETS:
        mine, batch = (tree["model"][name][target] for name in ("rmse", "rmse_batch_mean"))
        assert 0 < batch <= mine
        shares = [biotac_sp.normalise(target, rows(table, target)) for table in (true, predicted)]
        by_hand = [
            root_mean_squared_error(shares[0][at : at + 10].ravel(), shares[1][at : at + 10].ravel())
            for at in range(0, 40, 10)
        ]
        assert batch == pytest.approx(np.mean(by_hand), rel=1e-5)


@pytest.mark.parametrize("target", ["e_th", "e_mf"])
def test_each_electrode_is_told_alone(target: str, result: Result, metrics: dict[str, Any]) -> None:
    streams, mask = result.recordings["predictions"].streams, masks(result)[""]
    shares = [biotac_sp.normalise(target, rows(streams[name], target)[mask]) for name in ("true", "model")]
    by_electrode = metrics["model"]["by_electrode"][target]
    assert list(by_electrode) == [f"{n:02d}" for n in range(1, 25)]
    for index, measured in enumerate(by_electrode.values()):
        true, model = (values[:, index] for values in shares)
        assert measured["rmse"] == pytest.approx(root_mean_squared_error(true, model), rel=1e-4)
        assert measured["r2"] == pytest.approx(r2_score(true, model), rel=1e-3, abs=1e-3)
    assert "by_electrode" not in metrics["constant"]


def test_seen_known_and_novel_grasps_are_told_apart(result: Result, metrics: dict[str, Any]) -> None:
    about = result.recordings["predictions"].streams["grasps"].to_pydict()
    assert about["recording"] == sorted(about["recording"])
    assert [name for name, in_training in zip(about["recording"], about["seen"], strict=True) if in_training] == [
        "ball-000",
        "ball-001",
    ]
    known_objects = {name for name, is_known in zip(about["object"], about["known"], strict=True) if is_known}
    assert known_objects == {"ball", "melon"}
    assert about["object"][about["recording"].index("ball-040")] == ""
    assert metrics["counts"] == {"grasps": 11, "objects": 4}
    counts = {part: metrics[part]["counts"]["grasps"] for part in ("known", "novel", "seen")}
    assert counts == {"known": 6, "novel": 5, "seen": 2}


def test_each_object_has_measures_of_its_own_also_as_rows(result: Result, metrics: dict[str, Any]) -> None:
    tree = metrics["model"]["by_object"]
    assert {name: measured["n"] for name, measured in tree.items()} == {"unnamed": 1, "egg": 2, "shoe": 2, "melon": 6}
    streams = result.recordings["predictions"].streams
    mask = np.array([name == "egg" for name in streams["grasps"].to_pydict()["object"]])
    rmse = root_mean_squared_error(*(rows(streams[name], "pdc_mf")[mask] for name in ("true", "model")))
    assert tree["egg"]["rmse_counts"]["pdc_mf"] == pytest.approx(rmse, rel=1e-5)
    lines = list(csv.DictReader(io.StringIO(result.files["by_object.csv"].decode())))
    assert len(lines) == 4 * 4 * 4  # objects, predictors, targets
    line = next(row for row in lines if (row["object"], row["predictor"], row["target"]) == ("egg", "model", "pdc_mf"))
    assert int(line["n"]) == 2
    assert float(line["rmse_counts"]) == pytest.approx(rmse, rel=1e-4)
    single = next(row for row in lines if row["object"] == "unnamed")
    assert single["r2"] == ""  # a single grasp does not vary


def test_novel_objects_are_resampled_whole_and_known_ones_by_grasp(result: Result, metrics: dict[str, Any]) -> None:
    streams = result.recordings["predictions"].streams
    about = streams["grasps"].to_pydict()
    for part, by in (("novel", "object"), ("known", "recording")):
        mask = masks(result)[part]
        true, predicted, constant = (
            biotac_sp.normalise("pdc_th", rows(streams[name], "pdc_th")[mask]) for name in ("true", "model", "constant")
        )
        model, baseline = (regression.squared_sums(true, share) for share in (predicted, constant))
        expected = regression.skill_interval(model, baseline, np.array(about[by])[mask])
        reported = [metrics[part]["model"][name]["pdc_th"] or math.nan for name in ("skill", "skill_low", "skill_high")]
        assert reported == pytest.approx(list(expected), abs=1e-4, nan_ok=True)


def test_the_metrics_are_json_without_values_that_are_not_numbers(model: dict[str, bytes]) -> None:
    files = evaluated(model, dataset(recording(50, "shoe")))[1].files  # one grasp: no spread, no interval

    def refuse(name: str) -> float:
        raise AssertionError(name)

    tree = json.loads(files["metrics.json"], parse_constant=refuse)
    assert tree["model"]["r2"]["pdc_th"] is None
    assert tree["model"]["skill_low"]["e_th"] is None
    assert tree["model"]["rmse"]["e_th"] > 0


def test_the_streams_have_the_columns_and_types_that_are_promised(result: Result, asked: Any) -> None:
    output = result.recordings["predictions"]
    assert set(output.streams) == {"grasps", "true", *PREDICTORS}
    names = [name for target in biotac_sp.TARGETS for name in columns(target)]
    for stream in ("true", *PREDICTORS):
        assert output.streams[stream].column_names == names
        assert {str(field.type) for field in output.streams[stream].schema} == {"float"}  # 32 bits
        assert output.streams[stream].num_rows == len(asked.recordings)
    about = output.streams["grasps"]
    assert [(field.name, str(field.type)) for field in about.schema] == [
        *(("recording", "string"), ("object", "string"), ("session", "string")),
        *(("t_ns", "int64"), ("seen", "bool"), ("known", "bool")),
    ]
    felt = asked.recordings["egg-030"].tables["reading"].column("th_pdc")[0].as_py()
    assert rows(output.streams["true"], "pdc_th")[about.to_pydict()["recording"].index("egg-030")] == felt
    assert dict(output.attributes) == {}


def test_grasps_all_seen_leave_nothing_to_judge_but_what_was_seen(model: dict[str, bytes]) -> None:
    tree, result = evaluated(model, recordings())
    assert tree["counts"] == {"grasps": 0}
    assert "model" not in tree
    assert tree["seen"]["model"]["n"] == 12
    assert result.files["by_object.csv"].decode().count("\n") == 1


def test_a_grasp_counts_as_seen_by_its_content_or_its_reading_and_not_by_its_name(model: dict[str, bytes]) -> None:
    copy = dataclasses.replace(recording(0), name="ball-000")
    changed = recording(0, session="other")
    tree, _ = evaluated(model, dataset(copy))
    assert tree["seen"]["counts"]["grasps"] == 1
    assert evaluated(model, dataset(changed))[0]["seen"]["counts"]["grasps"] == 1  # a reading that was logged twice


def test_results_on_simulated_grasps_say_so(model: dict[str, bytes]) -> None:
    _, result = evaluated(model, dataset(recording(60, simulated=True)))
    assert dict(result.recordings["predictions"].attributes) == {"simulated": True}


def test_the_model_and_its_history_come_along(tmp_path: Path) -> None:
    files = trained(tmp_path, architecture="patches", inputs="xyz")
    result = evaluated(files, recordings(6, 1))[1]
    assert set(result.files) == {"metrics.json", "by_object.csv", "headline.json", "config.json", "history.jsonl"}
    assert all(result.files[name] == files[name] for name in ("config.json", "history.jsonl"))


def test_what_cannot_be_judged_is_refused(model: dict[str, bytes], tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match="no grasp"):
        touch_evaluation.evaluate(model, dataset())
    with pytest.raises(TacpipeError, match="ball-000 has no tactile reading"):
        touch_evaluation.evaluate(model, dataset(recording(0, felt=False)))
    bare = trained(tmp_path, **FAST, baselines=False)
    with pytest.raises(TacpipeError, match="--baselines"):
        touch_evaluation.evaluate(bare, recordings(6, 1))
