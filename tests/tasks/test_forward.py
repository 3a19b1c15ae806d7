from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.stage import Result
from tacpipe.tasks import forward, tracks
from tacpipe.tasks.forward import Forecaster
from tests.stages.learning_fakes import CHANNELS, FakeShard, dataset, motion, table

PARAMS: dict[str, Any] = {
    "hidden": 24,
    "epochs": 30,
    "batch": 32,
    "learning_rate": 0.01,
    "patience": 30,
    "gradient_clip": 1.0,
    "seed": 0,
    "context": 5,
    "horizon": 4,
}
TRAIN, VAL, TEST = [motion(k) for k in range(6)], [motion(k) for k in (10, 11)], [motion(k) for k in (20, 21, 22)]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return forward.train(PARAMS, dataset(*TRAIN), dataset(*VAL), tmp_path_factory.mktemp("checkpoint"))


def judged(model: Mapping[str, bytes], *shards: FakeShard) -> tuple[Any, Result]:
    result = forward.evaluate(model, dataset(*shards))
    return json.loads(result.files["metrics.json"]), result


def predictions(model: Mapping[str, bytes], content: pa.Table) -> np.ndarray:
    """Predicted latents (window, horizon, latent) of a recording that is one table."""
    forecaster = Forecaster.load(model)
    track = tracks.track(FakeShard("trial", content), forecaster.codec)  # type: ignore[arg-type]
    return forecaster.predict_track(track, track.starts(PARAMS["context"], PARAMS["horizon"]))


def test_the_model_beats_persistence_where_the_plan_tells_all(model: dict[str, bytes]) -> None:
    metrics, _ = judged(model, *TEST)
    assert metrics["skill"]["mse_counts"]["t4"]["low"] > 0.5
    assert metrics["model"]["mse_counts"]["all"]["t4"] < 0.5 * metrics["persistence"]["mse_counts"]["all"]["t4"]


def test_a_tiny_deterministic_set_is_learned_by_heart(tmp_path: Path) -> None:
    one = motion(3, rows=24)
    params = {**PARAMS, "epochs": 250, "patience": 250}
    files = forward.train(params, dataset(one), dataset(one), tmp_path)
    losses = [json.loads(line)["val_loss"] for line in files["history.jsonl"].splitlines()]
    assert min(losses) < 0.001 < losses[0]


def test_frames_after_t_do_not_change_what_is_predicted_at_t(model: dict[str, bytes]) -> None:
    content = TEST[0].table()
    before, now = predictions(model, content), 40
    tactile = np.column_stack([content[name].to_numpy() for name in CHANNELS]) - 16000.0
    pose = np.column_stack([content[name].to_numpy() for name in tracks.STATE])
    tactile[now + 1 :] += 500
    after = predictions(model, table(tactile, pose))
    known = now - PARAMS["context"] + 2  # windows whose last frame of the past is not after ``now``
    assert np.allclose(after[:known], before[:known], atol=1e-3)
    assert not np.allclose(after[known], before[known], atol=1)


def test_the_plan_of_a_step_changes_only_it_and_later_ones(model: dict[str, bytes]) -> None:
    forecaster = Forecaster.load(model)
    rng = np.random.default_rng(0)
    window, plan = rng.normal(size=(3, 5, len(CHANNELS) + 7)), rng.normal(size=(3, 4, 7))
    before = forecaster.predict(window, plan)
    changed = plan.copy()
    changed[:, 2] += 1
    after = forecaster.predict(window, changed)
    assert np.array_equal(after[:, :2], before[:, :2])
    assert (np.abs(after[:, 2:] - before[:, 2:]).max(axis=(0, 2)) > 0).all()


def test_persistence_of_a_constant_signal_has_no_error(model: dict[str, bytes]) -> None:
    still = FakeShard("still", table(np.full((40, len(CHANNELS)), 12.0)))
    metrics, result = judged(model, still)
    assert metrics["persistence"]["mse_counts"]["all"]["mean"] == 0
    assert metrics["context_mean"]["mae_counts"]["x"]["t3"] == 0
    assert metrics["skill"]["mse_counts"] == {}
    assert b"nan" not in result.files["trials.csv"].lower()


def test_errors_are_those_of_a_loop_over_windows(model: dict[str, bytes]) -> None:
    metrics, result = judged(model, *TEST)
    forecaster = Forecaster.load(model)
    errors: list[np.ndarray] = []
    held: list[np.ndarray] = []
    for shard in TEST:
        content = shard.table()
        counts = np.column_stack([content[name].to_numpy() for name in CHANNELS]).astype(float) - 16000
        pose = np.column_stack([content[name].to_numpy() for name in tracks.STATE])
        for start in range(len(counts) - 8):
            past, future = slice(start, start + 5), slice(start + 5, start + 9)
            window = np.hstack([counts[past], pose[past]])[None]
            errors.append(forecaster.predict(window, pose[future][None])[0] - counts[future])
            held.append(counts[start + 4] - counts[future])
    model_error, held_error = np.array(errors), np.array(held)  # (window, step, channel)
    sensor2 = np.array([name.startswith("xela2") for name in CHANNELS])
    assert metrics["counts"]["windows"] == len(errors)
    for step in range(4):
        name = f"t{step + 1}"
        found = metrics["model"]["mae_counts"]["all"][name]
        assert found == pytest.approx(np.abs(model_error[:, step]).mean(), rel=1e-3)
        found = metrics["persistence"]["mse_counts"]["sensor2"][name]
        assert found == pytest.approx((held_error[:, step, sensor2] ** 2).mean(), rel=1e-3)
        skill = 1 - (model_error[:, step] ** 2).mean() / (held_error[:, step] ** 2).mean()
        assert metrics["skill"]["mse_counts"][name]["mean"] == pytest.approx(skill, rel=1e-3)
    rows = list(csv.DictReader(io.StringIO(result.files["horizons.csv"].decode())))
    assert {row["predictor"] for row in rows} == {"model", "persistence", "context_mean"}
    assert [row["horizon_ms"] for row in rows[:4]] == ["20.0", "40.0", "60.0", "80.0"]


