import json
import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import tacpipe
from tacpipe import errors as tacpipe_errors
from tacpipe.maintenance import repair
from tacpipe.store.store import Store
from tests import chain
from tests.conftest import Lab, Ran, sample_data


@pytest.fixture
def lab(chained: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[[str], Ran]) -> Lab:
    """A project in which the chain has run, each command in a process of its own; those of the tests run in this one."""
    monkeypatch.chdir(chained)
    monkeypatch.delenv("TACPIPE_STORE", raising=False)
    return Lab(chained, call)


def metrics(folder: Path, results: str = "results/forward") -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    value: dict[str, dict[str, dict[str, dict[str, float]]]] = json.loads(
        (folder / results / "metrics.json").read_text()
    )
    return value


def test_every_step_has_a_finite_error_for_model_and_persistence(lab: Lab) -> None:
    report = metrics(lab.folder)
    for predictor in ("model", "persistence"):
        for step in range(1, 11):
            for measure in ("mse_counts", "mae_counts"):
                for group in ("both", "sensor1", "sensor2"):
                    value = report[predictor][measure][group][f"t{step}"]
                    assert math.isfinite(value) and value > 0
    assert math.isfinite(report["skill"]["mae_counts_geometric"]["t10"]["mean"])


def test_persistence_is_what_numpy_computes_from_the_segments(lab: Lab) -> None:
    split = tacpipe.open(lab.folder / "data/split").to_pandas(columns=["recording", "role"])
    test = set(split["recording"][split["role"] == "test"])
    errors = []
    for name, shard in tacpipe.open(lab.folder / "data/segments").recordings.items():
        if name not in test:
            continue
        table = shard.table()
        columns = [column for column in table.column_names if "_taxel" in column]
        values = np.column_stack([table[column].to_numpy() for column in columns]).astype(float)
        gap = np.any([table[column].to_numpy() for column in table.column_names if column.endswith("_gap")], axis=0)
        for start in range(len(values) - 19):
            window = slice(start, start + 20)
            if not gap[window].any():
                errors.append((values[start + 9 + 10] - values[start + 9]) ** 2)
    assert metrics(lab.folder)["persistence"]["mse_counts"]["both"]["t10"] == pytest.approx(np.mean(errors), rel=1e-4)


def test_a_rerun_of_the_chain_does_nothing(lab: Lab) -> None:
    for words in chain.CHAIN:
        result = lab.call(f"{words} --json")
        assert json.loads(result.out)["ran"] == 0, words


def test_a_model_evaluates_recordings_from_wherever_they_stand(lab: Lab) -> None:
    for stage in ("recordings", "synced", "segments"):
        result = lab.call(f"evaluate models/forward data/{stage} --split data/split -o results/{stage}")
        assert result.code == 0, result.err
        assert metrics(lab.folder, f"results/{stage}") == metrics(lab.folder)


def test_a_dataset_that_went_another_way_is_refused_with_the_param_that_differs(lab: Lab) -> None:
    assert lab.call("synchronize data/recordings -o data/slow --rate-hz 25").code == 0
    result = lab.call("evaluate models/forward data/slow -o results/slow")
    assert result.code == 2 and "rate_hz 25.0 instead of None" in result.err
    assert not (lab.folder / "results/slow").exists()


def test_recordings_that_the_model_was_trained_on_are_reported_apart(lab: Lab) -> None:
    assert lab.call("evaluate models/forward data/latents -o results/all").code == 0
    report = metrics(lab.folder, "results/all")
    assert report["seen"] and report["model"] == metrics(lab.folder)["model"]


