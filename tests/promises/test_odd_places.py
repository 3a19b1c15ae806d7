"""Stores that were moved, copied, thinned out or locked up, and systems that lack what others have."""

import builtins
import ctypes
import errno
import fcntl
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import pytest

from tacpipe.errors import DAMAGED, FAILED, USAGE
from tacpipe.maintenance import repair
from tacpipe.store.store import Store
from tests.conftest import Lab
from tests.promises import damages, specimen
from tests.promises.counts import count
from tests.promises.specimen import CHAIN, Specimen

FOLDERS = ("objects", "records", "roots", "tmp", "quarantine", "leases", "checkpoints")
YEARS_S = 10 * 365 * 86400.0


def seldom(*values: Any) -> list[Any]:
    """Return values of a test's parameter that are tried by `make test-faults` alone."""
    return [pytest.param(value, marks=pytest.mark.faults) for value in values]


def check_healing(project: Specimen) -> None:
    """Look whether reruns bring everything back, and whether the store is sound then."""
    for ran in project.rerun():
        assert ran.code == 0, ran
    files_now = project.data_files()
    assert {path: files_now.get(path) for path in project.sound} == dict(project.sound)
    assert project.lab.call("store repair").code == 0
    verified = project.lab.call("store verify")
    assert verified.code == 0, verified


# ---- folders and files that are not there


@pytest.mark.parametrize("folders", [FOLDERS, ("objects",), *seldom(*((name,) for name in FOLDERS[1:]))])
def test_folders_that_are_gone_are_made_again(project: Specimen, folders: tuple[str, ...]) -> None:
    for name in folders:
        shutil.rmtree(project.store / name)
    assert all(project.served().values())
    for command in ("status", "verify", "gc --dry-run", "repair"):
        assert project.lab.call(f"store {command}").code in (0, DAMAGED), command
    check_healing(project)


def test_a_copy_without_empty_folders_is_a_store(project: Specimen) -> None:
    for place in [path for path in project.store.rglob("*") if path.is_dir()][::-1]:
        if not any(place.iterdir()):
            place.rmdir()
    assert not (project.store / "quarantine").exists()
    damages.flip(project.object("scaled", "b.parquet"))
    assert all(project.served().values())
    check_healing(project)


def test_a_lost_shelf_of_objects_is_filled_again(project: Specimen) -> None:
    for shelf in sorted((project.store / "objects").iterdir())[::2]:
        shutil.rmtree(shelf)
    assert all(project.served().values())
    check_healing(project)


@pytest.mark.parametrize("content", [b"", b"7\n", *seldom(b"\xff\xfe", b"1\n2\n")])
def test_a_store_whose_mark_is_another_is_left_alone(project: Specimen, content: bytes) -> None:
    before = specimen.files(project.store)
    (project.store / "format").write_bytes(content)
    for command in ("scale data/recordings -o data/other --factor 9", "store repair"):
        failed = project.lab.call(command)
        assert failed.code == USAGE and "reads format 1" in failed.err, failed
    after = specimen.files(project.store)
    assert {path: text for path, text in after.items() if path != "format"} == {
        path: text for path, text in before.items() if path != "format"
    }
    (project.store / "format").unlink()  # A copier may leave it out.
    failed = project.lab.call("store verify")
    assert failed.code == USAGE and f"`echo 1 > {project.store / 'format'}`" in failed.err
    (project.store / "format").write_text("1\n")
    check_healing(project)


def test_leases_that_somebody_left_or_that_hold_anything_are_in_nobodys_way(project: Specimen) -> None:
    for name in ("ab" * 32 + ".lock", "run-0123.lock", "gc.lock", "run-.lock"):
        (project.store / "leases" / name).write_bytes(b"\xff\x00{]" + os.urandom(50))
    for command in ("status", "gc", "verify"):
        assert project.lab.call(f"store {command}").code == 0
    check_healing(project)


def test_two_objects_that_changed_places_are_both_found(project: Specimen) -> None:
    first, right = project.object("scaled", "a.parquet"), project.object("centred", "b.parquet")
    temporary = first.with_suffix(".aside")
    first.rename(temporary)
    right.rename(first)
    temporary.rename(right)
    verified = project.lab.call("store verify")
    assert verified.code == DAMAGED and first.name in verified.out and right.name in verified.out
    count("corruptions found", 2)
    check_healing(project)


