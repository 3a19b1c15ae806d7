"""Test untrusted stores: no command blocks, runs out of memory, or reads a file elsewhere."""

import fcntl
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import tacpipe
from tacpipe.datasets.manifest import stored
from tacpipe.datasets.pages import Item
from tacpipe.errors import DAMAGED, DONE, FAILED, USAGE, DamagedError, TacpipeError
from tacpipe.io.hashing import digest
from tacpipe.store.store import MissingError, Store
from tests.conftest import Lab
from tests.promises.counts import count
from tests.promises.limits import GIB, bound_memory, is_sentence
from tests.test_regular import link, sparse

ATTACKS: dict[str, Callable[[Path], None]] = {
    "a named pipe": os.mkfifo,
    "a link to a device": lambda path: link(path, "/dev/zero"),
    "a link to a file outside": lambda path: link(path, __file__),
    "three terabytes": sparse,
    "a folder": Path.mkdir,
}


@pytest.fixture
def remote(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Store:
    """A store to which a project pushed a dataset; commands run in a clone of the project."""
    lab.run("simulate toy -o data/q --trials 2 --rows 3")
    lab.run("scale data/q -o data/r")
    store = Store(lab.folder / "remote")
    lab.run(f"store push {store.root} data/r")
    clone = lab.folder / "clone"
    (clone / ".tacpipe").mkdir(parents=True)
    monkeypatch.chdir(clone)
    return store


def target(lab: Lab, remote: Store, kind: str) -> Path:
    """Return a file of the remote store, of a kind."""
    manifest = lab.manifest("data/r")
    (root,) = remote.roots.all()
    if kind == "object":
        return Path(remote.object_path(next(name for _, name in manifest.objects())))
    if kind == "manifest":
        return Path(remote.object_path(root["manifest"]))
    if kind == "format":
        return remote.root / "format"
    return min(remote.root.glob("records/*/*" if kind == "record" else "roots/*"))


@pytest.mark.parametrize("attack", ATTACKS)
@pytest.mark.parametrize(
    ("kind", "code"), [("object", DAMAGED), ("manifest", DAMAGED), ("record", DONE), ("root", USAGE), ("format", USAGE)]
)
def test_a_pull_ends_with_a_sentence_whatever_lies_in_the_place_of_a_file(
    lab: Lab, remote: Store, kind: str, code: int, attack: str
) -> None:
    file = target(lab, remote, kind)
    for record in remote.root.glob("records/*/*") if kind != "record" else ():
        record.unlink()  # Otherwise the missing object is computed again.
    file.unlink()
    ATTACKS[attack](file)
    with bound_memory(GIB):
        ran = lab.call(f"store pull {remote.root} data/r")
    assert ran.code == code, ran
    if code:
        assert is_sentence(ran.err) and not Path("data/r/manifest.json").exists()
    else:
        assert len(tacpipe.open("data/r").to_numpy()) == 2
    count("hostile inputs refused")


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_push_replaces_what_lies_in_the_place_of_an_object(lab: Lab, remote: Store, attack: str) -> None:
    os.chdir(lab.folder)
    file = target(lab, remote, "object")
    content = file.read_bytes()
    file.unlink()
    ATTACKS[attack](file)
    with bound_memory(GIB):
        lab.run(f"store push {remote.root} data/r")
    assert file.is_file() and not file.is_symlink() and file.stat().st_size == len(content)  # else nobody reads it
    assert file.read_bytes() == content
    assert b"A store of untrusted content" in Path(__file__).read_bytes()
    count("hostile inputs refused")


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_shard_beside_a_manifest_is_adopted_only_where_it_is_a_file_of_its_size(
    lab: Lab, attack: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run("simulate toy -o data/q --trials 1 --rows 3")
    lab.run("scale data/q -o data/r")
    untrusted = lab.folder / "untrusted"
    shutil.copytree(lab.folder / "data/r", untrusted)
    (untrusted / "trial-000.parquet").unlink()
    ATTACKS[attack](untrusted / "trial-000.parquet")
    monkeypatch.setenv("TACPIPE_STORE", str(lab.folder / "empty"))
    with bound_memory(GIB), pytest.raises(DamagedError) as error:
        tacpipe.open(untrusted).to_numpy()
    assert is_sentence(str(error.value))
    count("hostile inputs refused")


def test_a_shard_that_dvc_or_git_annex_linked_is_adopted(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("simulate toy -o data/q --trials 1 --rows 3")
    lab.run("scale data/q -o data/r")
    copy = shutil.copytree(lab.folder / "data/r", lab.folder / "copy")
    (copy / "trial-000.parquet").rename(lab.folder / "cached")
    (copy / "trial-000.parquet").symlink_to(lab.folder / "cached")
    monkeypatch.setenv("TACPIPE_STORE", str(lab.folder / "empty"))
    assert list(tacpipe.open(copy).to_numpy()) == ["trial-000"]


@pytest.mark.parametrize("attack", [attack for attack in ATTACKS if attack != "a link to a file outside"])
@pytest.mark.parametrize(
    "command", ["show given", "scale made -o given", "store push remote given", "store link given"]
)
def test_no_command_waits_for_a_manifest(lab: Lab, command: str, attack: str) -> None:
    lab.run("simulate toy -o made --trials 1 --rows 3")
    (lab.folder / "given").mkdir()
    ATTACKS[attack](lab.folder / "given/manifest.json")
    with bound_memory(GIB):
        ran = lab.call(command)
    assert ran.code in (FAILED, USAGE, DAMAGED) and is_sentence(ran.err), ran
    count("hostile inputs refused")


@pytest.mark.parametrize("attack", ATTACKS)
@pytest.mark.parametrize(
    "command", ["show given", "total given -o scaled", "store link given", "store push remote given"]
)
def test_no_command_waits_for_a_shard(lab: Lab, command: str, attack: str) -> None:
    lab.run("simulate toy -o data/q --trials 1 --rows 3")
    lab.run("scale data/q -o given")
    (lab.folder / "given/trial-000.parquet").unlink()
    ATTACKS[attack](lab.folder / "given/trial-000.parquet")
    with bound_memory(GIB):
        ran = lab.call(command)
    assert ran.code in (DONE, FAILED) and (ran.code == DONE or is_sentence(ran.err)), ran
    count("hostile inputs refused")


SHAPES: tuple[dict[str, Any], ...] = (
    {"path": 5},
    {"path": "a\0b"},
    {"path": ["data/r"]},
    {"kind": []},
    {"manifest": None},
    {"manifest": "../../x"},
    {"written_s": 10**30},
    {"written_s": "now"},
    {"history": {}},
    {"history": [5]},
    {"history": [{"manifest": "x" * 64}]},
    {"project": "lab"},
    {"project": {"id": 5, "name": "lab"}},
    {"project": {"id": "a" * 32, "name": "\x1b[2J" * 1000}},
    {"path": "../../victim"},
    {"kind": "absolute", "path": "/etc"},
)


@pytest.mark.parametrize("changed", SHAPES, ids=repr)
def test_a_root_that_was_made_up_is_listed_or_refused_with_a_sentence(
    lab: Lab, remote: Store, changed: dict[str, Any]
) -> None:
    (file,) = remote.root.glob("roots/*")
    root = {key: value for key, value in json.loads(file.read_text()).items() if key != "check"} | changed
    file.write_text(json.dumps({**root, "check": digest(root)}))
    for command in ("store list --remote {}", "store pull {} data/r", "store checkout abcdef --remote {} -o x"):
        ran = lab.call(command.format(remote.root))
        assert ran.code in (DONE, USAGE, DAMAGED) and (is_sentence(ran.err) if ran.code else True), ran
        assert "\x1b" not in ran.out + ran.err
    assert not (lab.folder / "victim").exists()
    count("hostile inputs refused")


def test_a_record_that_was_made_up_is_not_taken_over(lab: Lab, remote: Store) -> None:
    for number, result in enumerate(([], {"recordings": 5, "files": {}}, {"recordings": {}, "files": {"x": 5}})):
        identity: dict[str, Any] = {"stage": number}
        provenance: dict[str, Any] = {}
        body = {"identity": identity, "result": result}
        key = digest(identity)
        path = Path(remote.record_path(key))
        path.parent.mkdir(exist_ok=True)
        path.write_text(
            json.dumps({**body, "digest": digest(body), "provenance": provenance, "check": digest(provenance)})
        )
    lab.run(f"store pull {remote.root} data/r")
    assert all(isinstance(record["identity"].get("stage", ""), str) for _, record in Store(".tacpipe").records())


def test_what_a_manifest_declares_to_be_larger_than_the_disk_is_not_begun(lab: Lab, remote: Store) -> None:
    (root,) = remote.roots.all()
    manifest = stored(remote, root["manifest"])

    def declare(size: int, *names: str) -> None:
        """Push a manifest in which shards of recordings have another size."""
        entries = {name: manifest.recordings[name] for name in names}
        items = {
            name: Item({**entry, "shards": {"": {**entry["shards"][""], "bytes": size}}})
            for name, entry in entries.items()
        }
        remote.roots.write({**root, "manifest": manifest.with_recordings(items).keep(remote).digest})

    declare(10**18, *manifest.recordings)
    failed = lab.call(f"store pull {remote.root} data/r")
    assert failed.code == FAILED and "2,000,000,000.0 GB are to be copied" in failed.err
    declare(10**6, *manifest.recordings)
    failed = lab.call(f"store pull {remote.root} data/r")
    assert failed.code == DAMAGED and "its manifest declares 1,000,000" in failed.err
    assert lab.manifest("data/r").rows == 6


def test_an_object_is_read_up_to_what_is_declared_and_a_little_one_that_grew_is_quarantined(tmp_path: Path) -> None:
    store = Store(tmp_path / ".tacpipe")
    store.prepare()
    name = store.put(b"content").digest
    path = Path(store.object_path(name))
    path.chmod(0o644)
    with path.open("ab") as file:
        file.write(b"!")
    with pytest.raises(MissingError, match="is now in"):
        store.read(name, 7)
    sparse(path)
    with bound_memory(GIB), pytest.raises(MissingError, match="3,000,000,000,000 bytes"):
        store.read(name, 7)
    assert path.exists(), "nobody read it, so nobody knows whether it is damaged or the declared size is"


def test_a_lease_of_three_terabytes_is_refused(tmp_path: Path) -> None:
    store = Store(tmp_path / ".tacpipe")
    store.prepare()
    path = store.root / "leases" / f"run-{'a' * 32}.lock"
    sparse(path)
    with path.open() as lease, bound_memory(GIB):
        fcntl.flock(lease, fcntl.LOCK_EX)
        with pytest.raises(TacpipeError, match="3,000,000,000,000 bytes"):
            store.leases.runs()


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_checkpoint_that_is_not_a_file_of_its_own_is_as_none(tmp_path: Path, attack: str) -> None:
    from tacpipe.training import loop

    ATTACKS[attack](tmp_path / loop.FILE)
    with bound_memory(4 * GIB):
        assert loop.read_checkpoint(tmp_path) is None
