"""Test that a forged, unpacked or shared spool writes to no other place, and does not stop others from recording."""

import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tacpipe.io.files import user_name
from tests.conftest import Lab
from tests.recording import force_rig, live
from tests.recording.scripted import Script
from tests.recording.test_recovering import spooled
from tests.recording.test_schedule import FORCE

LONG_AGO_S = time.time() - 3600


def declare(folder: Path, **values: Any) -> None:
    """Write these values into the header of a spool."""
    path = folder / "header.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def files_outside_store(lab: Lab) -> set[Path]:
    """Return all that lies in the project outside of its store, and what lies next to the project."""
    project = {path for path in lab.folder.rglob("*") if not path.is_relative_to(lab.store.root)}
    return project | set(lab.folder.parent.iterdir())


def refuse(lab: Lab, folder: Path) -> str:
    """Return why a spool is not sealed; fails if it is, if anything was written for it, or if it says more than a line."""
    before, files = files_outside_store(lab), sorted(folder.iterdir())
    ran = lab.call("acquire --recover")
    assert ran.code == 1 and files_outside_store(lab) == before
    assert sorted(folder.iterdir()) == files
    prefix = f"tacpipe: The spool {folder} was not sealed. "
    assert ran.err.startswith(prefix) and ran.err.endswith("\n") and ran.err[:-1].isprintable()
    return ran.err.removeprefix(prefix)


@pytest.mark.long
@pytest.mark.parametrize(
    "output",
    ["{outside}/rec", "../rec", "sub/../../rec", "{project}/../rec", "link/rec", ".git/rec", "", "a\0b", 5, None],
)
def test_a_header_that_names_a_dataset_elsewhere_is_refused(lab: Lab, tmp_path_factory: Any, output: Any) -> None:
    outside = tmp_path_factory.mktemp("outside")
    (lab.folder / "link").symlink_to(outside)
    folder = spooled(lab)
    declare(folder, output=output.format(outside=outside, project=lab.folder) if isinstance(output, str) else output)

    assert "which is neither the -o of this command nor in the project of its store" in refuse(lab, folder)
    assert not list(outside.iterdir())


@pytest.mark.parametrize(
    "name", ["../x", "a/b", ".x", "a\x1b[2Jb", "manifest.json", "rig-0123abcd.toml", "x" * 300, "", 7]
)
def test_a_header_that_names_no_recording_is_refused(lab: Lab, name: Any) -> None:
    folder = spooled(lab)
    declare(folder, recording=name)

    assert refuse(lab, folder).startswith("Its recording is named ")


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"attributes": {"a": [1]}}, "Its attributes are "),
        ({"attributes": {"a": float("nan")}}, "Its attributes are "),
        ({"attributes": None}, "Its attributes are None"),
        ({"streams": ["force", "other"]}, "Its streams are "),
        ({"streams": ["\x1b[2J"]}, "Its streams are "),
        ({"clock": {"monotonic_ns": 0, "utc_ns": 1 << 80}}, "Its clock is "),
        ({"clock": [1, 2]}, "Its clock is "),
        ({"rig": None}, "Its rig file is None"),
        ({"rig": FORCE + 'x = "\x1b[2J"'}, "The rig file in "),
    ],
)
def test_a_header_that_makes_no_sense_is_refused_with_what_is_wrong(lab: Lab, values: Any, why: str) -> None:
    folder = spooled(lab)
    declare(folder, **values)

    assert refuse(lab, folder).startswith(why)


