"""Compare evaluation with numpy on the columns of the recordings, and check the files of a result."""

import csv
import dataclasses
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tacpipe.arrays import AnyFloats
from tacpipe.errors import TacpipeError
from tacpipe.io import parquet
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.prediction import ForwardModel
from tests.fake_recordings import FakeShard, dataset
from tests.stages.learning_fakes import CHANNELS, motion, table
from tests.tasks.forward.trials import (
    CONTEXT,
    HORIZON,
    LENGTH,
    compressed,
    counts,
    evaluated,
    poses,
    predicted_windows,
    trained,
)

OTHERS = {"known", "unseen", "counts", "skill", "situations", "context_mean"}
LINEAR = {"train_mean", "autoregression", "plan_by_load", "ridge", "ridge_actions"}


def held_object(seed: int, object_name: str | None) -> FakeShard:
    recording = motion(seed)
    return dataclasses.replace(recording, attributes={"trial": seed} | ({"object": object_name} if object_name else {}))


TRAIN, TEST = (
    [held_object(seed, "cup") for seed in range(4)],
    [held_object(20, "cup"), held_object(21, "jug"), held_object(22, "cup")],
)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder, fast = tmp_path_factory.mktemp("model"), {"learning_rate": 0.02, "epochs": 15, "patience": 15}
    return trained(folder, dataset(*TRAIN), dataset(held_object(10, "cup"), held_object(11, "cup")), **fast)


@pytest.fixture(scope="module")
def latents() -> Mapping[str, Any]:
    return {
        representation: compressed(*TRAIN, representation=representation) for representation in ("levels", "increments")
    }


