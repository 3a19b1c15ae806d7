"""Test the training of a model: its data, its files, and reproducibility."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from safetensors.numpy import load

from tacpipe.errors import TacpipeError
from tacpipe.io import spill
from tacpipe.io.columns import Columns
from tacpipe.models import linear
from tacpipe.plugins import registry
from tacpipe.plugins.params import to_json
from tacpipe.plugins.stage import Result
from tacpipe.tasks.forward import networks, tracks, training
from tacpipe.tasks.forward import training as forward_training
from tacpipe.tasks.forward.calibration import calibrate
from tacpipe.tasks.forward.evaluation import evaluate
from tacpipe.tasks.forward.prediction import predict
from tacpipe.tasks.task import CalibrationRequest
from tests.fake_recordings import FakeShard, dataset
from tests.stages.learning_fakes import CHANNELS, motion, table
from tests.tasks.forward.trials import HORIZON, compressed, evaluated, params, trained
from tests.training.followers import interrupted

TRAIN, VAL = [motion(seed) for seed in range(3)], [motion(10), motion(11)]
FILES = {"model.safetensors", "baselines.safetensors", "config.json", "history.jsonl"}


def config(files: dict[str, bytes]) -> dict[str, Any]:
    value: dict[str, Any] = json.loads(files["config.json"])
    return value


def losses(files: dict[str, bytes]) -> list[float]:
    return [json.loads(line)["val_loss"] for line in files["history.jsonl"].splitlines()]


def strolling(seed: int) -> FakeShard:
    """A recording in which nothing but the plan tells where the arm goes, and each channel feels where it is."""
    rng = np.random.default_rng(seed)
    pose = np.tile([0.5, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0], (80, 1))
    pose[:, 0] += rng.normal(0, 0.005, 80).cumsum()
    return FakeShard(f"stroll-{seed}", table((pose[:, :1] - 0.5) * np.linspace(500, 4000, len(CHANNELS)), pose))


def test_a_tiny_deterministic_set_is_learned_by_heart(tmp_path: Path) -> None:
    recordings = dataset(motion(3, rows=24))
    sizes = {"hidden": 24, "epochs": 200, "patience": 200, "learning_rate": 0.01, "cycle": False, "baselines": False}
    losses_of_epochs = losses(trained(tmp_path, recordings, recordings, architecture="recurrent", batch=32, **sizes))
    assert min(losses_of_epochs) < 0.001 < losses_of_epochs[0]


@pytest.mark.parametrize("latents", [False, True])
def test_recordings_on_disk_give_the_same_model_evaluation_and_predictions_as_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, latents: bool
) -> None:
    shards = [*TRAIN, *VAL, *(motion(seed) for seed in range(70, 75))]
    recordings = compressed(*shards) if latents else dataset(*shards)

    def part(*names: str) -> Any:
        return dataset(*(recordings.recordings[name] for name in names), files=dict(recordings.files))

    def results(folder: str) -> tuple[dict[str, bytes], dict[str, bytes], list[pa.Table]]:
        (tmp_path / folder).mkdir()
        names = [shard.name for shard in shards]
        first_val, first_calibration = len(TRAIN), len(TRAIN) + len(VAL)
        train, val = part(*names[:first_val]), part(*names[first_val:first_calibration])
        request = CalibrationRequest((10, 50, 90), False, 0.05, 0)
        model = calibrate(trained(tmp_path / folder, train, val), request, train, part(*names[first_calibration:-1]))
        evaluation = evaluate(model, part(names[-1]))
        prediction = predict(model, part(names[-1]), [1, 3], [10, 90])
        return model, dict(evaluation.files), [_rows(result) for result in (evaluation, prediction)]

    in_memory = results("in-memory")
    monkeypatch.setattr(tracks, "IN_MEMORY", 0)
    for module in (training, networks, tracks):
        monkeypatch.setattr(module, "BLOCK_ROWS", 7)
    monkeypatch.setattr(networks, "WINDOWS", 5)
    monkeypatch.setattr(Columns.batches, "__defaults__", (None, 7))
    monkeypatch.setattr(spill, "SEGMENT_BYTES", 1 << 14)
    monkeypatch.setattr(spill, "MAX_READ_BYTES", 0)
    assert results("on-disk") == in_memory


def _rows(result: Result) -> pa.Table:
    (output,) = result.recordings.values()
    return output.streams[""]


@pytest.mark.parametrize("architecture", registry.architectures("forward"))
def test_every_model_is_tensors_and_json_alone(architecture: str, tmp_path: Path) -> None:
    files = trained(tmp_path, dataset(*TRAIN[:1]), architecture=architecture, epochs=1)
    assert set(files) == FILES
    for name, content in files.items():
        if name.endswith(".safetensors"):
            assert all(np.isfinite(values).all() for values in load(content).values())
        else:
            lines = content.splitlines() if name.endswith(".jsonl") else [content]
            assert all(json.loads(line, parse_constant=pytest.fail) for line in lines)
    assert config(files)["architecture"] == architecture


def test_the_config_tells_what_was_trained_on_what(tmp_path: Path) -> None:
    recordings = [
        dataclasses.replace(shard, attributes={"object": f"bottle-{index % 2}"}) for index, shard in enumerate(TRAIN)
    ]
    stored = config(trained(tmp_path, dataset(*recordings), dataset(*VAL), stride=2))
    assert (stored["task"], stored["rate_hz"], stored["timeline"]) == ("forward", 50.0, "uniform")
    assert stored["codec"] == {"kind": "raw", "of": "levels", "frames": 1, "latents": 12, "name": "raw"}
    assert stored["inputs"]["tactile"] == CHANNELS
    assert stored["inputs"]["layout"][0] == {"stream": "xela1", "taxel": "1", "axis": "x"}
    assert stored["objects"] == ["bottle-0", "bottle-1"]
    assert stored["trained_on"] == {shard.name: shard.digest for shard in (*TRAIN, *VAL)}
    assert stored["counts"] == {
        "train": {"recordings": 3, "windows": 3 * 36},
        "val": {"recordings": 2, "windows": 2 * 72},  # validation and test have every window, whatever the stride
    }
    assert stored["params"] == to_json(params(stride=2, loss="absolute"))
    fitted = ("autoregression", "plan_by_load", "ridge", "ridge_actions")
    assert set(stored["baselines"]) == {f"{name}.alpha" for name in fitted}


def test_scales_are_those_of_numpy_over_the_training_rows(tmp_path: Path) -> None:
    stored = config(trained(tmp_path, dataset(*TRAIN), epochs=1))["scaling"]
    columns = [[shard.content[name].to_numpy() for name in CHANNELS] for shard in TRAIN]
    values = np.concatenate(columns, axis=1).astype(np.float64)  # (channel, time)
    assert np.allclose(stored["channel_count"], values.std(axis=1), rtol=1e-6)
    assert np.allclose(stored["feature_half"], np.ptp(values, axis=1) / 2, rtol=1e-5)


def test_validation_recordings_change_neither_scales_nor_baselines_other_than_alpha_and_shrinkage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(linear, "ALPHAS", (10.0,))
    wild = FakeShard("wild", table(np.random.default_rng(0).normal(0, 1e4, (40, len(CHANNELS)))))
    tame, wide = (
        trained(tmp_path / str(len(part)), dataset(*TRAIN), dataset(*part), epochs=1) for part in (VAL, [*VAL, wild])
    )
    assert config(tame)["scaling"] == config(wide)["scaling"]
    assert config(tame)["inputs"] == config(wide)["inputs"]
    first, second = load(tame["baselines.safetensors"]), load(wide["baselines.safetensors"])
    for name, values in first.items():
        if not name.endswith("shrinkage"):
            assert np.array_equal(values, second[name]), name
    scales, wide_scales = load(tame["model.safetensors"]), load(wide["model.safetensors"])
    for name in scales:
        if name.endswith(("_scale", "_mean")):
            assert np.array_equal(scales[name], wide_scales[name]), name


def test_a_channel_that_never_moves_and_one_recording_without_rows_do_no_harm(tmp_path: Path) -> None:
    def dead(shard: FakeShard) -> FakeShard:
        at = shard.content.column_names.index(CHANNELS[4])
        constant = pa.array(np.full(shard.content.num_rows, 16003.0, np.float32))
        return dataclasses.replace(
            shard, content=shard.content.set_column(at, shard.content.schema.field(at), constant)
        )

    recordings = dataset(*map(dead, TRAIN))
    files = trained(tmp_path / "dead", recordings, dataset(dead(VAL[0])), architecture="taxelwise")
    assert config(files)["scaling"]["channel_count"][4] == 1.0
    metrics, _ = evaluated(files, dead(motion(20)))
    assert np.isfinite(metrics["model"]["mse_standard"]["mean"])
    empty = FakeShard("empty", table(np.zeros((0, len(CHANNELS)))))
    with_empty = trained(tmp_path / "a", dataset(empty, *TRAIN), dataset(empty, *VAL), epochs=1)
    without = trained(tmp_path / "b", dataset(*TRAIN), dataset(*VAL), epochs=1)
    assert with_empty["model.safetensors"] == without["model.safetensors"]


def test_a_single_training_window_is_enough(tmp_path: Path) -> None:
    files = trained(tmp_path, dataset(motion(0, rows=9)), architecture="taxelwise", epochs=1)
    assert config(files)["counts"]["train"] == {"recordings": 1, "windows": 1}


def test_windows_are_all_or_those_in_contact(tmp_path: Path) -> None:
    contact = np.repeat([-1, 0, -1], [30, 30, 20])
    recording = motion(0)
    at = recording.content.column_names.index("contact")
    content = recording.content.set_column(at, recording.content.schema.field(at), pa.array(contact.astype(np.int32)))
    recordings = dataset(dataclasses.replace(recording, content=content))
    windows = {
        chosen: config(trained(tmp_path / chosen, recordings, recordings, epochs=1, windows=chosen))["counts"]["train"][
            "windows"
        ]
        for chosen in ("all", "contact")
    }
    assert windows == {"all": 72, "contact": 22}


@pytest.mark.parametrize("actions", ["planned", "none", "shuffled"])
def test_what_is_told_of_the_plan_decides_whether_it_helps(actions: str, tmp_path: Path) -> None:
    sizes = {"epochs": 15, "patience": 15, "learning_rate": 0.01, "baselines": False}
    validation = dataset(*map(strolling, range(30, 50)))  # half of the forecast would be persistence for one recording
    files = trained(tmp_path, dataset(*map(strolling, range(3))), validation, actions=actions, **sizes)
    metrics, _ = evaluated(files, strolling(20), strolling(21))
    skill = metrics["skill"]["mse_counts"][f"t{HORIZON}"]["mean"]
    assert skill > 0.9 if actions == "planned" else skill < 0.2


@pytest.mark.parametrize(
    ("architecture", "members"), [("recurrent", 1), ("taxelwise", 1), ("gru", 1), ("taxelwise", 2)]
)
def test_training_again_gives_the_same_bytes_and_another_seed_does_not(
    architecture: str, members: int, tmp_path: Path
) -> None:
    first, repeated, reseeded = (
        trained(tmp_path / name, architecture=architecture, members=members, epochs=1, seed=seed)
        for name, seed in (("a", 0), ("b", 0), ("c", 1))
    )
    assert first == repeated
    assert first["model.safetensors"] != reseeded["model.safetensors"]


@pytest.mark.parametrize(
    ("architecture", "actions", "members"),
    [("recurrent", "planned", 1), ("taxelwise", "planned", 1), ("gru", "shuffled", 1), ("gru", "planned", 2)],
)
def test_an_interrupted_training_goes_on_where_it_was(
    architecture: str, actions: str, members: int, tmp_path: Path
) -> None:
    options: dict[str, Any] = {"architecture": architecture, "actions": actions, "members": members}
    options |= {"epochs": 4, "hidden": 8}
    uninterrupted = trained(tmp_path / "whole", **options)
    with interrupted(tmp_path / "killed", epochs=3):
        trained(tmp_path / "killed", **options)
    assert trained(tmp_path / "killed", **options) == uninterrupted


@pytest.mark.parametrize("architecture", ["recurrent", "taxelwise"])
def test_a_model_begins_with_another_and_remembers_what_that_has_seen(architecture: str, tmp_path: Path) -> None:
    options: dict[str, Any] = {"architecture": architecture, "epochs": 6, "learning_rate": 0.01, "cycle": False}
    first = trained(tmp_path / "first", **options)
    requested = params(**{**options, "epochs": 1, "learning_rate": 1e-9})
    tuned = forward_training.train(requested, dataset(motion(5)), dataset(motion(10)), tmp_path / "tuned", first)
    for name, values in load(first["model.safetensors"]).items():
        assert np.allclose(load(tuned["model.safetensors"])[name], values, atol=1e-6), name
    assert losses(tuned)[0] == pytest.approx(min(losses(first)), rel=1e-4)
    assert config(tuned)["trained_on"] == {
        **{f"{shard.name} of the model before": shard.digest for shard in TRAIN},
        "trial-05": motion(5).digest,
        "trial-10": motion(10).digest,
    }


def test_a_model_that_begins_with_another_is_trained_by_its_own_loss_and_dropout(tmp_path: Path) -> None:
    first = trained(tmp_path / "first")
    trained_files = {
        name: forward_training.train(params(**changed), dataset(*TRAIN), dataset(*VAL), tmp_path / name, first)
        for name, changed in (("same", {}), ("loss", {"loss": "squared"}), ("dropout", {"dropout": 0.5}))
    }
    assert losses(trained_files["loss"]) != losses(trained_files["same"])
    assert trained_files["dropout"]["model.safetensors"] != trained_files["same"]["model.safetensors"]


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"hidden": 8}, "hidden 16 and the one to train 8"),
        ({"architecture": "lstm"}, "architecture gru and the one to train lstm"),
        ({"horizon": 3}, "horizon 4 and the one to train 3"),
    ],
)
def test_a_model_of_another_shape_is_nothing_to_begin_with(
    changed: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    with pytest.raises(TacpipeError, match=reason):
        forward_training.train(
            params(**changed), dataset(*TRAIN), dataset(*VAL), tmp_path / "b", trained(tmp_path / "a")
        )


def test_a_model_of_another_representation_is_nothing_to_begin_with(tmp_path: Path) -> None:
    latents = compressed(*TRAIN)
    first, watched = trained(tmp_path / "a"), compressed(*VAL, files=latents.files)
    with pytest.raises(TacpipeError, match="--init reads raw and the recordings hold PCA-3"):
        forward_training.train(params(), latents, watched, tmp_path / "b", first)
    of_another_codec = compressed(*VAL)
    model = forward_training.train(params(), latents, watched, tmp_path / "c")
    with pytest.raises(TacpipeError, match="another codec"):
        forward_training.train(params(), of_another_codec, of_another_codec, tmp_path / "d", model)


@pytest.mark.parametrize(("representation", "name"), [("levels", "PCA-3"), ("increments", "PCA-3 increments")])
def test_a_model_of_latents_holds_its_codec(representation: str, name: str, tmp_path: Path) -> None:
    training = compressed(*TRAIN, representation=representation)
    files = trained(tmp_path, training, compressed(*VAL, files=training.files))
    assert set(files) == FILES | {"codec.json", "codec.safetensors"}
    assert files["codec.safetensors"] == training.files["codec.safetensors"]
    assert config(files)["codec"]["name"] == name


def test_baselines_can_be_left_out(tmp_path: Path) -> None:
    files = trained(tmp_path, baselines=False)
    assert set(files) == FILES - {"baselines.safetensors"}
    assert "baselines" not in config(files)
    metrics, _ = evaluated(files, motion(20))
    assert {"model", "persistence", "context_mean", "skill", "counts", "situations"} == set(metrics)


def test_ground_truth_columns_change_nothing(tmp_path: Path) -> None:
    with_truth = [
        dataclasses.replace(shard, content=shard.content.append_column("gt_slip", pa.array(np.arange(80.0))))
        for shard in TRAIN
    ]
    files = [trained(tmp_path / name, dataset(*part), epochs=1) for name, part in (("a", with_truth), ("b", TRAIN))]
    assert files[0] == files[1]


def test_training_without_recordings_windows_or_touch_is_refused(tmp_path: Path) -> None:
    empty, short = dataset(), dataset(motion(1, rows=8))
    with pytest.raises(TacpipeError, match="no training recording"):
        forward_training.train(params(), empty, dataset(*VAL), tmp_path)
    with pytest.raises(TacpipeError, match="validation recordings contain no window"):
        forward_training.train(params(), dataset(*TRAIN), empty, tmp_path)
    with pytest.raises(TacpipeError, match="training recordings contain no window"):
        forward_training.train(params(), short, dataset(*VAL), tmp_path)
    constant = dataset(FakeShard("still", table(np.zeros((40, len(CHANNELS))))))
    with pytest.raises(TacpipeError, match="None of the 12 tactile channels ever moves in 1 training recordings"):
        forward_training.train(params(), constant, dataset(*VAL), tmp_path)


def test_an_error_that_gaps_cause_names_the_stream_and_the_option(tmp_path: Path) -> None:
    paused = [
        dataclasses.replace(shard, content=shard.content.append_column("sole_gap", pa.array(np.arange(80) % 4 > 0)))
        for shard in TRAIN
    ]
    with pytest.raises(TacpipeError, match=r"training recordings contain no window.*stream sole.*--gap-ms"):
        forward_training.train(params(), dataset(*paused), dataset(*VAL), tmp_path)


def test_training_on_rows_of_another_rate_or_grid_than_validation_is_refused(tmp_path: Path) -> None:
    fresh = dataclasses.replace(VAL[0], attributes={"grid": "fresh"})
    with pytest.raises(TacpipeError, match="not of one grid"):
        trained(tmp_path, validation=dataset(fresh))
