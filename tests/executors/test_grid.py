"""Test that one command for several folds gives the results of single folds, each in its own folder."""

import time
from pathlib import Path

import pytest

from tacpipe.engine import grid
from tacpipe.training.following import Line, TrainedNetwork
from tests.conftest import Lab

FOLDS = 3


@pytest.fixture
def split_lab(lab: Lab) -> Lab:
    lab.run("simulate toy -o data/rec --trials 6 --jobs 1")
    lab.run("scale data/rec -o data/one --jobs 1")
    lab.run(f"split data/one -o data/split --scheme kfold --folds {FOLDS}")
    return lab


@pytest.mark.parametrize("executor", ["local", pytest.param("dask", marks=pytest.mark.long)])
def test_several_folds_give_what_each_alone_gives(
    split_lab: Lab, executor: str, request: pytest.FixtureRequest
) -> None:
    name = "local" if executor == "local" else request.getfixturevalue("scheduler")
    for fold in range(FOLDS):
        split_lab.run(f"centre data/one --split data/split --fold {fold} -o data/alone-{fold}")
    ran = split_lab.run(
        f"centre data/one --split data/split --fold 0-{FOLDS - 1} -o data/all-{{fold}} --rerun --jobs 2 --executor {name}"
    )
    assert sorted(ran.out.split()) == [f"data/all-{fold}" for fold in range(FOLDS)]
    for fold in range(FOLDS):
        assert split_lab.manifest(f"data/all-{fold}").content == split_lab.manifest(f"data/alone-{fold}").content


def test_a_fold_that_fails_keeps_no_other_from_its_result(split_lab: Lab) -> None:
    ran = split_lab.call("centre data/one --split data/split --fold 0,9 -o data/all-{fold}")
    assert ran.code == 2
    assert "fold 9" in ran.err
    assert "1 of 2 folds" in ran.err
    assert split_lab.manifest("data/all-0").recordings


@pytest.mark.parametrize(("fold", "words"), [("x", "'x'"), ("3-1", "'3-1'"), ("-1", "-1"), ("0-1", "data/out-{fold}")])
def test_folds_that_make_no_sense_are_refused(split_lab: Lab, fold: str, words: str) -> None:
    ran = split_lab.call(f"centre data/one --split data/split --fold={fold} -o data/out")
    assert ran.code == 2
    assert words in ran.err
    assert not (split_lab.folder / "data/out").exists()


TRAIN = "train forward data/segments --split data/split --hidden 8 --epochs 2"
EPOCH: Line = {"epoch": 1, "train_loss": 1.0, "val_loss": 0.5}


def test_what_is_left_of_all_networks_is_added_up(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 10.0, 11.0, 13.0, 15.0])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    stopwatch = grid._Stopwatch()
    stopwatch.begin(TrainedNetwork(epochs=20, number=2, count=3), [EPOCH] * 5)
    stopwatch.batch(0.1, lambda: 0.0)  # the first one is not counted
    stopwatch.batch(0.2, lambda: 0.0)
    with pytest.raises(grid._TimedError):
        stopwatch.batch(0.3, lambda: 0.0)
    epoch_s = (15 - 11) / 0.2
    assert stopwatch.all_s == pytest.approx(10 + epoch_s * (15 + 20))


@pytest.mark.long
def test_a_grid_of_trainings_is_estimated_before_it_begins_and_a_hit_is_not(lab: Lab) -> None:
    lab.run("simulate forward -o data/rec --trials 4 --duration-s 4 --tactile-rate-hz 25 --robot-rate-hz 50 --jobs 1")
    lab.run("synchronize data/rec -o data/synced --rate-hz 25 --jobs 1")
    lab.run("segment contacts data/synced -o data/segments --jobs 1")
    lab.run("split data/segments -o data/split --scheme kfold --folds 2 --val 0.5")
    lab.run(f"{TRAIN} --fold 0 -o models/alone")
    ran = lab.run(f"{TRAIN} --fold 0-1 -o models/all-{{fold}} --jobs 1")
    assert "estimate: 1 model to train" in ran.err
    assert ran.err.index("estimate") < ran.err.index("1 ran")
    assert lab.manifest("models/all-0").content == lab.manifest("models/alone").content
    assert not list(Path(".tacpipe/checkpoints").glob("*"))
    assert "estimate" not in lab.run(f"{TRAIN} --fold 0-1 -o models/all-{{fold}} --jobs 1").err
    assert "estimate" not in lab.run(f"{TRAIN} --fold 0-1 -o models/new-{{fold}} --jobs 1 --quiet --rerun").err
