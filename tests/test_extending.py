"""The packages that the pages of docs/extending print are installed into a fresh environment, and used there as printed."""

import json
import os
import shlex
import signal
import subprocess
import sys
import sysconfig
import time
import venv
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tests import test_docs as docs
from tests.live.sessions import subscriber
from tests.recording import live

QUIET = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]


def write_package(page: Path, folder: Path) -> Path:
    """Write the package that a page prints below ``folder``, and return its folder."""
    package = folder / page.stem
    package.mkdir(parents=True)
    for block in docs.fenced_blocks(page.read_text()):
        if block.title:
            (package / block.title).write_text(block.text)
    assert (package / "pyproject.toml").exists(), page
    return package


def make_environment(folder: Path) -> Path:
    """Return the folder of programs of a fresh environment, which has what this one has and nothing of its own."""
    venv.create(folder, with_pip=False, symlinks=True)
    (site_packages,) = folder.glob("lib/python*/site-packages")
    (site_packages / "known.pth").write_text(f"import site; site.addsitedir({sysconfig.get_paths()['purelib']!r})\n")
    program = folder / "bin" / "tacpipe"
    program.write_text(
        f"#!{folder}/bin/python\nfrom tacpipe.cli.main import main\n\nif __name__ == '__main__':\n    main()\n"
    )
    program.chmod(0o755)
    return folder / "bin"


class Project:
    """A folder with an environment in which the packages of some pages are installed."""

    def __init__(self, folder: Path, pages: Sequence[Path]) -> None:
        self.programs = make_environment(folder / "environment")
        self.folder = folder / "project"
        self.folder.mkdir()
        clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "TACPIPE_STORE")}
        path = f"{self.programs}{os.pathsep}{os.environ['PATH']}"
        self.variables = {**clean, "PATH": path, "OMP_NUM_THREADS": "1"}
        packages = [str(write_package(page, folder / "packages")) for page in pages]
        pip = [sys.executable, "-m", "pip", "--python", str(self.programs / "python"), "install", *QUIET]
        self.run([*pip, *packages], "pip install")

    def run(self, words: Sequence[str], description: str) -> list[str]:
        """Run a program, which must succeed, and return the lines that it prints."""
        ran = subprocess.run(words, cwd=self.folder, env=self.variables, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, f"{description}: {ran.stderr}"
        return [line for line in (ran.stderr + ran.stdout).splitlines() if line]

    def tacpipe(self, command: str) -> list[str]:
        """Run ``tacpipe`` with a command."""
        return self.run([str(self.programs / "tacpipe"), *shlex.split(command)], command)

    def record(self, command: str) -> list[str]:
        """Run ``tacpipe`` with a command that records, with limits that suit a busy computer."""
        self.variables["PYTHONPATH"] = str(docs.ROOT)
        words = [str(self.programs / "python"), "-m", "tests.recording.patient", *shlex.split(command)]
        return self.run(words, command)

    def record_until(self, enough: Callable[[], bool], command: str) -> None:
        """Run ``tacpipe`` with a command that records until it is interrupted, as soon as there is enough."""
        words = [str(self.programs / "python"), "-m", "tests.recording.patient", *shlex.split(command)]
        with subprocess.Popen(words, cwd=self.folder, env=self.variables, stderr=subprocess.PIPE, text=True) as process:
            while process.poll() is None and not enough():
                time.sleep(0.05)
            process.send_signal(signal.SIGINT)
            assert process.stderr is not None
            errors = process.stderr.read()
        assert process.returncode == 0, f"{command}: {errors}"


@pytest.mark.long
@pytest.mark.minutes
@pytest.mark.timeout(3600)
def test_the_package_of_every_page_installs_and_does_what_the_page_prints(tmp_path: Path) -> None:
    """One project serves all pages: what one computed is reused on the next."""
    project = Project(tmp_path, docs.EXTENDING)
    before: set[str] = set()
    for page in docs.EXTENDING:
        commands = set()
        for block in docs.fenced_blocks(page.read_text()):
            if block.language == "python" and not block.title:
                project.run([str(project.programs / "python"), "-c", block.text], page.name)
            elif block.language == "console" and not block.mark:
                for command, lines in docs.printed_commands(block.text):
                    printed = project.tacpipe(command.removeprefix("tacpipe "))
                    docs.compare(f"{page.name}: {command}", lines, printed, rerun=command in before)
                    commands.add(command)
        before |= commands


@pytest.mark.rig
@pytest.mark.timeout(1800)
def test_a_task_of_another_package_publishes_live_what_it_predicts_from_the_recording(tmp_path: Path) -> None:
    """The task is installed as its page prints it, trained on recordings of an emulated rig, and runs live on that rig."""
    project = Project(tmp_path, [page for page in docs.EXTENDING if page.stem == "task"])
    with live.served(project.folder, live.SKIN), subscriber() as (port, messages):
        project.record("acquire rig.toml -o data/recordings --trials 3 --duration-s 2 --no-tare")
        project.tacpipe("split data/recordings -o data/split --scheme random --val 0.34 --test 0")
        project.tacpipe("train load data/recordings --split data/split -o models/trained --stream skin --ahead 3")
        project.tacpipe("calibrate models/trained data/recordings --split data/split -o models/load")
        command = f"live rig.toml --model models/load -o rec --limit 1e9 --publish udp:127.0.0.1:{port} --quiet"
        project.record_until(lambda: len(messages) > 80, command)
    project.tacpipe("evaluate models/load rec -o results/load")
    assert "coverage" in json.loads((project.folder / "results/load/metrics.json").read_text())["quantiles"]
    project.tacpipe("predict models/load rec -o predicted --causal --quantiles 10,90")
    session = live.only(project.folder)
    predicted = live.only(project.folder, "predicted").table()
    by_time = dict(zip(predicted["t_ns"].to_pylist(), predicted["ahead"].to_pylist(), strict=True))
    recorded = session.table("load")
    assert recorded.num_rows > 50 and not set(recorded["t_device_ns"].to_pylist()) - set(by_time)
    assert recorded["ahead"].to_pylist() == [by_time[t_ns] for t_ns in recorded["t_device_ns"].to_pylist()]
    published = {message["t_ns"]: message["ahead"] for message in messages if message["kind"] == "load"}
    assert published == {t_ns: by_time[t_ns] for t_ns in published} and set(published) >= set(
        recorded["t_device_ns"].to_pylist()
    )


def test_every_group_of_plug_ins_has_a_page() -> None:
    from tacpipe.plugins import registry

    text = (docs.ROOT / "docs" / "extending" / "index.md").read_text()
    without_page = {registry.COMMANDS}  # the order of commands is a part of a package
    assert {group for group in registry.GROUPS if f"`{group}`" not in text} == without_page
    assert {page.name for page in docs.EXTENDING} == {
        page.name for page in (docs.ROOT / "docs" / "extending").glob("*.md") if page.name != "index.md"
    }
