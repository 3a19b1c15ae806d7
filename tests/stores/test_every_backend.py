import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tacpipe.io.regular import IrregularError
from tacpipe.store import bucket
from tacpipe.store.backend import Backend
from tacpipe.store.remote import RemoteStore
from tests.promises.counts import count
from tests.stores import places
from tests.stores.places import Place

NAME, OTHER = (f"objects/{digits[:2]}/{digits}" for digits in ("ab" * 32, "cd" * 32))


@pytest.fixture
def files(place: Place) -> Backend:
    return place.files


def test_a_name_is_created_once_and_keeps_its_first_content(files: Backend) -> None:
    assert files.create(NAME, b"first") and not files.create(NAME, b"second")
    assert files.read(NAME) == b"first"


def test_of_sixteen_that_create_a_name_at_once_one_wins_and_its_content_stays(files: Backend) -> None:
    for turn in range(2):
        name = f"objects/0{turn}/0{turn}" + "e" * 62
        won: list[bytes] = []
        begin = threading.Barrier(16)

        def create(content: bytes, name: str = name, won: list[bytes] = won, begin: threading.Barrier = begin) -> None:
            begin.wait()
            if files.create(name, content):
                won.append(content)

        racers = [threading.Thread(target=create, args=(bytes([number]) * 1000,)) for number in range(16)]
        for racer in racers:
            racer.start()
        for racer in racers:
            racer.join()
        assert [files.read(name)] == won
        count("races to create a name in a store", 16)


def test_what_is_not_there_is_a_file_not_found_and_no_entry(files: Backend) -> None:
    with pytest.raises(FileNotFoundError):
        files.read(NAME)
    with pytest.raises(FileNotFoundError):
        list(files.blocks(NAME, 10))
    assert files.stat(NAME) is None and list(files.list("objects")) == []
    assert not files.move(NAME, OTHER)
    files.delete(NAME)


def test_content_that_is_larger_than_stated_is_not_read(files: Backend) -> None:
    files.create(NAME, b"12345")
    assert files.read(NAME, 5) == b"12345"
    with pytest.raises(IrregularError, match="5 bytes"):
        files.read(NAME, 4)
    with pytest.raises(IrregularError, match="5 bytes"):
        list(files.blocks(NAME, 4))


@pytest.mark.parametrize("size", [0, 1, 1000])
def test_content_of_any_size_comes_back(files: Backend, size: int) -> None:
    content = bytes(range(250)) * (size // 250) + b"x" * (size % 250)
    assert files.create(NAME, content) and files.read(NAME) == content
    entry = files.stat(NAME)
    assert entry is not None and (entry.name, entry.bytes) == (NAME, size)
    assert [(listed.name, listed.bytes) for listed in files.list("objects")] == [(NAME, size)]


def large(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """Return the blocks of content that takes three requests; S3 takes no part below 5 MB."""
    monkeypatch.setattr(bucket, "PART_BYTES", 5 << 20)
    return [bytes([number]) * (1 << 20) for number in range(13)]


def test_content_of_several_parts_comes_back(files: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = large(monkeypatch)
    assert files.create(NAME, iter(blocks)) and not files.create(NAME, iter(blocks))
    assert files.read(NAME) == b"".join(blocks) == b"".join(files.blocks(NAME, len(blocks) << 20))


@pytest.mark.parametrize("after", [0, 3, 12])
def test_content_that_turns_out_to_be_damaged_while_it_is_sent_is_not_kept(
    files: Backend, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    def blocks() -> Iterator[bytes]:
        yield from large(monkeypatch)[:after]
        raise ValueError("damaged")

    with pytest.raises(ValueError, match="damaged"):
        files.create(NAME, blocks())
    assert files.stat(NAME) is None and files.create(NAME, b"sound")


def test_a_name_moves_with_its_content_over_what_was_there(files: Backend) -> None:
    files.create(NAME, b"new")
    files.create(OTHER, b"old")
    assert files.move(NAME, OTHER)
    assert files.stat(NAME) is None and files.read(OTHER) == b"new"
    files.delete(OTHER)
    assert files.stat(OTHER) is None


def test_a_folder_of_a_store_lists_what_lies_at_any_depth_in_it_and_nothing_else(files: Backend) -> None:
    lease = f"leases/run-{'0' * 32}.lock"
    for name in (NAME, OTHER, lease):
        files.create(name, b"1")
    assert {entry.name for entry in files.list("objects")} == {NAME, OTHER}
    assert {entry.name for entry in files.list("leases")} == {lease}


def test_a_folder_of_more_names_than_a_server_lists_at_once_is_listed_whole(localbucket: str, tmp_path: Path) -> None:
    (tmp_path / "buckets/lab/store/objects/ab").mkdir(parents=True)
    names = {f"objects/ab/ab{number:062x}" for number in range(2500)}
    for name in names:
        (tmp_path / "buckets/lab/store" / name).write_bytes(b"")
    assert {entry.name for entry in places.bucket("s3://lab/store").files.list("objects")} == names


def test_a_list_of_many_pages_is_whole_also_where_any_request_for_one_fails_once(
    without_profiles: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bucket, "PAGE", 3)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    import obstore
    from obstore.exceptions import GenericError
    from obstore.store import MemoryStore

    lab_bucket = bucket.Bucket("s3://lab/store", MemoryStore())
    names = {f"objects/{number:02x}/{number:02x}{'0' * 62}" for number in range(20)}
    for name in names:
        lab_bucket.create(name, name.encode())
    honest = obstore.list
    for failing in range(1, 9):
        pages = 0

        def failing_once(*args: object, failing: int = failing, **kwargs: object) -> Iterator[object]:
            nonlocal pages
            for page in honest(*args, **kwargs):  # type: ignore[call-overload]
                pages += 1
                if pages == failing:
                    raise GenericError("the connection was lost")
                yield page

        monkeypatch.setattr(obstore, "list", failing_once)
        listed = [entry.name for entry in lab_bucket.list("objects")]
        assert sorted(listed) == sorted(names), failing
        count("requests to a store failed")


def test_only_as_many_pages_are_asked_for_as_are_used(without_profiles: None, monkeypatch: pytest.MonkeyPatch) -> None:
    from obstore.store import MemoryStore

    requests = []

    class Asked(bucket.Bucket):
        def _retry(self, request: Callable[[], Any], tries: int = 0) -> Any:
            requests.append(request)
            return super()._retry(request, tries)

    monkeypatch.setattr(bucket, "PAGE", 2)
    counting_bucket = Asked("s3://lab/store", MemoryStore())
    for number in range(8):
        counting_bucket.create(f"objects/0{number}/0{number}{'0' * 62}", b"x")
    requests.clear()
    next(counting_bucket.list("objects"))
    assert len(requests) == 1


@pytest.mark.parametrize("count_of", [3, 40])
def test_objects_are_looked_for_one_by_one_or_in_a_list_with_the_same_answer(place: Place, count_of: int) -> None:
    store = RemoteStore(place.files)
    sizes = {f"{number:02x}{'1' * 62}": number + 1 for number in range(count_of)}
    for name, size in sizes.items():
        place.files.create(f"objects/{name[:2]}/{name}", b"x" * size)
    absent = [f"{number:02x}{'2' * 62}" for number in range(count_of)]
    assert store.sizes([*absent, *sizes]) == sizes
    assert store.sizes(absent) == {} == store.sizes([])
