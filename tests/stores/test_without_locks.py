"""Test every order of a push and a concurrent operation in a store without locks."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tacpipe.errors import DamagedError, StorageError, TacpipeError, UsageError
from tacpipe.io.hashing import bytes_digest
from tacpipe.maintenance import copying, garbage, repair, transfer
from tacpipe.store.bucket import Bucket
from tacpipe.store.remote import RemoteStore
from tests.conftest import Lab
from tests.promises.counts import count
from tests.stores.stepping import Stepping

FOLDERS = ("", "objects", "records", "roots", "snapshots", "leases", "tmp")
EVERY = pytest.mark.parametrize("stride", [pytest.param(1, marks=pytest.mark.faults), 7])


pytestmark = pytest.mark.usefixtures("one_at_a_time")


def push(monkeypatch: pytest.MonkeyPatch, files: Bucket, path: str, **options: Any) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(transfer, "named_store", lambda remote: RemoteStore(files))
        transfer.push("s3://lab/store", [Path(path)], **options)


def expect_whole(files: Bucket, manifests: set[str]) -> None:
    """Expect all objects that the pushed datasets name, and that these datasets are ``manifests``."""
    store = RemoteStore(files)
    report = repair.verify(store)
    assert report.clean, report.to_text()
    assert {root["manifest"] for root in store.roots.all()} == manifests


def manifest(lab: Lab, path: str) -> str:
    return bytes_digest((lab.folder / path / "manifest.json").read_bytes())


@pytest.fixture
def abandoned(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """A bucket with objects that nothing names any more, which a push would reuse and a collection would remove."""
    lab.run("simulate toy -o data/r --trials 2 --rows 3")
    lab.run("scale data/r -o data/s --factor 1")
    files = Stepping({})
    push(monkeypatch, files, "data/s")
    (root,) = RemoteStore(files).roots.all()
    RemoteStore(files).roots.remove(root)
    return files.content()


def steps_of(content: dict[str, bytes], work: Callable[[Stepping], object], stride: int) -> Iterator[int]:
    files = Stepping(content)
    files.begin(0, lambda: None)
    work(files)
    assert files.steps > 10
    return iter(range(1, files.steps + 1, stride))


def collect(files: Bucket) -> None:
    garbage.collect(RemoteStore(files), dry_run=False, recordings=True)


@EVERY
def test_a_collection_at_any_step_of_a_push_takes_nothing_that_it_needs(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, abandoned: dict[str, bytes], stride: int
) -> None:
    for step in steps_of(abandoned, lambda files: push(monkeypatch, files, "data/s"), stride):
        files = Stepping(abandoned)
        files.begin(step, lambda: collect(files))  # noqa: B023
        push(monkeypatch, files, "data/s")
        expect_whole(files, {manifest(lab, "data/s")})
        count("collections beside pushes, without locks")


@EVERY
@pytest.mark.parametrize("collections", [1, 2])
def test_a_push_at_any_step_of_a_collection_finds_or_brings_all_that_it_needs(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, abandoned: dict[str, bytes], stride: int, collections: int
) -> None:
    for step in steps_of(abandoned, collect, stride):
        files = Stepping(abandoned)

        def push_and_collect(files: Stepping = files) -> None:
            push(monkeypatch, files, "data/s")
            if collections > 1:
                collect(files)

        files.begin(step, push_and_collect)
        collect(files)
        expect_whole(files, {manifest(lab, "data/s")})
        count("pushes beside collections, without locks")


@pytest.mark.inline
@EVERY
def test_a_collection_that_is_killed_at_any_step_loses_nothing_and_the_next_one_ends_it(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, abandoned: dict[str, bytes], stride: int
) -> None:
    def killed() -> None:
        raise KeyboardInterrupt

    for step in steps_of(abandoned, collect, stride):
        files = Stepping(abandoned)
        push(monkeypatch, files, "data/s")
        lab.run("scale data/r -o data/t --factor 5")
        push(monkeypatch, files, "data/t")
        (root_of_t,) = [root for root in RemoteStore(files).roots.all() if root["path"] == "data/t"]
        RemoteStore(files).roots.remove(root_of_t)
        files.begin(step, killed)
        with pytest.raises(KeyboardInterrupt):
            collect(files)
            killed()  # it took fewer steps
        expect_whole(files, {manifest(lab, "data/s")})
        collect(files)
        files.days = 15  # later
        collect(files)
        expect_whole(files, {manifest(lab, "data/s")})
        assert not list(files.list("tmp")) and not list(files.list("leases"))
        assert len(list(files.list("objects"))) == 2 + 2  # manifests too
        count("collections killed, without locks")


@EVERY
def test_a_push_that_is_killed_at_any_step_leaves_what_was_pushed_before_and_its_rerun_gives_the_same_bytes(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, abandoned: dict[str, bytes], stride: int
) -> None:
    def killed() -> None:
        raise KeyboardInterrupt

    pushed_bucket = Stepping({})
    push(monkeypatch, pushed_bucket, "data/s")
    expected = {
        name: value for name, value in pushed_bucket.content().items() if name.startswith(("objects", "records"))
    }
    for step in steps_of({}, lambda files: push(monkeypatch, files, "data/s"), stride):
        files = Stepping({})
        files.begin(step, killed)
        with pytest.raises(KeyboardInterrupt):
            push(monkeypatch, files, "data/s")
            killed()
        if RemoteStore(files).check():
            assert repair.verify(RemoteStore(files)).clean
        push(monkeypatch, files, "data/s")
        expect_whole(files, {manifest(lab, "data/s")})
        assert {name: value for name, value in files.content().items() if name in expected} == expected
        count("pushes killed, without locks")


@EVERY
def test_a_push_of_the_same_name_at_any_step_of_a_push_is_never_written_over_in_silence(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, abandoned: dict[str, bytes], stride: int
) -> None:
    base = Stepping({})
    push(monkeypatch, base, "data/r")
    lab.run("label data/r trial-000 --label material=foam")
    labelled = manifest(lab, "data/r")
    before = (lab.folder / "data/r/manifest.json").read_bytes()

    other_manifests: list[str] = []

    def push_other() -> None:
        lab.run("label data/r trial-000 --label material=cork")
        push(monkeypatch, files, "data/r", replace=True)
        other_manifests.append(manifest(lab, "data/r"))

    for step in steps_of(base.content(), lambda files: push(monkeypatch, files, "data/r", replace=True), stride):
        (lab.folder / "data/r/manifest.json").write_bytes(before)
        files = Stepping(base.content())
        other_manifests.clear()
        files.begin(step, push_other)
        try:
            push(monkeypatch, files, "data/r")
            refused = False
        except UsageError:  # the push of the other one was never pulled here
            refused = True
        except TacpipeError as error:
            raise AssertionError(str(error)) from error
        (root,) = RemoteStore(files).roots.all()
        history = {root["manifest"], *(entry["manifest"] for entry in root["history"])}
        assert {*other_manifests, *([] if refused else [labelled])} <= history, (step, refused)
        assert repair.verify(RemoteStore(files)).clean
        count("pushes of one name at once")


def test_a_push_whose_announcement_was_removed_says_so(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, abandoned: dict[str, bytes]
) -> None:
    files = Stepping(abandoned)
    honest = copying._send

    def send(*args: Any) -> None:
        honest(*args)
        for entry in files.list("leases"):
            files.delete(entry.name)

    monkeypatch.setattr(copying, "_send", send)
    with pytest.raises(TacpipeError, match="again"):
        push(monkeypatch, files, "data/s")


def test_announcements_that_are_older_than_the_grace_by_the_clock_of_the_place_are_removed(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, abandoned: dict[str, bytes]
) -> None:
    files = Stepping(abandoned)
    names = [f"leases/run-{digit * 32}.lock" for digit in "ab"]
    for name in names:
        files.create(name, b"{}")
    honest = files.list

    def listed(folder: str) -> Iterator[Any]:
        for entry in honest(folder):
            yield entry._replace(changed_s=entry.changed_s - 15 * 86400) if entry.name == names[0] else entry

    monkeypatch.setattr(files, "list", listed)
    collect(files)
    assert [entry.name for entry in honest("leases")] == names[1:]


def test_a_server_that_writes_over_what_it_is_asked_to_keep_is_refused(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.run("simulate toy -o data/r --trials 1 --rows 3")
    files = Stepping({})

    def create(name: str, content: Any) -> bool:
        files.delete(name)
        return Bucket.create(files, name, content)

    monkeypatch.setattr(files, "create", create)
    for _ in range(2):  # a store that is there already is refused too
        with pytest.raises(UsageError, match="conditional"):
            push(monkeypatch, files, "data/r")
    assert not [*files.list("objects"), *files.list("roots")]


def damaging(monkeypatch: pytest.MonkeyPatch, files: Stepping, name: str, answers: list[bytes]) -> None:
    """Have the next reads of a file give ``answers``, and those after them what the file holds."""

    def read(path: str, most: int | None = None) -> bytes:
        if path.startswith(name) and answers:
            return answers.pop(0)
        return Bucket.read(files, path, most)

    monkeypatch.setattr(files, "read", read)


@pytest.fixture
def pushed(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Stepping:
    """A bucket to which a dataset was pushed."""
    lab.run("simulate toy -o data/r --trials 1 --rows 3")
    files = Stepping({})
    push(monkeypatch, files, "data/r")
    return files


@pytest.mark.parametrize("name", ["roots/", "records/", "format"])
@pytest.mark.parametrize("answer", [b"", b"<html>Sign in</html>", b"{}", b"\xff" * 10])
def test_one_bad_answer_of_a_server_is_no_damage(
    pushed: Stepping, monkeypatch: pytest.MonkeyPatch, name: str, answer: bytes
) -> None:
    store, content = RemoteStore(pushed), pushed.content()
    (expected,), count = store.roots.all(), len(list(store.records()))
    damaging(monkeypatch, pushed, name, [answer])
    assert store.check() and store.roots.pushed("data/r", expected["project"]["id"]) == expected
    damaging(monkeypatch, pushed, name, [answer])
    assert store.roots.damaged() == [] and len(list(store.records())) == count
    damaging(monkeypatch, pushed, name, [answer])
    _, record = next(store.records())
    store.commit(record["identity"], record["result"], record["provenance"])
    damaging(monkeypatch, pushed, name, [])
    assert pushed.content() == content


def test_answers_that_differ_are_an_error_of_the_server_and_two_alike_are_damage(
    pushed: Stepping, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = RemoteStore(pushed)
    (root,) = store.roots.all()
    project = root["project"]["id"]
    damaging(monkeypatch, pushed, "roots/", [b"<html>1</html>", b"<html>2</html>"])
    with pytest.raises(StorageError, match=r"returns different content .*run the same command again"):
        store.roots.pushed("data/r", project)
    damaging(monkeypatch, pushed, "roots/", [b"<html>"] * 2)
    with pytest.raises(DamagedError, match=r"two reads gave the same bytes. Delete it"):
        store.roots.pushed("data/r", project)


def test_a_collection_takes_what_was_quarantined_fourteen_days_ago(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("simulate toy -o data/s --trials 2 --rows 3")
    files = Stepping({})
    push(monkeypatch, files, "data/s")
    before = files.content()
    ages_days = {"1" * 64: 13.9, "2" * 64: 14.1}
    for name, age_days in ages_days.items():
        files.create(f"quarantine/{name}.{time.time_ns() - int(age_days * 86400e9)}", b"damaged")
    collect(files)
    kept = {name for name in files.content() if name.startswith("quarantine/")}
    assert [name.split("/")[1].partition(".")[0] for name in kept] == ["1" * 64]
    assert before.keys() <= files.content().keys()


def test_nothing_is_collected_while_a_manifest_that_others_need_is_in_quarantine(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, abandoned: dict[str, bytes]
) -> None:
    files = Stepping(abandoned)
    push(monkeypatch, files, "data/s")
    (needed,) = lab.manifest("data/s").ancestors
    assert RemoteStore(files).quarantine(needed)
    content = files.content()
    with pytest.raises(DamagedError, match=f"{needed[:12]}.*nothing was removed"):
        collect(files)
    assert files.content() == content
