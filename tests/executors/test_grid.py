"""Test that one command for several folds gives the results of single folds, each in its own folder."""

from __future__ import annotations

import pytest

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
