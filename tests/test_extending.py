"""The packages that the pages of docs/extending print are installed into a fresh environment, and used there as printed."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from tests import test_docs as docs

TITLED = (".py", ".toml")


def packages(folder: Path) -> list[Path]:
    """Write the package of each page below ``folder``, and return their folders."""
    folders = []
    for page in docs.EXTENDING:
        place = folder / page.stem
        place.mkdir(parents=True)
        for block in docs.fenced_blocks(page.read_text()):
            if block.title:
                (place / block.title).write_text(block.text)
        assert (place / "pyproject.toml").exists(), page
        folders.append(place)
    return folders


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


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_the_package_of_every_page_installs_and_does_what_the_page_prints(tmp_path: Path) -> None:
    """One project serves all pages: what one computed is reused on the next."""
    programs = make_environment(tmp_path / "environment")
    project = tmp_path / "project"
    project.mkdir()
    clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "TACPIPE_STORE")}
    around = {**clean, "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}

    def run_program(words: list[str], label: str) -> list[str]:
        ran = subprocess.run(words, cwd=project, env=around, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, f"{label}: {ran.stderr}"
        return [line for line in (ran.stderr + ran.stdout).splitlines() if line]

    quiet = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    pip = [sys.executable, "-m", "pip", "--python", str(programs / "python"), "install", *quiet]
    run_program([*pip, *map(str, packages(tmp_path / "packages"))], "pip install")

    before: set[str] = set()
    for page in docs.EXTENDING:
        page_commands = set()
        for block in docs.fenced_blocks(page.read_text()):
            if block.language == "python" and not block.title:
                run_program([str(programs / "python"), "-c", block.text], page.name)
            elif block.language == "console":
                for command, lines in docs.printed_commands(block.text):
                    printed_lines = run_program(
                        [str(programs / "tacpipe"), *shlex.split(command)[1:]], f"{page.name}: {command}"
                    )
                    docs.compare(f"{page.name}: {command}", lines, printed_lines, rerun=command in before)
                    page_commands.add(command)
        before |= page_commands


def test_every_group_of_plug_ins_has_a_page() -> None:
    from tacpipe.plugins import registry

    text = (docs.ROOT / "docs" / "extending" / "index.md").read_text()
    without_page = {registry.COMMANDS}  # the order of commands is a part of a package
    assert {group for group in registry.GROUPS if f"`{group}`" not in text} == without_page
    assert {page.name for page in docs.EXTENDING} == {
        page.name for page in (docs.ROOT / "docs" / "extending").glob("*.md") if page.name != "index.md"
    }