@pytest.fixture
def script(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Script:
    """A rig whose force sensor sends for 5 s."""
    return force_rig.sending(lab, monkeypatch, 5)


def _no_json(folder: Path) -> None:
    (folder / "header.json").write_bytes(b"\x80{")


def _list(folder: Path) -> None:
    (folder / "header.json").write_text("[]")


def _deep(folder: Path) -> None:
    (folder / "header.json").write_text("[" * 100_000)


def _huge(folder: Path) -> None:
    os.truncate(folder / "header.json", 1 << 40)  # a hole that no memory holds


def _pipe(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return change


def _link(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).rename(folder / "aside")
        (folder / name).symlink_to(folder / "aside")

    return change


CHANGES = {
    **{"no JSON": _no_json, "a list": _list, "depth": _deep, "a hole": _huge},
    **{f"{name} a pipe": _pipe(name) for name in ("header.json", "bytes", "tally")},
    **{f"{name} a link": _link(name) for name in ("header.json", "bytes", "tally")},
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_spool_that_is_none_stays_and_keeps_nobody_from_recording(
    lab: Lab, script: Script, change: Callable[[Path], None]
) -> None:
    folder = spooled(lab, "old")
    change(folder)
    files = sorted(folder.iterdir())
    ran = lab.run("acquire rig.toml -o rec --duration-s 1 --name new")

    assert f"The spool {folder} was not sealed. " in ran.err
    assert sorted(folder.iterdir()) == files
    assert list(live.shards(lab.folder)) == ["new"]


def test_spools_of_other_users_are_neither_sealed_nor_removed(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, unfinished = spooled(lab), spooled(lab)
    (unfinished / "header.json").unlink()
    for path in (unfinished / "bytes", unfinished):
        os.utime(path, (LONG_AGO_S, LONG_AGO_S))
    monkeypatch.setenv("TACPIPE_STORE", str(lab.folder / ".tacpipe"))
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    monkeypatch.setattr("tempfile.TemporaryFile", lambda **_: (_ for _ in ()).throw(PermissionError()))
    ran = lab.run("acquire --recover")

    mine = user_name(folder.stat().st_uid)
    for spool in (folder, unfinished):
        assert f"The spool {spool} belongs to {mine}. Only this user can seal it.\n" in ran.err
        assert (spool / "bytes").exists()
    assert not (lab.folder / "rec").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="gives files to another user, which root alone may")
@pytest.mark.parametrize("name", ["header.json", "bytes", "tally"])
def test_a_file_of_another_user_in_ones_own_spool_is_refused(lab: Lab, name: str) -> None:
    folder = spooled(lab)
    os.chown(folder / name, 12345, -1)

    assert f"{folder / name} belongs to another user (12345). Only this user can seal it." in refuse(lab, folder)


def test_others_cannot_open_a_spool(lab: Lab) -> None:
    assert spooled(lab).stat().st_mode & 0o077 == 0


def test_a_folder_of_spools_that_is_a_link_is_not_followed(lab: Lab, script: Script, tmp_path_factory: Any) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    folder = spooled(lab)
    lab.store.prepare()
    (folder / "header.json").unlink()
    empty = folder.parent / ("ab" * 16)
    empty.mkdir()
    for path in (folder / "bytes", folder, empty):
        os.utime(path, (LONG_AGO_S, LONG_AGO_S))
    folder.parent.rename(elsewhere / "spool")
    (lab.store.root / "spool").symlink_to(elsewhere / "spool")
    ran = lab.call("acquire rig.toml -o rec --duration-s 1")

    assert ran.code == 2 and f"{lab.store.root / 'spool'} is a symbolic link" in ran.err
    assert (elsewhere / "spool" / folder.name / "bytes").exists() and (elsewhere / "spool" / empty.name).exists()


def test_a_dataset_elsewhere_is_sealed_into_where_it_is_named(lab: Lab, tmp_path_factory: Any) -> None:
    outside = tmp_path_factory.mktemp("outside") / "rec"
    folder = spooled(lab)
    declare(folder, output=str(outside))

    assert lab.run(f"acquire --recover -o {outside}").err.splitlines()[-1].startswith("recovered one: ")
    assert list(live.shards(outside.parent)) == ["one"] and not folder.exists()


def test_a_project_that_was_moved_seals_its_spools_where_it_is_now(
    lab: Lab, script: Script, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: Any
) -> None:
    moved = tmp_path_factory.mktemp("moved") / "project"

    def crash() -> None:
        shutil.copytree(lab.folder, moved)

    script.happens.append((2.0, crash))
    lab.run("acquire rig.toml -o data/rec --duration-s 3 --name one")
    monkeypatch.chdir(moved)
    lab.run("acquire --recover")

    assert list(live.shards(moved, "data/rec")) == ["one"]
    assert (lab.folder / "data/rec/manifest.json").exists()


@pytest.mark.parametrize("name", ["manifest.json", "rig-0123abcd.toml"])
def test_a_recording_cannot_take_the_name_of_a_file_of_its_dataset(lab: Lab, script: Script, name: str) -> None:
    assert lab.call(f"acquire rig.toml -o rec --duration-s 1 --name {name}").code == 2