def test_a_record_in_the_place_of_another_is_none(project: Specimen) -> None:
    ours, theirs = project.records("scale")[:2]
    damages.overwrite(ours, theirs.read_bytes())
    assert project.lab.store.record(ours.stem) is None
    count("corruptions found")
    check_healing(project)


def test_a_manifest_of_a_later_format_is_refused_and_left_as_it_is(project: Specimen) -> None:
    path = project.folder / "data/recordings/manifest.json"
    later = re.sub(rb'"format": [12]', b'"format": 3', path.read_bytes())
    damages.overwrite(path, later)
    for command in ("scale data/recordings -o data/other", "show data/recordings", "store gc"):
        failed = project.lab.call(command)
        assert failed.code in (2, DAMAGED) and "manifest format 3" in failed.err, failed
    assert path.read_bytes() == later


def test_recordings_that_are_lost_everywhere_are_asked_for_and_come_back_from_another_store(project: Specimen) -> None:
    project.lab.run("store push backup data/recordings data/scaled --ancestors")
    shutil.rmtree(project.folder / "src")
    for path in (project.object("recordings", "b/left.parquet"), project.folder / "data/recordings/b/left.parquet"):
        damages.unseen(path)
    for command in ("scale data/recordings -o data/other --factor 9 --jobs 1", "store repair"):
        failed = project.lab.call(command)
        assert failed.code == DAMAGED, failed
        assert "b/left.parquet, which cannot be recomputed: restore it" in failed.err + failed.out, failed
    assert not (project.folder / "data/other").exists()
    count("corruptions found", 2)
    project.lab.run("store pull backup data/recordings")
    assert all(project.served().values())


# ---- other places


