import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

import tacpipe
from tacpipe.io import regular
from tacpipe.io.hashing import bytes_digest
from tacpipe.io.hashing import digest as values_digest
from tacpipe.maintenance import repair
from tacpipe.store import projects
from tacpipe.store.roots import HISTORY, Roots
from tacpipe.store.store import MissingError, Store
from tests.conftest import Lab, write_source
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
    content = (lab.folder / "data/c/manifest.json").read_bytes()
    assert Path("data/c/manifest.json").read_bytes() == content
    assert counts(lab.run("centre data/s --split data/split -o data/again --json").out) == (0, 4)
    assert Path("data/again/manifest.json").read_bytes() == content
    assert repair.verify(Store(clone / ".tacpipe")).clean


def test_a_manifest_that_git_brought_is_enough_to_pull(lab: Lab, clone: Path) -> None:
    Path("data/c").mkdir(parents=True)
    shutil.copy(lab.folder / "data/c/manifest.json", "data/c/manifest.json")
    lab.run(f"store pull {remote_of(lab)} data/c")
    assert sorted(tacpipe.open("data/c").to_numpy()) == ["trial-000", "trial-001", "trial-002", "trial-003"]


def test_a_second_push_or_pull_moves_nothing(lab: Lab, clone: Path) -> None:
    lab.run(f"store pull {remote_of(lab)} data/s")
    assert lab.run_json(f"store pull {remote_of(lab)} data/s")["objects"] == 0


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


# ---- names and snapshots


