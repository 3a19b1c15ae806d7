import pytest

from tacpipe.engine.execution import SharedFiles
from tacpipe.errors import StorageError, TacpipeError
from tacpipe.io.files import Draft
from tacpipe.store.store import Store


class Made:
    """Writes a file, or fails, and counts how often it was asked."""

    def __init__(self, error: Exception | None = None) -> None:
        self.times, self.error = 0, error

    def __call__(self, draft: Draft) -> None:
        self.times += 1
        draft.write(b"touch")
        if self.error is not None:
            raise self.error


def drafts(store: Store) -> list[str]:
    return [path.name for path in (store.root / "tmp").iterdir()]


def test_a_shared_file_is_made_once_for_all_processes_of_a_run_and_goes_with_it(store: Store) -> None:
    with store.at_work():
        make = Made()
        for same_run in (store, Store(store.root, store.run)):
            path = SharedFiles(same_run).file(["a.csv", "skin"], make)
            assert path.read_bytes() == b"touch"
        SharedFiles(store).file(["b.csv", "skin"], make)
        assert make.times == 2 and len(drafts(store)) == 2
    assert not drafts(store)


def test_what_is_wrong_with_a_shared_file_is_found_once_and_reported_to_each(store: Store) -> None:
    with store.at_work():
        make = Made(TacpipeError("a.csv, line 3 has 2 cells"))
        for _ in range(3):
            with pytest.raises(TacpipeError, match="line 3"):
                SharedFiles(store).file("a.csv", make)
        assert make.times == 1


def test_a_disk_that_fails_is_asked_again(store: Store) -> None:
    with store.at_work():
        make = Made(StorageError("the disk is full"))
        for _ in range(2):
            with pytest.raises(StorageError):
                SharedFiles(store).file("a.csv", make)
        assert make.times == 2 and not drafts(store)


def test_what_another_run_left_stays_where_it_is(store: Store) -> None:
    with store.at_work():
        second_store = Store(store.root)
        with second_store.at_work():
            SharedFiles(second_store).file("a.csv", Made())
            drafts_of_first = drafts(store)
            SharedFiles(store).file("a.csv", Made())
            assert len(drafts(store)) == 2
        assert drafts(store) and drafts(store) != drafts_of_first
