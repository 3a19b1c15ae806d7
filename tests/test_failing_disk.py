"""A disk that fails to read, or a limit of open files, is its own sentence: never called damage, nor taken for absence."""

import errno
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tacpipe.datasets import manifest
from tacpipe.datasets.paths import verified_copy
from tacpipe.errors import FAILED, StorageError
from tacpipe.maintenance import checkout, garbage, pushed, repair, unnamed
from tacpipe.store import layout, location, projects
from tacpipe.store.store import Store
from tests.conftest import Lab, write_source
from tests.test_garbage import age

NUMBERS = [errno.EIO, errno.EMFILE, errno.ESTALE, errno.EACCES]
names = errno.errorcode.__getitem__


@contextmanager
def failing(number: int, meets: Callable[[str], bool], calls: tuple[str, ...] = ("open",)) -> Iterator[list[str]]:
    """Have every call of ``os`` with one of these names fail for paths that it ``meets``; yield the paths that it met."""
    met: list[str] = []
    real = {name: getattr(os, name) for name in calls}

    def call(name: str) -> Callable[..., Any]:
        def fail(path: Any, *arguments: Any, **options: Any) -> Any:
            if isinstance(path, str | os.PathLike) and meets(os.fspath(path)):
                met.append(os.fspath(path))
                raise OSError(number, os.strerror(number), os.fspath(path))
            return real[name](path, *arguments, **options)

        return fail

    for name in calls:
        setattr(os, name, call(name))
    try:
        yield met
    finally:
        for name, function in real.items():
            setattr(os, name, function)


@pytest.fixture
def full(lab: Lab) -> Lab:
    """A project with recordings, labels, a chain, a push and what nothing needs any more."""
    write_source("src", a="1 2 97", b="1 2 98")
    lab.run("ingest numbers src -o data/r --jobs 1")
    lab.run("label data/r b --set material=foam")
    lab.run("scale data/r -o data/s --jobs 1")
    lab.run("scale data/r -o data/gone --factor 7 --jobs 1")
    lab.run("store push remote data/r data/s")
    shutil.rmtree("data/gone")
    age(lab)
    return lab


def tree(folder: Path) -> dict[str, bytes]:
    """Return all files of a project but those that state when something was looked at."""
    passing = ("leases", "tmp", "roots")
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.parent.name not in passing and "other" not in path.parts
    }


COMMANDS = [
    "store verify",
    "store repair",
    "store gc --grace-days 0",
    "store list",
    "store status",
    "store checkout data/s -o data/again",
    "store push other data/s",
    "store pull remote data/s",
    "store link data/s",
    "explain data/s",
    "show data/s",
    "scale data/r -o data/s --factor 2 --jobs 1 --recompute-and-compare",
    "label data/r a --set material=cork",
]


@pytest.mark.parametrize(
    "number",
    [errno.EIO, *(pytest.param(number, marks=pytest.mark.long) for number in NUMBERS if number != errno.EIO)],
    ids=names,
)
@pytest.mark.parametrize("folder", ["objects", "records", "roots", "projects"])
def test_no_command_calls_what_the_disk_does_not_give_damaged_or_missing(full: Lab, folder: str, number: int) -> None:
    before = tree(full.folder)
    for command in COMMANDS:
        with failing(
            number, lambda path: f".tacpipe/{folder}/" in path and path.endswith(("json", *"0123456789abcdef"))
        ) as met:
            ran = full.call(command)
        about = f"{command}: {ran}"
        assert ran.code in ((0, FAILED) if met else (0,)), about
        words = ("damaged", "missing", "not in the store", "cannot be recomputed", "no longer", "vanished", "is not a")
        assert not [word for word in words if word in (ran.out + ran.err)], about
        if ran.code:
            assert os.strerror(number) in ran.err and ran.err.count("tacpipe: ") == 1, about
            assert before.items() <= tree(full.folder).items(), about
        else:
            shutil.rmtree("data/again", ignore_errors=True)
            shutil.rmtree("other", ignore_errors=True)
            before = tree(full.folder)
    assert repair.verify(full.store).clean


@pytest.mark.long
@pytest.mark.parametrize("folder", ["objects", "records", "roots"])
def test_a_collection_that_meets_a_file_it_cannot_read_removes_nothing(full: Lab, folder: str) -> None:
    before = tree(full.folder)
    read = 0
    for path in sorted(file for file in full.store.root.glob(f"{folder}/**/*") if file.is_file()):
        with failing(errno.EIO, lambda opened, target=str(path): opened == target) as met:  # type: ignore[misc]
            dry = full.call("store gc --grace-days 0 --dry-run")
            if not met:  # Shards, and manifests that are also in their dataset's folder, are not read.
                continue
            read += 1
            assert dry.code == full.call("store gc --grace-days 0").code == FAILED, path
        assert tree(full.folder) == before, path
    assert read > 2


def test_a_failing_object_is_listed_apart_and_the_rest_is_verified(full: Lab) -> None:
    path = next(full.store.root.glob("objects/*/*"))
    with failing(errno.EIO, lambda opened: opened == str(path)):
        soundness = repair.verify(full.store)
        ran = full.call("store verify --json")
    assert (
        list(soundness.unread) == [path.name]
        and not soundness.damaged
        and not soundness.missing
        and not soundness.clean
    )
    assert soundness.objects == len(list(full.store.root.glob("objects/*/*")))
    assert ran.code == FAILED and path.name in ran.out and '"damaged": []' in ran.out.replace("\n", "")
    assert full.run("store verify").code == 0


