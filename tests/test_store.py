import errno
import fcntl
import json
import os
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import LockedError, TacpipeError
from tacpipe.io.drafts import Draft
from tacpipe.io.hashing import bytes_digest, digest
from tacpipe.store.location import locate, project
from tacpipe.store.store import MissingError, Store

IDENTITY = {"stage": "scale", "version": 1, "params": {}, "inputs": {}}
EMPTY: dict[str, dict[str, object]] = {"recordings": {}, "files": {}}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    made = Store(tmp_path / ".tacpipe")
    made.prepare()
    return made


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
    inside, most = 0, 0

    def work() -> None:
        nonlocal inside, most
        for _ in range(20):
            with store.leases.hold("cd" * 32):
                inside += 1
                most = max(most, inside)
                inside -= 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1


def test_a_lease_that_another_computer_unlinked_meanwhile_is_taken_anew(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest, gone = fcntl.flock, [errno.ESTALE, errno.ESTALE]  # as a network file system answers

    def flock(handle: int, operation: int) -> None:
        if gone:
            raise OSError(gone.pop(), "Stale file handle")
        honest(handle, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    with store.leases.hold("ab" * 32, timeout_s=5):
        assert not gone
    gone.append(errno.ESTALE)
    with store.at_work():
        assert not gone


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


@pytest.mark.parametrize(("path", "kind"), [("/lab/data/s", "absolute"), ("data/s", "pushed")])
def test_a_root_as_it_was_once_written_is_read(store: Store, path: str, kind: str) -> None:
    old = {"path": path, "manifest": "ab" * 32, "previous": None, "written_s": 1}
    (store.root / "roots" / "old.json").write_text(json.dumps(old))
    assert store.roots.all() == [{**old, "kind": kind}]


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


def test_settling_syncs_each_folder_above_the_names_once_and_those_within_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path / "store")
    store.prepare()
    synced: list[str] = []
    monkeypatch.setattr("tacpipe.store.store.sync_folder", lambda path: synced.append(str(Path(path))))
    store.settle(["objects/ab/x", "objects/ab/y", "records/cd/z"])
    folders = [str(tmp_path / "store" / name) for name in ("objects/ab", "objects", "records/cd", "records", "")]
    assert sorted(synced) == sorted(folders)
    assert synced.index(folders[0]) < synced.index(folders[1]) < synced.index(folders[4])
