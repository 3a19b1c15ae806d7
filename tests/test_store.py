import errno
import fcntl
import json
import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import LockedError, TacpipeError, UsageError
from tacpipe.io.files import Draft
from tacpipe.io.hashing import bytes_digest, digest
from tacpipe.store.location import locate, project
from tacpipe.store.records import StageIdentity, StoredResult
from tacpipe.store.store import MissingError, Store
from tests.conftest import Lab, Ran

IDENTITY: StageIdentity = {"stage": "scale", "version": 1, "params": {}, "inputs": {}}
EMPTY: StoredResult = {"recordings": {}, "files": {}}


def test_what_is_put_comes_back_and_lies_under_its_digest_read_only(store: Store) -> None:
    stored = store.put(b"touch")
    path = Path(store.object_path(stored.digest))
    assert stored.digest == bytes_digest(b"touch") and stored.bytes == 5
    assert store.read(stored.digest) == path.read_bytes() == b"touch"
    assert path.stat().st_mode & 0o777 == 0o444
    assert path.parent.name == stored.digest[:2]


def test_putting_twice_writes_once(store: Store) -> None:
    path = Path(store.object_path(store.put(b"touch").digest))
    inode = path.stat().st_ino
    store.put(b"touch")
    assert path.stat().st_ino == inode


def test_what_is_written_bit_by_bit_is_the_object_that_it_would_be_in_one_piece(store: Store) -> None:
    def write(file: Draft) -> None:
        for piece in (b"to", memoryview(b"uc"), b"", b"h"):
            file.write(piece)

    for durable in (False, True):
        assert store.put_written(write, durable=durable) == store.put(b"touch")
    path = Path(store.object_path(bytes_digest(b"touch")))
    assert path.read_bytes() == b"touch" and path.stat().st_mode & 0o777 == 0o444
    assert not list((store.root / "tmp").iterdir())


def test_what_fails_while_it_is_written_leaves_nothing(store: Store) -> None:
    def write(file: Draft) -> None:
        file.write(b"tou")
        raise TacpipeError("the rest cannot be read")

    with pytest.raises(TacpipeError, match="the rest"):
        store.put_written(write)
    assert not [path for name in ("tmp", "objects") for path in (store.root / name).rglob("*") if path.is_file()]


def test_what_is_written_durably_replaces_a_damaged_copy(store: Store) -> None:
    path = Path(store.object_path(store.put(b"touch").digest))
    path.chmod(0o644)
    path.write_bytes(b"torch")
    store.put_written(lambda file: file.write(b"touch"), durable=True)
    assert store.read(bytes_digest(b"touch")) == b"touch"


