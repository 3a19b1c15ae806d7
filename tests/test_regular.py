import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from tacpipe.errors import StorageError
from tacpipe.io import regular
from tests.promises.limits import GIB, bound_memory, is_sentence

TERA = 3 * 10**12


def link(path: Path, target: Path | str) -> None:
    path.symlink_to(target)


def sparse(path: Path, size: int = TERA) -> None:
    path.touch()
    os.truncate(path, size)


def bind(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        folder = os.open(path.parent, os.O_RDONLY)  # a socket's address is short: it is named from its folder
        try:
            listener.bind(f"/proc/self/fd/{folder}/{path.name}")
        finally:
            os.close(folder)


IRREGULAR: dict[str, Callable[[Path], None]] = {
    "a named pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "a socket": bind,
    "a link to a device": lambda path: link(path, "/dev/zero"),
}


@pytest.mark.parametrize("follow", [True, False])
@pytest.mark.parametrize("kind", IRREGULAR)
def test_what_is_not_a_regular_file_is_refused_and_not_waited_for(tmp_path: Path, kind: str, follow: bool) -> None:
    IRREGULAR[kind](tmp_path / "file")
    for read in (regular.content, regular.opened):
        with bound_memory(GIB), pytest.raises(regular.IrregularError) as error:
            read(tmp_path / "file", follow=follow)
        assert is_sentence(str(error.value))


def test_a_link_is_followed_only_where_one_may_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"content")
    link(tmp_path / "link", tmp_path / "file")
    assert regular.content(tmp_path / "link") == b"content"
    with pytest.raises(regular.IrregularError, match="a symbolic link"):
        regular.content(tmp_path / "link", follow=False)


def test_a_file_of_as_many_bytes_as_may_be_is_read_and_one_more_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"12345")
    assert regular.content(tmp_path / "file", 5) == b"".join(regular.blocks(tmp_path / "file", 5)) == b"12345"
    with pytest.raises(regular.IrregularError, match="5 bytes, and should have 4"):
        regular.content(tmp_path / "file", 4)
    with pytest.raises(regular.IrregularError, match="5 bytes, and should have 4"):
        next(regular.blocks(tmp_path / "file", 4))


@pytest.mark.parametrize("size", [0, 1, regular.BLOCK_BYTES, 3 * regular.BLOCK_BYTES + 7])
def test_content_and_blocks_are_the_whole_file(tmp_path: Path, size: int) -> None:
    content = os.urandom(size)
    (tmp_path / "file").write_bytes(content)
    assert regular.content(tmp_path / "file") == content
    assert b"".join(regular.blocks(tmp_path / "file", size)) == content


def test_a_file_that_grows_while_it_is_read_is_read_to_its_end_or_its_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, read = tmp_path / "file", os.read
    path.write_bytes(b"12345")

    def grown(handle: int, count: int) -> bytes:
        with path.open("ab") as file:
            file.write(b"67" if path.stat().st_size < 10 else b"")
        return read(handle, count)

    monkeypatch.setattr(os, "read", grown)
    assert regular.content(path) == b"12345676767"
    path.write_bytes(b"12345")
    with pytest.raises(regular.IrregularError, match="should have 6"):
        regular.content(path, 6)


def test_a_file_of_three_terabytes_is_refused_before_it_is_read(tmp_path: Path) -> None:
    sparse(tmp_path / "file")
    with bound_memory(GIB), pytest.raises(StorageError, match=r"3,000\.0 GB"):
        regular.content(tmp_path / "file")
    with bound_memory(GIB), pytest.raises(regular.IrregularError, match="3,000,000,000,000 bytes"):
        regular.content(tmp_path / "file", 10**6)
    with bound_memory(GIB), pytest.raises(regular.IrregularError, match="3,000,000,000,000 bytes"):
        next(regular.blocks(tmp_path / "file", 10**6))


def test_json_that_does_not_fit_into_memory_is_refused_and_not_called_damaged(
    tmp_path: Path, leave_memory: Callable[[int], None]
) -> None:
    (tmp_path / "file").write_bytes(b"[" + b"[]," * 2**20 + b"[]]")
    assert len(regular.json_value(tmp_path / "file")) == 2**20 + 1
    leave_memory(2**26)
    with pytest.raises(StorageError, match="parsed"):
        regular.json_value(tmp_path / "file")
