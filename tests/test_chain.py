import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

import tacpipe
from tacpipe import errors as tacpipe_errors
from tacpipe import upkeep
from tacpipe.store import Store
from tests import chain
from tests.conftest import sample_data
from tests.conftest import tacpipe as command


@pytest.fixture(scope="module")
def lab(chained: Path) -> Path:
    """A project in which the chain has run."""
    return chained


def metrics(folder: Path, results: str = "results/forward") -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    value: dict[str, dict[str, dict[str, dict[str, float]]]] = json.loads(
        (folder / results / "metrics.json").read_text()
    )
    return value


def test_every_step_has_a_finite_error_for_model_and_persistence(lab: Path) -> None:
    found = metrics(lab)
    for predictor in ("model", "persistence"):
        for step in range(1, 11):
            for measure in ("mse_counts", "mae_counts"):
                for group in ("both", "sensor1", "sensor2"):
                    value = found[predictor][measure][group][f"t{step}"]
                    assert math.isfinite(value) and value > 0
    assert found["skill"]["mse_counts"]["t10"]["low"] <= found["skill"]["mse_counts"]["t10"]["high"]


def test_persistence_is_what_numpy_computes_from_the_segments(lab: Path) -> None:
    split = tacpipe.open(lab / "data/split").to_pandas(columns=["recording", "role"])
    test = set(split["recording"][split["role"] == "test"])
    errors = []
    for name, shard in tacpipe.open(lab / "data/segments").shards.items():
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
    assert metrics(lab)["persistence"]["mse_counts"]["both"]["t10"] == pytest.approx(np.mean(errors), rel=1e-4)


def test_a_rerun_of_the_chain_does_nothing(lab: Path) -> None:
    for words in chain.CHAIN:
        done = command(lab, f"{words} --json")
        assert json.loads(done.stdout)["ran"] == 0, words


def test_a_model_evaluates_recordings_from_wherever_they_stand(lab: Path) -> None:
    for given in ("recordings", "synced", "segments"):
        done = command(lab, f"evaluate models/forward data/{given} --split data/split -o results/{given}")
        assert done.returncode == 0, done.stderr
        assert metrics(lab, f"results/{given}") == metrics(lab)


def test_a_dataset_that_went_another_way_is_refused_with_the_param_that_differs(lab: Path) -> None:
    assert command(lab, "synchronize data/recordings -o data/slow --rate-hz 25").returncode == 0
    done = command(lab, "evaluate models/forward data/slow -o results/slow")
    assert done.returncode == 2 and "rate_hz 25.0 instead of 50.0" in done.stderr
    assert not (lab / "results/slow").exists()


def test_recordings_that_the_model_was_trained_on_are_reported_apart(lab: Path) -> None:
    assert command(lab, "evaluate models/forward data/latents -o results/all").returncode == 0
    found = metrics(lab, "results/all")
    assert found["seen"] and found["model"] == metrics(lab)["model"]


def test_an_empty_clone_pulls_a_model_and_its_data_and_evaluates(lab: Path, tmp_path: Path) -> None:
    remote, clone = tmp_path / "remote", tmp_path / "clone"
    (clone / ".tacpipe").mkdir(parents=True)
    datasets = "models/forward data/latents data/split"
    assert command(lab, f"store push {remote} {datasets}").returncode == 0
    assert command(clone, f"store pull {remote} {datasets}").returncode == 0
    done = command(clone, "evaluate models/forward data/latents --split data/split -o results/forward")
    assert done.returncode == 0, done.stderr
    assert metrics(clone) == metrics(lab)
    assert upkeep.verify(Store(clone / ".tacpipe")).clean


def test_a_model_can_begin_with_another_and_remembers_what_that_has_seen(lab: Path) -> None:
    train = f"{chain.TRAIN} --epochs 1 --no-baselines"
    done = command(lab, f"{train} --init models/forward -o models/tuned --learning-rate 0.0001")
    assert done.returncode == 0, done.stderr
    first, tuned = (
        [json.loads(line) for line in (lab / f"models/{name}/history.jsonl").read_text().splitlines()]
        for name in ("forward", "tuned")
    )
    assert tuned[0]["val_loss"] < first[0]["val_loss"]
    assert json.loads((lab / "models/tuned/config.json").read_text())["trained_on"]
    done = command(lab, f"{train} --init models/forward -o models/wrong --hidden 8")
    assert done.returncode == 1 and "hidden 16" in done.stderr