@pytest.fixture(scope="module")
def latent_models(latents: Mapping[str, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    models = {}
    for name in ("gru levels", "recurrent levels", "gru increments"):
        architecture, representation = name.split()
        watched = compressed(held_object(10, "cup"), files=latents[representation].files, representation=representation)
        models[name] = trained(
            tmp_path_factory.mktemp("model"), latents[representation], watched, architecture=architecture
        )
    return models


def sliding(values: AnyFloats) -> AnyFloats:
    """All windows (window, row, channel) of rows (time, channel)."""
    return np.lib.stride_tricks.sliding_window_view(values, LENGTH, axis=0).swapaxes(1, 2)


def oracle(*shards: FakeShard) -> dict[str, AnyFloats]:
    """Errors (window, step, channel) of the two that need no fit, from the columns."""
    windows = np.concatenate([sliding(counts(shard)) for shard in shards])
    ahead = windows[:, CONTEXT:]
    return {
        "persistence": windows[:, CONTEXT - 1, None] - ahead,
        "context_mean": windows[:, :CONTEXT].mean(axis=1, keepdims=True) - ahead,
    }


def test_persistence_and_context_mean_are_what_numpy_computes_from_the_columns(model: dict[str, bytes]) -> None:
    metrics, _ = evaluated(model, *TEST)
    groups = {
        "both": np.ones(len(CHANNELS), dtype=bool),
        "sensor1": np.array([name.startswith("xela1") for name in CHANNELS]),
        "sensor2": np.array([name.startswith("xela2") for name in CHANNELS]),
        **{axis: np.array([name.endswith(axis) for name in CHANNELS]) for axis in "xyz"},
    }
    scale = np.array(json.loads(model["config.json"])["scaling"]["channel_count"])
    for predictor, errors in oracle(*TEST).items():
        assert set(metrics[predictor]["mse_counts"]) == set(groups)
        for group, mask in groups.items():
            mae, mse = metrics[predictor]["mae_counts"][group], metrics[predictor]["mse_counts"][group]
            for step in range(HORIZON):
                group_errors = errors[:, step, mask]
                assert mae[f"t{step + 1}"] == pytest.approx(np.abs(group_errors).mean(), rel=1e-6)
                assert mse[f"t{step + 1}"] == pytest.approx(np.square(group_errors).mean(), rel=1e-6)
            assert mae["mean"] == pytest.approx(np.abs(errors[..., mask]).mean(), rel=1e-6)
        expected = np.square(errors / scale).mean()
        assert metrics[predictor]["mse_standard"]["mean"] == pytest.approx(expected, rel=1e-6)
    assert metrics["counts"] == {
        "windows": 3 * 72,
        "recordings": 3,
        "recordings_without_window": 0,
        "effective_windows": 3 * 72 // HORIZON,
    }


def test_the_model_s_errors_are_those_of_a_loop_over_predict(model: dict[str, bytes]) -> None:
    metrics, result = evaluated(model, *TEST)
    forecaster, errors = ForwardModel.load(model), []
    for shard in TEST:
        arm = tracks.track(shard, forecaster.codec).arm  # type: ignore[arg-type]
        rows = np.hstack([counts(shard), arm, np.zeros((len(arm), 1))])
        for start in range(len(rows) - LENGTH + 1):
            past, future = slice(start, start + CONTEXT), slice(start + CONTEXT, start + LENGTH)
            errors.append(forecaster.predict(rows[past], arm[future]) - counts(shard)[future])
    model_error, base = np.array(errors), oracle(*TEST)["persistence"]
    for step in range(HORIZON):
        name = f"t{step + 1}"
        expected = np.abs(model_error[:, step]).mean()
        assert metrics["model"]["mae_counts"]["both"][name] == pytest.approx(expected, rel=1e-3)
        skill = 1 - np.square(model_error[:, step]).mean() / np.square(base[:, step]).mean()
        assert metrics["skill"]["mse_counts"][name]["mean"] == pytest.approx(skill, rel=1e-3)
    lines = list(csv.DictReader(io.StringIO(result.files["horizons.csv"].decode())))
    assert {line["predictor"] for line in lines} == {"model", "persistence", "context_mean"} | LINEAR
    assert [line["horizon_ms"] for line in lines[:HORIZON]] == ["20.0", "40.0", "60.0", "80.0"]
    lines_by_step = {(line["predictor"], line["step"]): line for line in lines}
    stated_mae = float(lines_by_step["ridge", "2"]["mae_counts"])
    assert stated_mae == metrics["ridge"]["mae_counts"]["both"]["t2"]


def test_the_model_beats_persistence_where_the_plan_tells_all(model: dict[str, bytes]) -> None:
    metrics, _ = evaluated(model, *TEST)
    assert metrics["skill"]["mse_counts"]["t4"]["mean"] > 0.5
    assert metrics["model"]["mse_counts"]["both"]["t4"] < 0.5 * metrics["persistence"]["mse_counts"]["both"]["t4"]


def test_the_sums_of_the_errors_table_are_the_means_of_the_metrics(model: dict[str, bytes]) -> None:
    shards = [*TEST, TRAIN[0]]
    metrics, result = evaluated(model, *shards)
    frame = parquet.from_parquet(result.files["errors.parquet"]).to_pandas()
    assert set(frame["recording"]) == {shard.name for shard in shards}
    assert set(frame["object"]) == {"cup", "jug"}
    parts = {
        "": frame[~frame["seen"]],
        "known": frame[~frame["seen"] & frame["known"]],
        "unseen": frame[~frame["seen"] & ~frame["known"]],
        "seen": frame[frame["seen"]],
    }
    for name, part in parts.items():
        tree = metrics[name] if name else metrics
        for (predictor, group, step), rows in part.groupby(["predictor", "group", "step"]):
            cells = (rows["windows"] * rows["channels"]).sum()
            squared, absolute = rows["squared"].sum() / cells, rows["absolute"].sum() / cells
            scores = tree[predictor]
            if group in ("standard", "feature", "latent"):
                assert squared == pytest.approx(scores[f"mse_{group}"][f"t{step}"], rel=1e-6)
            else:
                assert squared == pytest.approx(scores["mse_counts"][group][f"t{step}"], rel=1e-6)
                assert absolute == pytest.approx(scores["mae_counts"][group][f"t{step}"], rel=1e-6)


def test_objects_that_the_model_was_trained_on_and_others_are_told_apart(model: dict[str, bytes]) -> None:
    metrics, result = evaluated(model, *TEST)
    assert (metrics["known"]["counts"]["recordings"], metrics["unseen"]["counts"]["recordings"]) == (2, 1)
    known_only, _ = evaluated(model, TEST[0], TEST[2])
    assert metrics["known"]["model"] == known_only["model"]
    assert not {"known", "unseen", "seen"} & set(known_only)
    rows = {row["recording"]: row for row in csv.DictReader(io.StringIO(result.files["trials.csv"].decode()))}
    assert (rows["trial-21"]["object"], rows["trial-21"]["known"], rows["trial-20"]["known"]) == (
        "jug",
        "false",
        "true",
    )
    unnamed, _ = evaluated(model, held_object(20, None), TEST[1])
    assert unnamed["known"]["counts"]["recordings"] == 1  # nobody said what is held


def test_recordings_that_the_model_has_seen_are_told_apart(model: dict[str, bytes]) -> None:
    unseen_only, _ = evaluated(model, *TEST)
    mixed, result = evaluated(model, *TEST, TRAIN[0], held_object(10, "cup"))
    assert {name: value for name, value in mixed.items() if name != "seen"} == unseen_only
    assert mixed["seen"]["counts"]["recordings"] == 2
    assert result.recordings[TRAIN[0].name].attributes["seen"] is True
    assert result.recordings[TEST[0].name].attributes == {"trial": 20, "object": "cup", "seen": False}
    only, _ = evaluated(model, TRAIN[0])
    assert "model" not in only
    assert only["counts"]["recordings"] == 0 and only["seen"]["counts"]["recordings"] == 1


def test_names_of_metrics_are_those_that_readers_rely_on(model: dict[str, bytes]) -> None:
    metrics, result = evaluated(model, *TEST)
    for predictor in ("model", "persistence"):
        for group in ("sensor1", "sensor2", "both"):
            assert set(metrics[predictor]["mae_counts"][group]) == {"t1", "t2", "t3", "t4", "mean"}
    assert set(metrics) == {
        *({"model", "persistence", "context_mean"} | LINEAR),
        *("counts", "skill", "situations", "known", "unseen"),
    }
    assert set(metrics["model"]) == {"mse_counts", "mae_counts", "mse_standard", "mse_latent", "mse_feature"}
    assert set(metrics["ridge"]) == {"mse_counts", "mae_counts", "mse_standard"}
    assert set(result.files) == {
        *(
            "metrics.json",
            "horizons.csv",
            "trials.csv",
            "errors.parquet",
            "config.json",
            "history.jsonl",
            "headline.json",
        ),
    }


def test_a_model_that_was_stored_with_alarm_levels_is_evaluated_as_one_without(model: dict[str, bytes]) -> None:
    config = json.loads(model["config.json"])
    config["anticipation"] = {"sd": [1.0], "theta": {"model": [2.0, None]}}
    stored_before = {**model, "config.json": json.dumps(config).encode()}
    assert evaluated(stored_before, *TEST)[0] == evaluated(model, *TEST)[0]


def test_features_are_measured_in_half_their_training_range(model: dict[str, bytes]) -> None:
    metrics, _ = evaluated(model, *TEST)
    half = np.ptp(np.concatenate([counts(shard) for shard in TRAIN]), axis=0) / 2
    expected = np.square(oracle(*TEST)["persistence"] / half).mean()
    assert metrics["persistence"]["mse_feature"]["mean"] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("gru levels", {"codec", "codec_persistence", "codec_anchored"}),
        ("recurrent levels", {"codec", "codec_persistence", "codec_anchored", "model_anchored"}),
        ("gru increments", {"codec"}),
    ],
)
def test_what_the_codec_alone_loses_stands_beside_the_model(
    name: str, rows: set[str], latents: Mapping[str, Any], latent_models: Mapping[str, dict[str, bytes]]
) -> None:
    representation = name.split()[1]
    codec, test = (
        latents[representation],
        compressed(*TEST, files=latents[representation].files, representation=representation),
    )
    metrics, result = evaluated(latent_models[name], *test.recordings.values(), files=codec.files)
    assert set(metrics) - LINEAR - OTHERS == {
        *("model", "persistence"),
        *rows,
    }
    assert set(metrics) > LINEAR
    assert metrics["codec"]["mse_latent"]["mean"] == 0
    assert metrics["codec"]["mse_counts"]["both"]["mean"] > 0
    for predictor, errors in oracle(*TEST).items():
        expected = np.abs(errors).mean()
        assert metrics[predictor]["mae_counts"]["both"]["mean"] == pytest.approx(expected, rel=1e-6)
    assert "codec.json" in result.files
    table_written = result.recordings["trial-20"].streams[""]
    assert table_written.column_names[:5] == ["t_ns", "contact", "z00", "z00_t1", "z00_t3"]


