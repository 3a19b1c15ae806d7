"""Folders that are no store, or hold more than one: nothing in them is changed, whichever command is given them."""

import json
import os
from collections.abc import Mapping
from pathlib import Path

import pytest

from tacpipe.datasets import directory
from tacpipe.errors import StorageError, UsageError
from tacpipe.io.hashing import bytes_digest
from tacpipe.recording import spool_folders
from tacpipe.store import layout
from tacpipe.store.store import Store
from tests.conftest import Lab, Ran
from tests.test_garbage import age

READ = (
    "store status",
    "store list",
    "store verify",
    "store gc",
    "store gc --dry-run",
    "store gc --recordings --grace-days 0",
)
WRITE = (
    "store gc --forget data/s",
    "store repair",
    "store checkout data/s -o data/t",
    "store checkout 3f2a91c0d4e5 -o data/t",
    "store link data/s",
    "store push remote data/s",
    "store pull remote data/s",
    "simulate toy -o data/new",
    "simulate toy -o data/r --check",
    "simulate toy -o data/r --recompute-and-compare",
    "scale data/r -o data/new",
    "label data/r trial-000 --label material=foam",
    "show data/s",
    "explain data/s",
    "acquire rig.toml -o data/rec --recover",
)
EVERY = (*READ, *WRITE)
LINKED = (*layout.FOLDERS, layout.SPOOL, layout.KEPT, layout.PROJECTS)
RUN = f"run-{'ab' * 16}"


def tree(folder: Path) -> dict[str, object]:
    """Return what lies beneath a folder: content of files, targets of links, with the times at which they were changed."""
    contents: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        content = str(path.readlink()) if path.is_symlink() else path.read_bytes() if path.is_file() else None
        contents[str(path.relative_to(folder))] = content, path.lstat().st_mtime_ns
    return contents