def test_a_model_is_loaded_and_predicts_from_python(lab: Path) -> None:
    model = tacpipe.load(lab / "models/forward")
    channels, pose = 96, [0.5, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0]
    window = np.concatenate([np.zeros((3, 10, channels)), np.tile(pose, (3, 10, 1))], axis=-1)
    predicted = model.predict(window, np.tile(pose, (3, 10, 1)))
    assert predicted.shape == (3, 10, channels) and np.isfinite(predicted).all()
    with pytest.raises(tacpipe_errors.UsageError, match="no model"):
        tacpipe.load(lab / "data/latents")


def test_a_preset_changes_what_would_run(lab: Path) -> None:
    printed = command(lab, "train forward data/latents --preset paper --print-params").stdout
    assert json.loads(printed)["batch"] == 32


def test_a_new_recording_gets_a_role_and_the_others_keep_theirs(lab: Path) -> None:
    more = "simulate forward -o data/more --trials 9 --duration-s 5"
    for words in (more, "synchronize data/more -o data/more-s", "segment contacts data/more-s -o data/more-c"):
        assert command(lab, words).returncode == 0
    words = "compress pca data/more-c --split data/split -o data/more-z --components 6"
    assert "1 recordings have no role" in command(lab, words).stderr
    words = "split data/more-c -o data/more-split --extend data/split --seed 3 --val 0.25 --test 0.25"
    done = command(lab, words)
    assert done.returncode == 0, done.stderr
    old, new = (tacpipe.open(lab / path).to_pandas() for path in ("data/split", "data/more-split"))
    assert len(new) == 9 and set(zip(old["recording"], old["role"], strict=True)) < set(
        zip(new["recording"], new["role"], strict=True)
    )


def test_duckdb_reads_the_shards_that_lie_beside_the_manifest(lab: Path) -> None:
    import duckdb

    glob = lab / "data/latents/*.parquet"
    rows = duckdb.execute(f"select count(*), avg(xela1_taxel01_z), avg(z00) from '{glob}'").fetchall()
    assert rows[0][0] == sum(
        entry["shards"][""]["rows"] for entry in tacpipe.open(lab / "data/latents").source.recordings.values()
    )


def test_training_that_was_killed_resumes_and_ends_with_the_same_weights(lab: Path, tmp_path: Path) -> None:
    shutil.copytree(lab, tmp_path / "lab", symlinks=True)
    folder = tmp_path / "lab"
    train = "train forward data/latents --split data/split --architecture gru --hidden 8 --epochs 3 --seed 5"
    train += " --no-baselines"
    assert command(folder, f"{train} -o models/whole").returncode == 0
    whole = (folder / "models/whole/model.safetensors").read_bytes()
    store = Store(folder / ".tacpipe")
    for path in store.root.glob("records/*/*.json"):
        if b'"train.forward"' in path.read_bytes() and b'"seed": 5' in path.read_bytes():
            path.unlink()
    script = (
        "import os, sys; from tacpipe.training import checkpoint; from tacpipe import cli;"
        f"sys.argv = ['tacpipe', *'{train} -o models/again'.split()];"
        "honest = checkpoint.write\n"
        "def write(*given, **named):\n    honest(*given, **named); os._exit(9)\n"
        "checkpoint.write = write\ncli.main()"
    )
    import subprocess
    import sys

    killed = subprocess.run([sys.executable, "-c", script], cwd=folder, check=False)
    assert killed.returncode == 9 and list(store.root.glob("checkpoints/*/*"))
    assert command(folder, f"{train} -o models/again").returncode == 0
    assert (folder / "models/again/model.safetensors").read_bytes() == whole
    assert not list(store.root.glob("checkpoints/*"))


@pytest.mark.data
@pytest.mark.skipif(not (sample_data() / "xela_flat_pick_move").exists(), reason="published recordings are not here")
def test_the_chain_runs_on_published_recordings(tmp_path: Path) -> None:
    source = tmp_path / "published"
    source.mkdir()
    for trial in sorted((sample_data() / "xela_flat_pick_move").iterdir())[4:14:2]:
        (source / trial.name).symlink_to(trial)
    (tmp_path / ".tacpipe").mkdir()
    first = f"ingest xela-flat {source} -o data/recordings"
    split = "split data/segments -o data/split --scheme random --val 0.2 --test 0.2"
    for words in (first, chain.CHAIN[1], chain.CHAIN[2], split, *chain.CHAIN[4:]):
        done = command(tmp_path, words)
        assert done.returncode == 0, f"{words}: {done.stderr}"
    found = metrics(tmp_path)
    assert all(math.isfinite(found["model"]["mse_counts"]["both"][f"t{step}"]) for step in range(1, 11))