@given(st.data())
def test_a_byte_flipped_anywhere_is_found_on_the_next_read_and_quarantined(data: st.DataObject) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder) / "store")
        store.prepare()
        content = data.draw(st.binary(min_size=1, max_size=200))
        stored = store.put(content)
        path = Path(store.object_path(stored.digest))
        path.chmod(0o644)
        damaged = bytearray(content)
        damaged[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
        path.write_bytes(damaged)
        with pytest.raises(MissingError, match="quarantine"):
            store.read(stored.digest)
        assert not store.has(stored.digest)
        assert [file.read_bytes() for file in (store.root / "quarantine").iterdir()] == [bytes(damaged)]


def test_what_cannot_be_made_again_replaces_a_damaged_copy_of_itself(store: Store) -> None:
    stored = store.put(b"recording")
    path = Path(store.object_path(stored.digest))
    path.chmod(0o644)
    path.write_bytes(b"recordinh")
    store.put(b"recording", durable=True)
    assert store.read(stored.digest) == b"recording"


def test_the_first_to_finish_wins(store: Store) -> None:
    first = store.commit(IDENTITY, {**EMPTY, "files": {"a": {"digest": "1", "bytes": 1}}}, {})
    second = store.commit(IDENTITY, {**EMPTY, "files": {"a": {"digest": "2", "bytes": 1}}}, {})
    assert second == first == store.record(digest(IDENTITY))


def test_a_record_that_was_tampered_with_counts_as_none_and_is_quarantined(store: Store) -> None:
    store.commit(IDENTITY, EMPTY, {})
    path = Path(store.record_path(digest(IDENTITY)))
    record = json.loads(path.read_text())
    record["result"]["files"] = {"a": {"digest": "0", "bytes": 0}}
    path.write_text(json.dumps(record))
    assert store.record(digest(IDENTITY)) is None
    assert not path.exists() and len(list((store.root / "quarantine").iterdir())) == 1


def test_a_lease_is_held_by_one_and_its_wait_times_out_with_its_own_exit_code(store: Store) -> None:
    with (
        store.leases.hold("ab" * 32),
        pytest.raises(LockedError, match="TACPIPE_LOCK_TIMEOUT_S") as caught,
        store.leases.hold("ab" * 32, timeout_s=0.05),
    ):
        pass
    assert caught.value.exit_code == 6
    with store.leases.hold("ab" * 32, timeout_s=0):
        pass
    assert list((store.root / "leases").iterdir()) == []


def test_leases_let_one_at_a_time_through(store: Store) -> None:
    inside, most_inside = 0, 0

    def work() -> None:
        nonlocal inside, most_inside
        for _ in range(20):
            with store.leases.hold("cd" * 32):
                inside += 1
                most_inside = max(most_inside, inside)
                inside -= 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most_inside == 1


def test_a_lease_that_another_computer_unlinked_meanwhile_is_taken_anew(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest, failures = fcntl.flock, [errno.ESTALE, errno.ESTALE]  # A network file system answers so.

    def flock(handle: int, operation: int) -> None:
        if failures:
            raise OSError(failures.pop(), "Stale file handle")
        honest(handle, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    with store.leases.hold("ab" * 32, timeout_s=5):
        assert not failures
    failures.append(errno.ESTALE)
    with store.at_work():
        assert not failures


def test_a_process_that_died_holds_no_lease(store: Store) -> None:
    child = os.fork()
    if child == 0:
        with store.leases.hold("ef" * 32):
            os._exit(9)
    os.waitpid(child, 0)
    with store.leases.hold("ef" * 32, timeout_s=0):
        pass


def test_runs_are_seen_while_they_last(store: Store) -> None:
    child = os.fork()
    if child == 0:
        with store.leases.running(["dead"]):
            os._exit(9)
    os.waitpid(child, 0)
    assert store.leases.runs() == []
    with store.leases.running(["m"]):
        handle = Store(store.root)
        (run,) = handle.leases.runs()
        assert run.manifests == ["m"] and run.note["pid"] == os.getpid()
    assert store.leases.runs() == []


def test_a_root_remembers_what_was_at_its_path_before(store: Store, tmp_path: Path) -> None:
    store.roots.set(tmp_path / "data", "first")
    store.roots.set(tmp_path / "data", "second")
    store.roots.set(tmp_path / "data", "second")
    root = store.roots.get(tmp_path / "data")
    assert root is not None and (root["manifest"], root["previous"]) == ("second", "first")


def test_a_store_of_another_format_is_refused(store: Store) -> None:
    (store.root / "format").write_text("7\n")
    with pytest.raises(TacpipeError, match="format 7"):
        store.prepare()


def test_the_store_lies_beside_the_project_or_where_the_environment_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TACPIPE_STORE", raising=False)
    (tmp_path / "dvc.yaml").touch()
    deep = tmp_path / "data" / "synced"
    deep.mkdir(parents=True)
    assert locate(deep).root == tmp_path / ".tacpipe"
    assert project(deep) == tmp_path
    monkeypatch.setenv("TACPIPE_STORE", str(tmp_path / "elsewhere"))
    assert locate(deep).root == tmp_path / "elsewhere"


def folders(root: Path, *paths: str) -> None:
    """Make folders (``a/``) and empty files below ``root``."""
    for path in paths:
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).mkdir(exist_ok=True) if path.endswith("/") else (root / path).touch()


@pytest.mark.parametrize(
    ("present", "working_folder", "datasets", "expected"),
    [
        (["lab/.tacpipe/"], "lab/a", ["lab/a/data/r"], "lab/a"),  # a stray store above an unmarked folder
        (["lab/.tacpipe/", "lab/a/.git/"], "lab/a/data", ["lab/a/data/r"], "lab/a"),
        (["lab/.tacpipe/project"], "lab/a", ["lab/a/data/r"], "lab"),  # `tacpipe store init` marks it so.
        (["lab/.tacpipe/", "lab/pyproject.toml"], "lab/a", ["lab/a/data/r"], "lab"),
        (["lab/.tacpipe/", "lab/params.yaml"], "", ["lab/a/data/r"], "lab"),
        (["lab/.git/", "lab/a/.tacpipe/"], "lab", ["lab/a/data/r"], "lab/a"),
        (["lab/.git/", "b/.git/"], "lab", ["b/data/s", "lab/data/r"], "b"),  # the output's project
        (["lab/.git/", "b/"], "lab", ["b/data/s", "lab/data/r"], "lab"),  # the output lies in none
        (["lab/.git/"], "b", ["b/data/s", "lab/data/r"], "b"),  # below the working directory
        (["lab/.git/"], "b", [], "b"),
        (["lab/.git/"], "lab/a", [], "lab"),
    ],
)
def test_the_store_is_that_of_the_project_in_which_the_datasets_lie(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    present: list[str],
    working_folder: str,
    datasets: list[str],
    expected: str,
) -> None:
    folders(tmp_path, *present, f"{working_folder}/.keep")
    monkeypatch.chdir(tmp_path / working_folder)
    assert project(*(tmp_path / path for path in datasets)) == tmp_path / expected


def test_a_store_above_the_project_is_used_with_a_notice_where_it_holds_a_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folders(tmp_path, "lab/a/.git/", "elsewhere/.tacpipe/")
    stray = Store(tmp_path / "lab/.tacpipe")
    stray.prepare()
    recordings, synced = tmp_path / "lab/a/data/r", tmp_path / "lab/a/data/s"
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert project(synced, recordings) == tmp_path / "lab/a" and "is used" not in capsys.readouterr().err
    stray.roots.set(recordings, "0" * 64)
    assert project(synced, recordings) == tmp_path / "lab" and f"{stray.root} is used" in capsys.readouterr().err
    assert project(synced) == tmp_path / "lab/a"
    (tmp_path / "lab/a/.git").rmdir()  # no project is marked any more
    assert project(synced, recordings) == tmp_path / "lab"
    assert project(synced) == tmp_path / "elsewhere"


def test_a_stray_store_captures_no_project_below_and_its_own_datasets_keep_it(
    call: Callable[[str], Ran], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders(tmp_path, "a/", "b/", "elsewhere/")
    monkeypatch.chdir(tmp_path)
    first = call("simulate forward --trials 1 --duration-s 4 -o a/r")
    assert first.code == 0 and first.err.count("created the store") == 1
    monkeypatch.chdir(tmp_path / "b")
    assert f"created the store {tmp_path / 'b/.tacpipe'}" in call("simulate forward --trials 1 --duration-s 4 -o r").err
    monkeypatch.chdir(tmp_path / "elsewhere")
    for reused in (0, 1):
        ran = call(f"synchronize {tmp_path / 'a/r'} -o {tmp_path / 'a/s'} --json")
        assert json.loads(ran.out)["reused"] == reused and "is used: it holds" in ran.err
    assert not Path(".tacpipe").exists()
    assert call("store init").code == 0
    folders(tmp_path, "elsewhere/deep/")
    monkeypatch.chdir(tmp_path / "elsewhere/deep")
    assert json.loads(call("store status --json").out)["store"] == str(tmp_path / "elsewhere/.tacpipe")


@pytest.mark.skipif(os.geteuid() != 0, reason="gives a store to another user, which root alone may")
def test_a_store_of_another_user_is_used_only_where_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / ".tacpipe"
    Store(root).prepare()
    Store(root).roots.set(tmp_path / "a/r", "0" * 64)
    os.chown(root, 12345, -1)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=r"belongs to another user \(id 12345; yours is 0\).*TACPIPE_STORE="):
        locate(tmp_path / "a/r")
    folders(tmp_path, "a/.git/")
    assert locate(tmp_path / "a/r").root == tmp_path / "a/.tacpipe"  # though the other holds it
    monkeypatch.setenv("TACPIPE_STORE", str(root))
    assert locate(tmp_path / "a/r").root == root


def test_settling_syncs_each_folder_above_the_names_once_and_those_within_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path / "store")
    store.prepare()
    synced: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda handle: synced.append(str(Path(f"/proc/self/fd/{handle}").readlink())))
    folders = [str(tmp_path / "store" / name) for name in ("objects/ab", "objects", "records/cd", "records", "")]
    for folder in (folders[0], folders[2]):
        Path(folder).mkdir()
    store.settle(["objects/ab/x", "objects/ab/y", "records/cd/z"])
    assert sorted(synced) == sorted(folders)
    assert synced.index(folders[0]) < synced.index(folders[1]) < synced.index(folders[4])


@pytest.mark.parametrize("harmed", [("data/r",), ("data/s",), ("data/r", "data/s")], ids="+".join)
@pytest.mark.parametrize("removed", [("data/r",), ("data/s",), ("data/r", "data/s")], ids="+".join)
def test_all_damaged_objects_are_recomputed_in_one_run(
    lab: Lab, harmed: tuple[str, ...], removed: tuple[str, ...]
) -> None:
    commands = {"data/r": "simulate toy -o data/r --trials 3 --rows 5", "data/s": "scale data/r -o data/s --factor 3"}
    for command in commands.values():
        lab.run(command)
    before = {path: path.read_bytes() for path in Path("data").rglob("*.parquet")}
    objects = [lab.store.object_path(bytes_digest(before[path])) for path in before if str(path).startswith(harmed)]
    for name in set(objects):
        content = bytearray(Path(name).read_bytes())
        content[len(content) // 2] ^= 1
        Path(name).unlink()  # the outputs are links to it
        Path(name).write_bytes(content)
    for path in before:
        if str(path).startswith(removed):
            path.unlink()
    for directory in removed:
        lab.run(commands[directory])
    assert {path: path.read_bytes() for path in Path("data").rglob("*.parquet")} == before