def opening(store: Store, folder: Path) -> dict[str, Callable[[], Any]]:
    """Return every function of the store and of its maintenance that opens a file there, called on one that is there."""
    paths = sorted(store.root.glob("objects/*/*"))
    key = next(store.root.glob("records/*/*.json")).stem
    name = next(path.name for path in paths if path.read_bytes()[:2] == b"{\n")
    (root,) = (root for root in store.roots.all() if root["path"].endswith("data/s"))
    return {
        "read": lambda: store.read(name),
        "blocks": lambda: list(store.blocks(name, 1 << 20)),
        "put": lambda: store.put((store.root / "objects" / name[:2] / name).read_bytes(), durable=True),
        "read_record": lambda: store.read_record(key),
        "record": lambda: store.record(key),
        "records": lambda: list(store.records()),
        "records.naming": lambda: list(store.find_naming(name, 0)),
        "roots.all": lambda: store.roots.all(),
        "roots.get": lambda: store.roots.get(folder / "data/s"),
        "projects.known": lambda: projects.identity_of(store, folder),
        "layout.check": lambda: layout.check(store.root),
        "checkout.list_manifests": lambda: checkout.list_manifests(store),
        "garbage.live": lambda: garbage.live(store),
        "pushed.lasting": lambda: pushed.lasting(store, root["manifest"]),
        "unnamed.irreplaceable": lambda: unnamed.irreplaceable(store, [path.name for path in paths], ()),
        "manifest.find": lambda: manifest.find(folder / "data/s"),
        "paths.verified_copy": lambda: verified_copy("ab" * 32, "manifest.json", (str(folder / "data/s"),)),
        "leases.runs": lambda: store.leases.runs(),
    }


@pytest.mark.parametrize("number", NUMBERS, ids=names)
def test_each_function_that_opens_a_file_states_that_the_system_failed(full: Lab, number: int) -> None:
    store = full.store
    before = tree(full.folder)
    for name, call in opening(store, full.folder).items():
        (store.root / f"leases/run-{'ab' * 16}.lock").write_bytes(b"{}")  # A lease of a run that was killed.
        with failing(number, lambda path: str(full.folder) in path) as met:
            try:
                call()
            except (StorageError, OSError) as error:
                raised = str(error)
            else:
                pytest.fail(f"{name} raised nothing")
        assert met and os.strerror(number) in raised, name
        assert tree(full.folder) == before, name
        call()


def test_a_limit_of_open_files_names_the_command_that_raises_it(full: Lab) -> None:
    with failing(errno.EMFILE, lambda path: "/objects/" in path):
        ran = full.call("store checkout data/s -o data/again")
    assert ran.code == FAILED and "ulimit -n" in ran.err


@pytest.mark.parametrize(("number", "limit"), [(errno.EMFILE, "ulimit -n"), (errno.EFBIG, "ulimit -f")], ids=str)
def test_a_limit_that_a_write_meets_names_the_command_that_raises_it(full: Lab, number: int, limit: str) -> None:
    with failing(number, lambda path: "/.tacpipe/tmp/" in path):
        ran = full.call("scale data/r -o data/other --factor 9 --jobs 1")
    assert ran.code == FAILED and limit in ran.err and ran.err.count("\n") == 1
    full.run("scale data/r -o data/other --factor 9 --jobs 1")


@pytest.mark.parametrize("number", NUMBERS, ids=names)
def test_a_mark_that_cannot_be_looked_at_chooses_no_other_store(full: Lab, number: int) -> None:
    below = full.folder / "data/s"
    with failing(number, lambda path: path.endswith(".tacpipe"), ("lstat",)), pytest.raises(StorageError):
        location.project(below)
    assert location.project(below) == full.folder


@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE], ids=names)
def test_an_object_that_is_aside_and_cannot_be_put_back_is_not_gone(full: Lab, number: int) -> None:
    store = full.store
    path = next(store.root.glob("objects/*/*"))
    path.rename(store.aside_path(path.name))
    with failing(number, lambda opened: "/tmp/gc-" in opened, ("rename",)), pytest.raises(StorageError):
        store.has(path.name)
    assert store.has(path.name)


@pytest.mark.parametrize("number", NUMBERS, ids=names)
def test_a_recording_whose_only_copy_cannot_be_read_is_not_called_lost(full: Lab, number: int) -> None:
    shutil.rmtree(full.store.root / "objects")
    (full.store.root / "objects").mkdir()
    with failing(number, lambda path: path.endswith(".parquet")) as met:
        ran = full.call("scale data/r -o data/other --factor 5 --jobs 1")
    assert met and ran.code == FAILED and os.strerror(number) in ran.err and "restore" not in ran.err
    full.run("scale data/r -o data/other --factor 5 --jobs 1")


def test_a_verification_that_cannot_look_for_objects_says_so_and_goes_to_its_end(
    full: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(store: Store, names: Iterable[str]) -> dict[str, int]:
        raise StorageError("The disk failed.")

    monkeypatch.setattr(Store, "sizes", fail)
    ran = full.call("store verify")
    assert ran.code == FAILED and "not read, and perhaps sound: objects: The disk failed." in ran.out
