"""Trials as folders: their names as recordings', collisions of them, and folders that cannot be listed."""

import ast
import errno
import io
import os
import re
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.datasets import paths
from tacpipe.engine import computing
from tacpipe.engine.keys import Done, WorkerTask
from tacpipe.errors import UsageError
from tacpipe.formats.published import PREFIX, trials, valid
from tacpipe.io import files, regular
from tests.conftest import Lab
from tests.formats import grasp_files, slide_files, video_files, xela_files

Trial = Callable[..., Path]


def make(place: Path, *names: str) -> list[str]:
    """Make empty trials and return their recordings' names."""
    for name in names:
        (place / name).mkdir(parents=True)
    return list(trials(place, ["a.csv"]))


def change(trial: Path, described: str) -> None:
    """Write another object into a trial's meta data: trials of the same bytes are one to the store."""
    meta = trial / "meta_data.csv"
    meta.write_text(meta.read_text().replace("7,box", described))


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("木", "木"),
        ("😀", "😀"),
        ("Prüfling-Ø5", "Prüfling-Ø5"),
        ("Кубок 1", "Кубок-1"),
        ("cafe\u0301", "café"),  # macOS writes it so
        ("a\u202etxt", "a-txt"),  # a mark that would reverse the text
        ("new\nline\x9b31m", "new-line-31m"),
        (".hidden", "hidden"),
        ("a\\b", "a-b"),
        ("\udcff", "trial"),  # bytes that are no UTF-8
    ],
)
def test_a_name_keeps_its_letters_and_nothing_that_a_path_or_a_terminal_minds(folder: str, name: str) -> None:
    assert valid(f"{PREFIX}{folder}") == name


@given(st.text(max_size=400))
def test_every_name_is_one_that_a_manifest_accepts_and_that_stays(folder: str) -> None:
    name = valid(folder)
    assert paths.safe_path(f"{name}.parquet")
    assert paths.safe_path(f"{name}/xela1.parquet")
    assert name.isprintable()
    assert unicodedata.is_normalized("NFC", name)
    assert paths.valid_name(name) == name


@given(st.text(st.characters(max_codepoint=127), max_size=180))
def test_names_of_ascii_are_what_they_were(folder: str) -> None:
    short = folder.removeprefix(PREFIX) or folder
    assert valid(folder) == (re.sub(r"[^A-Za-z0-9._-]+", "-", short).strip("-.") or "trial")


def test_long_names_that_begin_alike_stay_apart(tmp_path: Path) -> None:
    first, second = make(tmp_path, *(f"{PREFIX}{'木' * 70}{end}" for end in "ab"))
    assert first != second
    assert {len(name.encode()) <= paths.MAX_NAME_BYTES for name in (first, second)} == {True}


@pytest.mark.parametrize(
    ("folders", "clash"),
    [
        (["data_sample_cup 1", "data_sample_cup-1"], "cup-1"),
        (["x/data_sample_1", "y/data_sample_1", "x-y/data_sample_1", "x/y/data_sample_1"], "x-y-1"),
        (["data_sample_Cup", "data_sample_cup"], "Cup and cup, which differ only in case"),
        (["data_sample_caf\u00e9", "data_sample_cafe\u0301"], "café"),
        (["a/data_sample_1", "b/data_sample_1", "c/data_sample_b-1"], "b-1"),
    ],
)
def test_two_folders_of_one_name_are_refused_by_both_their_paths(
    tmp_path: Path, folders: list[str], clash: str
) -> None:
    with pytest.raises(UsageError, match=f"{re.escape(str(tmp_path))}.* and .*would both be named {clash}") as refused:
        make(tmp_path, *folders)
    assert sum(str(tmp_path / folder) in str(refused.value) for folder in folders) == 2


def test_folders_of_one_name_in_two_places_carry_the_place(tmp_path: Path) -> None:
    assert make(tmp_path, "x/data_sample_Cup", "y/data_sample_cup") == ["x-Cup", "y-cup"]


def test_unicode_names_go_through_the_whole_chain(lab: Lab, flat_trial: Trial) -> None:
    for object_name, name in enumerate(("木", "石", "😀", "cup 1", "new\nline")):
        change(flat_trial(f"{PREFIX}{name}", place=lab.folder / "raw"), f"{object_name},box")
    assert "5 ran" in lab.run("ingest xela-flat raw -o data/r").err
    lab.run("synchronize data/r -o data/s")
    names = ["cup-1", "new-line", "木", "石", "😀"]
    assert sorted(lab.manifest("data/s").recordings) == names
    assert all((lab.folder / "data/s" / f"{name}.parquet").is_file() for name in names)
    lab.run("label data/r 木 --set material=wood")
    assert lab.manifest("data/r").labels == {"木": {"material": "wood"}}
    assert "木" in lab.run("show data/r").out
    assert "0 ran, 5 reused" in lab.run("synchronize data/r -o data/s").err