def test_an_empty_clone_pulls_a_model_and_its_data_and_evaluates(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    remote, clone = tmp_path / "remote", tmp_path / "clone"
    (clone / ".tacpipe").mkdir(parents=True)
    datasets = "models/forward data/latents data/split"
    assert lab.call(f"store push {remote} {datasets}").code == 0
    monkeypatch.chdir(clone)
    assert lab.call(f"store pull {remote} {datasets}").code == 0
    result = lab.call("evaluate models/forward data/latents --split data/split -o results/forward")
    assert result.code == 0, result.err
    assert metrics(clone) == metrics(lab.folder)
    assert repair.verify(Store(clone / ".tacpipe")).clean


def test_a_model_can_begin_with_another_and_remembers_what_that_has_seen(lab: Lab) -> None:
    train = f"{chain.TRAIN} --epochs 1 --no-baselines"
    result = lab.call(f"{train} --init models/forward -o models/tuned --learning-rate 0.0001")
    assert result.code == 0, result.err
    first, tuned = (
        [json.loads(line) for line in (lab.folder / f"models/{name}/history.jsonl").read_text().splitlines()]
        for name in ("forward", "tuned")
    )
    assert tuned[0]["val_loss"] < first[0]["val_loss"]
    assert json.loads((lab.folder / "models/tuned/config.json").read_text())["trained_on"]
    result = lab.call(f"{train} --init models/forward -o models/wrong --hidden 8")
    assert result.code == 1 and "hidden 16" in result.err


def test_a_model_is_loaded_and_predicts_from_python(lab: Lab) -> None:
    model = tacpipe.load(lab.folder / "models/forward")
    channels, pose = 96, [0.5, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0]
    window = np.concatenate([np.zeros((3, 10, channels)), np.tile(pose, (3, 10, 1))], axis=-1)
    predicted = model.predict(window, np.tile(pose, (3, 10, 1)))
    assert predicted.shape == (3, 10, channels) and np.isfinite(predicted).all()
    with pytest.raises(tacpipe_errors.UsageError, match="not a model"):
        tacpipe.load(lab.folder / "data/latents")


@pytest.mark.parametrize(("dataset", "architecture"), [("data/latents", "gru"), ("data/segments", "taxelwise")])
def test_train_without_options_reads_whatever_the_chain_gives(lab: Lab, dataset: str, architecture: str) -> None:
    result = lab.call(
        f"train forward {dataset} --split data/split --preset quick --epochs 1 -o models/of-{architecture}"
    )
    assert result.code == 0, result.err
    config = json.loads((lab.folder / f"models/of-{architecture}/config.json").read_text())
    assert config["architecture"] == config["params"]["architecture"] == architecture
    result = lab.call(f"evaluate models/of-{architecture} {dataset} --split data/split -o results/of-{architecture}")
    assert result.code == 0, result.err


def test_a_model_predicts_from_python_what_the_command_writes_to_the_last_bit(lab: Lab) -> None:
    model, dataset = tacpipe.load(lab.folder / "models/forward"), tacpipe.open(lab.folder / "data/latents")
    lab.run("predict models/forward data/latents -o data/predicted")
    lab.run("predict models/forward data/latents -o data/predicted2 --steps 2,7")
    assert model.predict(dataset).equals(tacpipe.open(lab.folder / "data/predicted").table())
    expected = tacpipe.open(lab.folder / "data/predicted2").table()
    assert model.predict(dataset, steps=[7, 2]).equals(expected)
    predicted = model.predict(dataset.recordings["trial-003"], steps=[2, 7])
    of_it = [row for row in expected.to_pylist() if row["recording"] == "trial-003"]
    assert predicted.num_rows and predicted.to_pylist() == of_it


def test_windows_of_a_recording_give_its_predictions_and_hold_its_columns_less_rest(lab: Lab) -> None:
    model = tacpipe.load(lab.folder / "models/forward")
    shard = tacpipe.open(lab.folder / "data/latents").recordings["trial-003"]
    window, plan, t_ns = model.windows(shard)
    table, predicted = shard.table(), model.predict(shard, steps=[4])
    assert t_ns.tolist() == predicted["t_ns"].to_pylist()
    assert window.shape[2] == len(model.window_columns) + len(model.derived_columns) + 1
    assert plan.shape[2] == len(model.plan_columns) + len(model.derived_columns)
    row = table["t_ns"].to_pylist().index(int(t_ns[5]))
    for index, name in enumerate(model.window_columns):
        rest_value = float((table.schema.field(name).metadata or {}).get(b"rest", 0.0))
        assert window[5, -1, index] == pytest.approx(table[name][row].as_py() - rest_value, rel=1e-6, abs=1e-6), name
    for index, name in enumerate(model.plan_columns):
        assert plan[5, 0, index] == pytest.approx(table[name][row + 1].as_py(), rel=1e-6)
    steps = model.predict(window, plan)[:, 3]  # (window, channel)
    for index, name in enumerate(model.codec.channels):
        np.testing.assert_allclose(steps[:, index], predicted[f"{name}_t4"].to_numpy(), atol=0.05)


def test_recordings_that_lack_stages_of_the_model_go_through_them_first(lab: Lab) -> None:
    model = tacpipe.load(lab.folder / "models/forward")
    predicted = model.predict(tacpipe.open(lab.folder / "data/latents"))
    for stage in ("recordings", "segments"):
        assert model.predict(tacpipe.open(lab.folder / "data" / stage)).equals(predicted)
    from_segments, from_latents = (
        model.windows(tacpipe.open(lab.folder / "data" / name)["trial-000"]) for name in ("segments", "latents")
    )
    assert all(np.array_equal(actual, expected) for actual, expected in zip(from_segments, from_latents, strict=True))
    lab.run("synchronize data/recordings -o data/synced25 --rate-hz 25")
    with pytest.raises(tacpipe_errors.UsageError, match=r"rate_hz 25\.0 instead of None"):
        model.predict(tacpipe.open(lab.folder / "data/synced25"))
    with pytest.raises(tacpipe_errors.UsageError, match="str"):
        model.predict("data/latents")


def test_a_preset_changes_what_would_run(lab: Lab) -> None:
    printed = lab.call("train forward data/latents --preset paper --print-params").out
    assert json.loads(printed)["batch"] == 32


def test_a_new_recording_gets_a_role_and_the_others_keep_theirs(lab: Lab) -> None:
    simulate = "simulate forward -o data/more --trials 9 --duration-s 5"
    for words in (simulate, "synchronize data/more -o data/more-s", "segment contacts data/more-s -o data/more-c"):
        assert lab.call(words).code == 0
    words = "compress pca data/more-c --split data/split -o data/more-z --components 6"
    assert "1 recordings have no role" in lab.call(words).err
    words = "split data/more-c -o data/more-split --extend data/split --seed 3 --val 0.25 --test 0.25"
    result = lab.call(words)
    assert result.code == 0, result.err
    old, new = (tacpipe.open(lab.folder / path).to_pandas() for path in ("data/split", "data/more-split"))
    assert len(new) == 9 and set(zip(old["recording"], old["role"], strict=True)) < set(
        zip(new["recording"], new["role"], strict=True)
    )


def test_duckdb_reads_the_shards_that_lie_beside_the_manifest(lab: Lab) -> None:
    import duckdb

    glob = lab.folder / "data/latents/*.parquet"
    rows = duckdb.execute(f"select count(*), avg(xela1_taxel01_z), avg(z00) from '{glob}'").fetchall()
    assert rows[0][0] == sum(
        entry["shards"][""]["rows"] for entry in tacpipe.open(lab.folder / "data/latents").source.recordings.values()
    )


@pytest.mark.long
def test_training_that_was_killed_resumes_and_ends_with_the_same_weights(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(lab.folder, tmp_path / "lab", symlinks=True)
    monkeypatch.chdir(folder)
    train = "train forward data/latents --split data/split --architecture gru --hidden 8 --epochs 3 --seed 5"
    train += " --no-baselines"
    assert lab.call(f"{train} -o models/whole").code == 0
    weights = (folder / "models/whole/model.safetensors").read_bytes()
    store = Store(folder / ".tacpipe")
    for path in store.root.glob("records/*/*.json"):
        text = path.read_text().replace(" ", "")
        if '"train.forward"' in text and '"seed":5' in text:
            path.unlink()
    script = (
        "import os, sys; from tacpipe.training import loop; from tacpipe.cli import main as cli;sys.argv = ['tacpipe', "
        f"*'{train} -o models/again'.split()];honest = loop.write_checkpoint\ndef write(*given, **named):\n    "
        "honest(*given, **named); os._exit(9)\nloop.write_checkpoint = write\ncli.main()"
    )
    killed = subprocess.run([sys.executable, "-c", script], cwd=folder, check=False)
    assert killed.returncode == 9 and list(store.root.glob("checkpoints/*/*"))
    assert lab.call(f"{train} -o models/again").code == 0
    assert (folder / "models/again/model.safetensors").read_bytes() == weights
    assert not list(store.root.glob("checkpoints/*"))


@pytest.mark.long
@pytest.mark.data
@pytest.mark.skipif(not (sample_data() / "xela_flat_pick_move").exists(), reason="published recordings are not here")
def test_the_chain_runs_on_published_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[[str], Ran]
) -> None:
    source = tmp_path / "published"
    source.mkdir()
    for trial in sorted((sample_data() / "xela_flat_pick_move").iterdir())[4:14:2]:
        (source / trial.name).symlink_to(trial)
    (tmp_path / ".tacpipe").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TACPIPE_FOLLOW_LINKS", "1")
    monkeypatch.delenv("TACPIPE_STORE", raising=False)
    first = f"ingest xela-flat {source} -o data/recordings"
    split = "split data/segments -o data/split --scheme random --val 0.2 --test 0.2"
    for words in (first, chain.CHAIN[1], chain.CHAIN[2], split, *chain.CHAIN[4:]):
        result = call(words)
        assert result.code == 0, f"{words}: {result.err}"
    report = metrics(tmp_path)
    assert all(math.isfinite(report["model"]["mse_counts"]["both"][f"t{step}"]) for step in range(1, 11))