def test_what_the_codec_loses_is_what_numpy_computes(
    latents: Mapping[str, Any], latent_models: Mapping[str, dict[str, bytes]]
) -> None:
    codec = ForwardModel.load(latent_models["gru levels"]).codec
    test = compressed(*TEST, files=latents["levels"].files)
    metrics, _ = evaluated(latent_models["gru levels"], *test.recordings.values(), files=latents["levels"].files)
    lost = {shard.name: codec.decode(codec.encode(counts(shard), CHANNELS)) - counts(shard) for shard in TEST}
    windows = np.concatenate([sliding(shard) for shard in lost.values()])
    for predictor, expected in (
        ("codec", windows[:, CONTEXT:]),
        ("codec_anchored", windows[:, CONTEXT:] - windows[:, CONTEXT - 1, None]),
        ("codec_persistence", windows[:, CONTEXT - 1, None] + oracle(*TEST)["persistence"]),
    ):
        stated = metrics[predictor]["mse_counts"]["both"]["mean"]
        assert stated == pytest.approx(np.square(expected).mean(), rel=1e-3), predictor


def test_latents_of_another_codec_are_refused(
    latents: Mapping[str, Any], latent_models: Mapping[str, dict[str, bytes]]
) -> None:
    of_another_codec = compressed(*TEST)
    with pytest.raises(TacpipeError, match="another codec than the model's"):
        evaluated(latent_models["gru levels"], *of_another_codec.recordings.values(), files=of_another_codec.files)
    with pytest.raises(TacpipeError, match="trial-20: There is no column z00"):
        evaluated(latent_models["gru levels"], *TEST)


