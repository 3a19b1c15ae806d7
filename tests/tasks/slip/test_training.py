"""Models of the task slip: training, prediction, evaluation, calibration, and the files of a model."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.tasks.learning.examples import one_window, unlabelled
from tacpipe.tasks.slip import evaluation
from tacpipe.tasks.slip.model import SlipModel, calibrate, predict
from tacpipe.tasks.slip.params import SlipAuto, SlipBoosting, SlipLinear, SlipNetwork, SlipParams
from tacpipe.tasks.task import CalibrationRequest
from tests.fake_recordings import FakeRecording, dataset
from tests.tasks.slip.slip_recordings import held_object, stored, trained, trials

SMALL = SlipBoosting(trees=20, leaves=6, leaf=10, learning_rate=0.2)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("workspace")
    return trained(SMALL, dataset(*trials(16)), dataset(*trials(6, 50)), folder)


def test_a_model_finds_slips_of_unseen_recordings_before_they_begin(files: dict[str, bytes]) -> None:
    result = evaluation.evaluate(files, dataset(*trials(12, 100)))
    metrics = json.loads(result.files["metrics.json"])
    assert metrics["model"]["auc"]["before"]["value"] > 0.9
    assert metrics["model"]["alarms"]["10"]["predicted"] == metrics["counts"]["slips"] == 6
    assert metrics["time_only"]["auc"]["before"]["value"] < 0.7
    assert metrics["model"]["brier"] < metrics["constant"]["brier"]
    assert metrics["constant"]["auc"]["before"]["value"] == 0.5
    assert metrics["time_only"]["auc"]["before"]["value"] < metrics["best_feature"]["auc"]["before"]["value"]
    (column,) = json.loads(files["config.json"])["baselines"]["best_feature"]["columns"]
    assert result.notes == [
        f"The baseline best feature is {SlipModel.load(files).reader.names[column]}, larger before slips."
    ]


def test_a_model_of_shuffled_labels_finds_no_slip(tmp_path: Path) -> None:
    params = SlipBoosting(trees=20, leaves=6, leaf=10, learning_rate=0.2, labels="shuffled", seed=2)
    files = trained(params, dataset(*trials(40)), None, tmp_path)
    metrics = json.loads(evaluation.evaluate(files, dataset(*trials(12, 100))).files["metrics.json"])
    assert metrics["model"]["auc"]["before"]["value"] < 0.7


def test_recordings_that_the_model_was_trained_on_are_not_evaluated(files: dict[str, bytes]) -> None:
    with pytest.raises(TacpipeError, match="except those that the model was trained on"):
        evaluation.evaluate(files, dataset(*trials(4)))


def test_a_result_reads_back_as_it_was_evaluated(files: dict[str, bytes]) -> None:
    result = evaluation.evaluate(files, dataset(*trials(6, 100)))
    again = evaluation.EvaluatedSlips.from_result(stored(result))
    assert again.measure(1_000_000_000) == json.loads(result.files["metrics.json"])


def test_a_prediction_states_probability_and_alarms_of_each_row_with_full_windows(files: dict[str, bytes]) -> None:
    recording = held_object(101, 6.0)
    table = predict(files, dataset(recording)).recordings[recording.name].streams[""]
    assert table.column_names == ["t_ns", "probability", "score", "alarm_0.1", "alarm_1", "alarm_10"]
    at_s = table["t_ns"].to_numpy() / 1e9
    assert at_s[0] == pytest.approx(1.2, abs=0.06)  # rest of 0.2 s, then a window of 1 s
    probability = table["probability"].to_numpy()
    assert probability[(at_s > 5.5) & (at_s < 6)].mean() > 0.6 > 0.2 > probability[(at_s > 2) & (at_s < 4)].mean()


def test_later_samples_change_no_earlier_probability(files: dict[str, bytes]) -> None:
    recording = held_object(101, 6.0)
    shortened = {name: table.slice(0, 150) for name, table in recording.tables.items()}
    whole, part = (
        predict(files, dataset(type(recording)(tables, "trial", recording.attributes))).recordings["trial"].streams[""]
        for tables in (recording.tables, shortened)
    )
    assert 0 < part.num_rows < whole.num_rows
    assert part.equals(whole.slice(0, part.num_rows))


def test_a_single_window_scores_as_among_others(files: dict[str, bytes]) -> None:
    model = SlipModel.load(files)
    track = model.reader.track(held_object(103, 6.0))  # type: ignore[arg-type]
    rows = np.flatnonzero(track.ready)
    scores = model.scores(unlabelled(model.reader, track, [], rows))
    for row, score in list(zip(rows, scores, strict=True))[::17]:
        windows = [part[0] for part in model.reader.windows(track, np.array([row]))]
        assert model.scores(one_window(model.reader, windows, int(track.t_ns[row]), track.start_ns)) == score


def test_calibration_on_other_recordings_sets_levels_and_remembers_the_recordings(files: dict[str, bytes]) -> None:
    request = CalibrationRequest((10, 90), False, 0.05, 0)
    others = dataset(*trials(6, 200))
    calibrated = SlipModel.load(calibrate(files, request, dataset(), others))
    assert calibrated.calibration.method == "calibration recordings"
    assert set(others.recordings) <= set(calibrated.config["trained_on"])
    with pytest.raises(TacpipeError, match="have no slip"):
        calibrate(files, request, dataset(), dataset(held_object(300, None)))


def test_a_network_learns_and_loads_with_the_same_scores(tmp_path: Path) -> None:
    params = SlipNetwork(channels=6, layers=3, epochs=2, stride=4, batch=64)
    files = trained(params, dataset(*trials(8)), dataset(*trials(4, 50)), tmp_path)
    first, second = (
        predict(files, dataset(held_object(101, 6.0))).recordings["trial-101"].streams[""] for _ in range(2)
    )
    assert first.equals(second)
    assert np.ptp(first["score"].to_numpy()) > 0


def test_the_default_is_the_simplest_that_no_other_surpasses(tmp_path: Path) -> None:
    config = json.loads(trained(SlipAuto(stride=2), dataset(*trials(24)), None, tmp_path)["config.json"])
    losses = {row["name"]: row for row in config["candidates"]}
    assert list(losses) == ["constant", "time_only", "best_feature", "linear", "boosting"]
    assert config["chosen"] == "linear"
    assert losses["linear"]["excess"] <= losses["linear"]["error"]
    assert losses["linear"]["loss"] < min(row["loss"] for row in losses.values() if row["baseline"])


@pytest.mark.parametrize("params", [SlipLinear(), SMALL, SlipNetwork(epochs=1, channels=4, layers=2)])
def test_a_single_estimator_is_trained_whatever_its_baselines_reach(params: SlipParams, tmp_path: Path) -> None:
    params = dataclasses.replace(params, stride=10)
    config = json.loads(trained(params, dataset(*trials(12)), None, tmp_path)["config.json"])
    assert config["chosen"] == params.architecture
    assert not config["chosen_is_baseline"]


@pytest.mark.parametrize(
    ("recordings", "message"),
    [
        ([held_object(0, None), held_object(2, None)], "no window with a slip"),
        ([], "no training recording"),
    ],
)
def test_recordings_that_teach_nothing_are_refused(recordings: list[Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match=message):
        trained(SMALL, dataset(*recordings), None, tmp_path)


def test_files_of_another_model_are_refused(files: dict[str, bytes]) -> None:
    config = json.loads(files["config.json"])
    config["inputs"] = config["inputs"][:1]
    damaged = {**files, "config.json": json.dumps(config).encode()}
    with pytest.raises(TacpipeError, match="do not fit one another"):
        SlipModel.load(damaged)


def test_windows_of_one_row_tell_stable_grasps_from_sliding_ones(tmp_path: Path) -> None:
    def grasps(seed: int) -> FakeRecording:
        rng = np.random.default_rng(seed)
        slips = rng.random(40) < 0.5
        readings = rng.normal(0, 1, (40, 6))
        readings[:, 2] += 4 * slips
        fields = [pa.field("t_ns", pa.int64())]
        fields += [pa.field(f"e{n}", pa.float64(), metadata={"quantity": "tactile", "unit": "count"}) for n in range(6)]
        columns = [pa.array(np.arange(40) * 10**10), *map(pa.array, readings.T), pa.array(slips.astype(np.int8))]
        table = pa.Table.from_arrays(columns, schema=pa.schema([*fields, pa.field("slip", pa.int8())]))
        return FakeRecording({"hand": table}, f"object-{seed}")

    params = dataclasses.replace(SMALL, window_s=0.0, horizon_s=0.0, rest_s=0.0, match_time=False)
    files = trained(params, dataset(*map(grasps, range(8))), None, tmp_path)
    metrics = json.loads(evaluation.evaluate(files, dataset(*map(grasps, range(20, 24)))).files["metrics.json"])
    assert metrics["counts"]["windows"] == 160
    assert metrics["model"]["accuracy"]["value"] > 0.9 > 0.7 > metrics["constant"]["accuracy"]["value"]
    assert metrics["model"]["auc"]["during"]["value"] > 0.95
    recording = grasps(30)
    model = SlipModel.load(files)
    track = model.reader.track(recording)  # type: ignore[arg-type]
    first = one_window(model.reader, [track.streams[0].values[:1]], 0, 0)
    assert model.scores(first)[0] == model.table(recording)["score"][0].as_py()