def test_a_command_refuses_two_trials_of_one_name_and_writes_nothing(lab: Lab, flat_trial: Trial) -> None:
    for name in ("cup 1", "cup-1"):
        flat_trial(f"{PREFIX}{name}", place=lab.folder / "raw")
    ran = lab.call("ingest xela-flat raw -o data/r")
    assert ran.code == 2
    assert "raw/data_sample_cup 1 and raw/data_sample_cup-1 would both be named cup-1." in ran.err
    assert not (lab.folder / "data").exists()


def test_the_same_files_under_another_name_and_a_name_of_other_case_are_refused(lab: Lab, flat_trial: Trial) -> None:
    first = flat_trial(f"{PREFIX}cup", place=lab.folder / "raw")
    lab.run("ingest xela-flat raw -o data/r")
    first.rename(first.with_name(f"{PREFIX}mug"))
    ran = lab.call("ingest xela-flat raw -o data/r")
    assert ran.code == 2
    assert "data/r holds the files of mug already, as the recording cup." in ran.err
    second = first.with_name(f"{PREFIX}mug").rename(first.with_name(f"{PREFIX}CUP"))
    change(second, "8,box")
    ran = lab.call("ingest xela-flat raw -o data/r")
    assert ran.code == 2
    assert "data/r holds the recording cup, which differs from CUP only in case." in ran.err
    lab.run("ingest xela-flat raw -o data/r --replace")
    assert list(lab.manifest("data/r").recordings) == ["CUP"]


def test_a_folder_whose_name_is_no_text_is_read(lab: Lab, flat_trial: Trial) -> None:
    flat_trial(f"{PREFIX}caf" + os.fsdecode(b"\xe9"), place=lab.folder / "raw")
    lab.run("ingest xela-flat raw -o data/caf")
    (entry,) = lab.manifest("data/caf").recordings.values()
    assert entry["attributes"]["trial"] == f"{PREFIX}caf\ufffd"


def refused_by_the_system(monkeypatch: pytest.MonkeyPatch, call: str, end: str, number: int) -> None:
    """Have a call of the system fail on paths that end so, as a disk, a server or a limit has it fail."""
    real = getattr(os, call)

    def failing(path: object, *args: Any, **options: Any) -> Any:
        if str(path).endswith(end):
            raise OSError(number, os.strerror(number), path)
        return real(path, *args, **options)

    monkeypatch.setattr(os, call, failing)


