import json
import shutil
from pathlib import Path

import pytest

import tacpipe
from tacpipe import upkeep
from tacpipe.store import Store
from tests.conftest import Lab
from tests.test_pipeline import counts


@pytest.fixture
def clone(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty clone beside a lab that pushed its datasets to ``remote``."""
    lab.run("simulate toy -o data/r --trials 4 --rows 3")
    lab.run("scale data/r -o data/s --factor 1")
    lab.run("halves data/s -o data/split")
    lab.run("centre data/s --split data/split -o data/c")
    remote = lab.folder.with_name(f"{lab.folder.name}-remote")
    lab.run(f"store push {remote} data/s data/split data/c")
    folder = lab.folder.with_name(f"{lab.folder.name}-clone")
    (folder / ".tacpipe").mkdir(parents=True)
    monkeypatch.chdir(folder)
    return folder


def remote_of(lab: Lab) -> Path:
    return lab.folder.with_name(f"{lab.folder.name}-remote")


def test_an_empty_clone_pulls_what_was_pushed_and_works_on_it(lab: Lab, clone: Path) -> None:
    lab.run(f"store pull {remote_of(lab)} data/s data/split data/c")
    wanted = (lab.folder / "data/c/manifest.json").read_bytes()
    assert Path("data/c/manifest.json").read_bytes() == wanted
    assert counts(lab.run("centre data/s --split data/split -o data/again --json").out) == (0, 4)
    assert Path("data/again/manifest.json").read_bytes() == wanted
    assert upkeep.verify(Store(clone / ".tacpipe")).clean


def test_a_manifest_that_git_brought_is_enough_to_pull(lab: Lab, clone: Path) -> None:
    Path("data/c").mkdir(parents=True)
    shutil.copy(lab.folder / "data/c/manifest.json", "data/c/manifest.json")
    lab.run(f"store pull {remote_of(lab)} data/c")
    assert sorted(tacpipe.open("data/c").to_numpy()) == ["trial-000", "trial-001", "trial-002", "trial-003"]


def test_a_second_push_or_pull_moves_nothing(lab: Lab, clone: Path) -> None:
    lab.run(f"store pull {remote_of(lab)} data/s")
    assert json.loads(lab.run(f"store pull {remote_of(lab)} data/s --json").out)["objects"] == 0


def test_a_pull_brings_back_what_was_damaged_here(lab: Lab, clone: Path) -> None:
    lab.run(f"store pull {remote_of(lab)} data/s")
    store = Store(clone / ".tacpipe")
    for path in store.root.glob("objects/*/*"):
        path.unlink()
    for path in Path("data/s").glob("*.parquet"):
        path.unlink()
    lab.run(f"store pull {remote_of(lab)} data/s")
    assert tacpipe.open("data/s").to_numpy()["trial-001"].values[:, 0].tolist() == [0, 2, 4]


def test_what_is_damaged_there_is_not_brought_here(lab: Lab, clone: Path) -> None:
    name = lab.manifest("data/s").recordings["trial-003"]["shards"][""]["digest"]
    path = remote_of(lab) / "objects" / name[:2] / name
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    for record in remote_of(lab).glob("records/*/*"):
        record.unlink()
    failed = lab.call(f"store pull {remote_of(lab)} data/s")
    assert failed.code == 4 and "trial-003.parquet" in failed.err
    assert not Path("data/s/manifest.json").exists()


def test_a_dataset_that_was_never_pushed_is_named_with_those_that_were(lab: Lab, clone: Path) -> None:
    failed = lab.call(f"store pull {remote_of(lab)} data/r")
    assert failed.code == 2 and "data/c, data/s, data/split" in failed.err


def test_recordings_go_along_with_ancestors(lab: Lab, clone: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(lab.folder)
    lab.run(f"store push {remote_of(lab)} data/c --ancestors")
    names = {name for _, name in lab.manifest("data/r").objects()}
    assert all(Store(remote_of(lab)).has(name) for name in names)