def test_a_model_of_raw_channels_reads_recordings_that_have_latents_too(
    model: dict[str, bytes], latents: Mapping[str, Any]
) -> None:
    test = compressed(*TEST, files=latents["levels"].files)
    metrics, _ = evaluated(model, *test.recordings.values(), files=latents["levels"].files)
    assert metrics == evaluated(model, *TEST)[0]


def test_a_signal_that_stays_has_no_error_and_no_skill(model: dict[str, bytes]) -> None:
    constant = FakeShard("still", table(np.full((40, len(CHANNELS)), 12.0)))
    metrics, result = evaluated(model, constant)
    assert metrics["persistence"]["mse_counts"]["both"]["mean"] == 0
    assert metrics["context_mean"]["mae_counts"]["x"]["t3"] == 0
    assert metrics["skill"]["mse_counts"] == {}
    assert b"nan" not in result.files["trials.csv"].lower()
    json.loads(result.files["metrics.json"], parse_constant=pytest.fail)


def test_recordings_without_a_window_are_counted_and_do_no_harm(model: dict[str, bytes]) -> None:
    empty = FakeShard("a-empty", table(np.zeros((0, len(CHANNELS)))))
    short = FakeShard("short", motion(1, rows=LENGTH - 1).content)
    metrics, result = evaluated(model, empty, *TEST, short)
    expected, _ = evaluated(model, *TEST)
    assert metrics["counts"] == expected["counts"] | {"recordings_without_window": 2}
    assert metrics["model"] == expected["model"]
    for name in ("a-empty", "short"):
        predictions = result.recordings[name].tables
        assert isinstance(predictions, pa.Table)
        assert predictions.num_rows == 0
    none, _ = evaluated(model, empty)
    assert none == {"counts": {"windows": 0, "recordings": 0, "recordings_without_window": 1, "effective_windows": 0}}


def test_every_window_is_judged_in_contact_or_not(model: dict[str, bytes]) -> None:
    free = FakeShard("trial-20", table(counts(TEST[0]), poses(TEST[0]), contact=np.full(80, -1)), TEST[0].attributes)
    metrics, result = evaluated(model, free)
    assert metrics["model"] == evaluated(model, TEST[0])[0]["model"]
    predictions = result.recordings["trial-20"].streams[""]
    assert set(predictions["contact"].to_pylist()) == {-1}


def test_predictions_stand_at_the_time_they_are_known(model: dict[str, bytes]) -> None:
    _, result = evaluated(model, TEST[0])
    _, _, windows = predicted_windows(ForwardModel.load(model), TEST[0])
    predictions, name = result.recordings[TEST[0].name].streams[""], CHANNELS[0]
    assert predictions["t_ns"].to_pylist()[:2] == [4 * 20_000_000, 5 * 20_000_000]
    assert [column for column in predictions.column_names if column.startswith(name)] == [
        name,
        f"{name}_t1",
        f"{name}_t3",
    ]
    assert np.allclose(predictions[f"{name}_t3"].to_numpy(), windows.forecast.features[:, 2, 0], rtol=1e-5)
    assert np.allclose(predictions[name].to_numpy(), counts(TEST[0])[4:-4, 0], atol=1e-2)


def test_recordings_of_another_rate_or_grid_are_refused(model: dict[str, bytes]) -> None:
    content = TEST[0].content
    fast = content.set_column(0, content.schema.field(0), [np.arange(80) * 10_000_000])
    with pytest.raises(TacpipeError, match=r"100 rows a second and the model was trained at 50.*--rate-hz 50"):
        evaluated(model, FakeShard("fast", fast))
    with pytest.raises(TacpipeError, match=r"fresh has a fresh grid and the model was trained on a uniform one"):
        evaluated(model, FakeShard("fresh", content, {"grid": "fresh"}))


def test_recordings_of_another_layout_are_refused(model: dict[str, bytes]) -> None:
    fewer = FakeShard("fewer", TEST[0].content.drop_columns(CHANNELS[-3:]))
    with pytest.raises(
        TacpipeError, match="fewer: The tactile columns differ from those of the first training recording: it lacks"
    ):
        evaluated(model, fewer)


def test_judging_again_gives_the_same_bytes_for_a_control_too(tmp_path: Path) -> None:
    files = trained(tmp_path, actions="shuffled")
    (_, first), (_, second) = evaluated(files, *TEST), evaluated(files, *TEST)
    assert first.files == second.files
