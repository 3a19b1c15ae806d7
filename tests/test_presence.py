"""A note that all files of a dataset are there: while it holds none is looked at, and no fault of a name goes unseen."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tacpipe.datasets import directory
from tacpipe.io.hashing import file_digest
from tacpipe.store import layout, presence
from tests.conftest import Lab

SCALE = "scale data/r -o data/s --factor 2 --jobs 1"
DAY_NS = 86_400 * 10**9


@pytest.fixture
def shows(few_are_many: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Path]]:
    """The directories of which each file was looked at; all datasets are large, and all folders changed long ago."""
    shown_directories: list[Path] = []
    look, clock_ns = directory.showing, presence.Look._clock_ns

    def record_look(*arguments: object) -> str:
        shown_directories.append(Path(str(arguments[2])))
        return look(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(directory, "showing", record_look)
    monkeypatch.setattr(presence.Look, "_clock_ns", lambda self: clock_ns(self) + DAY_NS)
    yield shown_directories


@pytest.fixture
def noted(lab: Lab, shows: list[Path]) -> Lab:
    """A project with a dataset of four recordings that was found complete."""
    lab.run("simulate toy --trials 4 --rows 3 -o data/r")
    lab.run(SCALE)
    lab.run(SCALE)
    assert len(list((lab.folder / ".tacpipe/presence").iterdir())) == 1
    shows.clear()
    return lab


def content(folder: Path) -> dict[str, str]:
    return {path.name: file_digest(path) for path in sorted(folder.iterdir())}


def test_what_is_noted_is_a_hit_that_looks_at_no_file_and_reports_what_the_look_reported(
    noted: Lab, shows: list[Path]
) -> None:
    from_note = noted.run_json(SCALE)
    assert shows == []
    shutil.rmtree(noted.folder / ".tacpipe/presence")
    from_look = noted.run_json(SCALE)
    assert shows == [noted.folder / "data/s"]
    assert {**from_note, "seconds": 0} == {**from_look, "seconds": 0}
    assert from_note["reused"] == 4 and from_note["rows"] == 12


def first(lab: Lab) -> tuple[Path, Path]:
    """Return a file of the output, and the object that it is a link to."""
    path = lab.folder / "data/s/trial-001.parquet"
    return path, Path(lab.store.object_path(file_digest(path)))


def remove_file(lab: Lab) -> None:
    first(lab)[0].unlink()


def replace_file(lab: Lab) -> None:
    path, _ = first(lab)
    before = path.read_bytes()
    path.unlink()
    path.write_bytes(before[:-9] + b"?" + before[-8:])


def remove_object(lab: Lab) -> None:
    first(lab)[1].unlink()


def shorten_object(lab: Lab) -> None:
    _, stored = first(lab)
    draft = stored.with_name("draft")
    draft.write_bytes(stored.read_bytes()[:-5])
    draft.replace(stored)


def remove_all_objects(lab: Lab) -> None:
    for path, _ in lab.manifest("data/s").objects():
        Path(lab.store.object_path(file_digest(lab.folder / "data/s" / path))).unlink()


def remove_manifest(lab: Lab) -> None:
    (lab.folder / "data/s/manifest.json").unlink()


def remove_stored_manifest(lab: Lab) -> None:
    Path(lab.store.object_path(file_digest(lab.folder / "data/s/manifest.json"))).unlink()


def exchange_directory(lab: Lab) -> None:
    dataset_folder = lab.folder / "data/s"
    shutil.copytree(dataset_folder, lab.folder / "data/t")
    (lab.folder / "data/t/trial-002.parquet").unlink()
    shutil.rmtree(dataset_folder)
    (lab.folder / "data/t").rename(dataset_folder)


def exchange_shelf(lab: Lab) -> None:
    shelf = first(lab)[1].parent
    moved = shelf.with_name("aside")
    shelf.rename(moved)
    shelf.mkdir()
    shutil.rmtree(moved)


def lose_root(lab: Lab) -> None:
    for path in (lab.folder / ".tacpipe/roots").iterdir():
        path.unlink()


def lose_records(lab: Lab) -> None:
    shutil.rmtree(lab.folder / ".tacpipe/records")


FAULTS = [
    remove_file,
    replace_file,
    remove_object,
    shorten_object,
    remove_all_objects,
    remove_manifest,
    remove_stored_manifest,
    exchange_directory,
    exchange_shelf,
    lose_root,
    lose_records,
]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: str(fault.__name__))
@pytest.mark.parametrize("kept_times", [False, True], ids=["", "times kept"])
@pytest.mark.parametrize("settled", [True, False], ids=["", "a moment ago"])
def test_what_comes_goes_or_is_exchanged_is_found_by_the_next_command(
    noted: Lab, fault: Callable[[Lab], None], kept_times: bool, settled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not settled:
        monkeypatch.setattr(presence, "SETTLED_NS", 2 * DAY_NS)
        noted.run("scale data/r -o data/s --factor 3 --jobs 1")
        noted.run(SCALE)
    folder = noted.folder / "data/s"
    before = content(folder)
    folders = [path for path in noted.folder.rglob("*") if path.is_dir()]
    times = {path: path.stat() for path in folders}
    fault(noted)
    for path, stat in times.items() if kept_times else ():
        if path.exists():
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    noted.run(SCALE)
    assert content(folder) == before
    noted.run("store verify")


def test_another_run_is_no_hit(noted: Lab) -> None:
    assert '"ran": 4' in noted.run("scale data/r -o data/s --factor 3 --jobs 1 --json").out
    assert '"ran": 0' in noted.run(f"{SCALE} --json").out
    noted.run("label data/r trial-001 --set material=felt")
    noted.run(SCALE)
    assert noted.manifest("data/s").recordings["trial-001"]["attributes"]["material"] == "felt"


def test_objects_of_others_cost_a_look_at_the_shelves_that_they_came_to(noted: Lab, shows: list[Path]) -> None:
    noted.run("simulate toy --trials 3 --rows 5 -o data/other")
    noted.run(SCALE)
    assert shows == []


def test_a_note_is_written_anew_where_many_shelves_changed(
    noted: Lab, shows: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(presence, "_MAX_CHANGED", 0)
    (note,) = (noted.folder / ".tacpipe/presence").iterdir()
    before = note.read_bytes()
    _, stored = first(noted)
    (stored.parent / "x").touch()
    noted.run(SCALE)
    assert shows == [] and note.read_bytes() != before
    monkeypatch.setattr(presence.Look, "_are_intact", lambda *arguments: False)  # nothing is looked at now
    noted.run(SCALE)
    assert shows == []


def test_after_a_restart_of_the_computer_each_file_is_looked_at(
    noted: Lab, shows: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    boot_id = tmp_path / "boot"
    boot_id.write_text("another\n")
    monkeypatch.setattr(presence, "BOOT", boot_id)
    noted.run(SCALE)
    assert len(shows) == 1
    monkeypatch.setattr(presence, "BOOT", tmp_path / "none")
    noted.run(SCALE)
    noted.run(SCALE)
    assert len(shows) == 3


@pytest.mark.parametrize("at", [0, 40, -3, None])
def test_a_damaged_note_is_passed_over(noted: Lab, shows: list[Path], at: int | None) -> None:
    (note,) = (noted.folder / ".tacpipe/presence").iterdir()
    note_bytes = bytearray(note.read_bytes())
    if at is None:
        note_bytes.clear()
    else:
        note_bytes[at] ^= 1
    note.write_bytes(note_bytes)
    for shelf in (noted.store.root / "objects").iterdir():
        (shelf / "x").touch()  # the rows of all shelves are read
    noted.run(SCALE)
    assert len(shows) == 1
    assert set(layout.foreign(noted.store.root)) == {
        f"objects/{shelf.name}/x" for shelf in (noted.store.root / "objects").iterdir()
    }


def test_where_folders_changed_a_moment_ago_their_names_are_looked_at_and_their_times_are_not(
    lab: Lab, shows: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(presence, "SETTLED_NS", 2 * DAY_NS)
    lab.run("simulate toy --trials 2 --rows 3 -o data/r")
    lab.run(SCALE)
    note = presence.read_note(lab.store, lab.folder / "data/s")
    assert note is not None and note.head.directory is None
    assert set(note.shelves.values()) == {None}
    shows.clear()
    lab.run(SCALE)
    assert shows == []


def test_where_a_list_of_the_directory_gives_no_inodes_nothing_is_noted(
    lab: Lab, shows: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = presence._inodes
    monkeypatch.setattr(presence, "_inodes", lambda folder: dict.fromkeys(listed(folder), 0))
    lab.run("simulate toy --trials 2 --rows 3 -o data/r")
    lab.run(SCALE)
    lab.run(SCALE)
    assert not (lab.folder / ".tacpipe/presence").exists()


def test_copies_are_looked_at_each_time(lab: Lab, shows: list[Path]) -> None:
    lab.run("simulate toy --trials 2 --rows 3 -o data/r")
    lab.run("simulate toy --trials 2 --rows 3 -o data/r")
    lab.run(SCALE)
    path, stored = lab.folder / "data/s/trial-001.parquet", first(lab)[1]
    path.unlink()
    shutil.copy(stored, path)
    shows.clear()
    lab.run(SCALE)
    lab.run(SCALE)
    assert len(shows) == 2


def test_symbolic_links_are_followed_each_time(lab: Lab, shows: list[Path]) -> None:
    lab.run("simulate toy --trials 2 --rows 3 -o data/r")
    lab.run(SCALE)
    path, stored = first(lab)
    path.unlink()
    path.symlink_to(stored)
    shows.clear()
    lab.run(SCALE)
    lab.run(SCALE)
    assert path.is_symlink() and len(shows) == 2


def test_a_collection_removes_the_notes_on_directories_that_are_gone(noted: Lab) -> None:
    def notes() -> set[str]:
        return {path.name for path in (noted.folder / ".tacpipe/presence").iterdir()}

    noted.run("store gc")
    assert len(notes()) == 1
    lose_root(noted)
    noted.run("store gc --dry-run")
    assert len(notes()) == 1
    noted.run("store gc")
    assert notes() == set()


def test_a_store_that_cannot_be_written_is_a_hit_all_the_same(noted: Lab) -> None:
    shutil.rmtree(noted.folder / ".tacpipe/presence")
    (noted.folder / ".tacpipe/presence").write_text("")  # a file in the place of the folder
    assert '"reused": 4' in noted.run(f"{SCALE} --json").out
