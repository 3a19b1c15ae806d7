import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

import tacpipe
from tacpipe.maintenance import copying, repair
from tacpipe.store import roots
from tacpipe.store.store import Store
from tests.conftest import Lab
from tests.promises.counts import count
from tests.stores.places import Place
from tests.test_pipeline import counts


@pytest.fixture
def pushed(lab: Lab, place: Place) -> Place:
    """A store with a dataset and what it descends from, and the project that pushed it."""
    lab.run("simulate toy -o data/r --trials 4 --rows 3")
    lab.run("scale data/r -o data/s --factor 1")
    lab.run(f"store push {place.address} data/s")
    return place


def clone(lab: Lab, monkeypatch: pytest.MonkeyPatch, name: str = "clone") -> Path:
    """Enter another project, with the identity of this one if it has pushed."""
    folder = lab.folder.with_name(f"{lab.folder.name}-{name}")
    (folder / ".tacpipe").mkdir(parents=True)
    monkeypatch.chdir(folder)
    return folder


def shard(lab: Lab, trial: str = "trial-003", path: str = "data/s") -> str:
    """Return the name of a shard's object."""
    digest: str = lab.manifest(path).recordings[trial]["shards"][""]["digest"]
    return f"objects/{digest[:2]}/{digest}"


def listed(lab: Lab, place: Place) -> list[dict[str, Any]]:
    """Return what was pushed, as `store list` prints it."""
    manifests: list[dict[str, Any]] = json.loads(lab.run(f"store list --remote {place.address} --json").out)[
        "manifests"
    ]
    return manifests