def write(folder: Path, files: Mapping[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
        os.utime(folder / name, (0, 0))  # The files are as old as can be.


@pytest.fixture
def made_project(lab: Lab) -> Lab:
    """A project with recordings, a dataset made of them, and a store to which that was pushed."""
    lab.run("simulate toy -o data/r")
    lab.run("scale data/r -o data/s")
    lab.run("store push remote data/s")
    age(lab)
    return lab


def check_refusal(ran: Ran, *words: str) -> None:
    assert ran.code == 2 and ran.err.startswith("tacpipe: ") and ran.err.count("\n") == 1, ran
    assert all(word in ran.err for word in words), ran.err


SOMEBODYS = {
    "files and folders named as ours are": {"objects/ab/thesis.tex": "chapter 1", "tmp/scene.blend": "mesh"},
    "one file alone": {"thesis.tex": "chapter 1"},
    "an object store of another kind": {f"objects/ab/{'ab' * 32}": "blob"},
    "a draft of ours and a file of theirs": {f"tmp/{RUN}.{'cd' * 16}": "draft", "tmp/scene.blend": "mesh"},
    "leases of ours and a file of theirs": {f"leases/{RUN}.lock": "{}", "quarantine/plan.pdf": "plan"},
}


@pytest.mark.parametrize("files", SOMEBODYS.values(), ids=SOMEBODYS)
def test_a_folder_that_is_not_a_store_is_refused_by_every_command_and_stays_as_it_is(
    made_project: Lab, monkeypatch: pytest.MonkeyPatch, files: dict[str, str]
) -> None:
    theirs = made_project.folder / "theirs"
    write(theirs, files)
    before = tree(theirs), tree(made_project.folder / "data")
    monkeypatch.setenv("TACPIPE_STORE", str(theirs))
    for command in EVERY:
        ran = made_project.call(command)
        check_refusal(ran, str(theirs), "is not a store of tacpipe", "no file format", "TACPIPE_STORE")
        assert (tree(theirs), tree(made_project.folder / "data")) == before, command


def test_a_folder_that_is_not_a_store_is_no_remote(made_project: Lab) -> None:
    theirs = made_project.folder / "theirs"
    write(theirs, {"objects/ab/thesis.tex": "chapter 1", "tmp/scene.blend": "mesh"})
    before = tree(theirs)
    for command in ("push", "pull"):
        ran = made_project.call(f"store {command} theirs data/s")
        assert ran.code == 2 and str(theirs.name) in ran.err, ran
        assert tree(theirs) == before


@pytest.mark.parametrize("there", [True, False])
def test_commands_that_make_no_result_do_not_begin_a_store(
    made_project: Lab, monkeypatch: pytest.MonkeyPatch, there: bool
) -> None:
    empty = made_project.folder / "empty"
    if there:
        empty.mkdir()
        (empty / ".gitkeep").touch()
    monkeypatch.setenv("TACPIPE_STORE", str(empty))
    for command in (*READ, "store repair"):
        ran = made_project.run(command)
        assert ran.err == "" and empty.is_dir() == there
        assert not there or [path.name for path in empty.iterdir()] == [".gitkeep"], command
    assert "there is no store yet" in made_project.run("store status").out + made_project.run("store verify").out
    assert "all sound" not in made_project.run("store verify").out
    assert (
        made_project.call("store checkout data/s -o data/t").code
        == made_project.call("store gc --forget data/s").code
        == 2
    )
    made_project.run("simulate toy -o data/new")
    assert (empty / "format").read_text() == "1\n" and Store(empty).check()


def test_a_store_that_was_being_begun_when_its_process_was_killed_is_begun_again(tmp_path: Path) -> None:
    for name in layout.FOLDERS[:-1]:
        (tmp_path / name).mkdir()
    write(tmp_path, {f"tmp/.{'cd' * 16}": "1", f"leases/{RUN}.lock": "{}"})
    store = Store(tmp_path)
    assert not store.check()
    store.prepare()
    assert store.check() and store.has(store.put(b"touch").digest)


def test_a_store_that_another_process_begins_between_two_looks_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path)
    honest = layout._is_empty

    def other_is_faster(root: Path) -> bool:
        monkeypatch.setattr(layout, "_is_empty", honest)
        Store(root).prepare()
        Store(root).put(b"touch")
        return honest(root)

    monkeypatch.setattr(layout, "_is_empty", other_is_faster)
    assert store.check()


@pytest.mark.parametrize("mark", ["2\n", "17\n", "", "\x1b[2J"])
def test_a_store_of_another_format_is_refused_by_every_command(made_project: Lab, mark: str) -> None:
    (made_project.store.root / "format").write_text(mark)
    before = tree(made_project.folder)
    for command in EVERY:
        check_refusal(made_project.call(command), "has format", "reads format 1")
        assert tree(made_project.folder) == before, command


@pytest.mark.parametrize("name", LINKED)
def test_a_folder_of_a_store_that_is_a_link_is_refused_by_every_command(
    made_project: Lab, name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    theirs = tmp_path_factory.mktemp("theirs")
    write(
        theirs, {"scene.blend": "mesh", f"ab/{'ab' * 32}": "blob", f"{'ab' * 32}.lock": "", f"{'ab' * 32}.json": "{}"}
    )
    folder = made_project.store.root / name
    if folder.exists():
        folder.rename(theirs / "before")
    folder.symlink_to(theirs)
    before = tree(theirs), tree(made_project.folder)
    for command in EVERY:
        check_refusal(made_project.call(command), str(folder), "is a symbolic link")
        assert (tree(theirs), tree(made_project.folder)) == before, command


def test_a_store_that_is_itself_a_link_to_another_disk_works(
    made_project: Lab, tmp_path_factory: pytest.TempPathFactory
) -> None:
    disk = tmp_path_factory.mktemp("disk") / "store"
    made_project.store.root.rename(disk)
    made_project.store.root.symlink_to(disk)
    made_project.run("scale data/r -o data/t --factor 9")
    made_project.run("label data/r trial-000 --label material=foam")
    age(made_project)
    for command in ("store verify", "store repair", "store gc --recordings --grace-days 0", "store push remote data/t"):
        made_project.run(command)
    assert (disk / "format").exists() and made_project.store.root.is_symlink()
    made_project.store.root.unlink()
    made_project.store.root.symlink_to(disk.parent / "fresh")
    for command in (*READ, "simulate toy -o data/new"):
        check_refusal(made_project.call(command), "which does not exist", "Mount its disk")
    (disk.parent / "fresh").mkdir()
    made_project.run("simulate toy -o data/new")
    assert (disk.parent / "fresh" / "format").exists()


def test_what_is_not_of_a_stores_form_is_left_alone_and_named(
    made_project: Lab, tmp_path_factory: pytest.TempPathFactory
) -> None:
    theirs = tmp_path_factory.mktemp("theirs")
    other_digest = bytes_digest(b"theirs")
    write(
        theirs,
        {other_digest: "theirs", "scene.blend": "mesh", "bytes": "", "header.json": "{}", f"{other_digest}.json": "{}"},
    )
    root = made_project.store.root
    files = {
        "notes.txt",
        "objects/ab/thesis.tex",
        "objects/thesis.tex",
        f"objects/cd/{'ab' * 32}",  # This is another shelf than its name says.
        "records/ab/old.json",
        "roots/mine.json",
        "leases/mine.lock",
        "checkpoints/mine",
        "quarantine/plan.pdf",
        "tmp/scene.blend",
        "tmp/run-1.blend",
        "tmp/gc-plan",
        "spool/plan",
    }
    write(root, dict.fromkeys(files, "mine"))
    (root / "tmp" / f"{RUN}.{'cd' * 16}").mkdir()  # a folder named as a draft is
    (root / "objects" / "zz").mkdir()
    links = {
        f"objects/{other_digest[:2]}": theirs,  # a shelf
        f"records/{other_digest[:2]}": theirs,
        f"tmp/gc-{other_digest}": theirs / other_digest,
        f"quarantine/{other_digest}.1": theirs / other_digest,
        f"leases/{other_digest}.lock": theirs / other_digest,
        f"checkpoints/{other_digest}": theirs,
        f"spool/{'cd' * 16}": theirs,
    }
    for name, target in links.items():
        (root / name).parent.mkdir(exist_ok=True)
        assert not os.path.lexists(root / name)
        (root / name).symlink_to(target)
    foreign = sorted([*files, *links, f"tmp/{RUN}.{'cd' * 16}", "objects/zz"])
    age(made_project)
    before = tree(theirs), {name: value for name, value in tree(root).items() if name in foreign}
    for command in (*READ, "store repair", "store verify --json"):
        ran = made_project.run(command)
    assert json.loads(ran.out)["foreign"] == foreign
    assert spool_folders.find_abandoned(root) == []
    assert (tree(theirs), {name: value for name, value in tree(root).items() if name in foreign}) == before
    output = made_project.run("store verify").out
    assert (
        "not part of a store, left as it is: checkpoints/mine" in output
        and "12 more" in output
        and "all sound" in output
    )


def test_a_file_is_not_written_through_a_link_within_a_store(tmp_path: Path) -> None:
    store, theirs = Store(tmp_path / "store"), tmp_path / "theirs"
    store.prepare()
    theirs.mkdir()
    name = bytes_digest(b"touch")
    (store.root / "objects" / name[:2]).symlink_to(theirs)
    with pytest.raises(StorageError, match="symbolic link"):
        store.put(b"touch")
    Path(store.aside_path(name)).write_bytes(b"touch")
    assert not store.has(name) and Path(store.aside_path(name)).exists()  # it is not put back through the link either
    (theirs / name).write_bytes(b"damaged")
    assert not store.quarantine(store.object_path(name)) and (theirs / name).exists()
    (store.root / "leases" / "gc.lock").symlink_to(theirs / name)
    with pytest.raises(StorageError), store.leases.exclusive("gc"):
        pass
    assert (theirs / name).read_bytes() == b"damaged"


@pytest.mark.parametrize("kind", ["file", "folder as mark", "pipe as mark"])
def test_what_cannot_be_a_store_is_refused(tmp_path: Path, kind: str) -> None:
    root = tmp_path / "store"
    if kind == "file":
        root.write_text("mine")
    else:
        root.mkdir()
        (root / "format").mkdir() if kind == "folder as mark" else os.mkfifo(root / "format")
    for look in (Store(root).check, Store(root).prepare):
        with pytest.raises(UsageError, match=r"not a (folder|store)"):
            look()


def test_only_drafts_of_our_own_form_are_swept_from_a_dataset(tmp_path: Path) -> None:
    mine = (".notes.draft", ".paper.tex.draft", "trial-000/.plot.draft", ".a.parquet.0123456789abc.draft", "x.draft")
    ours = (".manifest.json.draft", "trial-000/.left.parquet.0123456789ab.draft", ".a.parquet.0123456789ab.draft")
    write(tmp_path / "data", dict.fromkeys((*mine, *ours), "text"))
    write(tmp_path / "theirs", {".left.parquet.0123456789ab.draft": "text"})
    (tmp_path / "data/linked").symlink_to(tmp_path / "theirs")
    directory.sweep(tmp_path / "data")
    remaining = {str(path.relative_to(tmp_path / "data")) for path in (tmp_path / "data").rglob("*") if path.is_file()}
    assert remaining == set(mine) and (tmp_path / "theirs/.left.parquet.0123456789ab.draft").exists()
    write(tmp_path / "data", {".page.html.old.draft": "mine", ".page.html.0123456789ab.draft": "ours"})
    directory.sweep_beside(tmp_path / "data/page.html")
    assert (tmp_path / "data/.page.html.old.draft").exists()
    assert not (tmp_path / "data/.page.html.0123456789ab.draft").exists()


def test_an_emulated_port_replaces_and_removes_links_alone(tmp_path: Path) -> None:
    from tacpipe.simulation.emulation.serial_port import Pty

    for name in ("left", ".left"):
        write(tmp_path, {name: "mine"})
        with pytest.raises(UsageError, match="is not from an emulator"):
            Pty(tmp_path / "left")
        assert (tmp_path / name).read_text() == "mine"
        (tmp_path / name).unlink()
    (tmp_path / "left").symlink_to("/dev/pts/of-an-emulator-that-was-killed")
    port = Pty(tmp_path / "left")
    assert (tmp_path / "left").readlink().parent == Path("/dev/pts")
    (tmp_path / "left").unlink()
    write(tmp_path, {"left": "mine"})
    port.close()
    assert (tmp_path / "left").read_text() == "mine"


@pytest.mark.parametrize(
    "output", [".tacpipe", ".tacpipe/objects", ".tacpipe/new/deep", "link/data", "other/new", "other/report.html"]
)
def test_no_output_lies_within_a_store(lab: Lab, output: str) -> None:
    lab.run("simulate toy -o data/r --trials 1 --rows 3")
    Store(lab.folder / "other").prepare()
    Path("link").symlink_to(".tacpipe/tmp")
    before = sorted(path for path in Path().rglob("*") if "presence" not in path.parts)
    refused = lab.call(f"scale data/r -o {output}")
    assert refused.code == 2 and "lies within the store" in refused.err and refused.err.count("\n") == 1
    assert sorted(path for path in Path().rglob("*") if "presence" not in path.parts) == before


@pytest.mark.parametrize("days", ["-5", "nan", "inf"])
def test_a_collection_refuses_a_grace_that_is_no_number_of_days(lab: Lab, days: str) -> None:
    lab.run("simulate toy -o data/r --trials 1 --rows 3")
    refused = lab.call(f"store gc --grace-days {days}")
    assert refused.code == 2 and f"--grace-days is {days}; it must be a number of days of 0 or more." in refused.err


def test_a_simulation_refuses_more_trials_than_a_dataset_holds(lab: Lab) -> None:
    refused = lab.call("simulate toy -o data/r --trials 99999999999")
    assert refused.code == 2 and "--trials is 99999999999; a dataset holds at most 1,000,000 recordings." in refused.err
