"""What the texts and the help say is true: commands run as printed, paths exist, examples parse."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tacpipe.cli import commands, main
from tacpipe.plugins import registry
from tests.conftest import Lab, tacpipe

ROOT = Path(__file__).parents[1]
BUILT_IN = sorted(
    name for name, target in registry.stages().items() if target.startswith(("tacpipe.", "tacpipe_stages."))
)
SENSORS = ("list", "probe", "emulate")
STORE = ("status", "verify", "repair", "gc", "link", "push", "pull")
COMMANDS = [
    *(name.replace(".", " ") for name in BUILT_IN),
    *(name for name in commands.NAMES if name not in ("sensors", "store")),
    *(f"sensors {name}" for name in SENSORS),
    *(f"store {name}" for name in STORE),
]


def blocks(text: str, language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    found: list[str] = re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    return found


def section(text: str, title: str) -> str:
    """Return the text below a heading of the second level."""
    return text.split(f"\n## {title}\n")[1].split("\n## ")[0]


MORE = "…"  # in the README, for lines that a command prints besides


def printed(block: str) -> list[tuple[str, list[str]]]:
    """Return the commands of a console block, each with the lines that are printed below it."""
    found: list[tuple[str, list[str]]] = []
    for line in block.splitlines():
        if line.startswith("$ "):
            found.append((line.removeprefix("$ "), []))
        else:
            found[-1][1].append(line)
    return found


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_every_command_ends_in_an_example_that_parses(command: str, lab: Lab) -> None:
    told = lab.run(f"{command} --help").out
    example = " ".join(told.split("Example: ")[1].split("\n\n")[0].split())
    words = shlex.split(example)

    assert words[0] == "tacpipe"
    assert words[1 : 1 + len(command.split())] == command.split()
    lab.run(shlex.join([*words[1:], "--help"]))  # an option or command that does not exist is refused


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_stage_has_a_summary_that_is_a_sentence(name: str) -> None:
    told = registry.summary(name)

    assert re.fullmatch(r"[A-Z].{8,}\.", told)
    assert len(told) <= 120


def test_every_other_command_and_group_has_a_summary_that_is_a_sentence() -> None:
    told = {**main.SUMMARIES, **commands.SUMMARIES}

    assert set(commands.NAMES) <= set(commands.SUMMARIES)
    assert {name.partition(".")[0] for name in BUILT_IN if "." in name} <= set(told)
    assert not [name for name, text in told.items() if not re.fullmatch(r"[A-Z].+\.", text)]


@pytest.mark.long
def test_the_commands_of_the_readme_print_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "README.md").read_text()
    sixty, own = section(text, "Sixty seconds on simulated recordings"), section(text, "Your own stage")
    (tmp_path / "own.egg-info").mkdir()
    (entry_points,) = blocks(own, "toml")
    points = entry_points.replace('[project.entry-points."tacpipe.stages"]', "[tacpipe.stages]").replace('"', "")
    (tmp_path / "own.egg-info" / "entry_points.txt").write_text(points)
    (code,) = blocks(own, "python")
    (tmp_path / "moving_stages.py").write_text(code)
    environment = {"PYTHONPATH": str(tmp_path), "TACPIPE_STORE": str(tmp_path / "store"), "OMP_NUM_THREADS": "1"}
    given = [command for block in blocks(sixty + own, "console") for command in printed(block)]
    assert len(given) >= 12

    for command, lines in given:
        ran = tacpipe(tmp_path, command.removeprefix("tacpipe "), **environment)
        assert ran.returncode == 0, f"{command}: {ran.stderr}"
        shown = [line for line in (ran.stderr + ran.stdout).splitlines() if line]
        seconds = re.compile(r"\d+\.\d s$")
        wanted = [seconds.sub("", line) for line in lines]
        found = [seconds.sub("", line) for line in shown]
        if MORE in wanted:  # lines whose numbers are another machine's
            at = wanted.index(MORE)
            after = len(wanted) - at - 1
            assert len(found) > len(wanted), command
            found = [*found[:at], MORE, *found[len(found) - after :]]
        assert found == wanted, command

    (python,) = blocks(sixty, "python")
    done = subprocess.run([sys.executable, "-c", python], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "trial-011" in done.stdout

    for page in sorted((ROOT / "docs" / "tasks").glob("*.md")):  # whose models and datasets are those of the README
        (python,) = blocks(page.read_text(), "python")
        done = subprocess.run([sys.executable, "-c", python], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{page.name}: {done.stderr}"


def test_the_commands_in_the_tasks_and_data_pages_exist(lab: Lab) -> None:
    pages = [*sorted((ROOT / "docs" / "tasks").glob("*.md")), ROOT / "data" / "README.md", ROOT / "README.md"]
    found = []
    for page in pages:
        text = page.read_text()
        lines = [line.split("#")[0] for block in blocks(text, "sh") for line in block.splitlines()]
        found += [line for line in lines if line.startswith("tacpipe ")] + re.findall(r"`(tacpipe [^`]+)`", text)
    assert len(found) >= 20

    for command in found:
        words = shlex.split(command.replace("...", ""))
        lab.run(shlex.join([*words[1:], *([] if "--help" in words else ["--help"])]))


def test_the_file_tree_of_the_readme_names_what_is_there_and_every_package() -> None:
    (tree,) = blocks(section((ROOT / "README.md").read_text(), "What lies where"), "text")
    named = {path for line in tree.splitlines() for path in re.split(r", ", re.split(r"\s{2,}", line)[0])}
    packages = {f"tacpipe/{path.parent.name}/" for path in (ROOT / "tacpipe").glob("*/__init__.py")}

    assert not [path for path in named if not (ROOT / path).exists()]
    assert packages <= named


def test_the_targets_that_the_texts_name_are_in_the_makefile() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    named = {name for page in pages for name in re.findall(r"(?:^|`)make ([a-z-]+)", page.read_text(), re.MULTILINE)}

    assert {"demo", "test", "lint", "types", "bench"} <= named
    assert named <= targets


def test_the_install_commands_of_the_texts_work_without_a_package_index() -> None:
    about = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wheel = f"./{about['name']}-{about['version']}-py3-none-any.whl"
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), ROOT / "data" / "README.md"]
    found = [
        words
        for page in pages
        for line in re.findall(r"(?:^|`)(pip (?:install|wheel) [^`#\n]+)", page.read_text(), re.MULTILINE)
        for words in [shlex.split(line)]
    ]
    assert len(found) >= 6

    for words in found:
        if words[1] == "wheel":
            assert words == ["pip", "wheel", "--no-deps", "-w", "dist", "."]
            continue
        source, _, extras = words[-1].rstrip("]").partition("[")
        assert source in (".", wheel), " ".join(words)  # a name alone is looked up in an index
        assert set(extras.split(",")) - {""} <= set(about["optional-dependencies"])


def test_what_runs_where_is_told_as_it_is() -> None:
    text, make, ran = ((ROOT / name).read_text() for name in ("CONTRIBUTING.md", "Makefile", ".ci/run"))
    (targets,) = re.findall(r"^for target in (.+); do$", ran, re.MULTILINE)
    first = text.split("\n\n")[1]

    for words in shlex.split(targets):
        target, _, options = words.partition(" ")
        assert f"{target}:" in make and f"make {target}" in first
        assert f"`make {target}{options and ' ' + options}`" in text
    for marker in ("long", "rig", "faults"):
        assert (
            f"`{marker}`" in section(text, "Tests") and f"make test-{marker}" in (ROOT / "pyproject.toml").read_text()
        )


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_says_in_one_sentence_that_python_is_missing(tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    for name in ("bash", "make", "touch"):
        (tmp_path / "bin" / name).symlink_to(str(shutil.which(name)))
    done = subprocess.run(
        ["make", "-C", str(ROOT), f"VENV={tmp_path / 'venv'}", "SHELL=bash", str(tmp_path / "venv" / ".python")],
        env={"PATH": str(tmp_path / "bin")},
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode != 0
    assert "Python 3.11 or newer is missing" in done.stderr
    assert not (tmp_path / "venv").exists()
