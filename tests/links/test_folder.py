"""Test that a watched folder returns each file once, when it is complete."""

import re
import time
from pathlib import Path

import pytest

from tacpipe.errors import DeviceError
from tacpipe.links import folder
from tests.links.peers import Quiet, open_address


def test_files_that_were_there_before_are_left_alone_and_a_rewritten_one_comes_again(tmp_path: Path) -> None:
    (tmp_path / "old.pcd").write_bytes(b"old")
    (tmp_path / "latest.pcd").write_bytes(b"first")
    link = open_address(f"folder:{tmp_path}", Quiet())
    assert link.read(0.3) == []

    (tmp_path / "latest.pcd").write_bytes(b"second")

    assert [data for _, data in link.read(5)] == [b"second"]
    assert link.read(0.3) == []
    link.close()


def test_a_file_that_someone_still_writes_is_not_given_out_however_long_he_pauses(tmp_path: Path) -> None:
    link = open_address(f"folder:{tmp_path}", Quiet())
    with (tmp_path / "cloud.pcd").open("wb") as file:
        file.write(b"half")
        file.flush()
        assert link.read(4 * folder.SETTLED_S) == []
        file.write(b" and half")

    assert [data for _, data in link.read(5)] == [b"half and half"]
    link.close()


def test_a_file_that_is_written_in_several_openings_comes_when_it_holds_still(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    link = open_address(f"folder:{tmp_path}", Quiet())
    (tmp_path / "a").write_bytes(b"1")
    assert link.read(0) == []
    now[0] += folder.SETTLED_S / 2
    with (tmp_path / "a").open("ab") as file:
        file.write(b"2")
    assert link.read(0) == []
    now[0] += folder.SETTLED_S * 0.75
    assert link.read(0) == []
    now[0] += folder.SETTLED_S

    assert [data for _, data in link.read(0)] == [b"12"]
    link.close()


@pytest.mark.parametrize("name", ["cloud.pcd.tmp", ".cloud.pcd.x7fq", "cloud.part", "cloud.pcd~"])
def test_names_that_a_writer_changes_later_are_not_looked_at(name: str, tmp_path: Path) -> None:
    link = open_address(f"folder:{tmp_path}", Quiet())
    (tmp_path / name).write_bytes(b"unfinished")
    assert link.read(3 * folder.SETTLED_S) == []

    (tmp_path / name).rename(tmp_path / "cloud.pcd")

    assert [data for _, data in link.read(5)] == [b"unfinished"]
    link.close()


def test_a_folder_that_is_missing_or_written_to_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="nowhere"):
        open_address(f"folder:{tmp_path / 'nowhere'}", Quiet())
    link = open_address(f"folder:{tmp_path}", Quiet())
    with pytest.raises(DeviceError, match=re.escape(str(tmp_path))):
        link.write(b"x")
    link.close()
