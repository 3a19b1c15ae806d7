"""Completion by the shell: asked through the variables that typer's scripts set, fast, and light."""

from __future__ import annotations

from pathlib import Path

import pytest

from tacpipe.cli import commands
from tacpipe.plugins import registry
from tests.conftest import run_python, tacpipe

HEAVY = {"torch", "pyarrow", "pandas", "sklearn", "open3d", "numpy", "scipy", "matplotlib"}
PROBE = """
import sys
from tacpipe.cli import main as cli
sys.argv = ["tacpipe"]
try:
    cli.main()
except SystemExit:
    pass
print("IMPORTED", *sorted({name.partition(".")[0] for name in sys.modules}))
"""


def completion_variables(shell: str, line: str) -> dict[str, str]:
    """Return what a shell's script sets when TAB is pressed behind ``line``."""
    variables = {"_TACPIPE_COMPLETE": f"complete_{shell}"}
    if shell == "bash":
        return variables | {"COMP_WORDS": line, "COMP_CWORD": str(len(line.split()) - (not line.endswith(" ")))}
    return variables | {"_TYPER_COMPLETE_ARGS": line, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}


def complete(folder: Path, shell: str, line: str) -> set[str]:
    process = tacpipe(folder, "", **completion_variables(shell, line))
    assert "Traceback" not in process.stderr
    return {word.partition("\t")[0].strip('(")*:') for word in process.stdout.replace('":"', "\t").split("\n")}


@pytest.mark.parametrize("shell", ["bash", *(pytest.param(name, marks=pytest.mark.long) for name in ("zsh", "fish"))])
def test_commands_methods_and_options_are_completed_in_every_shell(tmp_path: Path, shell: str) -> None:
    names = {name.partition(".")[0] for name in registry.stages()} | set(commands.NAMES)
    words = complete(tmp_path, shell, "tacpipe ")
    assert {name for name in names if any(word.endswith(name) for word in words)} == names
    assert any("material" in word for word in complete(tmp_path, shell, "tacpipe train m"))
    options = complete(tmp_path, shell, "tacpipe split --s")
    for option in ("--seed", "--scheme", "--set", "--skip-bad"):
        assert any(word.endswith(option) for word in options)


def test_a_group_of_commands_completes_its_verbs(tmp_path: Path) -> None:
    assert complete(tmp_path, "bash", "tacpipe store p") - {""} == {"push", "pull"}


@pytest.mark.parametrize("line", ["tacpipe ", "tacpipe train forward --", "tacpipe synchronize --r"])
def test_completion_imports_nothing_heavy(tmp_path: Path, line: str) -> None:
    process = run_python(tmp_path, "-c", PROBE, environment=completion_variables("bash", line), check=True)
    printed, _, imported = process.stdout.partition("IMPORTED ")
    assert printed.strip()
    assert set(imported.split()) & HEAVY == set()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_for_a_shell_asks_tacpipe(tmp_path: Path, shell: str) -> None:
    process = tacpipe(tmp_path, "", _TACPIPE_COMPLETE=f"source_{shell}")
    assert f"_TACPIPE_COMPLETE=complete_{shell}" in process.stdout
