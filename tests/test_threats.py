"""Statements of docs/explanation/threats.md that no other test tries."""

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tacpipe.io import memory
from tacpipe.maintenance import repair
from tacpipe.store.store import MissingError, Store
from tests.conftest import Lab, write_plugin, write_source

PLUGIN = "open('ran', 'w').close()\nraise SystemExit(9)\n"


@pytest.fixture
def command() -> Path:
    """Return the command tacpipe; `python -m tacpipe` also imports from the working directory."""
    path = Path(sys.executable).with_name("tacpipe")
    if not path.exists():
        pytest.skip("the command tacpipe is not installed next to this Python")
    return path


def test_a_plug_in_in_a_project_folder_is_not_loaded(tmp_path: Path, command: Path) -> None:
    points = "\n".join(
        f"[tacpipe.{group}]\nhostile = hostile:it" for group in ("stages", "formats", "sensors", "tasks")
    )
    write_plugin(tmp_path, "hostile", points, hostile=PLUGIN)
    for words in (["--help"], ["sensors", "list"], ["hostile", "x"]):
        ran = subprocess.run(
            [command, *words],
            cwd=tmp_path,
            env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode in (0, 2) and "hostile" not in ran.stdout and not (tmp_path / "ran").exists(), words


def test_worker_processes_import_no_module_of_the_working_directory(tmp_path: Path, command: Path) -> None:
    for name in ("multiprocessing", "numpy", "tacpipe"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write('{name} ')\n{PLUGIN}")
    words = "simulate forward --trials 8 --duration-s 4 --jobs 2 -o recordings"  # 8 tasks need worker processes
    for executor in ("local", "dask"):
        ran = subprocess.run(
            [command, *words.split(), "--executor", executor, "--quiet"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        shutil.rmtree(tmp_path / ".tacpipe", ignore_errors=True)
        assert ran.returncode == 0 and not (tmp_path / "ran").exists(), ran.stderr


def test_no_manifest_holds_a_path_of_the_computer_or_its_name(lab: Lab) -> None:
    write_source("src", a="1 2 3")
    lab.run("ingest numbers src -o data/r")
    lab.run(f"scale {lab.folder}/data/r -o {lab.folder}/data/s")
    lab.run("total data/s -o data/t")
    lab.run("label data/r a --set material=foam")
    for path in sorted(lab.folder.rglob("manifest.json")):
        content = path.read_text()
        assert str(lab.folder) not in content and platform.node() not in content, path
    assert any(
        platform.node() in path.read_text() for path in lab.store.root.glob("records/*/*")
    )  # The page states it.


def test_a_repair_writes_nothing_where_a_root_of_another_user_points(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.run("simulate toy --trials 1 --rows 3 -o data/r")
    lab.run("scale data/r -o data/s")
    (Path("data/s/manifest.json")).write_text('{"name": "a browser extension"}')
    before = Path("data/s/manifest.json").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(os, "getuid", lambda: 12345)
        repair.repair(lab.store)
    assert Path("data/s/manifest.json").read_bytes() == before
    repair.repair(lab.store)
    assert Path("data/s/manifest.json").read_bytes() != before  # it is this user's own


def test_an_object_is_not_read_beyond_its_declared_size(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(lab.folder / ".tacpipe")
    store.prepare()
    stored = store.put(b"touch")
    path = Path(store.object_path(stored.digest))
    path.unlink()
    with path.open("wb") as file:
        file.truncate(memory.AT_HAND + 1)  # sparse

    def read(handle: int, count: int) -> bytes:
        raise AssertionError(f"{count} bytes were read")

    monkeypatch.setattr(os, "read", read)
    with pytest.raises(MissingError, match="cannot be read"):
        store.read(stored.digest, stored.bytes)


def test_a_store_is_pushed_with_the_name_of_the_host_in_its_records(lab: Lab) -> None:
    lab.run("simulate toy --trials 1 --rows 3 -o data/r")
    lab.run("store push remote data/r")
    shutil.rmtree(lab.store.root)
    assert any(platform.node() in path.read_text() for path in Path("remote/records").glob("*/*"))