def test_a_project_that_is_moved_keeps_everything_and_a_collection_after_a_month_takes_nothing(
    project: Specimen, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    moved = tmp_path_factory.mktemp("moved") / "project"
    shutil.move(project.folder, moved)
    monkeypatch.chdir(moved)
    moved_project = Specimen(Lab(moved, project.lab.call), project.sound, project.manifests)
    specimen.age(moved)
    for options in ("", "--recordings --grace-days 0"):
        moved_project.lab.run(f"store gc {options}")
        assert moved_project.needed() <= {path.name for path in specimen.beneath(moved_project.store / "objects")}
    assert all(moved_project.served().values())
    explanation = moved_project.lab.run("explain data/centred").out
    assert (
        "data/scaled" in explanation
        and "no longer at a path" not in explanation
        and "not in this store" not in explanation
    )
    check_healing(moved_project)


def test_a_store_that_is_moved_away_from_its_project_still_serves_it(
    project: Specimen, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "store"
    shutil.move(project.store, elsewhere)
    monkeypatch.setenv("TACPIPE_STORE", str(elsewhere))
    assert all(project.served().values())
    specimen.age(elsewhere)
    project.lab.run("store gc --recordings")  # its datasets are out of reach for less than fourteen days
    assert project.needed() <= {path.name for path in specimen.beneath(elsewhere / "objects")}
    for ran in project.rerun():
        assert ran.code == 0, ran
    specimen.age(elsewhere)
    project.lab.run("store gc --recordings --grace-days 0")  # now they are known where they are
    assert project.needed() <= {path.name for path in specimen.beneath(elsewhere / "objects")}
    assert project.data_files() == dict(project.sound)


@pytest.mark.parametrize("mode", [0o644, *seldom(0o600, 0o777)])
def test_a_copy_without_modes_times_and_links_is_as_good(project: Specimen, mode: int) -> None:
    copy = project.folder.with_name(f"{project.folder.name}-copy")
    shutil.copytree(project.store, copy, copy_function=shutil.copyfile)
    shutil.rmtree(project.store)
    copy.rename(project.store)
    for path in specimen.beneath(project.store):
        path.chmod(mode)
    assert all(project.served().values())
    check_healing(project)


# ---- rights


def ordinary() -> None:
    """Give up what lets root pass over modes and owners, for good."""
    if os.getuid() == 0:
        libc = ctypes.CDLL(None, use_errno=True)
        for capability in (1, 2, 3):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, CAP_FOWNER
            if libc.prctl(24, capability, 0, 0, 0):  # PR_CAPBSET_DROP
                raise OSError(ctypes.get_errno(), "prctl")


def as_ordinary_user(project: Specimen, words: str, program: str = "tacpipe") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", program, *words.split()],
        cwd=project.folder,
        preexec_fn=ordinary,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(params=["read-only", *seldom("of another user")])
def locked(project: Specimen, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A project whose store may be read and not written."""
    try:
        subprocess.run(["true"], preexec_fn=ordinary, check=True)
    except (OSError, subprocess.SubprocessError):
        pytest.skip("this system does not let root give up its rights")
    paths = [project.store, *project.store.rglob("*")]
    if request.param == "of another user":
        if os.getuid():
            pytest.skip("only root can give files to another user")
        monkeypatch.setenv("TACPIPE_STORE", str(project.store))  # the store of another user is used on request only
        for path in paths:
            os.chown(path, 12345, 12345)
    else:
        for path in paths:
            path.chmod(0o555 if path.is_dir() else 0o444)
    yield project
    for path in paths:
        path.chmod(0o755)


def test_a_store_that_may_only_be_read_answers_and_says_in_a_sentence_what_it_cannot(locked: Specimen) -> None:
    before = specimen.files(locked.store)
    for command in (CHAIN[2], "explain data/centred", "store verify"):
        ran = as_ordinary_user(locked, command)
        assert ran.returncode == 0, (command, ran.stderr)
    for command in ("scale data/recordings -o data/other --factor 9 --jobs 1", "store gc"):
        failed = as_ordinary_user(locked, command)
        assert failed.returncode == FAILED and "cannot be written" in failed.stderr, (command, failed)
        assert failed.stderr.count("\n") == 1 and "TACPIPE_STORE" in failed.stderr
    assert specimen.files(locked.store) == before
    assert locked.data_files() == dict(locked.sound)


def test_a_store_that_may_only_be_read_is_pushed_from(
    locked: Specimen, tmp_path_factory: pytest.TempPathFactory
) -> None:
    before, remote = specimen.files(locked.store), tmp_path_factory.mktemp("remote")
    for verb in ("pushed", "repeated"):
        ran = as_ordinary_user(locked, f"store push {remote} data/recordings data/total --json")
        assert ran.returncode == 0 and not ran.stderr, (verb, ran.stderr)
    assert json.loads(ran.stdout)["objects"] == 0
    assert specimen.files(locked.store) == before
    assert repair.verify(Store(remote)).clean
    assert {root["path"] for root in Store(remote).roots.all()} == {"data/recordings", "data/total"}
    for path in (locked.object("total", "metrics.json"), locked.folder / "data/total/metrics.json"):
        path.chmod(0o644)
        path.write_bytes(b"damaged")
    failed = as_ordinary_user(locked, f"store push {remote.with_name('other')} data/total")
    assert failed.returncode == DAMAGED and "a `tacpipe store gc` at the same time may have removed" in failed.stderr


def test_damage_in_a_store_that_may_only_be_read_is_found_and_never_served(locked: Specimen) -> None:
    path, copy = locked.object("total", "metrics.json"), locked.folder / "data/total/metrics.json"
    content = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(content.replace(b"9", b"8"))
    path.chmod(0o444)
    (locked.folder / "look.py").write_text("import tacpipe\nprint(dict(tacpipe.open('data/total').files))")
    copy.unlink()
    failed = as_ordinary_user(locked, "", "look")
    assert failed.returncode and "damaged" in failed.stderr and "cannot be written" in failed.stderr
    assert "80" not in failed.stdout
    copy.write_bytes(content)  # a sound copy beside the manifest is as good as the object
    assert as_ordinary_user(locked, "", "look").stdout == f"{ {'metrics.json': content} }\n"
    verified = as_ordinary_user(locked, "store verify")
    assert verified.returncode == DAMAGED and path.name in verified.stdout, verified
    count("corruptions found")


# ---- systems that lack what others have


def refuse(number: int) -> Callable[..., Any]:
    def call(*_: Any, **__: Any) -> Any:
        raise OSError(number, os.strerror(number))

    return call


@pytest.mark.parametrize("number", [errno.EPERM, *seldom(errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK, errno.EXDEV)])
def test_without_hard_links_and_reflinks_all_is_as_with_them(
    project: Specimen, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    fresh(project)
    monkeypatch.setattr(os, "link", refuse(number))
    monkeypatch.setattr(fcntl, "ioctl", refuse(errno.ENOTTY))
    remake(project)
    assert {path.stat().st_nlink for path in specimen.beneath(project.folder / "data")} == {1}


@pytest.mark.parametrize("number", [errno.ENOLCK, *seldom(errno.ENOSYS, errno.EOPNOTSUPP)])
def test_without_locks_all_is_as_with_them(project: Specimen, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    fresh(project)
    monkeypatch.setattr(fcntl, "flock", refuse(number))
    remake(project)


def fresh(project: Specimen) -> None:
    shutil.rmtree(project.store)
    shutil.rmtree(project.folder / "data")
    project.store.mkdir()


def remake(project: Specimen) -> None:
    project.lab.run(CHAIN[0])
    project.lab.run(specimen.LABEL)
    check_healing(project)
    specimen.age(project.store)
    project.lab.run("store gc --recordings --grace-days 0")
    assert all(project.served().values())


@pytest.mark.parametrize("ahead_s", [YEARS_S, -YEARS_S])
def test_a_clock_that_was_set_changes_no_result_and_what_is_collected(
    project: Specimen, monkeypatch: pytest.MonkeyPatch, ahead_s: float
) -> None:
    honest, honest_ns = time.time, time.time_ns
    monkeypatch.setattr(time, "time", lambda: honest() + ahead_s)
    monkeypatch.setattr(time, "time_ns", lambda: honest_ns() + int(ahead_s * 1e9))
    project.lab.run("scale data/recordings -o data/other --factor 9 --jobs 1")
    garbage = {name for _, name in project.lab.manifest("data/other").objects()}
    shutil.rmtree(project.folder / "data/other")
    monkeypatch.undo()
    monkeypatch.chdir(project.folder)
    with project.lab.store.at_work([]):
        project.lab.store.announce(project.needed())
        project.lab.run("store gc --recordings --grace-days 0")
    remaining = {path.name for path in specimen.beneath(project.store / "objects")}
    assert project.needed() <= remaining
    specimen.age(project.store, days=-ahead_s / 86400)
    project.lab.run("store gc --recordings --grace-days 0")
    remaining = {path.name for path in specimen.beneath(project.store / "objects")}
    assert project.needed() <= remaining and not garbage & (remaining - project.needed())
    check_healing(project)


@pytest.mark.parametrize("number", [errno.EIO, *seldom(errno.EACCES, errno.ESTALE)])
def test_an_object_that_cannot_be_read_is_made_again_or_told_in_a_sentence(
    project: Specimen, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    bad = {str(project.object("recordings", "b/left.parquet")), str(project.object("scaled", "a.parquet"))}
    honest = builtins.open

    def opened(file: Any, *args: Any, **kwargs: Any) -> Any:
        if str(file) in bad:
            raise OSError(number, os.strerror(number), str(file))
        return honest(file, *args, **kwargs)

    monkeypatch.setattr(builtins, "open", opened)
    ran = project.lab.call("scale data/recordings -o data/other --factor 9 --jobs 1")
    assert ran.code in (0, DAMAGED) and "Traceback" not in ran.err, ran
    failed = project.lab.call("total data/scaled -o data/other2")
    assert failed.code in (0, DAMAGED) and "Traceback" not in failed.err, failed
    if failed.code == 0:
        assert project.lab.manifest("data/other2").digest == project.manifests["total"].digest
    else:
        assert os.strerror(number) in failed.err
    verified = project.lab.call("store verify")
    assert "Traceback" not in verified.err
    bad.clear()  # Another cable may end the errors.
    assert all(project.served().values())
    check_healing(project)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="nobody may write to /proc")
@pytest.mark.parametrize("output", ["/proc/x", "/proc/x/y", "/dev/null/x"])
def test_a_command_whose_output_cannot_be_written_leaves_no_root(lab: Lab, output: str) -> None:
    assert lab.call(f"simulate toy --jobs 1 -o {output}").code in (1, 2)
    assert lab.store.roots.all() == []
    assert "cannot be reached" not in lab.run("store status").out
