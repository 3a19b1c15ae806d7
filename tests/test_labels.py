"""`label` and `show` read and write only what they change or list, however many recordings there are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tacpipe.cli.show import SHOWN
from tacpipe.store.store import Store
from tests.conftest import Lab

MANY = SHOWN + 10
STREAMS = 2  # Each recording of the toy has this many.


@pytest.fixture
def many_recordings(lab: Lab) -> Lab:
    lab.run(f"simulate toy --trials {MANY} -o data/r --jobs 1")
    return lab


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """A function that returns how many objects were read since it was called last."""
    names: list[str] = []
    real = Store.read

    def read(store: Store, name: str, size: int | None = None) -> bytes:
        names.append(name)
        return real(store, name, size)

    monkeypatch.setattr(Store, "read", read)

    def count() -> int:
        read_count = len(names)
        names.clear()
        return read_count

    return count


def test_show_reads_the_shards_of_the_recordings_that_it_lists(many_recordings: Lab, read: Callable[[], int]) -> None:
    text = many_recordings.run("show data/r").out
    assert read() == SHOWN * STREAMS
    assert text.count("left") == SHOWN
    assert f"… and {MANY - SHOWN} more (--full)" in text
    assert f"{MANY} recordings, {MANY * STREAMS * 20} rows" in text
    assert f"material: cork ({MANY})" in text
    assert many_recordings.run("show data/r --full").out.count("left") == MANY
    assert read() == MANY * STREAMS
    assert len(many_recordings.run_json("show data/r")["recordings"]) == MANY


def inodes(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_ino for path in folder.rglob("*.parquet")}


def test_a_label_reads_and_writes_no_shard(many_recordings: Lab, read: Callable[[], int]) -> None:
    before = inodes(many_recordings.folder / "data/r")
    assert len(before) == MANY * STREAMS
    read()
    many_recordings.run("label data/r trial-003 --label material=foam")
    shards = {digest for _, digest in many_recordings.manifest("data/r").objects()}
    assert read() <= 3  # manifests
    assert inodes(many_recordings.folder / "data/r") == before
    assert all(many_recordings.store.has(digest) for digest in shards)
    assert many_recordings.manifest("data/r").recordings["trial-003"]["attributes"]["material"] == "foam"


def test_a_shard_that_is_gone_when_a_label_is_set_is_brought_back_by_link(many_recordings: Lab) -> None:
    shard = many_recordings.folder / "data/r/trial-000/left.parquet"
    content = shard.read_bytes()
    shard.unlink()
    many_recordings.run("label data/r trial-003 --label material=foam")
    many_recordings.run("store link data/r")
    assert shard.read_bytes() == content


@pytest.mark.parametrize(("trials", "ending"), [(3, "it has trial-000, trial-001, trial-002."), (7, "and 2 more.")])
def test_a_recording_that_is_not_there_is_refused_with_those_that_are(lab: Lab, trials: int, ending: str) -> None:
    lab.run(f"simulate toy --trials {trials} -o data/r --jobs 1")
    failed = lab.call("label data/r nobody --label a=b")
    assert failed.code == 2 and "nobody" in failed.err and failed.err.rstrip().endswith(ending)


def test_a_label_of_several_lines_is_refused_on_one(lab: Lab) -> None:
    lab.run("simulate toy --trials 1 -o data/r --jobs 1")
    failed = lab.call("label data/r trial-000 --label 'a\nb=c'")
    assert failed.code == 2 and failed.err.count("\n") == 1 and "a\\nb=c" in failed.err