@pytest.mark.parametrize("number", [errno.EACCES, errno.EIO, errno.ENOMEM, errno.ESTALE])
def test_a_folder_that_cannot_be_listed_is_named_and_nothing_is_ingested(
    lab: Lab, flat_trial: Trial, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    for name in ("a", "b"):
        flat_trial(f"{PREFIX}{name}", place=lab.folder / "raw")
    refused_by_the_system(monkeypatch, "scandir", f"{PREFIX}b", number)
    ran = lab.call("ingest xela-flat raw -o data/r --skip-bad")
    assert ran.code == 1
    assert f"raw/{PREFIX}b cannot be listed: {os.strerror(number)}. What it holds would be left out" in ran.err
    assert not (lab.folder / "data").exists()


def test_a_walk_finds_what_os_walk_finds_and_circles_end(tmp_path: Path) -> None:
    for folder in ("a/b/c", "a/d", "e"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "file").touch()
    (tmp_path / "a/b/round").symlink_to(tmp_path / "a")
    (tmp_path / "gone").symlink_to(tmp_path / "absent")
    (tmp_path / "self").symlink_to(tmp_path / "self")
    items = {place: (sorted(folders), sorted(names)) for place, folders, names in files.walk(tmp_path, links=False)}
    for place, (folders, names) in items.items():
        entries = sorted(path.name for path in Path(place).iterdir())
        links = [name for name in entries if Path(place, name).is_symlink()]
        assert sorted([*folders, *names]) == entries
        assert not set(links) & set(folders)
    assert set(items) == {place for place, _, _ in os.walk(tmp_path)}
    assert {place for place, _, _ in files.walk(tmp_path)} == set(items)
    assert list(files.walk(tmp_path / "absent")) == []


# functions of os, glob and pathlib that pass over errors, or raise them bare
LISTING = {"walk", "glob", "rglob", "iterdir", "fwalk"}
ALLOWED = {"holders.py"}  # looks at other users' processes, which may not be looked at


def test_no_module_lists_folders_but_by_the_functions_that_raise() -> None:
    root = Path(files.__file__).parent.parent
    tops = [os.walk(root / top) for top in ("tacpipe", "stages")]
    for module in [Path(place, name) for top in tops for place, _, names in top for name in names]:
        if module.suffix != ".py" or module.name in ALLOWED:
            continue
        for node in ast.walk(ast.parse(module.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in LISTING:
                assert ast.unparse(node.func.value) == "ast", f"{module}:{node.lineno}"


FORMATS = {  # format: file of each kind that it reads, and how it is made
    "xela-flat": ("xela_sensor1.csv", "robot_state.csv", "marker.csv", "meta_data.csv"),
    "xela-psc": ("xela_sensor2.csv", "robot_state.csv", "slip_label.csv", "meta_data.csv"),
    "biotac-slide": ("mat3_7_bio.csv", "mat3_7_cv.csv"),
    "roboskin": ("icub_fold_0.npy", "labels_fold_0.npy"),
    "gelsight-slip": ("camera_0.avi", "camera_2.avi"),
    "vision2tactile": ("cloud-object.pcd", "best-grasp.txt", "tactile.tac"),
}


def published(name: str, folder: Path) -> None:
    """Write recordings of a format, all of them good."""
    if name == "roboskin":
        slide_files.write_roboskin(folder, slide_files.touched(2))
    elif name == "biotac-slide":
        slide_files.write_biotac(folder)
        slide_files.write_biotac(folder, trial=8)
    elif name == "gelsight-slip":
        video_files.write_gelsight(folder)
        video_files.write_gelsight(folder, trial=2)
    elif name == "vision2tactile":
        grasp_files.write_grasp(folder)
        grasp_files.write_grasp(folder, after_s=60, seed=1)
    else:
        write = xela_files.write_flat if name == "xela-flat" else xela_files.write_psc
        write(folder / f"{PREFIX}a")
        write(folder / f"{PREFIX}b")


class Failing(io.RawIOBase):
    """A file whose reading fails."""

    def __init__(self, error: OSError) -> None:
        self.error = error

    def readable(self) -> bool:
        return True

    def readinto(self, _: Any) -> int:
        raise OSError(self.error.errno, self.error.strerror)  # errors of a read have no file name


@pytest.mark.parametrize(("name", "file"), [(name, file) for name, value in FORMATS.items() for file in value])
@pytest.mark.parametrize("number", [errno.EIO, errno.EMFILE, errno.ESTALE, errno.ENOMEM])
def test_a_disk_that_fails_is_no_bad_recording_whichever_file_it_is(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, name: str, file: str, number: int
) -> None:
    published(name, lab.folder / "raw")
    real, compute = regular.opened, computing.compute
    hashed: list[bool] = []

    def counted(task: WorkerTask) -> Done:
        hashed.append(True)
        return compute(task)

    def opened(path: Path | str) -> Any:  # fails once all files were hashed: what is hashed first ends the command too
        if not (str(path).endswith(file) and hashed):
            return real(path)
        error = OSError(number, os.strerror(number), str(path))
        if number == errno.EMFILE:
            raise error
        return io.BufferedReader(Failing(error))

    full = regular.content

    def content(path: Path | str, *args: Any, **options: Any) -> bytes:
        if str(path).endswith(file) and hashed:
            raise OSError(number, os.strerror(number), str(path))
        return full(path, *args, **options)

    monkeypatch.setattr(computing, "compute", counted)
    monkeypatch.setattr(regular, "opened", opened)
    monkeypatch.setattr(regular, "content", content)
    ran = lab.call(f"ingest {name} raw -o data/r --skip-bad")
    assert ran.code == 1, ran
    assert f"{file} cannot be read: {os.strerror(number)}. The recording may be sound" in ran.err
    assert "Traceback" not in ran.err
    assert not (lab.folder / "data").exists()


def test_a_disk_that_fails_while_files_are_hashed_is_named_with_the_file(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    published("xela-flat", lab.folder / "raw")
    error = OSError(errno.EIO, os.strerror(errno.EIO))
    real = regular.opened
    monkeypatch.setattr(
        regular,
        "opened",
        lambda path: io.BufferedReader(Failing(error)) if str(path).endswith("meta_data.csv") else real(path),
    )
    ran = lab.call("ingest xela-flat raw -o data/r --skip-bad")
    assert ran.code == 1
    assert f"{PREFIX}a/meta_data.csv cannot be used: Input/output error." in ran.err