def test_an_empty_clone_pulls_what_was_pushed_byte_for_byte_and_computes_nothing_again(
    lab: Lab, pushed: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = (lab.folder / "data/s/manifest.json").read_bytes()
    folder = clone(lab, monkeypatch)
    lab.run(f"store pull {pushed.address} data/s")
    assert (folder / "data/s/manifest.json").read_bytes() == expected
    assert repair.verify(Store(folder / ".tacpipe")).clean
    assert tacpipe.open("data/s").to_numpy()["trial-001"].values[:, 0].tolist() == [0, 2, 4]


@pytest.mark.long
def test_records_come_along_so_that_a_clone_reuses_what_another_one_computed(
    lab: Lab, pushed: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run(f"store push {pushed.address} data/r")
    clone(lab, monkeypatch)
    lab.run(f"store pull {pushed.address} data/r data/s")
    assert counts(lab.run("scale data/r -o data/again --factor 1 --json").out) == (0, 4)


@pytest.mark.long
def test_a_second_push_and_a_second_pull_move_nothing(lab: Lab, pushed: Place) -> None:
    for verb in ("push", "push --verify", "pull"):
        report = json.loads(lab.run(f"store {verb} {pushed.address} data/s --json").out)
        assert (report["objects"], report["bytes"], report["there"] >= 5) == (0, 0, True), verb


@pytest.mark.long
def test_a_push_that_was_cut_off_sends_only_what_is_missing(lab: Lab, pushed: Place) -> None:
    pushed.files.delete(shard(lab))
    report = json.loads(lab.run(f"store push {pushed.address} data/s --json").out)
    assert (report["objects"], report["replaced"]) == (1, 0)


@pytest.mark.long
@pytest.mark.parametrize("size", [0, 100, 10**6])
def test_an_object_of_another_size_is_replaced_by_the_next_push(lab: Lab, pushed: Place, size: int) -> None:
    content = pushed.files.read(shard(lab))
    pushed.replace(shard(lab), (content * 1000)[:size])
    report = json.loads(lab.run(f"store push {pushed.address} data/s --json").out)
    assert (report["objects"], report["replaced"], pushed.files.read(shard(lab))) == (1, 1, content)
    count("damages of a store found")


def test_an_object_with_other_bytes_is_never_pulled_is_named_and_is_replaced_by_a_push_that_verifies(
    lab: Lab, pushed: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = pushed.files.read(shard(lab))
    for name in pushed.names("records"):
        pushed.files.delete(name)  # else a folder's own records bring it back
    pushed.replace(shard(lab), content[:-1] + b"?")
    digest = Path(shard(lab)).name
    ran = lab.call(f"store verify --remote {pushed.address} --json")
    assert ran.code == 4 and digest in ran.out
    pushed.files.delete(shard(lab))
    assert pushed.files.create(shard(lab), content[:-1] + b"?")
    origin = Path.cwd()
    clone(lab, monkeypatch)
    failed = lab.call(f"store pull {pushed.address} data/s")
    assert failed.code == 4 and not Path("data/s").exists()
    monkeypatch.chdir(origin)
    pushed.files.delete(shard(lab))
    assert pushed.files.create(shard(lab), content[:-1] + b"?")
    report = json.loads(lab.run(f"store push {pushed.address} data/s --verify --json").out)
    assert (report["objects"], report["replaced"], pushed.files.read(shard(lab))) == (1, 1, content)
    assert lab.run(f"store verify --remote {pushed.address}").out.endswith("all sound\n")
    count("damages of a store found", 3)


@pytest.mark.long
def test_a_vanished_object_is_named_and_ends_a_pull_with_the_code_of_damage(
    lab: Lab, pushed: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    pushed.files.delete(shard(lab))
    for name in pushed.names("records"):
        pushed.files.delete(name)
    ran = lab.call(f"store verify --remote {pushed.address} --json")
    assert ran.code == 4 and json.loads(ran.out)["missing"] == [Path(shard(lab)).name]
    clone(lab, monkeypatch)
    failed = lab.call(f"store pull {pushed.address} data/s")
    assert failed.code == 4 and "trial-003.parquet" in failed.err and not Path("data/s").exists()
    count("damages of a store found", 2)


@pytest.mark.long
def test_a_manifest_that_vanished_is_named_and_comes_back_with_the_next_push(lab: Lab, pushed: Place) -> None:
    (entry,) = listed(lab, pushed)
    pushed.files.delete(f"objects/{entry['manifest'][:2]}/{entry['manifest']}")
    assert lab.call(f"store verify --remote {pushed.address}").code == 4
    lab.run(f"store push {pushed.address} data/s")
    assert lab.call(f"store verify --remote {pushed.address}").code == 0


@pytest.mark.long
def test_a_store_of_another_format_and_what_is_not_a_store_are_refused(lab: Lab, place: Place) -> None:
    lab.run("simulate toy -o data/r --trials 1")
    assert lab.call(f"store pull {place.address} data/r").code == 2
    place.files.create("format", b"99\n")
    for verb in ("push", "pull"):
        refused = lab.call(f"store {verb} {place.address} data/r")
        assert refused.code == 2 and "99" in refused.err
    assert not place.names("objects")


# ---- names and snapshots


def two_clones(lab: Lab, pushed: Place, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Return two computers of one project, each with labels of its own on what was pushed."""
    folders = []
    for name in ("foam", "cork"):
        folder = lab.folder.with_name(f"{lab.folder.name}-{name}")
        shutil.copytree(lab.folder, folder, ignore=shutil.ignore_patterns("leases", "remote"))
        monkeypatch.chdir(folder)
        lab.run(f"label data/r trial-000 --label material={name}")
        folders.append(folder)
    return folders[0], folders[1]


@pytest.mark.long
def test_a_push_onto_what_another_computer_pushed_since_is_refused_and_both_stay_as_snapshots(
    lab: Lab, pushed: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run(f"store push {pushed.address} data/r")
    first, second = two_clones(lab, pushed, monkeypatch)
    monkeypatch.chdir(first)
    lab.run(f"store push {pushed.address} data/r")
    monkeypatch.chdir(second)
    refused = lab.call(f"store push {pushed.address} data/r")
    assert refused.code == 2 and "--replace" in refused.err
    lab.run(f"store push {pushed.address} data/r --replace")
    states = [entry["state"] for entry in listed(lab, pushed) if entry["path"] == "data/r"]
    assert states == ["pushed here", "pushed earlier", "pushed earlier"]
    for number, digest in enumerate(entry["manifest"] for entry in listed(lab, pushed) if entry["path"] == "data/r"):
        lab.run(f"store checkout {digest} --remote {pushed.address} -o back/{number}")


def test_of_two_pushes_of_a_name_that_both_looked_before_either_wrote_one_is_refused(
    lab: Lab, pushed: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run(f"store push {pushed.address} data/r")
    first, second = two_clones(lab, pushed, monkeypatch)
    honest = copying.copy
    calls: list[int] = []

    def copy(*args: Any, **kwargs: Any) -> None:
        honest(*args, **kwargs)
        if not calls:
            calls.append(1)
            with monkeypatch.context() as patch:
                patch.chdir(second)
                patch.setenv("TACPIPE_LOCK_TIMEOUT_S", "0.05")
                calls.append(lab.call(f"store push {pushed.address} data/r").code)

    monkeypatch.setattr(copying, "copy", copy)
    monkeypatch.chdir(first)
    code = lab.call(f"store push {pushed.address} data/r").code
    assert (code, calls[1]) in ((0, 6), (2, 0)), "where there are locks the second waits, else the first is refused"
    newest = next(entry for entry in listed(lab, pushed) if entry["path"] == "data/r")
    winner = first if code == 0 else second
    assert json.loads((winner / "data/r/manifest.json").read_text())
    monkeypatch.chdir(winner)
    assert not json.loads(lab.run(f"store push {pushed.address} data/r --json").out)["objects"]
    assert next(entry for entry in listed(lab, pushed) if entry["path"] == "data/r")["manifest"] == newest["manifest"]
    count("pushes of one name at once")


@pytest.mark.long
def test_the_last_pushes_are_kept_and_forgotten_ones_are_collected(
    lab: Lab, place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(roots, "HISTORY", 2)
    for rows in range(1, 6):
        lab.run(f"simulate toy -o data/r --trials 1 --rows {rows} --jobs 1")
        lab.run(f"store push {place.address} data/r")
    assert len(listed(lab, place)) == 1 + 2
    newest, *_, oldest = [entry["manifest"] for entry in listed(lab, place)]
    lab.run(f"store gc --remote {place.address} --forget {newest} --forget {oldest[:12]}")
    assert len(listed(lab, place)) == 1
    lab.run(f"store gc --remote {place.address} --forget {listed(lab, place)[0]['project']}:data/r")
    assert listed(lab, place) == []


# ---- collection


def aged(place: Place) -> None:
    """Let all of a folder's store have been written long ago, for `gc`; a bucket's collection reads no times of objects."""
    if "://" not in place.address:
        for path in Path(place.address).rglob("*"):
            os.utime(path, (1_500_000_000, 1_500_000_000))


@pytest.mark.long
def test_a_collection_removes_what_nothing_names_and_keeps_all_that_is_needed(lab: Lab, pushed: Place) -> None:
    lab.run("scale data/r -o data/t --factor 5")
    lab.run(f"store push {pushed.address} data/t")
    before = pushed.whole()
    aged(pushed)
    dry = json.loads(lab.run(f"store gc --remote {pushed.address} --forget data/t --dry-run --json").out)
    assert pushed.whole() == before and dry["objects"] == 0
    project = listed(lab, pushed)[0]["project"]
    report = json.loads(lab.run(f"store gc --remote {pushed.address} --forget {project}:data/t --json").out)
    assert report["objects"] == 5 and report["records"] >= 4
    assert lab.run(f"store verify --remote {pushed.address}").out.endswith("all sound\n")
    assert [entry["path"] for entry in listed(lab, pushed)] == ["data/s"]
    assert json.loads(lab.run(f"store gc --remote {pushed.address} --json").out)["objects"] == 0


@pytest.mark.long
def test_recordings_that_nothing_names_are_kept_until_they_are_asked_for(lab: Lab, place: Place) -> None:
    Path("src").mkdir()
    Path("src/a.txt").write_text("1 2 3")
    lab.run("ingest numbers src -o data/i")
    lab.run(f"store push {place.address} data/i")
    before = place.names("objects")
    name = f"{listed(lab, place)[0]['project']}:data/i"
    aged(place)
    report = json.loads(lab.run(f"store gc --remote {place.address} --forget {name} --json").out)
    assert report["objects"] == 0 < report["kept_recordings"] and place.names("objects") == before
    for record in place.names("records"):
        place.files.delete(record)
    lab.run(f"store gc --remote {place.address}")
    assert place.names("objects") == before, "the manifest alone is enough"
    lab.run(f"store gc --remote {place.address} --recordings")
    assert not place.names("objects")


def test_a_damaged_root_ends_a_collection_before_anything_is_removed(lab: Lab, pushed: Place) -> None:
    (name,) = pushed.names("roots")
    pushed.replace(name, pushed.files.read(name).replace(b"data/s", b"data/x"))
    before = pushed.whole()
    aged(pushed)
    assert lab.call(f"store gc --remote {pushed.address}").code == 4 and pushed.whole() == before
    assert lab.call(f"store verify --remote {pushed.address}").code == 4
    count("damages of a store found", 2)