def test_names_of_metrics_are_the_same_for_model_and_baselines(model: dict[str, bytes]) -> None:
    metrics, _ = judged(model, *TEST)

    def names(tree: Any) -> Any:
        return {name: names(value) for name, value in tree.items()} if isinstance(tree, dict) else None

    assert names(metrics["model"]) == names(metrics["persistence"]) == names(metrics["context_mean"])
    assert set(metrics["model"]["mse_counts"]) == {"all", "sensor1", "sensor2", "x", "y", "z"}
    assert metrics["counts"]["effective_windows"] == metrics["counts"]["windows"] // 4


def test_recordings_the_model_has_seen_are_reported_apart(model: dict[str, bytes]) -> None:
    alone, _ = judged(model, *TEST)
    mixed, result = judged(model, *TEST, TRAIN[0], VAL[0])
    assert mixed["seen"]["counts"]["recordings"] == 2
    assert {name: value for name, value in mixed.items() if name != "seen"} == alone
    assert result.recordings[TRAIN[0].name].attributes["seen"] is True
    assert result.recordings[TEST[0].name].attributes == {"trial": 20, "seen": False}
    only, _ = judged(model, TRAIN[0])
    assert "model" not in only
    assert only["counts"]["recordings"] == 0


def test_predictions_stand_at_the_time_they_are_known(model: dict[str, bytes]) -> None:
    _, result = judged(model, TEST[0])
    found, forecast = result.recordings[TEST[0].name].tables, predictions(model, TEST[0].table())
    assert isinstance(found, pa.Table)
    assert found["t_ns"].to_pylist()[:2] == [4 * 20_000_000, 5 * 20_000_000]
    name = CHANNELS[0]
    assert [column for column in found.column_names if column.startswith(name)] == [name, f"{name}_t1", f"{name}_t3"]
    assert np.allclose(found[f"{name}_t3"].to_numpy(), forecast[:, 2, 0], rtol=1e-5)
    assert found[name][0].as_py() == pytest.approx(TEST[0].table()[name][4].as_py() - 16000)


def test_recordings_without_rows_are_counted_and_do_no_harm(model: dict[str, bytes], tmp_path: Path) -> None:
    empty = FakeShard("empty", table(np.zeros((0, len(CHANNELS)))))
    metrics, result = judged(model, *TEST, empty)
    assert metrics["counts"]["recordings_without_window"] == 1
    tables = result.recordings["empty"].tables
    assert isinstance(tables, pa.Table)
    assert tables.num_rows == 0
    params = {**PARAMS, "epochs": 1}
    with_empty = forward.train(params, dataset(empty, *TRAIN), dataset(*VAL), tmp_path / "a")
    without = forward.train(params, dataset(*TRAIN), dataset(*VAL), tmp_path / "b")
    assert with_empty["model.safetensors"] == without["model.safetensors"]


def test_scalings_know_nothing_of_validation(tmp_path: Path) -> None:
    params = {**PARAMS, "epochs": 1}
    wild = FakeShard("wild", table(np.random.default_rng(0).normal(0, 1e4, (40, len(CHANNELS)))))
    tame, wide = (
        json.loads(forward.train(params, dataset(*TRAIN), dataset(*part), tmp_path / str(len(part)))["config.json"])
        for part in (VAL, [*VAL, wild])
    )
    assert tame["scaling"] == wide["scaling"]
    assert tame["trained_on"] == {shard.name: shard.digest for shard in (*TRAIN, *VAL)}
    assert tame["counts"]["train"] == {"recordings": 6, "windows": 6 * (80 - 8)}


def test_ground_truth_columns_change_nothing(tmp_path: Path) -> None:
    params = {**PARAMS, "epochs": 1}
    told = [FakeShard(shard.name, shard.content.append_column("gt_slip", pa.array(np.arange(80.0)))) for shard in TRAIN]
    files = [
        forward.train(params, dataset(*part), dataset(*VAL), tmp_path / name)["model.safetensors"]
        for name, part in (("told", told), ("untold", TRAIN))
    ]
    assert files[0] == files[1]


def test_other_rates_shapes_and_tasks_are_refused(model: dict[str, bytes]) -> None:
    content = TEST[0].table()
    fast = content.set_column(0, content.schema.field(0), [np.arange(80) * 10_000_000])
    with pytest.raises(TacpipeError, match="100 rows a second and the model was trained at 50"):
        judged(model, FakeShard("fast", fast))
    with pytest.raises(TacpipeError, match=r"The plan has the shape \(1, 3, 7\)"):
        Forecaster.load(model).predict(np.zeros((1, 5, 19)), np.zeros((1, 3, 7)))
    config = {**json.loads(model["config.json"]), "task": "material"}
    with pytest.raises(TacpipeError, match="trained for material"):
        Forecaster.load({**model, "config.json": json.dumps(config).encode()})


def test_training_without_recordings_or_windows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TacpipeError, match="no training recording"):
        forward.train(PARAMS, dataset(), dataset(*VAL), tmp_path)
    with pytest.raises(TacpipeError, match="validation recordings hold no window"):
        forward.train(PARAMS, dataset(*TRAIN), dataset(), tmp_path)
