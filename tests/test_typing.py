"""Stages under type checkers: those that the texts print pass as printed, and a call with wrong arguments does not."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_docs import blocks

ROOT = Path(__file__).parents[1]
STAGE = """
from dataclasses import dataclass

from tacpipe import Dataset, Recording, RecordingOutput, Result, Stage, stage


@dataclass(frozen=True)
class Params:
    factor: int = 2


@stage(version=1)
def scale(params: Params, recording: Recording) -> RecordingOutput:
    return RecordingOutput({})


@stage(version=1)
def total(params: Params, recordings: Dataset) -> Result:
    return Result()


def good(params: Params, recording: Recording, recordings: Dataset) -> dict[str, bytes]:
    kept: Stage[[Params, Dataset], Result] = total
    names: list[str] = [one.name for one in recordings.select(object="cup")]
    made: RecordingOutput = scale(params, recording=recordings[names[0]])
    return dict(kept(params, recordings).files) if made.notes else {}
"""
WRONG = {
    "scale(Params(), 3)": "arg-type",
    "scale(Params())": "call-arg",
    "scale(Params(), recording, 1)": "call-arg",
    "scale({'factor': 2}, recording)": "arg-type",
    "total(Params(), recording)": "arg-type",
    "scale(Params(), record=recording)": "call-arg",
    "scale(Params(), recording).files": "attr-defined",
}


TITLED = re.compile(r'^```python title="([^"]+)"\n(.*?)^```$', re.DOTALL | re.MULTILINE)
CONFIG = """
[mypy]
[mypy-tacpipe.*]
follow_imports = silent
[mypy-torch.*,pandas.*,polars.*,duckdb.*,pyarrow.*]
follow_imports = skip
ignore_missing_imports = True
"""


def run_mypy(folder: Path, *files: Path) -> subprocess.CompletedProcess[str]:
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--no-error-summary",
        "--config-file",
        str(folder / "mypy.ini"),
    ]
    (folder / "mypy.ini").write_text(CONFIG)
    cache = ["--cache-dir", str(ROOT / ".mypy_cache" / "texts")]
    environment = {**os.environ, "MYPYPATH": str(ROOT)}  # mypy needs the path of an editable install.
    arguments = [*command, *cache, *map(str, files)]
    return subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def printed_stages() -> dict[str, str]:
    """Return every stage that a text prints, by the name of a module: that of its title, if it has one."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    stage_blocks = [
        (page.stem, code) for page in pages for code in blocks(page.read_text(), "python") if "@stage(" in code
    ]
    titles = {code: name.removesuffix(".py") for page in pages for name, code in TITLED.findall(page.read_text())}
    names = (
        titles.get(code, f"{re.sub(r'[^a-z]', '_', stem.lower())}_{place}")
        for place, (stem, code) in enumerate(stage_blocks)
    )
    return dict(zip(names, (code for _, code in stage_blocks), strict=True))


@pytest.mark.long
def test_mypy_refuses_a_stage_called_with_wrong_arguments_and_accepts_the_right_ones(tmp_path: Path) -> None:
    (tmp_path / "good.py").write_text(STAGE)
    for place, call in enumerate(WRONG):
        text = f"{STAGE}\n\ndef bad(recording: Recording) -> None:\n    {call}\n"
        (tmp_path / f"wrong{place}.py").write_text(text)
    ran = run_mypy(tmp_path, *sorted(tmp_path.glob("*.py")))
    errors = [line for line in ran.stdout.splitlines() if "error:" in line]
    for place, kind in enumerate(WRONG.values()):
        (line,) = (error for error in errors if error.startswith(f"wrong{place}.py"))
        assert f"[{kind}]" in line
    assert len(errors) == len(WRONG), ran.stdout  # good.py has no error.


def imported_modules() -> dict[str, str]:
    """Return the modules that stages of the texts import from the same page, by the name of the file."""
    modules: dict[str, str] = {}
    for page in sorted((ROOT / "docs" / "extending").glob("*.md")):
        text = page.read_text()
        if any("@stage(" in code for code in blocks(text, "python")):
            modules |= {name: code for name, code in TITLED.findall(text) if "@stage(" not in code}
    return modules


@pytest.mark.long
def test_the_stages_of_the_texts_pass_mypy_strict_as_printed(tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.py" for name in printed_stages()]
    for file, code in zip(files, printed_stages().values(), strict=True):
        file.write_text(code)
    for name, code in imported_modules().items():
        (tmp_path / name).write_text(code)
    ran = run_mypy(tmp_path, *files)
    assert files and ran.stdout == "" and ran.returncode == 0


def test_the_stages_of_the_texts_pass_ruff_as_printed_with_the_rules_of_the_project() -> None:
    stages = printed_stages()
    assert stages
    for name, code in stages.items():
        for arguments in (["check"], ["format", "--check"]):
            command = [
                sys.executable,
                "-m",
                "ruff",
                *arguments,
                "--stdin-filename",
                str(ROOT / "stages" / f"{name}.py"),
                "-",
            ]
            ran = subprocess.run(command, input=code, capture_output=True, text=True, check=False)
            assert ran.returncode == 0, f"{name}: {ran.stdout}{ran.stderr}"
