"""Reading ahead gives what reading alone gives: the same content, the same errors, nothing unverified."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from tacpipe import ahead
from tacpipe.ahead import Ahead
from tacpipe.errors import DamagedError
from tacpipe.hashing import bytes_digest

WORTH = 1000
CONTENTS = {f"trial-{number}": bytes([number]) * (WORTH + number) for number in range(6)}
DIGESTS = {path: bytes_digest(content) for path, content in CONTENTS.items()}


class Shelf:
    """Content by digest in a folder, read as a store reads: verified, damage refused; what was read is noted."""

    def __init__(self, folder: Path, contents: Mapping[str, bytes]) -> None:
        self.folder, self.asked = folder, list[str]()
        self.digests = {path: bytes_digest(content) for path, content in contents.items()}
        for path, content in contents.items():
            (folder / self.digests[path]).write_bytes(content)

    def read(self, name: str, path: str) -> bytes:
        self.asked.append(path)
        content = (self.folder / name).read_bytes()
        if bytes_digest(content) != name:
            raise DamagedError(f"{path} was damaged.")
        return content

    def sequences(self) -> Iterator[list[tuple[str, str]]]:
        yield [(name, path) for path, name in self.digests.items()]

    def ahead(self) -> Ahead:
        return Ahead(self.read, lambda name: str(self.folder / name), self.sequences)


@pytest.fixture(autouse=True)
def worth(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread is worth its while from a thousand bytes."""
    monkeypatch.setattr(ahead, "WORTH_BYTES", WORTH)


@pytest.fixture
def shelf(tmp_path: Path) -> Shelf:
    return Shelf(tmp_path, CONTENTS)


def wait() -> None:
    """Let all readings end."""
    for thread in threading.enumerate():
        if thread.name.startswith("ahead-"):
            thread.join()


def test_whoever_goes_through_in_order_gets_each_content_and_asks_for_two_alone(shelf: Shelf) -> None:
    reader = shelf.ahead()
    assert {path: reader(name, path) for path, name in DIGESTS.items()} == CONTENTS
    assert shelf.asked == ["trial-0", "trial-1"]


def test_whoever_goes_backwards_or_leaps_reads_nothing_ahead(shelf: Shelf) -> None:
    reader = shelf.ahead()
    for path in [*reversed(CONTENTS), "trial-0", "trial-2", "trial-4"]:
        assert reader(DIGESTS[path], path) == CONTENTS[path]
    assert shelf.asked == [*reversed(CONTENTS), "trial-0", "trial-2", "trial-4"]


def test_small_content_starts_no_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def started(*given: object) -> None:
        raise AssertionError("a thread was started")

    monkeypatch.setattr(ahead, "_Reading", started)
    small = {path: content[: WORTH - 1] for path, content in CONTENTS.items()}
    shelf = Shelf(tmp_path, small)
    reader = shelf.ahead()
    assert {path: reader(name, path) for path, name in shelf.digests.items()} == small
    big = Shelf(tmp_path, CONTENTS)
    with pytest.raises(AssertionError, match="a thread was started"):
        list(map(big.ahead(), big.digests.values(), big.digests))


def test_damage_that_was_read_ahead_is_told_when_it_is_asked_for_and_not_before(shelf: Shelf) -> None:
    damaged = shelf.folder / DIGESTS["trial-2"]
    damaged.write_bytes(CONTENTS["trial-2"][:-1] + b"\xff")
    (shelf.folder / DIGESTS["trial-4"]).unlink()
    reader = shelf.ahead()
    reader(DIGESTS["trial-0"], "trial-0")
    assert reader(DIGESTS["trial-1"], "trial-1") == CONTENTS["trial-1"]
    wait()
    with pytest.raises(DamagedError, match=r"^trial-2 was damaged\.$"):
        reader(DIGESTS["trial-2"], "trial-2")
    assert shelf.asked == ["trial-0", "trial-1", "trial-2"]
    damaged.write_bytes(CONTENTS["trial-2"])  # as mended: it is read again, not remembered as bad
    assert reader(DIGESTS["trial-2"], "trial-2") == CONTENTS["trial-2"]
    assert reader(DIGESTS["trial-3"], "trial-3") == CONTENTS["trial-3"]
    wait()
    with pytest.raises(FileNotFoundError):
        reader(DIGESTS["trial-4"], "trial-4")


def test_no_more_than_a_few_shards_are_held_however_much_is_begun_and_left(tmp_path: Path) -> None:
    several = {
        f"{stream}/{path}": bytes([position]) + content
        for position, stream in enumerate("abcdefgh")
        for path, content in CONTENTS.items()
    }
    shelf = Shelf(tmp_path, several)
    streams = [[(name, path) for path, name in shelf.digests.items() if path[0] == stream] for stream in "abcdefgh"]
    reader = Ahead(shelf.read, lambda name: str(shelf.folder / name), lambda: iter(streams))
    for given in streams:
        for name, path in given[:2]:
            reader(name, path)
    assert len(reader._readings) == 4


def test_a_process_that_was_forked_while_something_was_read_ahead_reads_on(shelf: Shelf) -> None:
    reader = shelf.ahead()
    for path in ("trial-0", "trial-1"):
        reader(DIGESTS[path], path)
    wait()
    child = os.fork()
    if child == 0:
        rest = [path for path in CONTENTS if path not in ("trial-0", "trial-1")]
        os._exit(0 if all(reader(DIGESTS[path], path) == CONTENTS[path] for path in rest) else 1)
    assert os.waitpid(child, 0)[1] == 0
