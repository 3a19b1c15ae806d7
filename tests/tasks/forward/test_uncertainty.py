"""Quantiles of a forecaster: calibrated on recordings, predicted in tables and arrays, evaluated next to persistence's."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.tasks.forward import calibration as forward_calibration
from tacpipe.tasks.forward import evaluation as forward_evaluation
from tacpipe.tasks.forward import prediction
from tacpipe.tasks.forward import prediction as forward_prediction
from tacpipe.tasks.forward.prediction import ForwardModel
from tacpipe.tasks.task import CalibrationRequest
from tests.fake_recordings import dataset
from tests.stages.learning_fakes import CHANNELS, motion
from tests.tasks.forward.trials import ENSEMBLE, HORIZON, asked, compressed, evaluated, predicted_windows, trained

TEST = motion(20)
PERCENTS = (10, 50, 90)
TRAINING, CALIBRATION = [motion(seed) for seed in range(3)], [motion(seed) for seed in range(11, 15)]


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return trained(tmp_path_factory.mktemp("model"))


def calibrated(files: dict[str, bytes], *, promise: bool = False, count: int = 4) -> dict[str, bytes]:
    request = CalibrationRequest(PERCENTS, promise, 0.05, 0)
    return forward_calibration.calibrate(files, request, dataset(*TRAINING), dataset(*CALIBRATION[:count]))


@pytest.fixture(scope="module")
def model(plain: dict[str, bytes]) -> dict[str, bytes]:
    return calibrated(plain)


def test_a_calibrated_model_predicts_the_same_and_adds_its_quantiles(
    plain: dict[str, bytes], model: dict[str, bytes]
) -> None:
    before = forward_prediction.predict(plain, dataset(TEST), [1, 4]).recordings[TEST.name].streams[""]
    after = forward_prediction.predict(model, dataset(TEST), [1, 4]).recordings[TEST.name].streams[""]
    assert before.equals(after)
    table = forward_prediction.predict(model, dataset(TEST), [1, 4], [10, 90]).recordings[TEST.name].streams[""]
    assert table.select(before.column_names).equals(before)
    assert table.column_names[1:4] == [f"{CHANNELS[0]}_t1", f"{CHANNELS[0]}_t1_q10", f"{CHANNELS[0]}_t1_q90"]
    assert table.schema.field(f"{CHANNELS[0]}_t1_q90").metadata[b"quantile"] == b"0.9"
    low, high = (table[f"{CHANNELS[5]}_t4_q{percent}"].to_numpy() for percent in (10, 90))
    assert (low < high).all()


def test_the_table_and_arrays_have_the_same_quantiles(model: dict[str, bytes]) -> None:
    table = forward_prediction.predict(model, dataset(TEST), [4], PERCENTS).recordings[TEST.name].streams[""]
    loaded = ForwardModel.load(model)
    recorded, starts, _ = predicted_windows(loaded, TEST)
    arrays = loaded.predict(*asked(recorded, starts), quantiles=PERCENTS)
    assert arrays.shape == (len(starts), HORIZON, len(CHANNELS), 3)
    for at, percent in enumerate(PERCENTS):
        expected = table[f"{CHANNELS[3]}_t4_q{percent}"].to_numpy()
        assert np.allclose(arrays[:, 3, 3, at], expected, rtol=1e-4, atol=0.05)
    single = loaded.predict(*(part[0] for part in asked(recorded, starts)), quantiles=[90])
    assert np.allclose(single[..., 0], arrays[0, ..., 2], rtol=1e-4, atol=0.05)


@pytest.mark.parametrize("changed", [ENSEMBLE, {"actions": "none"}])
def test_table_and_arrays_have_the_same_quantiles_where_older_rows_or_no_plan_are_read(
    changed: dict[str, Any], tmp_path: Path
) -> None:
    files = calibrated(trained(tmp_path, **changed))
    table = forward_prediction.predict(files, dataset(TEST), [4], PERCENTS).recordings[TEST.name].streams[""]
    model = ForwardModel.load(files)
    window, plan, _ = prediction.inputs(model, dataset(TEST))
    if "actions" in changed:
        plan = plan[::-1].copy()  # another plan, of which this model reads nothing
    arrays = model.predict(window, plan, quantiles=PERCENTS)
    for at, percent in enumerate(PERCENTS):
        expected = table[f"{CHANNELS[3]}_t4_q{percent}"].to_numpy()
        assert np.allclose(arrays[:, 3, 3, at], expected, rtol=1e-4, atol=0.05)


def test_as_many_values_of_calibration_recordings_lie_below_a_quantile_as_its_level_states(
    model: dict[str, bytes],
) -> None:
    # the law of the correction on the recordings that it is computed on: no fewer, and no more than a few ties beyond
    tree, _ = evaluated(model, *CALIBRATION)
    measured = tree["quantiles"]["seen"]["model"]
    for step in range(1, HORIZON + 1):
        assert measured["below_q90"][f"t{step}"] == pytest.approx(0.9, abs=0.01)
        assert measured["below_q10"][f"t{step}"] == pytest.approx(0.1, abs=0.01)


def test_evaluation_reports_quantiles_next_to_those_of_persistence(model: dict[str, bytes]) -> None:
    tree, result = evaluated(model, TEST, motion(21))
    measures = tree["quantiles"]
    assert measures["levels"] == [10, 50, 90]
    assert measures["recordings"] == {"fitted": 3, "corrected": 4}
    assert measures["most_promised"] == 0.8
    for predictor in ("model", "model_unconditional", "persistence"):
        assert set(measures[predictor]["coverage"]) == {*(f"t{step}" for step in range(1, HORIZON + 1)), "mean"}
        assert measures[predictor]["coverage_low"] == {}  # two recordings have no interval
    assert measures["persistence"]["pinball_skill"]["mean"] == pytest.approx(0, abs=1e-12)
    assert 0.6 < measures["model"]["coverage"]["mean"] < 0.95
    table = pq.read_table(io.BytesIO(result.files["coverage.parquet"]))
    assert table.num_rows == 2 * 3 * HORIZON
    (drawn, _) = json.loads(result.files["bands.json"])
    assert drawn["recording"] == TEST.name and len(drawn["t_s"]) == len(drawn["q90"])


def test_pinball_in_metrics_is_that_of_the_predicted_table(model: dict[str, bytes]) -> None:
    tree, _ = evaluated(model, TEST)
    table = forward_prediction.predict(model, dataset(TEST), [2], PERCENTS).recordings[TEST.name].streams[""]
    _, _, windows = predicted_windows(ForwardModel.load(model), TEST)
    lost = []
    for channel, name in enumerate(CHANNELS):
        for percent in PERCENTS:
            above = windows.truth.count[:, 1, channel] - table[f"{name}_t2_q{percent}"].to_numpy()
            lost.append(np.maximum(percent / 100 * above, (percent / 100 - 1) * above).mean())
    assert tree["quantiles"]["model"]["pinball"]["t2"] == pytest.approx(np.mean(lost), rel=1e-5)


@pytest.mark.parametrize("seed", [0, 10])  # a training recording and the validation recording of `trained`
def test_a_recording_that_trained_or_stopped_the_model_does_not_calibrate_it(
    plain: dict[str, bytes], seed: int
) -> None:
    recordings = dataset(*CALIBRATION[:3], motion(seed))
    with pytest.raises(UsageError, match=f"{motion(seed).name}.*tacpipe split --calibration"):
        forward_calibration.calibrate(
            plain, CalibrationRequest(PERCENTS, False, 0.05, 0), dataset(*TRAINING), recordings
        )


def test_a_model_without_quantiles_is_evaluated_as_before_and_has_none_to_give(plain: dict[str, bytes]) -> None:
    tree, result = evaluated(plain, TEST)
    assert "quantiles" not in tree and "coverage.parquet" not in result.files
    with pytest.raises(TacpipeError, match="tacpipe calibrate"):
        forward_prediction.predict(plain, dataset(TEST), [1], [10])


def test_a_level_that_was_not_fitted_is_refused(model: dict[str, bytes]) -> None:
    with pytest.raises(TacpipeError, match="10,50,90, not 25"):
        forward_prediction.predict(model, dataset(TEST), [1], [25])


def test_four_recordings_can_promise_the_band_and_three_cannot(
    plain: dict[str, bytes], model: dict[str, bytes]
) -> None:
    promised, _ = evaluated(calibrated(plain, promise=True), TEST)
    pooled, _ = evaluated(model, TEST)
    assert promised["quantiles"]["method"] == "promised"
    assert promised["quantiles"]["model"]["width"]["mean"] > pooled["quantiles"]["model"]["width"]["mean"]
    with pytest.raises(TacpipeError, match="3 calibration recordings can guarantee a band with a coverage of 75 %"):
        calibrated(plain, promise=True, count=3)


def test_recordings_of_the_calibration_count_as_seen(model: dict[str, bytes]) -> None:
    tree, _ = evaluated(model, CALIBRATION[2], TEST)
    assert tree["counts"]["recordings"] == 1 and tree["seen"]["counts"]["recordings"] == 1


def test_a_model_of_latents_has_quantiles_in_counts(tmp_path: Path) -> None:
    training = compressed(*TRAINING)
    files = trained(tmp_path, training, compressed(motion(10), files=training.files))
    request = CalibrationRequest(PERCENTS, False, 0.05, 0)
    calibrated_model = forward_calibration.calibrate(
        files, request, training, compressed(*CALIBRATION, files=training.files)
    )
    tree, _ = evaluated(
        calibrated_model, *compressed(TEST, files=training.files).recordings.values(), files=training.files
    )
    assert 0.5 < tree["quantiles"]["model"]["coverage"]["mean"] <= 1


def test_quantiles_of_another_model_are_refused(model: dict[str, bytes], tmp_path: Path) -> None:
    shorter = trained(tmp_path, horizon=2)
    with pytest.raises(TacpipeError, match="other channels or steps"):
        forward_evaluation.evaluate({**shorter, "quantiles.safetensors": model["quantiles.safetensors"]}, dataset(TEST))