@pytest.fixture
def two(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Lab:
    """Two projects, ``one`` and ``two``, each with other recordings at ``data/r``."""
    for name, trials in (("one", 2), ("two", 3)):
        (lab.folder / name / ".tacpipe").mkdir(parents=True)
        enter(lab, name, monkeypatch)
        lab.run(f"simulate toy -o data/r --trials {trials} --rows 3")
    return lab


def enter(lab: Lab, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(lab.folder / name)


def age(store: Path) -> None:
    """Let all that lies in a store have been written long ago, for `gc`."""
    for path in store.rglob("*"):
        os.utime(path, (1_500_000_000, 1_500_000_000))


def collect(lab: Lab, store: Path, options: str = "") -> None:
    age(store)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TACPIPE_STORE", str(store))
        lab.run(f"store gc {options}")


def snapshots(lab: Lab) -> list[tuple[str, str, str]]:
    """Return project, path and state of all that was pushed, newest first where a project pushed."""
    listed = lab.run_json(f"store list --remote {lab.folder}/remote")["manifests"]
    return [(entry["project"], entry["path"], entry["state"]) for entry in listed]


def test_two_projects_push_the_same_path_and_each_pulls_its_own(two: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    contents = {}
    for name in ("one", "two"):
        enter(two, name, monkeypatch)
        assert f"pushed {name}:data/r: " in two.run("store push ../remote data/r").out
        contents[name] = Path("data/r/manifest.json").read_bytes()
    collect(two, two.folder / "remote", "--recordings")
    for name in ("one", "two"):
        enter(two, name, monkeypatch)
        shutil.rmtree("data/r")
        shutil.rmtree(".tacpipe/objects")
        two.run("store pull ../remote data/r")
        assert Path("data/r/manifest.json").read_bytes() == contents[name]
        assert repair.verify(Store(".tacpipe")).clean


def test_another_projects_dataset_is_pulled_by_its_name_which_the_refusal_gives(
    two: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("one", "two"):
        enter(two, name, monkeypatch)
        two.run("store push ../remote data/r")
    (two.folder / "third/.tacpipe").mkdir(parents=True)
    enter(two, "third", monkeypatch)
    failed = two.call("store pull ../remote data/r")
    assert failed.code == 2 and "but of others: one:data/r, two:data/r" in failed.err
    two.run("store pull ../remote two:data/r")
    assert Path("data/r/manifest.json").read_bytes() == (two.folder / "two/data/r/manifest.json").read_bytes()
    failed = two.call("store pull ../remote one:data/r")
    assert failed.code == 2 and "--replace" in failed.err
    two.run("store pull ../remote one:data/r --replace")
    assert Path("data/r/manifest.json").read_bytes() == (two.folder / "one/data/r/manifest.json").read_bytes()


def test_projects_of_the_same_name_are_told_apart_by_their_ids(two: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("one", "two"):
        (two.folder / name / "same/.tacpipe").mkdir(parents=True)
        enter(two, f"{name}/same", monkeypatch)
        two.run(f"simulate toy -o r --trials {len(name)} --rows {len(name) + (name == 'two')}")
        two.run("store push ../../remote r")
    names = [f"{project}:{path}" for project, path, _ in snapshots(two)]
    assert all(re.fullmatch(r"[0-9a-f]{8}:r", prefixed) for prefixed in names) and len(set(names)) == 2
    (two.folder / "third/.tacpipe").mkdir(parents=True)
    enter(two, "third", monkeypatch)
    assert two.call("store pull ../remote same:r").code == 2
    two.run(f"store pull ../remote {names[0]}")


def test_a_push_onto_what_somebody_else_pushed_since_is_refused_and_erases_nothing(
    two: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    enter(two, "one", monkeypatch)
    two.run("store push ../remote data/r")
    shutil.copytree(two.folder / "one", two.folder / "rig", ignore=shutil.ignore_patterns("leases"))
    enter(two, "rig", monkeypatch)
    two.run("label data/r trial-000 --label material=foam")
    two.run("store push ../remote data/r")
    enter(two, "one", monkeypatch)
    two.run("label data/r trial-001 --set material=cork")
    failed = two.call("store push ../remote data/r")
    assert failed.code == 2 and "holds another one:data/r" in failed.err and "--replace" in failed.err
    assert [state for *_, state in snapshots(two)].count("pushed here") == 1
    two.run("store push ../remote data/r --replace")
    collect(two, two.folder / "remote", "--recordings")
    assert len(snapshots(two)) == 3
    digests = [entry["manifest"] for entry in two.run_json("store list --remote ../remote")["manifests"]]
    labelled = set()
    for digest in digests:
        two.run(f"store checkout {digest} --remote ../remote -o back/{digest}")
        labelled.add(json.dumps(dict(two.manifest(f"one/back/{digest}").labels)))
    assert len(labelled) == 3, "each snapshot came back with its own labels"


def test_a_dataset_that_was_made_again_and_again_is_pushed_without_a_question(
    two: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    enter(two, "one", monkeypatch)
    two.run("store push ../remote data/r")
    for rows in range(4, 4 + HISTORY + 3):
        two.run(f"simulate toy -o data/r --trials 1 --rows {rows} --jobs 1")
    two.run("store push ../remote data/r")
    assert [state for *_, state in snapshots(two)] == ["pushed here", "pushed earlier"]


def test_what_was_pushed_earlier_is_kept_by_the_stated_rule(two: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    enter(two, "one", monkeypatch)
    for count in range(1, 4):  # recordings of each
        write_source("src", **{str(count): "1 2 3"})
        two.run("ingest numbers src -o data/i")
        two.run("store push ../remote data/i")
    for rows in range(1, HISTORY + 5):
        two.run(f"simulate toy -o data/r --trials 1 --rows {rows} --jobs 1")
        two.run("store push ../remote data/r")
    collect(two, two.folder / "remote", "--recordings")
    assert [path for _, path, _ in snapshots(two)].count("data/i") == 3
    assert [path for _, path, _ in snapshots(two)].count("data/r") == 1 + HISTORY
    newest, middle, oldest = (
        entry["manifest"]
        for entry in two.run_json("store list --remote ../remote")["manifests"]
        if entry["path"] == "data/i"
    )
    collect(two, two.folder / "remote", f"--recordings --forget {newest} --forget {oldest[:12]}")
    remaining = two.run_json("store list --remote ../remote")["manifests"]
    assert [(entry["manifest"], entry["state"]) for entry in remaining if entry["path"] == "data/i"] == [
        (middle, "pushed here")
    ]
    collect(two, two.folder / "remote", "--recordings --forget one:data/i --forget data/r")
    assert snapshots(two) == [] and not list((two.folder / "remote/objects").glob("*/*"))


def test_a_second_computer_joins_a_project_by_its_name(two: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    enter(two, "one", monkeypatch)
    two.run("store push ../remote data/r")
    (two.folder / "clone/.tacpipe").mkdir(parents=True)
    enter(two, "clone", monkeypatch)
    two.run("store pull ../remote data/r")
    failed = two.call("store push ../remote data/r --project three")
    assert failed.code == 2 and "no project is called three" in failed.err and "one (" in failed.err
    two.run("label data/r trial-000 --label material=foam")
    two.run("store push ../remote data/r --project one")
    two.run("store push ../remote data/r")
    assert snapshots(two) == [("one", "data/r", "pushed here"), ("one", "data/r", "pushed earlier")]


def test_a_store_elsewhere_serves_projects_without_a_mark_and_no_dataset_is_a_dot(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("unmarked")
    monkeypatch.setenv("TACPIPE_STORE", str(folder / "store"))
    remote = folder / "remote"
    for number, name in enumerate(("a", "b")):
        (folder / name).mkdir()
        monkeypatch.chdir(folder / name)
        for path in ("data/r", "data/s"):
            lab.run(f"simulate toy -o {path} --trials {len(path)} --rows {number + 1}")
        lab.run(f"store push {remote} data/r data/s")
    monkeypatch.chdir(folder / "a/data/r")
    lab.run(f"store push {remote} .")
    listed = lab.run_json(f"store list --remote {remote}")["manifests"]
    names = sorted(f"{entry['project']}:{entry['path']}" for entry in listed)
    assert names == ["a:data/r", "a:data/s", "b:data/r", "b:data/s", "data:r"]


@pytest.mark.parametrize(
    ("mark", "working_folder", "path", "name"),
    [
        (".git", "", "data/r", "data/r"),
        (".git", "data", "r", "data/r"),
        (".git", "", "data/../data/r", "data/r"),
        (".git", "data/r", ".", "data/r"),
        ("data/r/.git", "", "data/r", "r"),
        ("", "", "data/r", "data/r"),
        ("", "data/r", ".", "r"),
        ("", "elsewhere", "../data/r", "r"),
        ("", "elsewhere", "not/there", "not/there"),
    ],
)
def test_a_dataset_is_named_by_its_path_within_its_project(
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    mark: str,
    working_folder: str,
    path: str,
    name: str,
) -> None:
    folder = tmp_path_factory.mktemp("named")
    for place in ("data/r", "elsewhere", *([mark] if mark else [])):
        (folder / place).mkdir(parents=True, exist_ok=True)
    monkeypatch.chdir(folder / working_folder)
    assert projects.place(Path(path))[1] == name


def test_one_push_of_a_name_waits_for_another(two: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    enter(two, "one", monkeypatch)
    two.run("store push ../remote data/r")
    remote = Store(two.folder / "remote")
    (root,) = remote.roots.all()
    monkeypatch.setenv("TACPIPE_LOCK_TIMEOUT_S", "0.05")
    with remote.leases.hold(values_digest(["pushed", root["project"]["id"], "data/r"]), "by another computer"):
        assert two.call("store push ../remote data/r").code == 6


def test_a_damaged_identity_is_not_replaced_by_another(two: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    enter(two, "one", monkeypatch)
    two.run("store push ../remote data/r")
    (file,) = Path(".tacpipe/projects").iterdir()
    file.write_text(file.read_text().replace('"name": "one"', '"name": "owe"'))
    failed = two.call("store push ../remote data/r")
    assert failed.code == 4 and "--project" in failed.err
    two.run("store push ../remote data/r --project one")
    assert snapshots(two) == [("one", "data/r", "pushed here")]


# ---- damage in the other store


@pytest.mark.parametrize("size", [0, 100, 10**6])
def test_a_push_replaces_what_has_another_size_there(
    lab: Lab, clone: Path, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    monkeypatch.chdir(lab.folder)
    manifest = lab.manifest("data/s")
    name = manifest.recordings["trial-003"]["shards"][""]["digest"]
    path = Path(Store(remote_of(lab)).object_path(name))
    content = path.read_bytes()
    path.chmod(0o644)
    os.truncate(path, size)
    outcome = lab.run_json(f"store push {remote_of(lab)} data/s")
    assert (outcome["objects"], outcome["replaced"], path.read_bytes()) == (1, 1, content)


def test_a_push_that_verifies_replaces_what_has_other_bytes_there(
    lab: Lab, clone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(lab.folder)
    name = lab.manifest("data/s").recordings["trial-003"]["shards"][""]["digest"]
    path = Path(Store(remote_of(lab)).object_path(name))
    content = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(content[:-1] + b"?")
    assert lab.run_json(f"store push {remote_of(lab)} data/s")["replaced"] == 0
    assert "replaced 1 that were damaged there" in lab.run(f"store push {remote_of(lab)} data/s --verify").out
    assert path.read_bytes() == content
    assert repair.verify(Store(remote_of(lab))).clean


def test_an_object_of_many_blocks_goes_over_without_being_held_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = Store(tmp_path / "one"), Store(tmp_path / "two")
    for store in (source, target):
        store.prepare()
    content = os.urandom(5 * regular.BLOCK_BYTES + 3)
    name = source.put(content).digest
    blocks = list(source.blocks(name, len(content)))
    assert max(map(len, blocks)) == regular.BLOCK_BYTES
    target.take(name, blocks)
    assert target.read(name) == content
    Path(source.object_path(name)).chmod(0o644)
    Path(source.object_path(name)).write_bytes(content[:-1])
    with pytest.raises(MissingError, match="damaged"):
        Store(tmp_path / "two").take(name, source.blocks(name, len(content)))
    assert target.read(name) == content and not list((tmp_path / "two/tmp").iterdir())


def test_a_push_that_another_one_writes_over_where_nothing_locks_says_so_and_its_rerun_keeps_both(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run("simulate toy -o data/r --trials 1 --rows 3")
    lab.run("store push remote data/r")
    lab.run("label data/r trial-000 --label material=foam")
    remote = Store(lab.folder / "remote")
    (before,) = remote.roots.all()
    other_digest, honest = "ab" * 32, Roots.push

    def push(roots: Roots, *arguments: Any, **options: Any) -> bool:
        honest(roots, *arguments, **options)
        name, project, _, _ = arguments  # the other one looked before this one wrote
        return honest(roots, name, project, other_digest, before, lasting=False)

    with monkeypatch.context() as patch:
        patch.setattr(Roots, "push", push)
        ran = lab.call("store push remote data/r")
    assert ran.code == 1 and "run the same command again" in ran.err.lower()
    lab.run("store push remote data/r --replace")
    (root,) = remote.roots.all()
    assert {root["manifest"], *(entry["manifest"] for entry in root["history"])} >= {other_digest, before["manifest"]}
    assert root["manifest"] == bytes_digest(Path("data/r/manifest.json").read_bytes())
